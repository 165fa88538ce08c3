"""What every agent's settings have in common."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.fields import Checked, check_memory, check_names, positive_reals


@dataclasses.dataclass(frozen=True)
class AgentConfig(Checked):
    """Settings of an agent, and how to make it from them. Subclasses add the fields.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    name: ClassVar[str]
    """Name on the command line, such as `ppo`."""
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]]
    """Kinds of action spaces that the agent can act in."""

    def __post_init__(self) -> None:
        """Turn lists, which JSON and YAML have, into tuples, and validate."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
        super().__post_init__()

    def make_model(self, env: Any, seed: int) -> Any:
        """The agent, ready to learn.

        Args:
            env: a Stable-Baselines3 `VecEnv`.
            seed: of weights, minibatches and actions.

        Returns:
            A Stable-Baselines3 `BaseAlgorithm` on the CPU.

        Raises:
            ValueError: the settings do not go with the environments.
        """
        raise NotImplementedError

    def make_policy(self, observation_space: spaces.Box, action_space: spaces.Space[Any]) -> Any:
        """The policy of such an agent with fresh weights: what its saved weights are loaded into.

        Returns:
            A Stable-Baselines3 `BasePolicy` on the CPU, whose `state_dict` has the keys of the
            agent's own.
        """
        raise NotImplementedError

    def as_mapping(self) -> dict[str, Any]:
        """The settings as JSON-serialisable values, with the `name` that `find_agent` finds the agent by."""
        return {"name": self.known_as(), **dataclasses.asdict(self)}

    @classmethod
    def known_as(cls) -> str:
        """The name that `codrl_mj.agents.find_agent` finds the agent by: `module:Class` if it is not one of ours."""
        ours = cls.__module__.startswith("codrl_mj.")
        return cls.name if ours else f"{cls.__module__}:{cls.__qualname__}"

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> "AgentConfig":
        """The settings that `as_mapping` described, `name` left out; missing fields keep their defaults.

        Raises:
            ValueError: a field is unknown or out of bounds.
        """
        check_names(mapping, (field.name for field in dataclasses.fields(cls)), "key", "agent.")
        return cls(**mapping)


def check_buffer(name: str, steps: int, env: Any, observations: int) -> None:
    """Refuse a buffer of steps, each with one or two observations, that memory does not hold; `name` is its field's."""
    numbers = observations * spaces.flatdim(env.observation_space) + spaces.flatdim(
        env.action_space
    )
    check_memory(4.0 * numbers * steps, f"{name} = {steps:,}", "lower it")


@dataclasses.dataclass(frozen=True)
class DeepAgentConfig(AgentConfig):
    """Settings of an agent with networks, on Stable-Baselines3."""

    input_scale: tuple[float, ...] | None = positive_reals()
    """Fixed factors > 0 on the observation's entries before they enter a network, in their order;
    entries without one stay as they are. Velocities of the mountain cars are below 0.07, too small
    for a network to notice.
    """

    def make_policy(self, observation_space: spaces.Box, action_space: spaces.Space[Any]) -> Any:
        """See `AgentConfig.make_policy`."""
        # no optimiser: torch's first takes almost two seconds to import a compiler
        arguments = {**self._policy_arguments(), "optimizer_class": lambda *_, **__: None}
        return self._policy_class()(observation_space, action_space, lambda _: 0.0, **arguments)

    def _policy_class(self) -> Any:
        """The class of the agent's policy."""
        raise NotImplementedError

    def _policy_arguments(self) -> dict[str, Any]:
        """Keyword arguments of that class, besides spaces and learning rate."""
        if self.input_scale is None:
            return {}
        from codrl_mj.agents.models import ScaledObservation

        return {
            "features_extractor_class": ScaledObservation,
            "features_extractor_kwargs": {"factors": self.input_scale},
        }
