"""Env sources of third-party environments: Gymnasium's, those of other packages, and functions."""

import contextlib
import copy
import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import gymnasium
from gymnasium.envs.registration import EnvSpec, load_env_creator

from codrl_mj.actuators import IDEAL, ActuatorModel
from codrl_mj.boundary import Argument, Info, Options
from codrl_mj.envs.config import (
    SOURCE_KINDS,
    Env,
    EnvConfig,
    EnvSource,
    SourceKind,
    Space,
    StoredActuators,
    VecEnv,
)
from codrl_mj.envs.patterns import actuators_by_pattern
from codrl_mj.user_code import load_module

Creator = Callable[..., Env]
"""Function or class that makes an environment without motors from keyword arguments."""


BYTES_PER_ENV = 200_000
"""Memory that a third-party environment takes at least [bytes], much more than a task."""


class ExternalEnvSource(EnvSource):
    """Env source of a function or class that makes environments with a MuJoCo model.

        >>> RIG = codrl_mj.ExternalEnvSource("rig", RigEnv, time_limit=200)

    The environments must have MuJoCo's `model` and `data` as attributes, and build the model from
    XML. If the variable above is in `rig.py`, `rig:RIG` is the name of the source.
    """

    def __init__(
        self, name: str, creator: Creator, time_limit: int | None = None, reference: str = ""
    ) -> None:
        """Create a source.

        Args:
            name: name in messages.
            creator: function or class that makes an environment from options and `render_mode`.
            time_limit: maximum length of an episode [environment steps]; None for no limit.
            reference: `module:NAME` of the creator; by default that of this source.
        """
        self.name, self._creator, self.time_limit = name, creator, time_limit
        self._reference = reference

    @property
    def reference(self) -> str:
        """Name by which `find_source` finds it in any process."""
        return self._reference or super().reference

    @property
    def creator(self) -> Creator:
        """Function or class that makes an environment without motors."""
        return self._creator

    @property
    def spec(self) -> EnvSpec:
        """Specification of its environments, as in Gymnasium's registry."""
        # Gymnasium accepts few characters in an id, and not those of <lambda>.
        spec_id = re.sub(r"[^\w:.-]", "", self.name) or "environment"
        return EnvSpec(spec_id, self._creator, max_episode_steps=self.time_limit)

    def make(self, config: EnvConfig, **arguments: Argument) -> Env:
        """Make an environment with `gymnasium.make`, and with motors.

        Raises:
            ValueError: see `codrl_mj.make`.
        """
        from codrl_mj.external_envs.environments import make_with_motors

        settings = {"max_episode_steps": config.time_limit, "disable_env_checker": True}
        with self._with_name_in_errors(config):
            return make_with_motors(
                self.spec, self.creator, config, **(settings | config.options | arguments)
            )

    def make_vec(self, config: EnvConfig, num_envs: int, **arguments: Argument) -> VecEnv:
        """Make a vector environment that steps its environments one by one."""
        from codrl_mj.envs.serial import VECTOR_ARGUMENTS, SerialVectorEnv

        vector_arguments = {
            name: arguments.pop(name) for name in VECTOR_ARGUMENTS if name in arguments
        }
        make = functools.partial(config.build, **arguments)
        return SerialVectorEnv(num_envs, make, bytes_per_env=BYTES_PER_ENV, **vector_arguments)

    def action_space(self, config: EnvConfig) -> Space:
        """Return the action space of the environment without motors."""
        with self._with_name_in_errors(config):
            return _action_space(self, json.dumps(config.options))

    def actuators(self, actuator: object) -> dict[str, ActuatorModel]:
        """Return the actuators as the configuration stores them: pattern -> `ActuatorModel`."""
        from codrl_mj.engine.matching import resolve_patterns

        return resolve_patterns(
            actuators_by_pattern(actuator, self.default_actuator), f"the environment {self.name}"
        )

    def actuators_by_name(self, actuators: StoredActuators) -> dict[str, ActuatorModel]:
        """Return pattern -> actuator from the result of `actuators`."""
        assert isinstance(actuators, Mapping)
        return dict(actuators)

    def override_actuators(self, config: EnvConfig, patterns: Mapping[str, object]) -> Info:
        """Return pattern -> actuator: `patterns`, and the configuration's for all other motors."""
        from codrl_mj.engine.matching import match_pattern, matchable_names
        from codrl_mj.engine.reading import actuators_sharing_motor

        if all(configured == IDEAL for configured in config.actuators):
            return dict(patterns)
        with contextlib.closing(config.build()) as env:
            model = env.unwrapped.model  # type: ignore[attr-defined]
            names = matchable_names(model)
        overridden = {index for pattern in patterns for index in match_pattern(pattern, names)}
        remaining = {
            " & ".join(
                re.escape(names[motor][0])
                for motor in actuators_sharing_motor(model, index)
                if motor not in overridden
            ): actuator
            for pattern, actuator in config.actuators_by_name.items()
            for index in match_pattern(pattern, names)
            if index not in overridden
        }
        return {**remaining, **patterns}

    def code(self, options: Options) -> set[str | Path]:
        """Return the module of the creator, and files named in options."""
        module = getattr(self.creator, "__module__", "")
        return super().code(options) | ({module} if module else set())

    @contextlib.contextmanager
    def _with_name_in_errors(self, config: EnvConfig) -> Iterator[None]:
        """Put the environment's name, or its options, in front of errors in a `with` block."""
        try:
            yield
        except (TypeError, ValueError) as error:
            is_option_error = isinstance(error, TypeError) and config.options
            subject = (
                f"options = {config.options!r}: {self.name} does not take them"
                if is_option_error
                else self.name
            )
            raise ValueError(f"{subject}: {error}") from error


