"""Gymnasium environments with motors: `make`."""

import copy
import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, SupportsFloat

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv

from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import Action, Argument, Info, Observation, PickledState
from codrl_mj.engine.reading import bring_to_rest, motor_slots, motors
from codrl_mj.envs.bank import extend_space
from codrl_mj.envs.config import Env, EnvConfig
from codrl_mj.envs.model_bank import ModelBank
from codrl_mj.envs.recording import SubstepRecorder
from codrl_mj.envs.snapshots import (
    check_snapshot,
    elapsed_steps,
    encode_name,
    generator_from_words,
    set_elapsed_steps,
    set_state_of,
    state_of,
)
from codrl_mj.external_envs.building import patcher_of
from codrl_mj.physics.streams import generator_words
from codrl_mj.physics.variation import write_fields


def make_with_motors(
    spec: EnvSpec, creator: Callable[..., Env], config: EnvConfig, **options: Argument
) -> "MotorsAddedEnv":
    """Create a Gymnasium environment with motors.

    With `"ideal"` actuators it is bit for bit the environment that `gymnasium.make` makes.

    Args:
        spec: specification of the environment.
        creator: class or function that makes it without motors.
        config: settings of its motors.
        **options: arguments of `gymnasium.make` and the environment, such as `render_mode`.

    Raises:
        ValueError: see `codrl_mj.add_motors`; a model is not built from XML; or the configuration
            does not fit the model.
    """
    spec = copy.copy(spec)
    spec.entry_point = MotorsAddedCreator(creator, config, spec.id)
    return MotorsAddedEnv(gymnasium.make(spec, **options))


@dataclasses.dataclass(frozen=True)
class MotorsAddedCreator:
    """Callable that makes an environment with motors, in place of the original entry point."""

    creator: Callable[..., Env]
    """Original class or function, which makes the environment without motors."""
    config: EnvConfig
    """Settings of the motors."""
    env_id: str
    """Id of the environment, for messages."""

    @property
    def metadata(self) -> Info:
        """Metadata of the environment, which `gymnasium.make` reads."""
        # A plain function has none; Gymnasium handles the AttributeError.
        metadata: Info = self.creator.metadata  # type: ignore[attr-defined]
        return metadata

    def __call__(self, **options: Argument) -> gymnasium.Env:
        """Make the environment."""
        patcher = patcher_of(self.config)
        # An error of a registered id names the id already.
        is_function = self.env_id.rpartition(":")[2] not in gymnasium.registry
        if is_function:
            _check_arguments(self.creator, options, self.env_id)
        with patcher.patch_model_loading():
            env = self.creator(**options)
        _check_env(env, self.env_id)
        patcher.check(self.env_id, f"env = {self.env_id}: " if is_function else "")
        # Attributes are set that only Gymnasium's MujocoEnv has.
        base: Any = env.unwrapped
        # mypy takes no class for hashable whose instances are not.
        env_class: Any = type(base)
        # The class of the existing object is replaced, because only the original creator, which may
        # be a function, knows the class and the wrappers around it.
        if issubclass(env_class, MujocoEnv):
            base.__class__, base.recreate = (
                _class_with_motors(env_class),
                functools.partial(self.make_unwrapped, **options),
            )
        return env

    def make_unwrapped(self, **options: Argument) -> gymnasium.Env:
        """Make the environment, without wrappers."""
        return self(**options).unwrapped


def _check_arguments(
    creator: Callable[..., Env], options: Mapping[str, Argument], name: str
) -> None:
    """Raise ValueError if a function cannot be called with these options."""
    try:
        signature = inspect.signature(creator)
    # Some functions in C have no signature.
    except ValueError:
        return
    try:
        signature.bind(**options)
    except TypeError as error:
        raise ValueError(
            f"env = {name}: cannot be called with the arguments {dict(options)}: {error}; pass what"
            f" it needs to make, and let it accept the rest, as in lambda **options:"
            " gymnasium.make(ID, **options)"
        ) from None


