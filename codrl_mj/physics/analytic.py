"""A task on the installed Gymnasium environment, unmodified, driven with an arbitrary force through its attributes."""

from typing import Any, Protocol

import gymnasium
import numpy as np

from codrl_mj.disturbances import OFF, Disturbances
from codrl_mj.motor import Actuator, advance, advance_imperfect, to_vector
from codrl_mj.physics.base import TRACE_NAMES, Signals, check_finite, ideal_signals, motor_signals
from codrl_mj.physics.disturber import disturber, sensed
from codrl_mj.tasks import Task


class Driver(Protocol):
    """Drives one Gymnasium environment by one integration step at a time."""

    speed: int
    """Index of the actuated body's velocity in the state."""

    def __init__(self, gymnasium_id: str) -> None:
        """Make the Gymnasium environment."""

    def __call__(self, state: np.ndarray, force: float, timestep: float, integrator: str) -> np.ndarray:
        """The state one integration step later."""


def _unwrapped(gymnasium_id: str) -> Any:
    return gymnasium.make(gymnasium_id, disable_env_checker=True).unwrapped


class PendulumDriver:
    """`PendulumEnv`: the torque limit and the time step are attributes, the action is the torque."""

    speed = 1

    def __init__(self, gymnasium_id: str) -> None:
        """Make the Gymnasium environment, without a torque limit."""
        self._env = _unwrapped(gymnasium_id)
        self._env.max_torque = np.inf

    def __call__(
        self,
        state: np.ndarray,
        force: float,
        timestep: float,
        integrator: str,  # noqa: ARG002 - it has one only
    ) -> np.ndarray:
        """One `step` with the torque as a float64 action, which Gymnasium does not round."""
        env = self._env
        env.dt = timestep
        env.state = state
        env.step(np.array([force]))
        return env.state


class CartPoleDriver:
    """`CartPoleEnv`: the force magnitude, the time step and the integrator are attributes."""

    speed = 1

    def __init__(self, gymnasium_id: str) -> None:
        """Make the Gymnasium environment."""
        self._env = _unwrapped(gymnasium_id)

    def __call__(self, state: np.ndarray, force: float, timestep: float, integrator: str) -> np.ndarray:
        """One `step` with `force_mag` set to the force."""
        env = self._env
        env.force_mag = force
        env.tau = timestep
        env.kinematics_integrator = integrator
        env.state = state
        env.steps_beyond_terminated = None  # the end of an episode is the task's to judge
        env.step(1)
        return env.state


class AcrobotDriver:
    """`AcrobotEnv`: the torques to choose from and the time step are attributes."""

    speed = 3
    _LARGEST = 400.0  # N*m*s^2

    def __init__(self, gymnasium_id: str) -> None:
        """Make the Gymnasium environment."""
        self._env = _unwrapped(gymnasium_id)

    def __call__(
        self,
        state: np.ndarray,
        force: float,
        timestep: float,
        integrator: str,  # noqa: ARG002 - it has one only
    ) -> np.ndarray:
        """One `step` with the torque as the only one to choose from."""
        if not abs(force) * timestep**2 < self._LARGEST:  # Gymnasium wraps angles turn by turn: it would not come back
            return np.full(4, np.nan)
        env = self._env
        env.AVAIL_TORQUE = [force]
        env.dt = timestep
        env.state = state
        env.step(0)
        return env.state


class MountainCarDriver:
    """`MountainCarEnv`: its step has no duration, but force, gravity and speed limit are attributes.

    One step is v += force - gravity cos(3 x), x += v. With w = v dt for its v, and force and gravity times dt^2, it is
    a step of any duration dt.
    """

    speed = 1
    _strength = "force"

    def __init__(self, gymnasium_id: str) -> None:
        """Make the Gymnasium environment; remember what it is before it is driven."""
        self._acceleration = getattr(_unwrapped(gymnasium_id), self._strength)  # m/s^2 per N
        self._env = _unwrapped("MountainCar-v0")
        self._gravity, self._max_speed = self._env.gravity, self._env.max_speed

    def __call__(
        self,
        state: np.ndarray,
        force: float,
        timestep: float,
        integrator: str,  # noqa: ARG002 - it has one only
    ) -> np.ndarray:
        """One `step` to the right with `force` set to the force's effect, of either sign."""
        env = self._env
        env.force = force * self._acceleration * timestep**2
        env.gravity = self._gravity * timestep**2
        env.max_speed = self._max_speed * timestep
        env.state = (state[0], state[1] * timestep)
        env.step(2)
        return np.array([env.state[0], env.state[1] / timestep])


class MountainCarContinuousDriver(MountainCarDriver):
    """`MountainCarEnv` again, with the `power` of `Continuous_MountainCarEnv`.

    The continuous environment's equations are the same, but written so that they cannot be scaled (its gravity is no
    attribute), and it rounds its state to float32.
    """

    _strength = "power"


DRIVERS: dict[str, type[Driver]] = {
    "pendulum": PendulumDriver,
    "cartpole": CartPoleDriver,
    "acrobot": AcrobotDriver,
    "mountain_car": MountainCarDriver,
    "mountain_car_continuous": MountainCarContinuousDriver,
}
"""The driver of each task's Gymnasium environment."""


