"""DDPG: deep deterministic policy gradient, with the paper's critic of two streams."""

import dataclasses
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.agents.off_policy import ActorCriticConfig
from codrl_mj.fields import real, units


@dataclasses.dataclass(frozen=True)
class DDPGConfig(ActorCriticConfig):
    """Deep deterministic policy gradient, on Stable-Baselines3, with the paper's critic.

    State and action each pass through layers of their own; then they are joined. Every hidden layer has a ReLU; the
    actor ends in tanh, times half the action's range.
    """

    name: ClassVar[str] = "ddpg"
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Box,)

    noise_sigma: float = real(0.2, least=0)
    """Scale sigma of the exploration noise, >= 0, in shares of half the action's range; 0: none."""
    actor_units: tuple[int, ...] = units((64, 64))
    """Units of the actor's hidden layers. The paper: 64-64."""
    state_units: tuple[int, ...] = units((16, 32))
    """Units of the critic's layers for the state alone; () lets it through. The paper: 1 (pendulum), 64 (car)."""
    action_units: tuple[int, ...] = units((32,))
    """Units of the critic's layers for the action alone; () lets it through. The paper: 32 (pendulum), () (car)."""
    joint_units: tuple[int, ...] = units((256, 256))
    """Units of the critic's hidden layers after both are joined. The paper: 256-256 (pendulum), 64 (car)."""

    def make_model(self, env: Any, seed: int) -> Any:
        """See `AgentConfig.make_model`."""
        from codrl_mj.agents.off_policy_models import TwoRateDDPG

        return TwoRateDDPG(**self._model_arguments(env, seed))

    def _policy_class(self) -> Any:
        from codrl_mj.agents.networks import TwoStreamPolicy

        return TwoStreamPolicy

    def _policy_arguments(self) -> dict[str, Any]:
        return {
            "net_arch": list(self.actor_units),
            "n_critics": 1,
            "state_units": self.state_units,
            "action_units": self.action_units,
            "joint_units": self.joint_units,
            **super()._policy_arguments(),
        }
