"""What the agents with networks have in common."""

import dataclasses
from typing import Any

from gymnasium import spaces

from codrl_mj.agents.base import AgentConfig
from codrl_mj.fields import factors


@dataclasses.dataclass(frozen=True)
class DeepAgentConfig(AgentConfig):
    """Settings of an agent with networks, on Stable-Baselines3."""

    input_scale: tuple[float, ...] | None = factors()
    """Fixed factors > 0 on the observation's entries before they enter a network, in their order; entries without one
    stay as they are. Velocities of the mountain cars are below 0.07, too small for a network to notice."""

    def make_policy(self, observation_space: spaces.Box, action_space: spaces.Space[Any]) -> Any:
        """See `AgentConfig.make_policy`."""
        arguments = {**self._policy_arguments(), "optimizer_class": _NoOptimizer}
        return self._policy_class()(observation_space, action_space, lambda _: 0.0, **arguments)

    def _policy_class(self) -> Any:
        """The class of the agent's policy."""
        raise NotImplementedError

    def _policy_arguments(self) -> dict[str, Any]:
        """Keyword arguments of that class, besides spaces and learning rate."""
        if self.input_scale is None:
            return {}
        from codrl_mj.agents.networks import ScaledObservation

        return {
            "features_extractor_class": ScaledObservation,
            "features_extractor_kwargs": {"factors": self.input_scale},
        }


class _NoOptimizer:
    """In the place of one, in policies that only act: torch's first takes almost two seconds to import a compiler."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        """Take what an optimiser takes."""