class GymnasiumEnvSource(ExternalEnvSource):
    """Env source of one environment in Gymnasium's registry."""

    def __init__(self, name: str) -> None:
        """Take an id such as `HalfCheetah-v5`; `module:ID` imports the module first."""
        self.name = name
        if ":" in name:
            load_module(name)

    @property
    def reference(self) -> str:
        """Id of the environment."""
        return self.name

    @property
    def spec(self) -> EnvSpec:
        """Specification in Gymnasium's registry."""
        try:
            return copy.copy(gymnasium.spec(self.name.rpartition(":")[2]))
        except (gymnasium.error.Error, ModuleNotFoundError) as error:
            raise ValueError(
                f"task = {self.name!r}: {error}; if Gymnasium does not load the environment's"
                " package by itself, write module:ID"
            ) from None

    @property
    def time_limit(self) -> int | None:  # type: ignore[override]
        """Time limit of the registration [environment steps]; None if there is none."""
        return self.spec.max_episode_steps

    @property
    def creator(self) -> Creator:
        """Class or function of the registration."""
        entry = self.spec.entry_point
        return load_env_creator(entry) if isinstance(entry, str) else entry  # type: ignore[return-value]

    def code(self, options: Options) -> set[str | Path]:
        """Return the modules of the class and of the registration, and files named in options."""
        module = self.name.rpartition(":")[0]
        return super().code(options) | ({module} if module else set())


@functools.cache
def _action_space(source: ExternalEnvSource, options: str) -> Space:
    """Return the action space without motors; options are JSON text, to be hashable."""
    env = gymnasium.make(source.spec, disable_env_checker=True, **json.loads(options))
    space = env.action_space
    env.close()
    return space


_ID = re.compile(r"(?:[\w.]+:)?(?:[\w-]+/)?[\w.-]+-v\d+")


def _claims(name: str) -> bool:
    """Return True if a name is a third-party id: `HalfCheetah-v5`, `package/Robot-v0`."""
    return _ID.fullmatch(name) is not None


def _wrap(target: object, name: str | None) -> ExternalEnvSource | None:
    """Return the source of a function or class that makes environments; None for other objects."""
    if not callable(target):
        return None
    label = getattr(target, "__name__", type(target).__name__)
    return ExternalEnvSource(label, target, reference=name or label)


# The cache returns the same source for the same id, whose action space is then also cached.
_cached_source = functools.cache(GymnasiumEnvSource)


def _find(name: str) -> GymnasiumEnvSource:
    """Return the source of an id; importing its module needs permission even if it is cached."""
    if ":" in name:
        load_module(name)
    return _cached_source(name)


SOURCE_KINDS.append(SourceKind(_claims, _find, _wrap))
