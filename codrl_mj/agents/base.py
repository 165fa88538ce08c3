"""Base classes of the agents' settings."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from gymnasium import spaces

from codrl_mj.fields import Checked, check_memory, check_names, positive_reals


@dataclasses.dataclass(frozen=True)
class AgentConfig(Checked):
    """Settings of an agent, and its construction from them; subclasses add the fields.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    name: ClassVar[str]
    """Name on the command line, such as `ppo`."""
    action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]]
    """Classes of action spaces in which the agent can act."""

    def __post_init__(self) -> None:
        """Convert lists, as read from JSON and YAML, to tuples, and validate the fields."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
        super().__post_init__()

    def make_model(self, env: Any, seed: int) -> Any:
        """Create the agent.

        Args:
            env: a Stable-Baselines3 `VecEnv`.
            seed: seed of weights, minibatches and actions.

        Returns:
            A Stable-Baselines3 `BaseAlgorithm` on the CPU.

        Raises:
            ValueError: the settings do not fit the environments.
        """
        raise NotImplementedError

    def make_policy(self, observation_space: spaces.Box, action_space: spaces.Space[Any]) -> Any:
        """Create a policy with initial weights, into which saved weights can be loaded.

        Returns:
            A Stable-Baselines3 `BasePolicy` on the CPU, whose `state_dict` has the same keys as the
            policy of the agent.
        """
        raise NotImplementedError

    def as_mapping(self) -> dict[str, Any]:
        """Return the settings as JSON-serializable values, with `registry_name` as `name`."""
        return {"name": self.registry_name(), **dataclasses.asdict(self)}

    @classmethod
    def registry_name(cls) -> str:
        """Return the agent's name for `find_agent`: `module:Class` for a custom agent."""
        is_built_in = cls.__module__.startswith("codrl_mj.")
        return cls.name if is_built_in else f"{cls.__module__}:{cls.__qualname__}"

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> "AgentConfig":
        """Return settings from the result of `as_mapping` without `name`.

        Missing fields have their defaults.

        Raises:
            ValueError: a field is unknown or out of bounds.
        """
        check_names(mapping, (field.name for field in dataclasses.fields(cls)), "key", "agent.")
        return cls(**mapping)


def check_buffer(name: str, steps: int, env: Any, observations: int) -> None:
    """Raise an error if a buffer does not fit into memory.

    Args:
        name: the field that sets the buffer's size, for the message.
        steps: number of steps in the buffer.
        env: the environments.
        observations: number of observations stored for each step.
    """
    numbers = observations * spaces.flatdim(env.observation_space) + spaces.flatdim(
        env.action_space
    )
    check_memory(4.0 * numbers * steps, f"{name} = {steps:,}", "lower it")


@dataclasses.dataclass(frozen=True)
class DeepAgentConfig(AgentConfig):
    """Settings of an agent with neural networks, based on Stable-Baselines3."""

    input_scale: tuple[float, ...] | None = positive_reals()
    """Fixed factors > 0 that multiply the observation's entries before they enter a network, in
    order; further entries are not scaled. Velocities of the mountain cars are below 0.07, too small
    for a network to notice.
    """

    def make_policy(self, observation_space: spaces.Box, action_space: spaces.Space[Any]) -> Any:
        """See `AgentConfig.make_policy`."""
        # A policy for evaluation needs no optimizer. Constructing the first one makes torch import
        # a compiler, which takes almost two seconds.
        arguments = {**self._policy_arguments(), "optimizer_class": lambda *_, **__: None}
        return self._policy_class()(observation_space, action_space, lambda _: 0.0, **arguments)

    def _policy_class(self) -> Any:
        """Return the class of the agent's policy."""
        raise NotImplementedError

    def _policy_arguments(self) -> dict[str, Any]:
        """Return keyword arguments of the policy's class, without spaces and learning rate."""
        if self.input_scale is None:
            return {}
        from codrl_mj.agents.models import ScaledObservation

        return {
            "features_extractor_class": ScaledObservation,
            "features_extractor_kwargs": {"factors": self.input_scale},
        }
