"""DQN: deep Q-learning, on Stable-Baselines3."""

import dataclasses
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.agents.off_policy import OffPolicyConfig
from codrl_mj.fields import integer, real, units


@dataclasses.dataclass(frozen=True)
class DQNConfig(OffPolicyConfig):
    """Deep Q-learning with a target network, on Stable-Baselines3 (Huber loss, gradients clipped to norm 10)."""

    name: ClassVar[str] = "dqn"
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Discrete,)

    hidden: tuple[int, ...] = units((64, 128))
    """Units of the hidden layers (ReLU). The paper: 64-128."""
    target_every: int = integer(1, least=1)
    """Environment steps between two updates of the target network, >= 1."""
    exploration_start: float = real(1.0, least=0, most=1)
    """Probability epsilon of a random action at the start, in [0, 1]."""
    exploration_end: float = real(0.01, least=0, most=1)
    """Smallest epsilon, in [0, 1]."""
    exploration_decay: float | None = real(0.99, above=0, most=1, optional=True)
    """Factor on epsilon with every episode, in (0, 1]; None: it falls linearly over `exploration_fraction`."""
    exploration_fraction: float = real(0.2, above=0, most=1)
    """Share of all steps over which epsilon falls linearly, in (0, 1], if `exploration_decay` is None."""

    def make_model(self, env: Any, seed: int) -> Any:
        """See `AgentConfig.make_model`."""
        from stable_baselines3 import DQN

        from codrl_mj.agents.off_policy_models import EpisodicDQN

        arguments = {
            **self._model_arguments(env, seed),
            "target_update_interval": self.target_every,
            "exploration_initial_eps": self.exploration_start,
            "exploration_final_eps": self.exploration_end,
            "exploration_fraction": self.exploration_fraction,
        }
        if self.exploration_decay is None:
            return DQN(**arguments)
        return EpisodicDQN(**arguments, exploration_decay=self.exploration_decay)

    def _policy_class(self) -> Any:
        from stable_baselines3.dqn.policies import DQNPolicy

        return DQNPolicy

    def _policy_arguments(self) -> dict[str, Any]:
        return {"net_arch": list(self.hidden), **super()._policy_arguments()}
