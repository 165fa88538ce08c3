"""The actuators of a task's simulations, which MuJoCo's control callback drives."""

import functools
from collections.abc import Callable, Sequence

import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import Action, PickledState
from codrl_mj.envs.bank import ActuatorBank
from codrl_mj.envs.randomization import RandomizationState, apply_to_batch, apply_to_simulation
from codrl_mj.envs.setup import ResolvedEnv
from codrl_mj.physics.base import (
    Force,
    Physics,
    Signals,
    make_info_reader,
    signal_names,
    trace_names,
)
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics


class TaskBank(ActuatorBank):
    """The actuators of one simulation of a task, or of a batch."""

    def __init__(
        self,
        setup: ResolvedEnv,
        physics: Physics | MujocoBatchPhysics,
        actuators: Sequence[Sequence[ActuatorModel]],
    ) -> None:
        """Connect to simulations.

        Args:
            setup: the resolved configuration.
            physics: the simulation, or a batch of N.
            actuators: the actuators of each simulation, N tuples.
        """
        self.setup, self._physics, self._count = setup, physics, len(actuators)
        # `signals` is called in every step, and attributes that are written do not change it.
        self._commands_torque = setup.commands.is_torque_controlled
        apply_values = (
            functools.partial(apply_to_batch, physics)
            if isinstance(physics, MujocoBatchPhysics)
            else functools.partial(apply_to_simulation, physics)
        )
        super().__init__(
            setup.task.motors,
            setup.sensors,
            setup.commands.action_space,
            RandomizationState(setup.randomization, actuators, apply_values),
            setup.needs_key,
        )

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """Index of a motor of the task -> motor of the present episode, in the first simulation."""
        return dict(enumerate(self.randomization.motors(0, self.setup.config.actuators)))

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the motors' signals in `info`."""
        return signal_names(self.setup.simulation.family)

    @property
    def trace_names(self) -> tuple[str, ...]:
        """Columns of `Physics.trace`."""
        return trace_names(self.setup.simulation.family)

    @property
    def memory(self) -> np.ndarray:
        """Delayed commands and pulses, a live array (N, k); k = 0 without disturbances."""
        return self._physics.memory.reshape(self._count, -1)

    @property
    def force(self) -> Callable[[Action], Force]:
        """(element of `action_space`) -> desired force [N or N*m], before disturbances."""
        return self.setup.commands.force

    @property
    def forces(self) -> Callable[[np.ndarray], np.ndarray]:
        """(N elements of `action_space`) -> desired forces [N or N*m], (N,) or (N, motors)."""
        return self.setup.commands.forces

    @functools.cached_property
    def _read_info(self) -> Callable[[Sequence[object] | np.ndarray], Signals]:
        """Function that turns columns of the trace into a mapping of names to columns."""
        return make_info_reader(self.trace_names[:-1])

    def __getstate__(self) -> PickledState:
        """Return all but the reader of columns: a local function, which is made on demand."""
        return {name: value for name, value in self.__dict__.items() if name != "_read_info"}

    def signals(self, columns: Sequence[object] | np.ndarray, desired: Force) -> Signals:
        """Return a trace's columns by name, with the `desired` force [N or N*m].

        If the actuator does not follow a force command, `desired_force` is the delivered force.
        """
        signals = self._read_info(columns)
        signals["desired_force"] = desired if self._commands_torque else signals["actual_force"]
        return signals

    def sensor_values(self, row: np.ndarray | None) -> np.ndarray:
        """Return the values of `sensors`, shape (k,), in the only simulation.

        Args:
            row: the last row of its trace; None at the start of an episode.
        """
        assert isinstance(self._physics, Physics)
        row = np.zeros_like(self._physics.trace[-1]) if row is None else row
        return self._physics.read_sensors(row).reshape(-1)
