"""dm_control's environments with motors: `make_dm_control`. Needs the extra `dm-control`."""

from collections.abc import Callable, Mapping
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_control import suite

from codrl_mj.actuators.noise import LARGEST_KEY
from codrl_mj.engine.reading import Readout, clear_motors
from codrl_mj.fields import did_you_mean
from codrl_mj.foreign.building import Building
from codrl_mj.foreign.readings import readings


class MotorisedEnvironment(dm_env.Environment):
    """An environment of dm_control's that builds all its models with motors; whatever else it has is had through this.

    Its own order of stepping is kept: by default `mj_step2` before `mj_step1`, where `signals` are those of the forces
    that moved it last.
    """

    def __init__(self, build: Callable[[], dm_env.Environment], building: Building, noise_seed: int | None) -> None:
        """Build it.

        Args:
            build: makes the environment.
            building: the motors.
            noise_seed: of the noise of their sensors.

        Raises:
            ValueError: see `codrl_mj.motorised`.
        """
        self._building = building
        with building.motorising():
            self._environment = build()
        building.check()
        self._generator = np.random.default_rng(noise_seed)
        self._read: tuple[Any, Readout] | None = None

    def reset(self) -> dm_env.TimeStep:
        """Start an episode, the motors at rest; composer environments build their model anew."""
        with self._building.motorising():
            return self._begun(self._environment.reset())

    def step(self, action: Any) -> dm_env.TimeStep:
        """Advance by one environment step; an episode that has ended starts anew."""
        with self._building.motorising():
            return self._begun(self._environment.step(action))

    def _begun(self, timestep: dm_env.TimeStep) -> dm_env.TimeStep:
        """Give noisy sensors their keys where an episode begins."""
        if timestep.first() and any(motor.random for motor in self._readout.motors.values()):
            keys = self._generator.integers(LARGEST_KEY, size=len(self._readout.motors))
            clear_motors(self.mujoco[1], keys.tolist())
        return timestep

    @property
    def _readout(self) -> Readout:
        model, _ = self.mujoco
        if self._read is None or self._read[0] is not model:
            self._read = model, Readout(model)
        return self._read[1]

    def signals(self) -> dict[str, Any]:
        """The motors' signals after the last step, as in `info` of `codrl_mj.make`.

        `desired_force` and `actual_force` [N or N*m], the signals of the families and `saturated`; of several motors
        arrays (n_motors,) in the model's order.
        """
        return readings(self._readout, self.mujoco[1])

    @property
    def mujoco(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Present model and data; those of a composer environment change with every reset."""
        physics = self._environment.physics
        return physics.model.ptr, physics.data.ptr

    def observation_spec(self) -> Any:
        """The environment's."""
        return self._environment.observation_spec()

    def action_spec(self) -> Any:
        """The environment's."""
        return self._environment.action_spec()

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
    actuators: Mapping[str, Any],
    *,
    allow_unstable: bool = False,
    noise_seed: int | None = None,
    **options: Any,
) -> MotorisedEnvironment:
    """An environment of dm_control's, or of anybody's made with it, with motors behind its actuators.

        >>> env = codrl_mj.make_dm_control("cheetah/run", {".*": "maxon-ec45-flat-50w"}, task_kwargs={"random": 1})

    With `"ideal"` actuators it is bit for bit the environment without them.

    Args:
        environment: `DOMAIN/TASK` of the suite, or a function that makes an environment.
        actuators: what goes where, as for `codrl_mj.motorise`.
        allow_unstable: likewise.
        noise_seed: of the noise of the motors' sensors.
        **options: of `dm_control.suite.load`, or of the function.

    Raises:
        ValueError: see `codrl_mj.motorise`; an unknown environment; or its model is not built from XML.
    """
    building = Building(actuators, allow_unstable)
    if not isinstance(environment, str):
        return MotorisedEnvironment(lambda: environment(**options), building, noise_seed)
    domain, _, task = environment.partition("/")
    if (domain, task) not in suite.ALL_TASKS:
        known = ["/".join(each) for each in suite.ALL_TASKS]
        raise ValueError(
            f"environment = {environment!r}: {did_you_mean(environment, known)}must be DOMAIN/TASK of "
            "dm_control.suite.ALL_TASKS, or a function"
        )
    return MotorisedEnvironment(lambda: suite.load(domain, task, **options), building, noise_seed)
