"""A custom agent: Stable-Baselines3's A2C with the settings that `train` accepts."""

import dataclasses
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.agents import DeepAgentConfig
from codrl_mj.fields import integer, real


@dataclasses.dataclass(frozen=True)
class A2CConfig(DeepAgentConfig):
    """Advantage actor-critic."""

    name: ClassVar[str] = "a2c"
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Box, spaces.Discrete)

    learning_rate: float = real(7e-4, above=0)
    """Step size of RMSProp, > 0."""
    rollout_steps: int = integer(8, minimum=1)
    """Steps of each environment between two updates, >= 1."""

    def make_model(self, env: Any, seed: int) -> Any:
        """See `AgentConfig.make_model`."""
        from stable_baselines3 import A2C

        return A2C(
            "MlpPolicy", env, self.learning_rate, self.rollout_steps, seed=seed, device="cpu"
        )

    def _policy_class(self) -> Any:
        from stable_baselines3.common.policies import ActorCriticPolicy

        return ActorCriticPolicy