class AnalyticPhysics:
    """A task on Gymnasium's own equations. See `codrl_mj.physics.base.Physics`."""

    def __init__(
        self,
        task: Task,
        actuator: Actuator | None,
        inner_steps: int,
        integrator: str,
        max_force: float | None = None,
        disturbances: Disturbances = OFF,
    ) -> None:
        """Make the Gymnasium environment.

        Args:
            task: the task.
            actuator: motor and current loop; None is the ideal actuator.
            inner_steps: integration steps per environment step.
            integrator: one of the task's integrators.
            max_force: limit of a quantised force [N] or torque [N*m]; None is the task's.
            disturbances: imperfections of drive, sensor and supply, and load pulses.

        Raises:
            ValueError: the disturbances include friction or damping, which Gymnasium's equations have no place for.
        """
        if disturbances.of_joint:
            raise ValueError(
                f"joint_damping = {disturbances.joint_damping:g} and joint_friction = "
                f"{disturbances.joint_friction:g}: Gymnasium's equations have neither; use physics='mujoco'"
            )
        self.task = task
        self.actuator = actuator
        self.inner_steps = inner_steps
        self._integrator = integrator
        self._timestep = task.step_duration / inner_steps
        self._driver = DRIVERS[task.name](task.gymnasium_id)
        self._parameters = None if actuator is None else to_vector(actuator)
        self._disturbances = disturbances
        limit = task.max_force if max_force is None else max_force
        self._disturber = disturber(disturbances, self._timestep, limit, 1)
        self.trace = np.zeros((inner_steps, len(TRACE_NAMES)))
        self.reset(np.zeros(len(task.state_names)))

    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode from `state`, with the motor at rest.

        Args:
            state: the mechanical state.
            key: of the random numbers of the episode's disturbances.
        """
        self.state = np.array(state, dtype=np.float64)
        self._loop = (0.0, 0.0, 0.0)  # current, integral, previous error
        self._time = 0.0
        self._key = key
        if self._disturber is not None:
            self._disturber.reset(0, key)

    def set_actuator(self, actuator: Actuator) -> None:
        """Exchange the motor for another; to be followed by a reset. An ideal actuator cannot be exchanged."""
        assert self.actuator is not None
        self.actuator = actuator
        self._parameters = to_vector(actuator)

    def step(self, desired_force: float) -> Signals:
        """Advance by one environment step, with the desired force (at most the task's `max_force`) held over it.

        Raises:
            SimulationDivergedError: the state is no longer finite.
        """
        signals = ideal_signals(desired_force)
        command = desired_force
        for row in self.trace:
            if self._disturber is not None:
                command = float(self._disturber.command(np.array([desired_force]))[0])
                signals = ideal_signals(desired_force, command)
            if self.actuator is not None:
                signals = self._motor(self.actuator, desired_force, command, float(self.state[self._driver.speed]))
            force = signals.actual_force
            if self._disturber is not None:
                force += float(self._disturber.load()[0])
            self.state = self._driver(self.state, force, self._timestep, self._integrator)
            self._time += self._timestep
            speed = self.state[self._driver.speed]
            row[:] = command, signals.actual_force, signals.current, signals.voltage, speed, signals.saturated
        check_finite(self.task, self.state, self._time)
        return signals

    def sensed(self, signals: Signals) -> Signals:
        """Signals of the present moment with the current [A] that the sensor measures."""
        measured = sensed(self._disturbances, [signals.current], [self._key], [self._time], self._timestep)
        return signals._replace(current=float(measured[0]))

    def snapshot(self) -> np.ndarray:
        """State, motor, time and key as a vector, shape (k,), float64.

        `memory` and what `set_actuator` changed are not in it. Gymnasium's environment remembers nothing else.
        """
        return np.array([*self.state, *self._loop, self._time, self._key], dtype=np.float64)

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from what `snapshot` returned."""
        size = len(self.task.state_names)
        self.state = snapshot[:size].copy()
        *loop, self._time, self._key = snapshot[size:].tolist()
        self._loop = tuple(loop)

    @property
    def memory(self) -> np.ndarray:
        """What the disturbances remember, a live array; empty if nothing."""
        return np.empty(0) if self._disturber is None else self._disturber.memory[0]

    def _motor(self, actuator: Actuator, desired_force: float, command: float, speed: float) -> Signals:
        """Advance the loop by one integration step."""
        arm, disturbances = actuator.motor.arm_radius, self._disturbances
        arguments: Any = (self._parameters, self._timestep, *self._loop, command * arm, speed / arm)
        available = actuator.controller.max_voltage
        if disturbances.of_motor:
            imperfections = disturbances.current_bias, disturbances.current_noise, disturbances.supply_resistance
            arguments += (*imperfections, self._key, self._time)
            *loop, voltage, available = advance_imperfect(*arguments)
        else:
            *loop, voltage = advance(*arguments)
        self._loop = tuple(loop)  # type: ignore[assignment]
        return motor_signals(actuator, desired_force, self._loop[0], voltage, command, available)
