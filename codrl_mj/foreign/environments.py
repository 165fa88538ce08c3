"""Gymnasium's environments with motors: `make`."""

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.utils import RecordConstructorArgs, seeding

from codrl_mj.actuators import ActuatorModel, Command
from codrl_mj.disturbances import resolve_disturbances
from codrl_mj.engine.reading import bring_to_rest, motors, slots
from codrl_mj.envs.snapshots import check_snapshot, elapsed_steps, set_elapsed_steps
from codrl_mj.foreign.building import Building
from codrl_mj.foreign.commands import command_of
from codrl_mj.foreign.draws import PREFIX
from codrl_mj.foreign.readings import Sensors, readings
from codrl_mj.foreign.recording import MotorsRecorder
from codrl_mj.foreign.simulated import Simulated
from codrl_mj.foreign.state import set_state_of, state_of
from codrl_mj.physics.streams import set_words, words_of
from codrl_mj.specs import resolve_patterns


def make(
    env_id: str | Callable[..., Any],
    actuators: Mapping[str, Any],
    *,
    action: str = "force",
    observe_actuator: bool = False,
    randomize: Mapping[str, Any] | None = None,
    disturbances: Any = None,
    allow_unstable: bool = False,
    **options: Any,
) -> "MotorisedEnv":
    """An environment of Gymnasium's, or of anybody's who registers with it, with motors behind its actuators.

        >>> env = codrl_mj.make("HalfCheetah-v5", actuators={".*": "maxon-ec45-flat-50w"})

    With `"ideal"` actuators it is bit for bit the environment that `gymnasium.make` makes. Processes are given
    functions that call this, such as `functools.partial(codrl_mj.make, "HalfCheetah-v5", {".*": "lag"})`.

    Args:
        env_id: the id; or a function, or class, that makes an environment of one's own, which needs no id.
        actuators: what goes where, as for `codrl_mj.motorise`.
        action: `force`: the environment's own actions, whose forces are what is desired (a position servo stays one);
            or what the actuators take besides, such as `current` and `voltage`, with their limits as the action space.
            The environment still computes its costs from its own controls: from the torque that a current makes, or as
            many amperes as volts.
        observe_actuator: whether the observation ends with what the motors' sensors say, motor by motor.
        randomize: path -> distribution (or its text): what is drawn at every reset: FIELD of all motors, PATTERN:FIELD
            of those of a pattern, and of the model `model.mass.BODY`, `model.gravity` and `model.damping.JOINT`; or
            pattern -> field -> distribution. What was drawn is in the reset's info, `randomization`. The generator is
            not the environment's: its initial states are the same as without.
        disturbances: delay, quantum and rate of the commands, and load pulses, once an environment step: see
            `codrl_mj.Disturbances`. Of a plain motor in its force [N or N*m] before the gear, of others in what their
            control stands for.
        allow_unstable: as for `codrl_mj.motorise`.
        **options: of `gymnasium.make` and the environment, such as `render_mode` and `max_episode_steps`.

    Raises:
        gymnasium.error.UnregisteredEnv: there is no such environment.
        ValueError: see `codrl_mj.motorise`; a model is not built from XML; or an argument does not go with the
            actuators or the environment.
    """
    if isinstance(env_id, str):
        entry = gymnasium.spec(env_id)
    else:
        entry = EnvSpec(getattr(env_id, "__name__", "environment"), env_id)
        env_id = entry.id
    if str(entry.entry_point).startswith("codrl_mj.envs:"):
        raise ValueError(f"{env_id}: its actuators are its own: gymnasium.make({env_id!r}, actuator=...)")
    resolved = resolve_patterns(actuators, f"the environment {env_id}")
    if isinstance(randomize, Mapping):
        randomize = _by_pattern(randomize, resolved)
    spec = copy.copy(entry)
    spec.entry_point = Motorised(entry.entry_point, resolved, action, allow_unstable, env_id)
    return MotorisedEnv(gymnasium.make(spec, **options), observe_actuator, randomize, disturbances)


def _by_pattern(randomize: Mapping[str, Any], patterns: Iterable[str]) -> dict[str, Any]:
    """Pattern -> field -> distribution, and field of the model -> distribution; a path without a pattern is for all."""
    found: dict[str, Any] = {}
    for path, one in randomize.items():
        pattern, colon, field = path.rpartition(":")
        if isinstance(one, Mapping) or (not colon and path.startswith(PREFIX)):
            found[path] = one
            continue
        for each in (pattern,) if colon else patterns:
            found.setdefault(each, {})[field] = one
    return found


