"""SAC: soft actor-critic, on Stable-Baselines3."""

import dataclasses
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.agents.off_policy import ActorCriticConfig
from codrl_mj.fields import flag, real, units


@dataclasses.dataclass(frozen=True)
class SACConfig(ActorCriticConfig):
    """Soft actor-critic (Haarnoja et al., 2018), on Stable-Baselines3. The paper does not use it."""

    name: ClassVar[str] = "sac"
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Box,)

    hidden: tuple[int, ...] = units((64, 64))
    """Units of the hidden layers of the actor and of each critic (ReLU)."""
    entropy_coefficient: float | None = real(None, least=0)
    """Weight of the entropy, >= 0; None: learned, so that the entropy per action entry is -1 nat."""
    state_dependent_noise: bool = flag(False)
    """Explore by noise that is a function of the state, drawn anew at every training (Raffin et al., 2021)."""
    log_std_init: float = real(-3.0)
    """State-dependent noise: natural logarithm of its standard deviation at the start."""

    def make_model(self, env: Any, seed: int) -> Any:
        """See `AgentConfig.make_model`."""
        from codrl_mj.agents.off_policy_models import TwoRateSAC

        return TwoRateSAC(
            **self._model_arguments(env, seed),
            ent_coef="auto" if self.entropy_coefficient is None else self.entropy_coefficient,
            use_sde=self.state_dependent_noise,
        )

    def _policy_class(self) -> Any:
        from stable_baselines3.sac.policies import SACPolicy

        return SACPolicy

    def _policy_arguments(self) -> dict[str, Any]:
        return {
            "net_arch": list(self.hidden),
            "use_sde": self.state_dependent_noise,
            "log_std_init": self.log_std_init,
            **super()._policy_arguments(),
        }
