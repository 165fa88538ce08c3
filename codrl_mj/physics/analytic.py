"""Simulation of a task by its reference: unmodified Gymnasium, or equations in closed form."""

from collections.abc import Sequence

import numpy as np

from codrl_mj.actuators import ActuatorModel, Inputs, parameters_type
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.physics.base import Force, Physics, SimulationConfig


class AnalyticPhysics(Physics):
    """Simulation of a task by the equations of motion of its `Task.reference_env`."""

    def __init__(self, simulation: SimulationConfig) -> None:
        """Create the task's reference environment.

        Raises:
            ValueError: an actuator or `joint` adds inertia or friction, for which the equations
                have no term; or the task has no reference environment.
        """
        actuator_additions = [
            (f"the {type(actuator).__name__}'s ", actuator.additions)
            for actuator in simulation.actuators
        ]
        for owner, additions in (*actuator_additions, ("joint.", simulation.joint)):
            for name in ("armature", "damping", "friction"):
                if value := getattr(additions, name):
                    raise ValueError(
                        f"{owner}{name} = {value:g}: the equations have no term for it; use"
                        " physics='mujoco'"
                    )
        task = simulation.task
        if task.reference_env is None:
            raise ValueError(
                f"physics = 'analytic': {task.name} has no Task.reference_env; use 'mujoco'"
            )
        super().__init__(simulation)
        self.timestep = simulation.timestep
        self.reference_env = task.make_reference_env(simulation.options)
        self._actuators: list[tuple[float, Parameters]] = []
        self.set_actuators(simulation.actuators)
        self.reset(np.zeros(len(task.state_names)))

    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode; see `Physics.reset`."""
        self.state = np.array(state, dtype=np.float64)
        kind = self.simulation.family.State
        rest = kind._make([0.0] * len(kind._fields))
        self._states = [rest] * len(self._actuators)
        self.time = 0.0
        self._key = key
        self._disturber.reset(
            np.zeros(1, dtype=np.int64), key, self.simulation.holding_forces(self.state[np.newaxis])
        )

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Replace the actuators by others of their family; a reset must follow."""
        kind = parameters_type(self.simulation.family)
        self._actuators = [
            (actuator.arm_radius, kind(*actuator.parameter_values)) for actuator in actuators
        ]

    def step(self, desired_force: Force) -> None:
        """Take an environment step; see `Physics.step`."""
        desired = np.atleast_2d(np.asarray(desired_force, dtype=np.float64))
        has_several, speeds = len(self._actuators) > 1, list(self.simulation.task.speed_indices)
        for rows in self.trace:
            commands, loads = (array[0] for array in self._disturber.disturb_commands(desired))
            for motor_index, (row, command) in enumerate(zip(rows, commands.tolist(), strict=True)):
                row[:-1] = command, *self._advance(motor_index, command)
            force: Force = rows[:, 1] if has_several else float(rows[0, 1])
            if self._disturber.enabled:
                force = force + (loads if has_several else float(loads[0]))
            self.state = self.reference_env(
                self.state, force, self.timestep, self.simulation.integrator
            )
            self.time += self.timestep
            rows[:, -1] = self.state[speeds]
        self.check_finite()

    def _advance(self, motor_index: int, command: float) -> tuple[float, ...]:
        """Advance an actuator by one integration step; return its force and its signals."""
        arm, parameters = self._actuators[motor_index]
        velocity_index = self.simulation.task.speed_indices[motor_index]
        position, speed = self.state[
            [
                self.simulation.task.qpos[self.simulation.task.qvel.index(velocity_index)],
                velocity_index,
            ]
        ].tolist()
        inputs = Inputs(
            command * arm, position / arm, speed / arm, self.time, self._key + motor_index
        )
        self._states[motor_index], torque, signals = self.simulation.family.advance(
            parameters, self.timestep, self._states[motor_index], inputs
        )
        return torque / arm, *signals

    def read_sensors(self, row: np.ndarray) -> np.ndarray:
        """Return the sensors' readings; see `Physics.read_sensors`."""
        return np.array(
            [
                self.simulation.family.observe(
                    parameters,
                    self.timestep,
                    self.simulation.family.Signals(*signals[2:-1].tolist()),
                    Inputs(0.0, 0.0, 0.0, self.time, self._key + motor_index),
                )
                for motor_index, ((_, parameters), signals) in enumerate(
                    zip(self._actuators, row, strict=True)
                )
            ]
        )

    def snapshot(self) -> np.ndarray:
        """Return state, actuators, time and key as a vector, shape (k,), float64.

        It includes neither `memory` nor changes by `set_actuators`. The reference environment has
        no other state.
        """
        states = [value for state in self._states for value in state]
        return np.array([*self.state, *states, self.time, self._key], dtype=np.float64)

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from the result of `snapshot`."""
        size, kind = len(self.simulation.task.state_names), self.simulation.family.State
        self.state = snapshot[:size].copy()
        *values, self.time, self._key = snapshot[size:].tolist()
        count = len(kind._fields)
        self._states = [
            kind._make(values[index * count : (index + 1) * count])
            for index in range(len(self._actuators))
        ]