def _check_env(env: object, name: str) -> None:
    """Raise ValueError if the result of a creator cannot get motors."""
    if isinstance(env, gymnasium.Env):
        layers = [env]
        while isinstance(layers[-1], gymnasium.Wrapper):
            layers.append(layers[-1].env)
        if any(type(layer).__module__.startswith("codrl_mj.") for layer in layers):
            raise ValueError(
                f"env = {name}: made {env}, which has motors already; pass its name or"
                " configuration, and the actuator, to make instead of the function"
            )
        return
    modules = {base.__module__.partition(".")[0] for base in type(env).__mro__}
    if env is None:
        remedy = "return the environment at its end"
    elif isinstance(env, type):
        remedy = f"return an instance, {env.__name__}(), or pass the class itself"
    elif isinstance(env, VectorEnv):
        remedy = "return a single environment, and make several with codrl_mj.make_vec"
    elif isinstance(env, mujoco.MjModel | mujoco.MjSpec):
        remedy = "add motors to a MjSpec with codrl_mj.add_motors"
    elif "dm_env" in modules:
        remedy = "use codrl_mj.make_dm_control"
    elif callable(env):
        remedy = "pass that function itself"
    else:
        remedy = f"derive {type(env).__name__} from gymnasium.Env"
    raise ValueError(f"env = {name}: made {env!r}, must make a gymnasium.Env; {remedy}")


@functools.cache
def _class_with_motors(env_class: type[MujocoEnv]) -> type[MujocoEnv]:
    """Return a subclass whose `set_state` brings the motors to rest, and whose copies have motors.

    Gymnasium's environments copy and pickle themselves by calling their constructor again, which
    would build the model without motors.
    """

    class WithMotors(env_class):  # type: ignore[misc, valid-type]
        recreate: Callable[[], Env]

        @functools.cached_property
        def _slots(self) -> list[np.ndarray]:
            return list(motor_slots(self.data, motors(self.model)).values())

        def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
            for slot in self._slots:
                bring_to_rest(slot, self.data.time, slot[1])
            super().set_state(qpos, qvel)

        def __reduce__(self) -> tuple[Callable[[], Env], tuple[()]]:
            return self.recreate, ()

    for name in ("__name__", "__qualname__", "__module__", "__doc__"):
        setattr(WithMotors, name, getattr(env_class, name))
    return WithMotors