@dataclasses.dataclass(frozen=True)
class Motorised:
    """What makes an environment with motors, in place of the entry point that makes it without."""

    entry_point: Any
    """Makes it without."""
    actuators: Mapping[str, ActuatorModel]
    """Pattern -> actuator."""
    action: str
    """What actions stand for."""
    allow_unstable: bool
    """As for `codrl_mj.motorise`."""
    env_id: str = ""
    """The environment's, for messages."""

    @functools.cached_property
    def commands(self) -> dict[str, Command | None]:
        """Pattern -> what an action means to its motors; None where it is the environment's own.

        Raises:
            ValueError: an actuator takes no such command.
        """
        return {pattern: command_of(one, self.action, pattern) for pattern, one in self.actuators.items()}

    @property
    def simulated(self) -> dict[str, ActuatorModel]:
        """Pattern -> what is simulated: the actuator, or what a command leaves of it."""
        return {
            pattern: self.actuators[pattern] if command is None else command.actuator
            for pattern, command in self.commands.items()
        }

    @property
    def metadata(self) -> dict[str, Any]:
        """The environment's, which `gymnasium.make` asks for."""
        return self._creator.metadata  # an AttributeError where a plain function makes the environment

    @property
    def _creator(self) -> Any:
        return load_env_creator(self.entry_point) if isinstance(self.entry_point, str) else self.entry_point

    def __call__(self, **options: Any) -> gymnasium.Env:
        """Make it.

        Raises:
            ValueError: see `codrl_mj.motorised`.
        """
        creator, building = self._creator, Building(self.simulated, self.allow_unstable)
        ours = isinstance(creator, type) and issubclass(creator, MujocoEnv)
        with building.motorising():
            env = _with_motors(creator)(**options) if ours else creator(**options)
        building.check(self.env_id)
        if ours:
            env.remade = functools.partial(self, **options)
        return env


@functools.cache
def _with_motors(kind: Any) -> Any:
    """A subclass of an environment's class that brings motors to rest where the state is set, and keeps them if copied.

    Gymnasium's environments copy and pickle themselves by being made again.
    """

    class WithMotors(kind):
        remade: Any = None

        @functools.cached_property
        def _motors(self) -> list[np.ndarray]:
            return list(slots(self.data, motors(self.model)).values())

        def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
            for slot in self._motors:
                bring_to_rest(slot, self.data.time, slot[1])
            super().set_state(qpos, qvel)

        def __reduce__(self) -> Any:
            return self.remade, ()

    for name in ("__name__", "__qualname__", "__module__", "__doc__"):
        setattr(WithMotors, name, getattr(kind, name))
    return WithMotors


