"""Many simulations of a task in MuJoCo at once, on the engine's own thread pool."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numba
import numpy as np
from mujoco.batch import Batch

from codrl_mj import engine
from codrl_mj.actuators import ActuatorModel, Ideal, check_same_family
from codrl_mj.disturbances import OFF, PLAIN, Disturbances, Joint
from codrl_mj.engine.families import HEAD, load_family, signals_at
from codrl_mj.engine.sensors import compiled_observe
from codrl_mj.physics.base import LARGEST, Signals, SimulationDivergedError, named_signals
from codrl_mj.physics.constrain import compiled_batch
from codrl_mj.physics.disturber import disturber
from codrl_mj.physics.mjcf import flags_with_friction, needed_callbacks, task_model
from codrl_mj.physics.mujoco_single import wiring
from codrl_mj.physics.stepping import NOISE_KEY, TORQUE
from codrl_mj.physics.variation import Variation, additions_of, bare_model, write_fields
from codrl_mj.tasks import Task


class MujocoBatchPhysics:
    """N simulations of one task, bit for bit those of N `MujocoPhysics`; states and signals are arrays.

    Every simulation has its own actuators: parameters are per-simulation model fields.
    """

    def __init__(
        self,
        task: Task,
        actuators: Sequence[Sequence[ActuatorModel]],
        inner_steps: int,
        integrator: str,
        max_forces: np.ndarray | None = None,
        num_threads: int = 0,
        disturbances: Disturbances = OFF,
        joint: Joint = PLAIN,
    ) -> None:
        """Compile the model and make the batch; arguments as for `MujocoPhysics`.

        But for `actuators`, which have one for each motor for each of N simulations, and `num_threads` of the engine; 0
        uses every CPU.
        """
        self.task = task
        self.family = check_same_family([one for each in actuators for one in each])
        self.motorised = not issubclass(self.family, Ideal)
        if self.motorised:
            load_family(self.family)
        self.inner_steps = inner_steps
        self.max_forces = task.max_forces if max_forces is None else max_forces
        self._explicit = integrator == "euler"
        self._corrected = self._explicit or task.constrain is not None
        timestep = task.step_duration / inner_steps
        self.num_envs = len(actuators)
        self.model = task_model(task, tuple(actuators[0]), timestep, max_forces, self._explicit, joint)
        self._disturber = disturber(disturbances, timestep, self.max_forces, self.num_envs)
        self._wiring = [wiring(self.model, name, one) for name, one in zip(task.motors, actuators[0], strict=True)]
        self._dofs = np.array([int(one.dof) for one in self._wiring])
        self._slots = np.array([int(one.act) for one in self._wiring])
        self._controls = np.array([int(one.ctrl) for one in self._wiring])
        self._positions, self._velocities = np.array(task.qpos), np.array(task.qvel)
        self._size = self.num_envs, num_threads
        self._varied = False  # whether the models differ in more than their actuators
        self._fields: dict[str, np.ndarray] = {}
        self._make_batch()
        self._rest = self._batch.state[0].copy()  # a simulation just reset, motor at rest
        self._arms = np.ones((self.num_envs, len(task.motors)))
        every, additions = np.arange(self.num_envs), additions_of(actuators)
        self.set_actuators(every, actuators)
        if (additions != additions[0]).any():
            motors = [int(one.actuator) for one in self._wiring]
            mounting = Variation(bare_model(task.name, joint), motors=motors, mounting=True)
            self.set_model(every, mounting.fields(np.empty((self.num_envs, 0)), additions))

    def _make_batch(self) -> None:
        """Make the engine's batch, and take the views that a step uses."""
        self._callbacks = needed_callbacks(self.model)
        self._install()
        self._batch = Batch(self.model, *self._size)
        self._kernels = compiled_batch(self.task, self._explicit)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self._act = self._batch.bind("ctrl"), self._batch.bind("act")
        self._load, self._time = self._batch.bind("qfrc_applied"), self._batch.bind("time")

    def _install(self) -> None:
        if self._callbacks:
            engine.install(*self._callbacks)

    def field(self, name: str) -> np.ndarray:
        """A field of the model with a value for each simulation, shape (N, ...): live, to be written to."""
        if name not in self._fields:
            self._fields[name] = self._batch.expand(name)
        return self._fields[name]

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the engine's batch, of which a copy needs the rows and fields."""
        kept = {name: value for name, value in self.__dict__.items() if name not in _ENGINE}
        return kept | {"rows": self.snapshot(), "_fields": {name: field.copy() for name, field in self._fields.items()}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore, in this or another process."""
        kept = dict(state)
        rows, fields = kept.pop("rows"), kept.pop("_fields")
        self.__dict__.update(kept, _fields={})
        self._make_batch()
        for name, values in fields.items():
            self.field(name)[:] = values
        if self._varied:
            self._batch.set_const()
        self.restore(rows)

    def set_actuators(self, rows: np.ndarray, actuators: Sequence[Sequence[ActuatorModel]]) -> None:
        """Give some simulations other actuators of the family; to be followed by a reset of them.

        What they add to their joints is the models': see `set_model`.
        """
        numbers = np.array([[one.numbers for one in each] for each in actuators])
        self.set_parameters(rows, numbers, np.array([[one.arm_radius for one in each] for each in actuators]))

    def set_parameters(self, rows: np.ndarray, numbers: np.ndarray, arms: np.ndarray) -> None:
        """Do what `set_actuators` does, with their `numbers` as an array (m, n, p) and their arms [m] as one (m, n)."""
        if not self.motorised:
            return
        user, gear, limits = map(self.field, ("actuator_user", "actuator_gear", "actuator_ctrlrange"))
        for at, (one, limit) in enumerate(zip(self._wiring, self.max_forces, strict=True)):
            index, arm = int(one.actuator), arms[:, at]
            user[rows, index, HEAD : HEAD + numbers.shape[2]] = numbers[:, at]
            gear[rows, index, 0] = 1.0 / arm
            limits[rows, index] = np.stack([-limit * arm, limit * arm], axis=-1)
        self._arms[rows] = arms

    def set_model(self, rows: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of some simulations' models, as `Variation.fields` returns them, before these are reset."""
        for name, values in fields.items():
            self.field(name)[rows] = values
        if "dof_frictionloss" in fields:
            rub, flags = fields["dof_frictionloss"].any(axis=1), self.model.opt.disableflags
            self.field("opt.disableflags")[rows] = np.where(rub, flags_with_friction(flags), flags)
        self._varied = True
        self._batch.set_const(rows)

    @property
    def state(self) -> np.ndarray:
        """Mechanical states in the task's order, shape (N, n), float64; a new array."""
        state = np.empty((len(self._qpos), len(self.task.state_names)))
        self._kernels.read(self._qpos, self._qvel, state)
        return state

    @state.setter
    def state(self, states: np.ndarray) -> None:
        self._place(slice(None), states)

    def _place(self, rows: np.ndarray | slice, states: np.ndarray) -> None:
        self._qpos[rows], self._qvel[rows] = states[:, self._positions], states[:, self._velocities]

    def models(self) -> Iterator[mujoco.MjModel]:
        """One model, which has each simulation's fields in turn; what is only drawn is the first one's."""
        model = copy.copy(self.model)
        for row in range(self.num_envs):
            write_fields(model, self._fields, row)
            yield model

    def reset(self, rows: np.ndarray, states: np.ndarray, keys: np.ndarray | float = 0.0) -> None:
        """Start episodes of m simulations, from states (m, n) with keys (m,) of random numbers, motors at rest.

        Raises:
            CallbackInUseError: another library's MuJoCo callback was installed in the meantime.
        """
        self._install()  # raises if somebody replaced ours since the last episodes
        self._batch.state[rows] = self._rest
        self._place(rows, states)
        if self.motorised:
            for at, slot in enumerate(self._slots):
                self._act[rows, slot + NOISE_KEY] = keys + at
        if self._disturber is not None:
            self._disturber.reset(rows, keys)

    def step(self, desired_force: np.ndarray) -> Signals:
        """Advance every simulation by one environment step, under forces (N,) or (N, n); the signals, of that shape."""
        given = command = desired_force.reshape(self.num_envs, -1)
        if self._disturber is None:
            _write_columns(self._ctrl, self._controls, command, self._arms)
            self._integrate(self.inner_steps)
        else:
            for _ in range(self.inner_steps):
                command = self._disturber.commands(given)
                self._load[:, self._dofs] = self._disturber.loads()
                _write_columns(self._ctrl, self._controls, command, self._arms)
                self._integrate(1)
        names = self.family.Signals._fields  # type: ignore[attr-defined]
        shown = np.zeros((1 + len(names), *command.shape))
        if self.motorised:
            _read_signals(self._act, self._slots, signals_at(self.family), self._arms, shown)
        else:
            shown[0] = command
        shown = shown.reshape(-1, *desired_force.shape)
        return {"desired_force": desired_force, **named_signals(("actual_force", *names), shown)}

    def _integrate(self, steps: int) -> None:
        """Take integration steps."""
        timestep = self.model.opt.timestep
        if not self._corrected:
            self._batch.step(nstep=steps)
            return
        moved = np.empty(self._qpos.shape)
        for _ in range(steps):
            if self._explicit:
                self._kernels.move(self._qpos, self._qvel, moved, timestep)
            self._batch.step()
            self._kernels.correct(self._qpos, self._qvel, moved, timestep)

    def observed(self, signals: Signals | None, rows: np.ndarray | None = None) -> np.ndarray:
        """What the sensors say at present, shape (m, n, k); without signals of a last step, as episodes start."""
        rows = np.arange(self.num_envs) if rows is None else rows
        names = self.family.Signals._fields  # type: ignore[attr-defined]
        shown = np.zeros((len(rows), len(self._wiring), len(names)))
        for at, name in enumerate(names if signals is not None else ()):
            shown[:, :, at] = signals[name].reshape(self.num_envs, -1)[rows]  # type: ignore[index]
        seen = np.empty((len(rows), len(self._wiring), len(self.family.OBSERVED)))
        user, fill = self.field("actuator_user"), compiled_observe(self.family)
        timestep, times = self.model.opt.timestep, self._time.reshape(-1)
        _observe_all(
            fill,
            rows,
            np.array([int(one.actuator) for one in self._wiring]),
            self._slots + NOISE_KEY,
            *(user, self._act, timestep, times, shown, seen),
        )
        return seen

    @property
    def memory(self) -> np.ndarray:
        """What the disturbances remember beside the engine's own state, a live array (N, k); (N, 0) if nothing."""
        if self._disturber is None:
            return np.empty((self.num_envs, 0))
        return self._disturber.memory.reshape(self.num_envs, -1)

    def check_finite(self, states: np.ndarray, rows: np.ndarray) -> None:
        """Raise if a state among `rows` (a mask, shape (N,)) left the finite numbers, naming the simulation.

        Raises:
            SimulationDivergedError: as it says.
        """
        fine = np.abs(states) <= LARGEST
        if fine.all():
            return
        broken = np.flatnonzero(~fine.all(axis=1) & rows)
        if len(broken) == 0:
            return
        first = broken[0]
        entry = self.task.state_names[int(np.argmin(fine[first]))]
        value = states[first][np.argmin(fine[first])]
        raise SimulationDivergedError(
            f"{self.task.name}: {len(broken)} of {len(states)} simulations diverged; environment {first} at "
            f"t = {self._time.reshape(-1)[first]:g} s: {entry} = {value:g}. Reset them; if this repeats, shorten the "
            "integration step (inner_steps) or lower the gains"
        )

    def snapshot(self) -> np.ndarray:
        """The whole state of every simulation, motor included, shape (N, k), float64."""
        return self._batch.state.copy()

    def restore(self, snapshot: np.ndarray) -> None:
        """Continue from what `snapshot` returned."""
        self._batch.state[:] = snapshot

    def show(self, index: int, data: mujoco.MjData) -> None:
        """Bring `data`, of this model, to the pose of one simulation, for drawing."""
        data.qpos[:] = self._qpos[index]
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_camlight(self.model, data)
        mujoco.mj_passive(self.model, data)


@numba.njit(nogil=True, error_model="numpy")
def _observe_all(
    fill: Any,
    rows: np.ndarray,
    actuators: np.ndarray,
    keys: np.ndarray,
    user: np.ndarray,
    act: np.ndarray,
    timestep: float,
    times: np.ndarray,
    shown: np.ndarray,
    seen: np.ndarray,
) -> None:
    for at in range(len(rows)):
        row = rows[at]
        for motor in range(len(actuators)):
            numbers, signals = user[row, actuators[motor], HEAD:].ctypes.data, shown[at, motor].ctypes.data
            fill(numbers, signals, timestep, times[row], act[row, keys[motor]], seen[at, motor].ctypes.data)


@numba.njit(nogil=True, error_model="numpy")
def _write_columns(array: np.ndarray, columns: np.ndarray, values: np.ndarray, scales: np.ndarray) -> None:
    for row in range(len(values)):
        for at in range(len(columns)):
            array[row, columns[at]] = values[row, at] * scales[row, at]


@numba.njit(nogil=True, error_model="numpy")
def _read_signals(act: np.ndarray, slots: np.ndarray, first: int, arms: np.ndarray, shown: np.ndarray) -> None:
    for row in range(len(act)):
        for at in range(len(slots)):
            shown[0, row, at] = act[row, slots[at] + TORQUE] / arms[row, at]
            for signal in range(1, len(shown)):
                shown[signal, row, at] = act[row, slots[at] + first + signal - 1]


_ENGINE = ("_batch", "_kernels", "_qpos", "_qvel", "_ctrl", "_act", "_load", "_time")
