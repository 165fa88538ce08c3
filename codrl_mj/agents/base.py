"""Base classes of the agents' settings."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from gymnasium import spaces

from codrl_mj.boundary import Json, JsonObject
from codrl_mj.envs.config import Space
from codrl_mj.fields import Checked, check_memory, check_names, positive_reals

# torch takes seconds to import, which is too long for callers that only need settings.
Tensor = Any
"""A `torch.Tensor`."""


class TrainingEnvs(Protocol):
    """Environments of a training; Stable-Baselines3's `VecEnv` follows the protocol."""

    num_envs: int
    """Number of environments."""
    observation_space: Space
    """Observation space of each environment."""
    action_space: Space
    """Action space of each environment."""


class AgentPolicy(Protocol):
    """Policy of an agent; Stable-Baselines3's `BasePolicy` follows the protocol."""

    observation_space: Space
    """Observation space of the training."""
    action_space: Space
    """Action space of the training."""

    def predict(
        self, observation: np.ndarray, *, deterministic: bool = False
    ) -> tuple[np.ndarray, object]:
        """Return actions (N, ...) for observations (N, k), and a state, which callers ignore."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the weights by name."""

    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> object:
        """Replace the weights."""

    def set_training_mode(self, mode: bool) -> None:
        """Set modules to training or to evaluation."""


class AgentModel(Protocol):
    """An agent that learns; Stable-Baselines3's `BaseAlgorithm` follows the protocol."""

    policy: AgentPolicy
    """The agent's policy, which changes while the agent learns."""

    def set_logger(self, logger: object) -> None:
        """Replace the logger, a Stable-Baselines3 `Logger`."""

    def learn(
        self, total_timesteps: int, callback: object = None, log_interval: int | None = None
    ) -> object:
        """Learn for a number of environment steps; callbacks are those of Stable-Baselines3."""


@dataclasses.dataclass(frozen=True)
class AgentConfig(Checked):
    """Settings of an agent, and its construction from them; subclasses add the fields.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    name: ClassVar[str]
    """Name on the command line, such as `ppo`."""
    action_spaces: ClassVar[tuple[type[Space], ...]]
    """Classes of action spaces in which the agent can act."""

    def __post_init__(self) -> None:
        """Convert lists, as read from JSON and YAML, to tuples, and validate the fields."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))
        super().__post_init__()

    def make_model(self, env: TrainingEnvs, seed: int) -> AgentModel:
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

    def make_policy(self, observation_space: spaces.Box, action_space: Space) -> AgentPolicy:
        """Create a policy with initial weights, into which saved weights can be loaded.

        Returns:
            A Stable-Baselines3 `BasePolicy` on the CPU, whose `state_dict` has the same keys as the
            policy of the agent.
        """
        raise NotImplementedError

    def as_mapping(self) -> JsonObject:
        """Return the settings as JSON-serializable values, with `registry_name` as `name`."""
        return {"name": self.registry_name(), **dataclasses.asdict(self)}

    @classmethod
    def registry_name(cls) -> str:
        """Return the agent's name for `find_agent`: `module:Class` for a custom agent."""
        is_built_in = cls.__module__.startswith("codrl_mj.")
        return cls.name if is_built_in else f"{cls.__module__}:{cls.__qualname__}"

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Json]) -> "AgentConfig":
        """Return settings from the result of `as_mapping` without `name`.

        Missing fields have their defaults.

        Raises:
            ValueError: a field is unknown or out of bounds.
        """
        check_names(mapping, (field.name for field in dataclasses.fields(cls)), "key", "agent.")
        return cls(**mapping)


def check_buffer(name: str, steps: int, env: TrainingEnvs, observations: int) -> None:
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

    def make_policy(self, observation_space: spaces.Box, action_space: Space) -> AgentPolicy:
        """See `AgentConfig.make_policy`."""
        # A policy for evaluation needs no optimizer. Constructing the first one makes torch import
        # a compiler, which takes almost two seconds.
        arguments = {**self._policy_arguments(), "optimizer_class": lambda *_, **__: None}
        return self._policy_class()(observation_space, action_space, lambda _: 0.0, **arguments)

    def _policy_class(self) -> Callable[..., AgentPolicy]:
        """Return the class of the agent's policy."""
        raise NotImplementedError

    def _policy_arguments(self) -> dict[str, object]:
        """Return keyword arguments of the policy's class, without spaces and learning rate."""
        if self.input_scale is None:
            return {}
        from codrl_mj.agents.models import ScaledObservation

        return {
            "features_extractor_class": ScaledObservation,
            "features_extractor_kwargs": {"factors": self.input_scale},
        }
