"""Environments of dm_control with motors: `make_dm_control`. Needs the extra `dm-control`."""

import functools
from collections.abc import Callable, Mapping

import dm_env
import mujoco
import numpy as np
from dm_control import suite
from dm_control.rl import control
from dm_env import specs
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import Action, Argument, AttributeValue, Info, Observation
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.model_bank import ModelBank
from codrl_mj.external_envs import check_dm_control
from codrl_mj.external_envs.building import patcher_of
from codrl_mj.external_envs.sources import ExternalEnvSource
from codrl_mj.fields import did_you_mean


class MotorsAddedEnvironment(dm_env.Environment):
    """Wrapper of a dm_control environment that adds motors to every model that it builds.

    All other attributes, such as `physics` and `task`, are those of the environment. The order of
    stepping is dm_control's: by default `mj_step2` runs before `mj_step1`, so `signals` belong to
    the forces that acted in the last completed step.
    """

    def __init__(
        self,
        build: Callable[[], dm_env.Environment],
        config: EnvConfig,
        noise_seed: int | None = None,
    ) -> None:
        """Build the environment, with motors."""
        self._config, self._patcher = config, patcher_of(config)
        with self._patcher.patch_model_loading():
            self._environment = build()
        if not isinstance(self._environment, dm_env.Environment):
            raise ValueError(
                f"environment: the function made {self._environment!r}, must make a"
                " dm_env.Environment; return one at its end, or use codrl_mj.make for an"
                " environment of Gymnasium"
            )
        self._patcher.check()
        # Compared by name, because dm_control.composer may not be imported.
        classes = type(self._environment).__mro__
        if config.randomize is not None and any(
            environment_class.__module__.startswith("dm_control.composer")
            for environment_class in classes
        ):
            raise ValueError(
                f"randomize: {type(self._environment).__name__} builds its model again at every"
                " reset; use its own variations instead"
            )
        self._generator = np.random.default_rng(noise_seed)
        self._ended = True
        self._bound: tuple[mujoco.MjModel, ModelBank] | None = None
        # If the motors do not fit the environment, the property raises now and not at the first
        # step.
        _ = self.bank

    def reset(self) -> dm_env.TimeStep:
        """Start an episode, with the motors at rest; composer environments rebuild their model."""
        if self._config.randomize is not None:
            self.bank.randomization.draw_single(self._generator)
        with self._patcher.patch_model_loading():
            timestep = self._environment.reset()
        self._ended = False
        self.bank.begin(self._generator)
        return timestep

    def step(self, action: Action) -> dm_env.TimeStep:
        """Advance by one environment step; the step after the end of an episode resets.

        Raises:
            ValueError: the shape of the action is not that of the action specification.
            SimulationDivergedError: a value of the simulation is not finite, and the environment
                does not end the episode for this reason.
        """
        if self._ended:
            return self.reset()
        bank, time = self.bank, self.mujoco[1].time
        try:
            with self._patcher.patch_model_loading():
                timestep = self._environment.step(bank.controls(action))
        except control.PhysicsError:
            # The environment ended the simulation for its own reason, or because it diverged.
            bank.check_finite(type(self._environment).__name__, time)
            raise
        self._ended = timestep.last()
        return timestep

    @property
    def bank(self) -> ModelBank:
        """Motors of the present model, which changes when the environment rebuilds it."""
        model, data = self.mujoco
        if self._bound is None or self._bound[0] is not model:
            spec = self._environment.action_spec()
            low, high = (
                np.broadcast_to(bound, spec.shape) for bound in (spec.minimum, spec.maximum)
            )
            actions = spaces.Box(low, high, dtype=np.float64)
            bank = ModelBank(data, self._config, actions, self._environment.control_timestep())
            self._bound = model, bank
        return self._bound[1]

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """Actuator index in the model -> motor of the present episode."""
        return dict(self.bank.motors)

    @property
    def randomization(self) -> Info:
        """Drawn values of the present episode; empty if nothing is randomized."""
        return self.bank.randomization.report()

    def signals(self) -> Info:
        """Return the motors' signals after the last step, as in `info` of `codrl_mj.make`.

        `desired_force` and `actual_force` [N or N*m], the signals of the families and `saturated`;
        for several motors arrays (n_motors,) in the model's order.
        """
        return self.bank.signals()

    @property
    def mujoco(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Present model and data; a composer environment replaces them at every reset."""
        physics = self._environment.physics
        return physics.model.ptr, physics.data.ptr

    def observation_spec(self) -> Observation:
        """Return the environment's observation specification."""
        return self._environment.observation_spec()

    def action_spec(self) -> specs.BoundedArray:
        """Return the action specification, with the limits of the motors' commands."""
        spec = self._environment.action_spec()
        if self._config.action == "force":
            return spec
        space = self.bank.action_space
        assert isinstance(space, spaces.Box)
        return specs.BoundedArray(spec.shape, spec.dtype, space.low, space.high, spec.name)

    def reward_spec(self) -> specs.Array:
        """Return the environment's reward specification."""
        return self._environment.reward_spec()

    def discount_spec(self) -> specs.BoundedArray:
        """Return the environment's discount specification."""
        return self._environment.discount_spec()

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()

    def __getattr__(self, name: str) -> AttributeValue:
        """Return any other attribute from the wrapped environment, such as `physics` or `task`."""
        if name.startswith("__") or name == "_environment":
            raise AttributeError(name)
        return getattr(self._environment, name)


def make_dm_control(
    environment: str | Callable[..., dm_env.Environment],
    actuators: Mapping[str, object],
    *,
    action: str = "force",
    randomize: Mapping[str, object] | None = None,
    disturbances: object = None,
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
    noise_seed: int | None = None,
    **options: Argument,
) -> MotorsAddedEnvironment:
    """Create an environment of dm_control, or another `dm_env.Environment`, with motors.

        >>> motors = {".*": "maxon-ec45-flat-50w"}
        >>> env = codrl_mj.make_dm_control("cheetah/run", motors, task_kwargs={"random": 1})

    With `"ideal"` actuators it behaves bit for bit like the environment without motors.

    Args:
        environment: `DOMAIN/TASK` of the suite, or a function that makes an environment.
        actuators: pattern of actuators' names -> actuator, as for `codrl_mj.add_motors`.
        action: as for `codrl_mj.make`.
        randomize: as for `codrl_mj.make`; the drawn values are in `randomization`. Not for
            environments that rebuild their model at every reset.
        disturbances: as for `codrl_mj.make`; actions must be the model's controls.
        allow_unstable: as for `codrl_mj.make`.
        joint_dynamics: as for `codrl_mj.make`.
        noise_seed: seed of the sensors' noise, of randomization and of load pulses.
        **options: arguments of `dm_control.suite.load`, or of the function.

    Raises:
        ValueError: see `codrl_mj.add_motors`; an unknown environment; a model that is not built
            from XML; or an argument that does not fit the actuators or the environment.
        RuntimeError: dm_control does not work with the installed MuJoCo.
    """
    check_dm_control()
    creator: Callable[..., dm_env.Environment]
    if not isinstance(environment, str) and not callable(environment):
        raise ValueError(
            f"environment = {environment!r}: must be DOMAIN/TASK, or a function that makes an"
            " environment; pass a function instead of an environment, such as lambda:"
            " suite.load(DOMAIN, TASK)"
        )
    if not isinstance(environment, str):
        name, creator = getattr(environment, "__name__", "environment"), environment
    else:
        domain, _, task = environment.partition("/")
        if (domain, task) not in suite.ALL_TASKS:
            known = ["/".join(pair) for pair in suite.ALL_TASKS]
            raise ValueError(
                f"environment = {environment!r}: {did_you_mean(environment, known)}must be"
                " DOMAIN/TASK of dm_control.suite.ALL_TASKS, or a function"
            )
        name, creator = environment, functools.partial(suite.load, domain, task)
    settings: Info = {"randomize": randomize, "disturbances": disturbances}
    config = EnvConfig(
        ExternalEnvSource(name, creator),
        actuators,
        action=action,
        allow_unstable=allow_unstable,
        joint_dynamics=joint_dynamics,
        **settings,
    )
    return MotorsAddedEnvironment(functools.partial(creator, **options), config, noise_seed)
