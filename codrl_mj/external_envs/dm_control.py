"""dm_control's environments with motors: `make_dm_control`. Needs the extra `dm-control`."""

from collections.abc import Callable, Mapping
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_control import suite
from dm_control.rl import control
from dm_env import specs
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel
from codrl_mj.disturbances import NO_DISTURBANCES, resolve
from codrl_mj.engine.specs import resolve_patterns
from codrl_mj.envs.motors import ActuatorBank, MotorSettings
from codrl_mj.external_envs import check_dm_control
from codrl_mj.external_envs.building import Building
from codrl_mj.fields import did_you_mean


class MotorsAddedEnvironment(dm_env.Environment):
    """An environment of dm_control's that builds all its models with motors; whatever else it has is had through this.

    Its own order of stepping is kept: by default `mj_step2` before `mj_step1`, where `signals` are
    those of the forces that moved it last.
    """

    def __init__(
        self,
        build: Callable[[], dm_env.Environment],
        settings: MotorSettings,
        noise_seed: int | None = None,
    ) -> None:
        """Build it."""
        self._settings = settings
        self._building = Building(
            settings.simulated, settings.allow_unstable, settings.joint_dynamics, settings.action
        )
        with self._building.motorising():
            self._environment = build()
        self._building.check()
        kinds = type(
            self._environment
        ).__mro__  # of `dm_control.composer`, which need not have been imported?
        if settings.randomize is not None and any(
            one.__module__.startswith("dm_control.composer") for one in kinds
        ):
            raise ValueError(
                f"randomize: {type(self._environment).__name__} builds its model anew at every"
                " reset; let its own variations change it"
            )
        self._generator = np.random.default_rng(noise_seed)
        self._ended = True
        self._bound: tuple[mujoco.MjModel, ActuatorBank] | None = None
        _ = self._motors  # what is wrong is said here

    def reset(self) -> dm_env.TimeStep:
        """Start an episode, the motors at rest; composer environments build their model anew."""
        if self._settings.randomize is not None:
            self._motors.draws.draw_one(self._generator)
        with self._building.motorising():
            timestep = self._environment.reset()
        self._ended = False
        self._motors.begin(self._generator)
        return timestep

    def step(self, action: Any) -> dm_env.TimeStep:
        """Advance by one environment step; an episode that has ended starts anew.

        Raises:
            ValueError: the action has not the shape of the action specification.
            SimulationDivergedError: the simulation left the finite numbers, where the environment
                does not end then.
        """
        if self._ended:
            return self.reset()
        motors, time = self._motors, self.mujoco[1].time
        try:
            with self._building.motorising():
                timestep = self._environment.step(motors.controls(action))
        except control.PhysicsError:  # or whatever else ends its simulation
            motors.check_finite(type(self._environment).__name__, time)
            raise
        self._ended = timestep.last()
        return timestep

    @property
    def _motors(self) -> ActuatorBank:
        """The motors in the present model."""
        model, data = self.mujoco
        if self._bound is None or self._bound[0] is not model:
            spec = self._environment.action_spec()
            low, high = (
                np.broadcast_to(bound, spec.shape) for bound in (spec.minimum, spec.maximum)
            )
            actions = spaces.Box(low, high, dtype=np.float64)
            motors = ActuatorBank(
                data, self._settings, actions, self._environment.control_timestep()
            )
            self._bound = model, motors
        return self._bound[1]

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """The motors of the present episode, by the index of the actuator in the model."""
        return dict(self._motors.present)

    @property
    def randomization(self) -> dict[str, Any]:
        """What the present episode was drawn with; empty if nothing was drawn."""
        return self._motors.draws.report()

    def signals(self) -> dict[str, Any]:
        """The motors' signals after the last step, as in `info` of `codrl_mj.make`.

        `desired_force` and `actual_force` [N or N*m], the signals of the families and `saturated`;
        of several motors arrays (n_motors,) in the model's order.
        """
        return self._motors.signals()

    @property
    def mujoco(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Present model and data; those of a composer environment change with every reset."""
        physics = self._environment.physics
        return physics.model.ptr, physics.data.ptr

    def observation_spec(self) -> Any:
        """The environment's."""
        return self._environment.observation_spec()

    def action_spec(self) -> Any:
        """The environment's, with the limits of the motors' commands where these are what an action stands for."""
        spec = self._environment.action_spec()
        if self._settings.action == "force":
            return spec
        space: Any = self._motors.action_space
        return specs.BoundedArray(spec.shape, spec.dtype, space.low, space.high, spec.name)

    def reward_spec(self) -> Any:
        """The environment's."""
        return self._environment.reward_spec()

    def discount_spec(self) -> Any:
        """The environment's."""
        return self._environment.discount_spec()

    def close(self) -> None:
        """Free what the environment holds."""
        self._environment.close()

    def __getattr__(self, name: str) -> Any:
        """What else the environment has, such as `physics` and `task`."""
        if name.startswith("__") or name == "_environment":
            raise AttributeError(name)
        return getattr(self._environment, name)


def make_dm_control(
    environment: str | Callable[..., dm_env.Environment],
    actuators: Mapping[Any, Any],
    *,
    action: str = "force",
    randomize: Mapping[str, Any] | None = None,
    disturbances: Any = None,
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
    noise_seed: int | None = None,
    **options: Any,
) -> MotorsAddedEnvironment:
    """An environment of dm_control's, or of anybody's made with it, with motors behind its actuators.

        >>> env = codrl_mj.make_dm_control("cheetah/run", {".*": "maxon-ec45-flat-50w"}, task_kwargs={"random": 1})

    With `"ideal"` actuators it is bit for bit the environment without them.

    Args:
        environment: `DOMAIN/TASK` of the suite, or a function that makes an environment.
        actuators: what goes where, as for `codrl_mj.add_motors`.
        action: as for `codrl_mj.make`, and so are the next three.
        randomize: see there; what was drawn is in `randomization`. Not for environments that build
            their model anew at every reset.
        disturbances: see there; actions have to be the model's controls.
        allow_unstable: see there.
        joint_dynamics: see there.
        noise_seed: of the noise of the motors' sensors, of draws and of load pulses.
        **options: of `dm_control.suite.load`, or of the function.

    Raises:
        ValueError: see `codrl_mj.add_motors`; an unknown environment; its model is not built from
            XML; or an argument does not go with the actuators or the environment.
        RuntimeError: dm_control does not work with the installed MuJoCo.
    """
    check_dm_control()
    resolved = resolve_patterns(actuators, "an environment of dm_control")
    disturbed = resolve(disturbances, NO_DISTURBANCES)
    settings = MotorSettings(
        resolved, action, False, randomize, disturbed, allow_unstable, joint_dynamics
    )
    if not isinstance(environment, str):
        return MotorsAddedEnvironment(lambda: environment(**options), settings, noise_seed)
    domain, _, task = environment.partition("/")
    if (domain, task) not in suite.ALL_TASKS:
        known = ["/".join(each) for each in suite.ALL_TASKS]
        raise ValueError(
            f"environment = {environment!r}: {did_you_mean(environment, known)}must be DOMAIN/TASK"
            " of dm_control.suite.ALL_TASKS, or a function"
        )
    return MotorsAddedEnvironment(lambda: suite.load(domain, task, **options), settings, noise_seed)
