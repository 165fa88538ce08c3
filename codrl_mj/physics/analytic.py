"""A task on the installed Gymnasium environment, unmodified, driven with an arbitrary force through its attributes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel, Inputs, parameters_type
from codrl_mj.physics.base import Physics, SimulationConfig


class AnalyticPhysics(Physics):
    """A task on Gymnasium's own equations."""

    def __init__(self, simulation: SimulationConfig) -> None:
        """Make the Gymnasium environment.

        Raises:
            ValueError: something is added to the joint, which Gymnasium's equations have no place
                for; or the task has no Gymnasium environment.
        """
        adding = [(f"the {type(one).__name__}'s ", one.additions) for one in simulation.actuators]
        for whose, added in (*adding, ("joint.", simulation.joint)):
            for name in ("armature", "damping", "friction"):
                if value := getattr(added, name):
                    raise ValueError(
                        f"{whose}{name} = {value:g}: the equations have no place for it; use"
                        " physics='mujoco'"
                    )
        task = simulation.task
        if task.twin is None:
            raise ValueError(
                f"physics = 'analytic': {task.name} rebuilds no environment of Gymnasium's; use"
                " 'mujoco'"
            )
        super().__init__(simulation)
        self.timestep = simulation.timestep
        self.twin = task.twin()
        self._actuators: list[tuple[float, Any]] = []
        self.set_actuators(simulation.actuators)
        self.reset(np.zeros(len(task.state_names)))

    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """See `Physics.reset`."""
        self.state = np.array(state, dtype=np.float64)
        rest = self.simulation.family.State(*[0.0] * len(self.simulation.family.State._fields))  # type: ignore[attr-defined]
        self._states = [rest] * len(self._actuators)
        self.time = 0.0
        self._key = key
        self._disturber.reset(
            np.zeros(1, dtype=np.int64), key, self.simulation.holding_forces(self.state[np.newaxis])
        )

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Exchange the actuators for others of their family; to be followed by a reset."""
        kind = parameters_type(self.simulation.family)
        self._actuators = [(actuator.arm_radius, kind(*actuator.parameter_values)) for actuator in actuators]

    def step(self, desired_force: Any) -> None:
        """See `Physics.step`."""
        desired = np.atleast_2d(np.asarray(desired_force, dtype=np.float64))
        several, speeds = len(self._actuators) > 1, list(self.simulation.task.speeds)
        for rows in self.trace:
            commands, loads = (each[0] for each in self._disturber.disturb_commands(desired))
            for number, (row, command) in enumerate(zip(rows, commands.tolist(), strict=True)):
                row[:-1] = command, *self._advance(number, command)
            force: Any = rows[:, 1] if several else float(rows[0, 1])
            if self._disturber.on:
                force = force + (loads if several else float(loads[0]))
            self.state = self.twin(self.state, force, self.timestep, self.simulation.integrator)
            self.time += self.timestep
            rows[:, -1] = self.state[speeds]
        self.check_finite()

    def _advance(self, number: int, command: float) -> tuple[float, ...]:
        """Advance an actuator by one integration step: the force that it delivers, and its signals."""
        arm, parameters = self._actuators[number]
        at = self.simulation.task.speeds[number]
        position, speed = self.state[
            [self.simulation.task.qpos[self.simulation.task.qvel.index(at)], at]
        ].tolist()
        inputs = Inputs(command * arm, position / arm, speed / arm, self.time, self._key + number)
        self._states[number], torque, signals = self.simulation.family.advance(
            parameters, self.timestep, self._states[number], inputs
        )
        return torque / arm, *signals

    def read_sensors(self, row: np.ndarray) -> np.ndarray:
        """See `Physics.observed`."""
        return np.array(
            [
                self.simulation.family.observe(
                    parameters,
                    self.timestep,
                    self.simulation.family.Signals(*signals[2:-1].tolist()),
                    Inputs(0.0, 0.0, 0.0, self.time, self._key + number),
                )
                for number, ((_, parameters), signals) in enumerate(
                    zip(self._actuators, row, strict=True)
                )
            ]
        )

    def snapshot(self) -> np.ndarray:
        """State, actuators, time and key as a vector, shape (k,), float64.

        `memory` and what `set_actuators` changed are not in it. Gymnasium's environment remembers
        nothing else.
        """
        states = [value for state in self._states for value in state]
        return np.array([*self.state, *states, self.time, self._key], dtype=np.float64)

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from what `snapshot` returned."""
        size, kind = len(self.simulation.task.state_names), self.simulation.family.State
        self.state = snapshot[:size].copy()
        *values, self.time, self._key = snapshot[size:].tolist()
        count = len(kind._fields)  # type: ignore[attr-defined]
        self._states = [
            kind(*values[at * count : (at + 1) * count]) for at in range(len(self._actuators))
        ]
