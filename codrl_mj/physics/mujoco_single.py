"""One simulation of a task in MuJoCo, with actuators in the control callback."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj import engine
from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import PickledState
from codrl_mj.engine.families import USER_HEADER_SIZE
from codrl_mj.physics.base import Force, Physics, Scene, SimulationConfig, Stepping
from codrl_mj.physics.mjcf import flags_with_friction, needed_callbacks, task_model
from codrl_mj.physics.stepping import Wiring, compiled_stepping, make_pointer_table
from codrl_mj.physics.variation import write_fields

ARM_COLUMN = Wiring._fields.index("arm")


class MujocoPhysics(Physics):
    """Simulation of a task with its MJCF model.

    One `mj_step` is one integration step. With CartPole's explicit Euler integrator, the positions
    are then recomputed with the old velocities instead of the new ones. For slide and hinge joints
    this is exactly Gymnasium's update. If the task has bounds (`Task.constrain`), the state is
    moved back inside them after every integration step.
    """

    stepping: Stepping
    scene: Scene

    def __init__(self, simulation: SimulationConfig) -> None:
        """Compile the model and install the callbacks that it needs."""
        super().__init__(simulation)
        self.model = task_model(simulation)
        self.data = mujoco.MjData(self.model)
        self._flags = self.model.opt.disableflags
        task = simulation.task
        self._qpos_order, self._qvel_order = _to_slice(task.qpos), _to_slice(task.qvel)
        self.wiring: list[Wiring] = []
        """Indices of the actuators' quantities in the model."""
        for name, actuator in zip(task.motors, simulation.actuators, strict=True):
            index = self.model.actuator(name).id
            joint = self.model.actuator_trnid[index, 0]
            dof, qpos = self.model.jnt_dofadr[joint], self.model.jnt_qposadr[joint]
            # Actuators without activations have the address -1.
            first = max(self.model.actuator_actadr[index], 0)
            self.wiring.append(
                Wiring(
                    index, self.model.actuator_ctrladr[index], first, dof, actuator.arm_radius, qpos
                )
            )
        self.settings = np.hstack(
            [np.array(self.wiring, dtype=np.float64), self._disturber.parameters]
        )
        """Settings as in `codrl_mj.physics.stepping`, which also explains `pointer_table` and
        `pointers`.
        """
        self._bind()
        self.reset(np.zeros(len(task.state_names)))

    def _bind(self) -> None:
        """Create the views that a step uses, and ensure that the callbacks are installed."""
        self._qpos, self._qvel = self.data.qpos, self.data.qvel
        self.stepping = compiled_stepping(self.simulation)
        self.pointer_table = make_pointer_table(
            self.data, self.settings, self._disturber.memory, self.trace
        )
        self.pointers = self.pointer_table.ctypes.data
        self.scene = (self.model, self.data)
        self._callbacks = needed_callbacks(self.model)
        self.install()

    def install(self) -> None:
        """Ensure that the callbacks are installed; raise if another library replaced them."""
        if self._callbacks:
            engine.install(*self._callbacks)

    def __getstate__(self) -> PickledState:
        """Return all attributes except views and model; a copy takes the model from its data."""
        return {name: value for name, value in self.__dict__.items() if name not in _VIEWS}

    def __setstate__(self, state: PickledState) -> None:
        """Restore the object, in this or another process."""
        self.__dict__.update(state)
        # The copy of the data has its own copy of the model. Both must be the same object again, so
        # that a changed model changes the simulation.
        self.model = self.data.model
        self._bind()

    @property
    def time(self) -> float:  # type: ignore[override]
        """Time since the start of the episode [s]."""
        time: float = self.data.time
        return time

    @property
    def state(self) -> np.ndarray:
        """Mechanical state in the task's order, shape (n,), float64; a new array."""
        state = np.empty(len(self._qpos) + len(self._qvel))
        state[self._qpos_order] = self._qpos
        state[self._qvel_order] = self._qvel
        return state

    @state.setter
    def state(self, state: np.ndarray) -> None:
        self._qpos[:], self._qvel[:] = state[self._qpos_order], state[self._qvel_order]

    def reset(self, state: np.ndarray, key: float = 0.0) -> None:
        """Start an episode; see `Physics.reset`."""
        # `install` raises if another library has replaced our callbacks since the last episode.
        self.install()
        self.stepping.start(np.asarray(state, dtype=np.float64), float(key), self.pointers)

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Replace the actuators by others of their family; a reset must follow.

        The inertia and friction that they add to their joints are fields of the model, which this
        does not change: see `set_model`.
        """
        if not self.simulation.motors_added:
            return
        for row, (actuator, limit) in enumerate(
            zip(actuators, self.simulation.max_forces, strict=True)
        ):
            index, arm, parameter_values = (
                int(self.wiring[row].actuator),
                actuator.arm_radius,
                actuator.parameter_values,
            )
            parameters_end = USER_HEADER_SIZE + len(parameter_values)
            self.model.actuator_user[index, USER_HEADER_SIZE:parameters_end] = parameter_values
            self.model.actuator_gear[self.model.actuator_outadr[index], 0] = 1.0 / arm
            self.model.actuator_ctrlrange[int(self.wiring[row].ctrl)] = -limit * arm, limit * arm
            self.settings[row, ARM_COLUMN] = arm

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the model, named as in `Variation.fields`, before a reset."""
        write_fields(self.model, fields)
        if "dof_frictionloss" in fields:
            has_friction = fields["dof_frictionloss"].any()
            self.model.opt.disableflags = (
                flags_with_friction(self._flags) if has_friction else self._flags
            )
        mujoco.mj_setConst(self.model, self.data)

    def show(self, state: np.ndarray) -> None:
        """Update the body poses to `state`, for rendering; motor and episode do not change."""
        self._qpos[:] = state[self._qpos_order]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        # On a hill, the passive-force callback lifts the car to the surface.
        mujoco.mj_passive(self.model, self.data)

    def step(self, desired_force: Force) -> None:
        """Take an environment step; see `Physics.step`."""
        if not self.stepping.step(desired_force, self.pointers):
            self.check_finite()

    def read_sensors(self, row: np.ndarray) -> np.ndarray:
        """Return the sensors' readings; see `Physics.read_sensors`."""
        readings = np.empty((len(row), len(self.simulation.family.OBSERVED)))
        self.stepping.read_sensors(row, readings, self.pointers)
        return readings

    def snapshot(self) -> np.ndarray:
        """Return the state of simulation and motors (`mjSTATE_INTEGRATION`) as a vector, float64.

        It includes neither `memory` nor changes by `set_actuators` and `set_model`.
        """
        vector = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, vector, _STATE)
        return vector

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from the result of `snapshot`."""
        mujoco.mj_setState(self.model, self.data, snapshot, _STATE)


def _to_slice(entries: tuple[int, ...]) -> slice:
    """Return evenly spaced indices as a slice, which numpy handles faster than a list."""
    stride = entries[1] - entries[0] if len(entries) > 1 else 1
    return slice(entries[0], entries[-1] + 1, stride)


_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_VIEWS = (
    "model",
    "_qpos",
    "_qvel",
    "stepping",
    "pointers",
    "pointer_table",
    "bound_arrays",
    "scene",
)
