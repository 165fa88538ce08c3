"""Many MuJoCo simulations of a task as rows of arrays, stepped by several threads."""

import copy
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import PickledState
from codrl_mj.engine.families import USER_HEADER_SIZE
from codrl_mj.physics.base import (
    MAX_STATE,
    Compiled,
    NumbaTuple,
    SimulationConfig,
    SimulationDivergedError,
)
from codrl_mj.physics.disturber import Disturber
from codrl_mj.physics.mjcf import flags_with_friction
from codrl_mj.physics.mujoco_single import MujocoPhysics
from codrl_mj.physics.rows import BatchRows, derive_fields, make_lane, state_slice
from codrl_mj.physics.sharing import new_board, num_cpus, run_shared
from codrl_mj.physics.stepping import NOISE_KEY
from codrl_mj.physics.variation import (
    Variation,
    arms_and_additions,
    bare_model,
    field_of,
    write_fields,
)

DERIVED = (
    *("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "dof_length"),
    *("tendon_length0", "tendon_invweight0", "actuator_acc0", "actuator_length0"),
)
"""Fields of a model that MuJoCo derives from masses and lengths."""


class MujocoBatchPhysics:
    """N simulations of one task as arrays, bit for bit identical to N `MujocoPhysics`.

    Every simulation has its own actuators, because their parameters are model fields with a value
    for each simulation.
    """

    def __init__(
        self,
        simulation: SimulationConfig,
        actuators: Sequence[Sequence[ActuatorModel]],
        num_threads: int = 0,
    ) -> None:
        """Compile the model and create a row for each of the N tuples in `actuators`.

        All actuators must be of the family in `simulation`. `num_threads` = 0 uses all CPUs.
        """
        self.simulation, task = simulation, simulation.task
        self.num_envs, self._num_threads = len(actuators), num_threads
        self._nominal = MujocoPhysics(simulation)
        self._disturber = Disturber(
            simulation.disturbances,
            simulation.timestep,
            simulation.max_forces,
            self.num_envs,
            simulation.force_per_position,
        )
        self._wiring = self._nominal.wiring
        self._positions, self._velocities = np.array(task.qpos), np.array(task.qvel)
        self._fields: dict[str, np.ndarray] = {}
        # State of a simulation after a reset, with the motor at rest.
        self._rest = self._nominal.snapshot()
        self._states = np.repeat(self._rest[np.newaxis], self.num_envs, axis=0)
        self._arms = np.ones((self.num_envs, len(task.motors)))
        self._bind()
        all_rows, (arms, additions) = np.arange(self.num_envs), arms_and_additions(actuators)
        self._arms[:] = arms
        # If all actuators equal those of the model, the rows can share its parameters.
        if any(tuple(row) != simulation.actuators for row in actuators):
            self.set_parameters(
                all_rows,
                np.array([[actuator.parameter_values for actuator in row] for row in actuators]),
                arms,
            )
        if (additions != additions[0]).any():
            indices = [int(wiring.actuator) for wiring in self._wiring]
            variation = Variation(
                bare_model(task.name, simulation.joint, simulation.options),
                motors=indices,
                vary_additions=True,
            )
            self.set_model(all_rows, variation.fields(np.empty((self.num_envs, 0)), additions))

    def _bind(self) -> None:
        """Make the data of each thread, and the views that a step uses."""
        threads = min(self._num_threads or num_cpus(), self.num_envs)
        self._data = [mujoco.MjData(copy.copy(self._nominal.model)) for _ in range(threads)]
        self.model, self.data = self._nominal.model, self._nominal.data
        self.stepping = self._nominal.stepping
        self._lanes: list[NumbaTuple] = []
        slices = {name: state_slice(self.model, name) for name in ("time", "qpos", "qvel", "act")}
        self._time, self._qpos, self._qvel, self._act = (
            self._states[:, state_part] for state_part in slices.values()
        )
        memory = self._disturber.memory
        self._rows = tuple(
            BatchRows(self._states, self._arms, memory.reshape(*self._arms.shape, memory.shape[1]))
        )

    def _lane(self) -> NumbaTuple:
        """Make all threads' lanes if model fields were added; return the first lane."""
        if not self._lanes:
            self._lanes = [
                tuple(make_lane(self._nominal, data, self._fields)) for data in self._data
            ]
            self._steps: NumbaTuple = None
        return self._lanes[0]

    def field(self, name: str) -> np.ndarray:
        """Return a live array (N, ...) of a model field, with a value for each simulation."""
        if name not in self._fields:
            nominal = np.asarray(field_of(self.model, name))
            nominal = nominal.astype(np.int32) if nominal.dtype.kind == "i" else nominal
            self._fields[name] = np.repeat(nominal[np.newaxis], self.num_envs, axis=0)
            self._lanes = []
        return self._fields[name]

    def __getstate__(self) -> PickledState:
        """Return everything except views and the simulations of threads."""
        return {
            name: value for name, value in self.__dict__.items() if name not in _REBUILT_ATTRIBUTES
        }

    def __setstate__(self, state: PickledState) -> None:
        """Restore the object, in this or another process."""
        self.__dict__.update(state)
        self._bind()

    def set_parameters(
        self, rows: np.ndarray, parameter_values: np.ndarray, arms: np.ndarray
    ) -> None:
        """Set parameters (m, n, p) and arms [m] (m, n) of m simulations; then reset them.

        The inertia and friction that they add to their joints are fields of the models, which this
        does not change: see `set_model`.
        """
        if not self.simulation.motors_added:
            return
        user, gear, limits = map(
            self.field, ("actuator_user", "actuator_gear", "actuator_ctrlrange")
        )
        for motor_index, (wiring, limit) in enumerate(
            zip(self._wiring, self.simulation.max_forces, strict=True)
        ):
            actuator, arm = int(wiring.actuator), arms[:, motor_index]
            user[
                rows, actuator, USER_HEADER_SIZE : USER_HEADER_SIZE + parameter_values.shape[2]
            ] = parameter_values[:, motor_index]
            gear[rows, self.model.actuator_outadr[actuator], 0] = 1.0 / arm
            limits[rows, int(wiring.ctrl)] = np.stack([-limit * arm, limit * arm], axis=-1)
        self._arms[rows] = arms

    def set_model(self, rows: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Change model fields, named as in `Variation.fields`; then reset these simulations."""
        for name, values in fields.items():
            self.field(name)[rows] = values
        if "dof_frictionloss" in fields:
            has_friction, flags = (
                fields["dof_frictionloss"].any(axis=1),
                self.model.opt.disableflags,
            )
            self.field("opt.disableflags")[rows] = np.where(
                has_friction, flags_with_friction(flags), flags
            )
        for name in DERIVED:
            # MuJoCo derives further fields from those that changed. They are needed per simulation,
            # too.
            self.field(name)
        derived = np.array([list(self._fields).index(name) for name in DERIVED])
        derive_fields(rows, self._lane(), derived)

    @property
    def state(self) -> np.ndarray:
        """Mechanical states in the task's order, shape (N, n), float64; a new array."""
        state = np.empty((self.num_envs, len(self.simulation.task.state_names)))
        state[:, self._positions], state[:, self._velocities] = self._qpos, self._qvel
        return state

    @state.setter
    def state(self, states: np.ndarray) -> None:
        self._qpos[:], self._qvel[:] = states[:, self._positions], states[:, self._velocities]

    def models(self) -> Iterator[mujoco.MjModel]:
        """Yield one model object, with the non-visual fields of each simulation in turn."""
        model = copy.copy(self.model)
        for row in range(self.num_envs):
            write_fields(model, self._fields, row)
            yield model

    def reset(self, rows: np.ndarray, states: np.ndarray, keys: np.ndarray | float = 0.0) -> None:
        """Start episodes of m simulations from states (m, n) with random keys (m,)."""
        # `install` raises if another library has replaced our callbacks since the last episodes.
        self._nominal.install()
        self._states[rows] = self._rest
        self._qpos[rows], self._qvel[rows] = states[:, self._positions], states[:, self._velocities]
        if self.simulation.motors_added:
            for motor_index, wiring in enumerate(self._wiring):
                self._act[rows, int(wiring.act) + NOISE_KEY] = keys + motor_index
        if self._disturber.enabled:
            self._disturber.reset(rows, keys, self.simulation.holding_forces(states))

    def step(self, kernel: Compiled, steps: NumbaTuple) -> bool:
        """Take an environment step of every simulation; return True if any diverged.

        `kernel` is `Kernels.step_rows`, and `steps` a `VectorStep`, of `codrl_mj.envs.compiled`.
        """
        self._lane()
        # Helping threads keep the arguments of the turn in which they joined, so new arguments need
        # a new board.
        if steps is not self._steps:
            self._steps, self._board = steps, new_board()
        arguments = self._rows, tuple(steps)
        return run_shared(
            kernel, self._board, self._lanes, self.num_envs, self.simulation.inner_steps, *arguments
        )

    def observe(self, kernel: Compiled, rows: np.ndarray, observations: np.ndarray) -> None:
        """Fill observations of simulations that were reset; `kernel` is `Kernels.observe_rows`."""
        kernel(rows, self._lane(), self._rows, observations)

    @property
    def memory(self) -> np.ndarray:
        """State of the disturbances, a live array (N, k); (N, 0) without disturbances."""
        return self._disturber.memory.reshape(self.num_envs, -1)

    def check_finite(self, states: np.ndarray, rows: np.ndarray) -> None:
        """Raise if a state is invalid where `rows` (N,) is True; the message names the first."""
        is_valid = np.abs(states) <= MAX_STATE
        diverged = np.flatnonzero(~is_valid.all(axis=1) & rows)
        if len(diverged) == 0:
            return
        first = diverged[0]
        entry = self.simulation.task.state_names[int(np.argmin(is_valid[first]))]
        value = states[first][np.argmin(is_valid[first])]
        raise SimulationDivergedError(
            f"{self.simulation.task.name}: {len(diverged)} of {len(states)} simulations diverged;"
            f" environment {first} at t = {self._time[first, 0]:g} s: {entry} = {value:g}. Reset"
            " them; if this repeats, shorten the integration step (inner_steps) or lower the gains"
        )

    def snapshot(self) -> np.ndarray:
        """Return the states of all simulations with their motors, shape (N, k), float64."""
        return self._states.copy()

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from the result of `snapshot`."""
        self._states[:] = snapshot

    def show(self, index: int) -> None:
        """Move `data` to the pose of one simulation, for rendering."""
        self._nominal.show(self.state[index])


_REBUILT_ATTRIBUTES = (
    *("model", "data", "stepping", "_data", "_board", "_steps", "_lanes"),
    *("_time", "_qpos", "_qvel", "_act", "_rows"),
)
