"""One simulation of a task in MuJoCo, the motor in the control callback."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from codrl_mj import callbacks
from codrl_mj.callbacks.engine import addresses
from codrl_mj.disturbances import OFF, Disturbances
from codrl_mj.motor import Actuator, to_vector
from codrl_mj.physics.base import TRACE_NAMES, Signals, check_finite
from codrl_mj.physics.disturber import disturber
from codrl_mj.physics.mjcf import needed_callbacks, task_model
from codrl_mj.physics.stepping import ARM, DISTURBANCE, actuator_settings, compiled_stepping
from codrl_mj.physics.variation import write_fields
from codrl_mj.tasks import Task


class MujocoPhysics:
    """A task's MJCF model and its data. See `codrl_mj.physics.base.Physics`.

    One `mj_step` is one integration step. With CartPole's explicit Euler integrator the positions are then moved by the
    old velocity instead of the new one, which for slide and hinge joints is exactly Gymnasium's update. Where the task
    has bounds (`Task.constrain`), the state is put back inside them after every integration step.
    """

    def __init__(
        self,
        task: Task,
        actuator: Actuator | None,
        inner_steps: int,
        integrator: str,
        max_force: float | None = None,
        disturbances: Disturbances = OFF,
    ) -> None:
        """Compile the model and install the callbacks that it needs.

        Args:
            task: the task.
            actuator: motor and current loop; None is the ideal actuator.
            inner_steps: integration steps per environment step.
            integrator: one of the task's integrators.
            max_force: limit of the desired force [N] or torque [N*m]; None is the task's.
            disturbances: imperfections of drive, sensor, supply and joint, and load pulses.
        """
        self.task = task
        self.actuator = actuator
        self.inner_steps = inner_steps
        self._explicit = integrator == "euler"
        self._max_force = task.max_force if max_force is None else max_force
        timestep = task.step_duration / inner_steps
        self.model = task_model(task, actuator, timestep, max_force, self._explicit, disturbances)
        self.data = mujoco.MjData(self.model)
        self._qpos_order, self._qvel_order = _progression(task.qpos), _progression(task.qvel)
        self._disturbances = disturbances
        self._disturber = disturber(disturbances, timestep, self._max_force, 1)
        self.trace = np.zeros((inner_steps, len(TRACE_NAMES)))
        dof = self.model.jnt_dofadr[self.model.actuator("motor").trnid[0]]
        kind = actuator is not None, disturbances.of_motor, dof
        sensor = disturbances.current_bias, disturbances.current_noise
        numbers: Any = [] if self._disturber is None else self._disturber.numbers
        self._settings = np.array([*kind, *sensor, *actuator_settings(actuator), *numbers], dtype=np.float64)
        self._bind()
        self.reset(np.zeros(len(task.state_names)))

    def _bind(self) -> None:
        """Take the views that a step uses, and make sure that the callbacks are there."""
        self._qpos, self._qvel = self.data.qpos, self.data.qvel
        memory = np.zeros((1, 0)) if self._disturber is None else self._disturber.memory
        self.arguments = *addresses(self.data), self._settings, memory, self.trace
        self.stepping = compiled_stepping(
            self.task, self._explicit, self._disturber is not None, self._disturbances.current_noise > 0.0
        )
        self._callbacks = needed_callbacks(self.model)
        self._install()

    def _install(self) -> None:
        if self._callbacks:
            callbacks.install(*self._callbacks)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the views and the model, which a copy takes of its own data."""
        return {name: value for name, value in self.__dict__.items() if name not in _VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore, in this or another process."""
        self.__dict__.update(state)
        self.model = self.data.model  # the one model of the copy: whoever changes either changes the simulation
        self._bind()

    @property
    def state(self) -> np.ndarray:
        """The mechanical state in the task's order, shape (n,), float64, as MuJoCo's data have it now; a new array."""
        state = np.empty(len(self.task.state_names))
        state[self._qpos_order] = self._qpos
        state[self._qvel_order] = self._qvel
        return state

    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode from `state`, with the motor at rest.

        Args:
            state: the mechanical state.
            key: of the random numbers of the episode's disturbances.
        """
        self._install()  # raises if somebody replaced ours since the last episode
        self.stepping.start(np.asarray(state, dtype=np.float64), float(key), *self.arguments)

    def set_actuator(self, actuator: Actuator) -> None:
        """Exchange the motor for another; to be followed by a reset. An ideal actuator cannot be exchanged."""
        assert self.actuator is not None
        arm = actuator.motor.arm_radius
        vector = to_vector(actuator)
        self.model.actuator_user[0, : len(vector)] = vector
        self.model.actuator_gear[0, 0] = 1.0 / arm
        self.model.actuator_ctrlrange[0] = -self._max_force * arm, self._max_force * arm
        self._settings[ARM:DISTURBANCE] = actuator_settings(actuator)
        self.actuator = actuator

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the model; to be followed by a reset.

        Args:
            fields: as `codrl_mj.physics.variation.Variation.fields` returns them, for one simulation.
        """
        write_fields(self.model, fields)
        mujoco.mj_setConst(self.model, self.data)

    def show(self, state: np.ndarray) -> None:
        """Bring the body poses up to date with `state`, for drawing; the motor and the episode are left alone."""
        self._qpos[:] = state[self._qpos_order]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_passive(self.model, self.data)  # where there is a hill, its callback puts the car on it

    def step(self, desired_force: float) -> Signals:
        """Advance by one environment step, with the desired force (at most `max_force`) held over it.

        Raises:
            SimulationDivergedError: the state is no longer finite.
        """
        fine, *signals = self.stepping.step(float(desired_force), *self.arguments)
        if not fine:
            self.check_finite()
        return Signals(*signals)

    def check_finite(self) -> None:
        """Raise if the state is not finite or beyond `LARGEST`, saying which entry and when.

        Raises:
            SimulationDivergedError: as it says.
        """
        check_finite(self.task, self.state, self.data.time)

    def sensed(self, signals: Signals) -> Signals:
        """Signals of the present moment with the current [A] that the sensor measures."""
        return signals._replace(current=self.stepping.sensed(float(signals.current), *self.arguments))

    def snapshot(self) -> np.ndarray:
        """Simulation and motor as the engine's state vector (`mjSTATE_INTEGRATION`), shape (k,), float64.

        `memory` and what `set_actuator` and `set_model` changed are not in it.
        """
        vector = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, vector, _STATE)
        return vector

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from what `snapshot` returned."""
        mujoco.mj_setState(self.model, self.data, snapshot, _STATE)

    @property
    def memory(self) -> np.ndarray:
        """What the disturbances remember beside the engine's own state, a live array; empty if nothing."""
        return np.empty(0) if self._disturber is None else self._disturber.memory[0]


def _progression(entries: tuple[int, ...]) -> slice:
    """The slice that selects `entries`, an arithmetic progression; numpy takes a fraction of a list's time for it."""
    stride = entries[1] - entries[0] if len(entries) > 1 else 1
    return slice(entries[0], entries[-1] + 1, stride)


_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_VIEWS = ("model", "_qpos", "_qvel", "stepping", "arguments")
