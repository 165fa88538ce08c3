"""TD3: twin delayed DDPG, on Stable-Baselines3."""

import dataclasses
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.agents.off_policy import ActorCriticConfig
from codrl_mj.fields import integer, real, units


@dataclasses.dataclass(frozen=True)
class TD3Config(ActorCriticConfig):
    """Twin delayed DDPG (Fujimoto et al., 2018), on Stable-Baselines3. The paper does not use it."""

    name: ClassVar[str] = "td3"
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Box,)

    noise_sigma: float = real(0.1, least=0)
    """Scale sigma of the exploration noise, >= 0, in shares of half the action's range; 0: none."""
    hidden: tuple[int, ...] = units((64, 64))
    """Units of the hidden layers of the actor and of each critic (ReLU)."""
    policy_delay: int = integer(2, least=1)
    """Critic updates for each update of the actor and the targets, >= 1."""
    target_noise: float = real(0.2, least=0)
    """Standard deviation of the noise on the target actions, >= 0, in shares of half the action's range; clipped at 2.5
    times that."""

    def make_model(self, env: Any, seed: int) -> Any:
        """See `AgentConfig.make_model`."""
        from codrl_mj.agents.off_policy_models import TwoRateTD3

        return TwoRateTD3(
            **self._model_arguments(env, seed),
            policy_delay=self.policy_delay,
            target_policy_noise=self.target_noise,
            target_noise_clip=2.5 * self.target_noise,
        )

    def _policy_class(self) -> Any:
        from stable_baselines3.td3.policies import TD3Policy

        return TD3Policy

    def _policy_arguments(self) -> dict[str, Any]:
        return {"net_arch": list(self.hidden), **super()._policy_arguments()}
