"""Gymnasium's environments with motors: `make`."""

import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.utils import RecordConstructorArgs

from codrl_mj.actuators import ActuatorModel
from codrl_mj.disturbances import NO_DISTURBANCES, resolve
from codrl_mj.engine.reading import bring_to_rest, motors, slots
from codrl_mj.engine.specs import resolve_patterns
from codrl_mj.envs.motors import ActuatorBank, MotorSettings, longer
from codrl_mj.envs.recording import SubstepRecorder
from codrl_mj.envs.snapshots import (
    check_snapshot,
    elapsed_steps,
    encode_name,
    generator_of,
    set_elapsed_steps,
    set_state_of,
    state_of,
)
from codrl_mj.external_envs.building import Building
from codrl_mj.physics.streams import generator_words


def make(
    env_id: str | Callable[..., Any],
    actuators: Mapping[Any, Any],
    *,
    action: str = "force",
    observe_actuator: bool = False,
    randomize: Mapping[str, Any] | None = None,
    disturbances: Any = None,
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
    **options: Any,
) -> "MotorsAddedEnv":
    """An environment of Gymnasium's, or of anybody's who registers with it, with motors behind its actuators.

    With `"ideal"` actuators it is bit for bit the environment that `gymnasium.make` makes.

    Args:
        env_id: the id; or a function, or class, that makes an environment of one's own, which needs
            no id.
        actuators: what goes where, as for `codrl_mj.add_motors`.
        action: `force`: the environment's own actions, whose forces are what is desired (a position
            servo stays one); or what the actuators take besides, such as `current` and `voltage`,
            with their limits as the action space. The environment still computes its costs from its
            own controls: from the torque that a current makes, or as many amperes as volts.
        observe_actuator: whether the observation ends with what the motors' sensors say, motor by
            motor.
        randomize: path -> distribution (or its text): what is drawn at every reset: FIELD of all
            motors, PATTERN:FIELD of those of a pattern, and of the model `model.mass.BODY`,
            `model.gravity` and `model.damping.JOINT`; or pattern -> field -> distribution. What was
            drawn is in the reset's info, `randomization`. The generator is not the environment's:
            its initial states are the same as without.
        disturbances: delay, quantum and rate of the commands, and load pulses, once an environment
            step: see `codrl_mj.Disturbances`. Of a plain motor in its force [N or N*m] before the
            gear, of others in what their control stands for.
        allow_unstable: as for `codrl_mj.add_motors`.
        joint_dynamics: likewise.
        **options: of `gymnasium.make` and the environment, such as `render_mode` and
            `max_episode_steps`.

    Raises:
        gymnasium.error.UnregisteredEnv: there is no such environment.
        ValueError: see `codrl_mj.add_motors`; a model is not built from XML; or an argument does not
            go with the actuators or the environment.
    """
    if isinstance(env_id, str):
        entry = gymnasium.spec(env_id)
    elif not callable(env_id):
        raise ValueError(
            f"env_id = {env_id!r}: must be an id, or a function or class that makes an environment"
        )
    else:
        entry = EnvSpec(getattr(env_id, "__name__", "environment"), env_id)
        env_id = entry.id
    if str(entry.entry_point).startswith("codrl_mj.envs:"):
        raise ValueError(
            f"{env_id}: its actuators are its own: gymnasium.make({env_id!r}, actuator=...)"
        )
    settings = MotorSettings(
        resolve_patterns(actuators, f"the environment {env_id}"),
        action,
        observe_actuator,
        randomize,
        resolve(disturbances, NO_DISTURBANCES),
        allow_unstable,
        joint_dynamics,
    )
    spec, makes = copy.copy(entry), entry.entry_point
    spec.entry_point = MotorsAdded(
        load_env_creator(makes) if isinstance(makes, str) else makes, settings, env_id
    )
    return MotorsAddedEnv(gymnasium.make(spec, **options))


@dataclasses.dataclass(frozen=True)
class MotorsAdded:
    """What makes an environment with motors, in place of what makes it without."""

    creator: Any
    """A class or function that makes it without."""
    settings: MotorSettings
    """Of the motors."""
    env_id: str
    """The environment's, for messages."""

    @property
    def metadata(self) -> dict[str, Any]:
        """The environment's, which `gymnasium.make` asks for."""
        return (
            self.creator.metadata
        )  # an AttributeError where a plain function makes the environment

    def __call__(self, **options: Any) -> gymnasium.Env:
        """Make it."""
        settings = self.settings
        building = Building(
            settings.simulated, settings.allow_unstable, settings.joint_dynamics, settings.action
        )
        with building.motorising():
            env = self.creator(**options)
        building.check(self.env_id)
        base: Any = env.unwrapped
        kind: Any = type(base)
        if issubclass(kind, MujocoEnv):
            base.__class__, base.remade = (
                _with_motors(kind),
                functools.partial(self.base, **options),
            )
        return env

    def base(self, **options: Any) -> gymnasium.Env:
        """Make it, without wrappers around it."""
        return self(**options).unwrapped


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