class MotorisedEnv(gymnasium.Wrapper, RecordConstructorArgs):
    """What `make` adds to an environment that was built with motors.

    Every step's `info` has `desired_force` and `actual_force` [N or N*m], at the motors' side of the model's gears, the
    signals of the actuators' families and `saturated`, at the end of the step; of several motors arrays (n_motors,) in
    the model's order.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        observe_actuator: bool = False,
        randomize: Mapping[str, Mapping[str, Any]] | None = None,
        disturbances: Any = None,
    ) -> None:
        """Wrap an environment that `Motorised` made.

        Args:
            env: the environment.
            observe_actuator: as for `make`, and so are the others.
            randomize: see there.
            disturbances: see there.

        Raises:
            ValueError: see `make`.
        """
        RecordConstructorArgs.__init__(
            self, observe_actuator=observe_actuator, randomize=randomize, disturbances=disturbances
        )
        super().__init__(env)
        base, name = env.unwrapped, env.spec.id if env.spec else ""
        if not isinstance(getattr(base, "model", None), mujoco.MjModel) or not hasattr(base, "data"):
            raise ValueError(
                f"{name}: has no MuJoCo model and data as attributes: build it inside codrl_mj.motorised, and read the "
                "motors with codrl_mj.signals"
            )
        assert base.spec is not None
        self._motorised: Motorised = base.spec.entry_point  # type: ignore[assignment]
        self._disturbances = resolve_disturbances(disturbances)
        self._randomize = randomize
        self._observes = observe_actuator
        self._generator = np.random.default_rng()
        self._begun = False
        self._bind()

    def _bind(self) -> None:
        """Find the motors of the environment's model.

        Raises:
            ValueError: see `make`.
        """
        base: Any = self.unwrapped
        self._recorder: MotorsRecorder | None = None
        self._data, motorised = base.data, self._motorised
        self._simulated = Simulated(
            base.data,
            motorised.simulated,
            motorised.commands,
            self.env.action_space,
            randomize=self._randomize,
            disturbances=self._disturbances,
            step_duration=getattr(base, "dt", None),
            allow_unstable=motorised.allow_unstable,
        )
        if self._simulated.action_space is not self.env.action_space:
            self.action_space = self._simulated.action_space
        self._sensors: Sensors | None = None
        self._look()
        if self._observes:
            self.observation_space = _longer(self.env.observation_space, len(self.sensor_names))

    def _look(self) -> None:
        """Have the sensors of the present motors."""
        if self._observes:
            self._sensors = Sensors(self._data, self._simulated.motors)

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """The motors of the present episode, by the index of the actuator in the model."""
        return dict(self._simulated.motors)

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Of the motors' signals in `info`."""
        return tuple(readings(self._simulated.readout, self._data))

    @property
    def recorder(self) -> MotorsRecorder:
        """Reads the environment between its steps; from now on every integration step is looked at."""
        if self._recorder is None:
            readout, command = self._simulated.readout, self._motorised.action
            self._recorder = MotorsRecorder(self._data, readout, command, lambda: self.motors)
        return self._recorder

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of what `observe_actuator` appends to the observation."""
        return () if self._sensors is None else self._sensors.names

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, the motors at rest; a seed starts the generator of their draws too."""
        if seed is not None:
            own = np.random.SeedSequence(seed, spawn_key=(1,))  # independent of the environment's
            self._generator = np.random.Generator(np.random.PCG64(own))
        self._simulated.draw(self._generator)
        self._look()
        observation, info = self.env.reset(seed=seed, options=options)
        self._begun = True
        self._simulated.begin(self._generator)
        return self._observed(observation), info | self._drawn()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance by one environment step.

        Raises:
            ValueError: the action has not the shape of the action space.
            SimulationDivergedError: the simulation left the finite numbers.
        """
        time = self._data.time
        with contextlib.nullcontext() if self._recorder is None else self._recorder.watching():
            observation, reward, terminated, truncated, info = self.env.step(self._simulated.controls(action))
        self._simulated.check_finite(self._motorised_id, time)
        seen = readings(self._simulated.readout, self._data)
        return self._observed(observation), reward, terminated, truncated, info | seen

    def _observed(self, observation: Any) -> Any:
        if self._sensors is None:
            return observation
        return np.concatenate([observation, self._sensors.seen()]).astype(observation.dtype)

    def _drawn(self) -> dict[str, Any]:
        return {"randomization": self.randomization} if self.randomization else {}

    @property
    def randomization(self) -> dict[str, Any]:
        """What the present episode was drawn with, as in the reset's info; empty if nothing was drawn."""
        return self._simulated.report

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as plain arrays: simulation, motors, generators, draws, time limit.

        That is MuJoCo's state and what was computed from it, which observations and rewards read; not what an
        environment keeps in attributes of its own, nor what wrappers count besides `TimeLimit`. Of environments that
        are no `MujocoEnv` of Gymnasium's nobody knows where their state is: the snapshot has the generators, and
        `restore` starts an episode.
        """
        found = {
            "environment": np.frombuffer(self._motorised_id.encode(), dtype=np.uint8).copy(),
            **(state_of(self._data) if self._whole else {}),
            "generator": words_of(self.unwrapped.np_random),
            "motors_generator": words_of(self._generator),
            "elapsed_steps": elapsed_steps(self.env),
        }
        return found | {name: array.copy() for name, array in self._simulated.memory.items()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> Any:
        """Continue from what `snapshot` returned, bit for bit, in an environment made with the same arguments.

        Returns:
            None; or the first observation of the episode that was started, where the state is not in the snapshot.

        Raises:
            ValueError: the snapshot is of another environment, or of arguments that need other entries or shapes;
                nothing was changed.
        """
        expected = self.snapshot()
        check_snapshot(snapshot, expected)
        if not np.array_equal(snapshot["environment"], expected["environment"]):
            raise ValueError(
                f"snapshot['environment'] is of {bytes(snapshot['environment'])!r}: must be of {self._motorised_id!r}"
            )
        if not self._begun:  # which Gymnasium's wrappers insist on
            self.env.reset()
            self._begun = True
        if "drawn" in expected:
            self._simulated.restore(snapshot["drawn"].copy())
            self._look()
        generator, _ = seeding.np_random(0)
        set_words(generator, snapshot["generator"])
        self.unwrapped.np_random = generator
        self._generator, _ = seeding.np_random(0)
        set_words(self._generator, snapshot["motors_generator"])
        if not self._whole:
            return self.reset()[0]
        set_state_of(self._data, snapshot["state"], snapshot["computed"])
        if "disturbances" in expected:
            self._simulated.memory["disturbances"][:] = snapshot["disturbances"]
        set_elapsed_steps(self.env, snapshot["elapsed_steps"])
        return None

    @property
    def _motorised_id(self) -> str:
        return "" if self.env.spec is None else self.env.spec.id

    @property
    def _whole(self) -> bool:
        """Whether all of the environment's state is known."""
        return isinstance(self.unwrapped, MujocoEnv)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but what belongs to the model, which a copied environment makes again."""
        return {name: value for name, value in self.__dict__.items() if name not in _OF_THE_MODEL}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore, in this or another process; as with all of Gymnasium's, the copy has to be reset."""
        self.__dict__.update(state, _begun=False)
        self._bind()


_OF_THE_MODEL = ("_data", "_simulated", "_sensors", "_recorder")


def _longer(space: gymnasium.Space, count: int) -> spaces.Box:
    """An observation space with some unbounded entries more.

    Raises:
        ValueError: it is no vector.
    """
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"observe_actuator=True: observations are {space}, and only to vectors can be appended")
    low, high = (
        np.append(bound, np.full(count, value)) for bound, value in ((space.low, -np.inf), (space.high, np.inf))
    )
    return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