class MotorsAddedEnv(gymnasium.Wrapper, RecordConstructorArgs):
    """Wrapper that `make` puts around an environment that was built with motors.

    The `info` of every step has values at its end: `desired_force` and `actual_force` [N or N*m],
    both on the motors' side of the model's gears, the signals of the actuators' families, and
    `saturated`. For several motors they are arrays (n_motors,) in the model's order.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        """Wrap an environment that a `MotorsAddedCreator` made."""
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        base, name = env.unwrapped, env.spec.id if env.spec else ""
        if not isinstance(getattr(base, "model", None), mujoco.MjModel) or not hasattr(
            base, "data"
        ):
            raise ValueError(
                f"env = {name}: must have MuJoCo's model and data as attributes; name them so, or"
                " build it in a block of codrl_mj.motors_added, and read the motors with"
                " codrl_mj.signals"
            )
        assert base.spec is not None
        self._config: EnvConfig = base.spec.entry_point.config  # type: ignore[union-attr]
        self._generator = np.random.default_rng()
        self._was_reset = False
        self._bind()

    def _bind(self) -> None:
        """Find the motors of the environment's model, and set the spaces."""
        # `__init__` has checked that it has these attributes.
        base: Any = self.unwrapped
        self._recorder: SubstepRecorder | None = None
        self.bank = ModelBank(
            base.data, self._config, self.env.action_space, getattr(base, "dt", None)
        )
        if self.bank.action_space is not self.env.action_space:
            self.action_space = self.bank.action_space
        if self.bank.sensors:
            self.observation_space = extend_space(
                self.env.observation_space, len(self.bank.sensors)
            )

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """Actuator index in the model -> motor of the present episode."""
        return dict(self.bank.motors)

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the motors' signals in `info`."""
        return self.bank.signal_names

    @property
    def recorder(self) -> SubstepRecorder:
        """Recorder of integration steps; it starts recording when the property is first read."""
        if self._recorder is None:
            dt = getattr(self.unwrapped, "dt", None)
            self._recorder = SubstepRecorder(
                self.bank, self._config.action, dt if isinstance(dt, float) else None
            )
        return self._recorder

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the values that `observe_actuator` appends to the observation."""
        return self.bank.sensors

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Start an episode, with the motors at rest; a seed also seeds the motors' generator."""
        if seed is not None:
            # The spawn key makes the motors' numbers independent of the environment's own.
            seed_sequence = np.random.SeedSequence(seed, spawn_key=(1,))
            self._generator = np.random.Generator(np.random.PCG64(seed_sequence))
        self.bank.randomization.draw_single(self._generator)
        observation, info = self.env.reset(seed=seed, options=options)
        self._was_reset = True
        self.bank.begin(self._generator)
        drawn_values = self.randomization
        return self._with_sensors(observation), info | (
            {"randomization": drawn_values} if drawn_values else {}
        )

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        """Advance by one environment step.

        Raises:
            ValueError: the shape of the action is not that of the action space.
            SimulationDivergedError: a value of the simulation is not finite.
        """
        bank = self.bank
        time = bank.data.time
        controls = bank.controls(action)
        outcome = (
            self.env.step(controls)
            if self._recorder is None
            else self._recorder.step(self.env, controls)
        )
        observation, reward, terminated, truncated, info = outcome
        bank.check_finite(self._id, time)
        return (
            self._with_sensors(observation),
            reward,
            terminated,
            truncated,
            info | bank.signals(),
        )

    def _with_sensors(self, observation: Observation) -> Observation:
        if not self.bank.sensors:
            return observation
        return np.concatenate([observation, self.bank.sensor_values()]).astype(observation.dtype)

    @property
    def randomization(self) -> Info:
        """Drawn values of the present episode, as in the reset's info; empty without draws."""
        return self.bank.randomization.report()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays: simulation, motors, generators, draws, time limit.

        The snapshot contains MuJoCo's state, and the arrays computed from it that observations and
        rewards read. It does not contain attributes of the environment, or counters of wrappers
        other than `TimeLimit`. An environment that is not a Gymnasium `MujocoEnv` may store its
        state anywhere: its snapshot has only the generators, and `restore` starts an episode.
        """
        return {
            "environment": encode_name(self._id),
            **(state_of(self.bank.data) if self._has_known_state else {}),
            "generator": generator_words(self.unwrapped.np_random),
            "motors_generator": generator_words(self._generator),
            "elapsed_steps": elapsed_steps(self.env),
            **self.bank.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> Observation | None:
        """Continue from a snapshot, bit for bit, in an environment made with the same arguments.

        Returns:
            None; or the first observation of a new episode, if the state is not in the snapshot.
        """
        check_snapshot(snapshot, self.snapshot(), "environment")
        # Gymnasium's wrappers refuse to be used before a first reset.
        if not self._was_reset:
            self.env.reset()
            self._was_reset = True
        self.bank.restore(snapshot)
        self.unwrapped.np_random = generator_from_words(snapshot["generator"])
        self._generator = generator_from_words(snapshot["motors_generator"])
        if not self._has_known_state:
            return self.reset()[0]
        set_state_of(self.bank.data, snapshot["state"], snapshot["computed"])
        set_elapsed_steps(self.env, snapshot["elapsed_steps"])
        return None

    @property
    def _id(self) -> str:
        return "" if self.env.spec is None else self.env.spec.id

    @property
    def _has_known_state(self) -> bool:
        """True if MuJoCo's data contain the environment's whole state."""
        return isinstance(self.unwrapped, MujocoEnv)

    def __getstate__(self) -> PickledState:
        """Return all attributes except those tied to the model, which a copy builds again."""
        state = {
            name: value
            for name, value in self.__dict__.items()
            if name not in ("bank", "_recorder")
        }
        return state | {"_nominal_fields": self.bank.randomization.nominal_fields()}

    def __setstate__(self, state: PickledState) -> None:
        """Restore in this or another process; the copy must then be reset, as in Gymnasium."""
        self.__dict__.update(state, _was_reset=False)
        nominal_fields: dict[str, np.ndarray] = self.__dict__.pop("_nominal_fields")
        base = self.unwrapped
        # Copied data have their own copy of the model, which the environment must use, too.
        if base.model is not base.data.model:  # type: ignore[attr-defined]
            base.model = base.data.model  # type: ignore[attr-defined]
        # The copied model has the drawn values of the episode, which would become the new bank's
        # nominal values. A `MujocoEnv` has built its model again.
        if not self._has_known_state and nominal_fields:
            write_fields(base.model, nominal_fields)  # type: ignore[attr-defined]
            mujoco.mj_setConst(base.model, base.data)  # type: ignore[attr-defined]
        self._bind()