class MotorsAddedEnv(gymnasium.Wrapper, RecordConstructorArgs):
    """What `make` adds to an environment that was built with motors.

    Every step's `info` has `desired_force` and `actual_force` [N or N*m], at the motors' side of
    the model's gears, the signals of the actuators' families and `saturated`, at the end of the
    step; of several motors arrays (n_motors,) in the model's order.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        """Wrap an environment that `MotorsAdded` made."""
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        base, name = env.unwrapped, env.spec.id if env.spec else ""
        if not isinstance(getattr(base, "model", None), mujoco.MjModel) or not hasattr(
            base, "data"
        ):
            raise ValueError(
                f"{name}: has no MuJoCo model and data as attributes: build it inside"
                " codrl_mj.motors_added, and read the motors with codrl_mj.signals"
            )
        assert base.spec is not None
        self._settings: MotorSettings = base.spec.entry_point.settings  # type: ignore[union-attr]
        self._generator = np.random.default_rng()
        self._begun = False
        self._bind()

    def _bind(self) -> None:
        """Find the motors of the environment's model."""
        base: Any = self.unwrapped
        self._watch: SubstepRecorder | None = None
        self._motors = ActuatorBank(
            base.data, self._settings, self.env.action_space, getattr(base, "dt", None)
        )
        if self._motors.action_space is not self.env.action_space:
            self.action_space = self._motors.action_space
        if self._motors.sensors:
            self.observation_space = longer(self.env.observation_space, len(self._motors.sensors))

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """The motors of the present episode, by the index of the actuator in the model."""
        return dict(self._motors.present)

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Of the motors' signals in `info`."""
        return tuple(self._motors.signals())

    @property
    def recorder(self) -> SubstepRecorder:
        """Reads the environment between its steps; from now on every integration step is looked at."""
        if self._watch is None:
            dt = getattr(self.unwrapped, "dt", None)
            self._watch = SubstepRecorder(
                self._motors, self._settings.action, dt if isinstance(dt, float) else None
            )
        return self._watch

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of what `observe_actuator` appends to the observation."""
        return self._motors.sensors

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, the motors at rest; a seed starts the generator of their draws too."""
        if seed is not None:
            own = np.random.SeedSequence(seed, spawn_key=(1,))  # independent of the environment's
            self._generator = np.random.Generator(np.random.PCG64(own))
        self._motors.draws.draw_one(self._generator)
        observation, info = self.env.reset(seed=seed, options=options)
        self._begun = True
        self._motors.begin(self._generator)
        drawn = self.randomization
        return self._observed(observation), info | ({"randomization": drawn} if drawn else {})

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance by one environment step.

        Raises:
            ValueError: the action has not the shape of the action space.
            SimulationDivergedError: the simulation left the finite numbers.
        """
        motors = self._motors
        time = motors.data.time
        controls = motors.controls(action)
        outcome = (
            self.env.step(controls) if self._watch is None else self._watch.step(self.env, controls)
        )
        observation, reward, terminated, truncated, info = outcome
        motors.check_finite(self._id, time)
        return self._observed(observation), reward, terminated, truncated, info | motors.signals()

    def _observed(self, observation: Any) -> Any:
        if not self._motors.sensors:
            return observation
        return np.concatenate([observation, self._motors.seen()]).astype(observation.dtype)

    @property
    def randomization(self) -> dict[str, Any]:
        """What the present episode was drawn with, as in the reset's info; empty if nothing was drawn."""
        return self._motors.draws.report()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as plain arrays: simulation, motors, generators, draws, time limit.

        That is MuJoCo's state and what was computed from it, which observations and rewards read;
        not what an environment keeps in attributes of its own, nor what wrappers count besides
        `TimeLimit`. Of environments that are no `MujocoEnv` of Gymnasium's nobody knows where their
        state is: the snapshot has the generators, and `restore` starts an episode.
        """
        return {
            "environment": encode_name(self._id),
            **(state_of(self._motors.data) if self._whole else {}),
            "generator": generator_words(self.unwrapped.np_random),
            "motors_generator": generator_words(self._generator),
            "elapsed_steps": elapsed_steps(self.env),
            **self._motors.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> Any:
        """Continue from what `snapshot` returned, bit for bit, in an environment made with the same arguments.

        Returns:
            None; or the first observation of the episode that was started, where the state is not
            in the snapshot.
        """
        check_snapshot(snapshot, self.snapshot(), "environment")
        if not self._begun:  # which Gymnasium's wrappers insist on
            self.env.reset()
            self._begun = True
        self._motors.restore(snapshot)
        self.unwrapped.np_random = generator_of(snapshot["generator"])
        self._generator = generator_of(snapshot["motors_generator"])
        if not self._whole:
            return self.reset()[0]
        set_state_of(self._motors.data, snapshot["state"], snapshot["computed"])
        set_elapsed_steps(self.env, snapshot["elapsed_steps"])
        return None

    @property
    def _id(self) -> str:
        return "" if self.env.spec is None else self.env.spec.id

    @property
    def _whole(self) -> bool:
        """Whether all of the environment's state is known."""
        return isinstance(self.unwrapped, MujocoEnv)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but what belongs to the model, which a copied environment makes again."""
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in ("_motors", "_watch")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore, in this or another process; as with all of Gymnasium's, the copy has to be reset."""
        self.__dict__.update(state, _begun=False)
        base = self.unwrapped
        if base.model is not base.data.model:  # type: ignore[attr-defined]  # MuJoCo copies data with its model
            base.model = base.data.model  # type: ignore[attr-defined]
        self._bind()
