"""Many simulations of a task in MuJoCo at once, on the engine's own thread pool."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from codrl_mj import callbacks
from codrl_mj.callbacks.kernels import AVAILABLE_VOLTAGE, CURRENT, NOISE_KEY, VOLTAGE
from codrl_mj.disturbances import OFF, Disturbances
from codrl_mj.motor import Actuator, to_vector
from codrl_mj.motor.parameters import MAX_VOLTAGE, TORQUE_CONSTANT
from codrl_mj.physics.base import LARGEST, Signals, SimulationDivergedError, delivered
from codrl_mj.physics.constrain import compiled_batch
from codrl_mj.physics.disturber import disturber, sensed
from codrl_mj.physics.mjcf import needed_callbacks, task_model
from codrl_mj.tasks import Task


class MujocoBatchPhysics:
    """N simulations of one task, bit for bit those of N `MujocoPhysics`; states and signals are arrays.

    Every simulation has its own actuator: parameters are per-simulation model fields.
    """

    def __init__(
        self,
        task: Task,
        actuators: Sequence[Actuator] | None,
        inner_steps: int,
        integrator: str,
        num_envs: int,
        max_force: float | None = None,
        num_threads: int = 0,
        disturbances: Disturbances = OFF,
    ) -> None:
        """Compile the model and make the batch.

        Args:
            task: the task.
            actuators: one for each simulation, or None for ideal actuators.
            inner_steps: integration steps per environment step.
            integrator: one of the task's integrators.
            num_envs: number of simulations, >= 1.
            max_force: limit of the desired force [N] or torque [N*m]; None is the task's.
            num_threads: threads of the engine; 0 uses every CPU.
            disturbances: imperfections of drive, sensor, supply and joint, and load pulses.
        """
        self.task = task
        self.inner_steps = inner_steps
        self.max_force = task.max_force if max_force is None else max_force
        self._explicit = integrator == "euler"
        self._corrected = self._explicit or task.constrain is not None
        timestep, first = task.step_duration / inner_steps, actuators[0] if actuators else None
        self.model = task_model(task, first, timestep, max_force, self._explicit, disturbances)
        self._disturbances = disturbances
        self._disturber = disturber(disturbances, timestep, self.max_force, num_envs)
        self._dof = int(self.model.jnt_dofadr[self.model.actuator("motor").trnid[0]])
        self.num_envs = num_envs
        self._size = num_envs, num_threads
        self._varied = False  # whether the models differ in more than their actuators
        self._fields: dict[str, np.ndarray] = {}
        self._make_batch()
        self._rest = self._batch.state[0].copy()  # a simulation just reset, motor at rest
        self.motorised = actuators is not None
        self._arm = self._torque_constant = self._limit = np.ones(num_envs)
        if actuators is not None:
            self._arm, self._torque_constant, self._limit = (np.empty(num_envs) for _ in range(3))
            self.set_actuators(np.arange(num_envs), actuators)

    def _make_batch(self) -> None:
        """Make the engine's batch, and take the views that a step uses."""
        self._callbacks = needed_callbacks(self.model)
        self._install()
        self._batch = Batch(self.model, *self._size)
        self._kernels = compiled_batch(self.task, self._explicit)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._ctrl, self._act = self._batch.bind("ctrl"), self._batch.bind("act")
        self._load = self._batch.bind("qfrc_applied")

    def _install(self) -> None:
        if self._callbacks:
            callbacks.install(*self._callbacks)

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

    def set_actuators(self, rows: np.ndarray, actuators: Sequence[Actuator]) -> None:
        """Give some simulations other motors; to be followed by a reset of them."""
        vectors = np.array([to_vector(actuator) for actuator in actuators])
        self.set_parameters(rows, vectors, np.array([actuator.motor.arm_radius for actuator in actuators]))

    def set_parameters(self, rows: np.ndarray, vectors: np.ndarray, arms: np.ndarray) -> None:
        """Do what `set_actuators` does, with actuators as arrays.

        Args:
            rows: indices of simulations, shape (m,).
            vectors: parameter vectors, shape (m, p), as `codrl_mj.motor.to_vector` makes them.
            arms: arms [m], shape (m,).
        """
        user, gear, limits = map(self.field, ("actuator_user", "actuator_gear", "actuator_ctrlrange"))
        user[rows, 0, : vectors.shape[1]] = vectors
        gear[rows, 0, 0] = 1.0 / arms
        limits[rows, 0] = np.stack([-self.max_force * arms, self.max_force * arms], axis=-1)
        self._arm[rows] = arms
        self._torque_constant[rows] = vectors[:, TORQUE_CONSTANT]
        self._limit[rows] = vectors[:, MAX_VOLTAGE]

    def set_model(self, rows: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Change fields of the models of some simulations; to be followed by a reset of them.

        Args:
            rows: indices of simulations, shape (m,).
            fields: as `codrl_mj.physics.variation.Variation.fields` returns them, for m simulations.
        """
        for name, values in fields.items():
            self.field(name)[rows] = values
        self._varied = True
        self._batch.set_const(rows)

    @property
    def state(self) -> np.ndarray:
        """Mechanical states in the task's order, shape (N, n), float64; a new array."""
        state = np.empty((len(self._qpos), len(self.task.state_names)))
        self._kernels.read(self._qpos, self._qvel, state)
        return state

    def reset(self, rows: np.ndarray, states: np.ndarray, keys: np.ndarray | float = 0.0) -> None:
        """Start episodes of some simulations, with their motors at rest.

        Args:
            rows: indices, shape (m,).
            states: initial states in the task's order, shape (m, n).
            keys: of the random numbers of the episodes' disturbances, shape (m,).

        Raises:
            CallbackInUseError: another library's MuJoCo callback was installed in the meantime.
        """
        self._install()  # raises if somebody replaced ours since the last episodes
        self._batch.state[rows] = self._rest
        self._qpos[rows] = states[:, list(self.task.qpos)]
        self._qvel[rows] = states[:, list(self.task.qvel)]
        if self._disturbances.of_motor:
            self._act[rows, NOISE_KEY] = keys
        if self._disturber is not None:
            self._disturber.reset(rows, keys)

    def step(self, desired_force: np.ndarray) -> Signals:
        """Advance every simulation by one environment step.

        Args:
            desired_force: held over the step, shape (N,), at most `max_force`.

        Returns:
            The signals, each an array of shape (N,).
        """
        command = desired_force
        if self._disturber is None:
            self._ctrl[:, 0] = desired_force * self._arm
            self._integrate(self.inner_steps)
        else:
            for _ in range(self.inner_steps):
                command = self._disturber.command(desired_force)
                self._load[:, self._dof] = self._disturber.load()
                self._ctrl[:, 0] = command * self._arm
                self._integrate(1)
        if not self.motorised:
            nothing = np.zeros(len(desired_force))
            return Signals(desired_force, command.copy(), nothing, nothing.copy(), nothing.copy(), nothing > 0)  # type: ignore[arg-type]
        current, voltage = self._act[:, CURRENT].copy(), self._act[:, VOLTAGE].copy()
        limit = self._act[:, AVAILABLE_VOLTAGE] if self._disturbances.of_motor else self._limit
        return Signals(*delivered(desired_force, command, current, voltage, self._arm, self._torque_constant, limit))

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

    def sensed(self, signals: Signals, rows: np.ndarray | None = None) -> Signals:
        """Signals of the present moment with the currents [A] that the sensors measure.

        Args:
            signals: arrays, of shape (m,).
            rows: indices of their simulations, shape (m,); None for all.
        """
        chosen = slice(None) if rows is None else rows
        keys = self._act[chosen, NOISE_KEY] if self._disturbances.of_motor else np.zeros(len(self._act))[chosen]
        times = self._batch.bind("time")[chosen]
        timestep = self.model.opt.timestep
        return signals._replace(current=sensed(self._disturbances, signals.current, keys, times, timestep))  # type: ignore[arg-type]

    @property
    def memory(self) -> np.ndarray:
        """What the disturbances remember beside the engine's own state, a live array (N, k); (N, 0) if nothing."""
        return np.empty((self.num_envs, 0)) if self._disturber is None else self._disturber.memory

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
            f"t = {self._batch.bind('time')[first]:g} s: {entry} = {value:g}. Reset them; if this repeats, shorten the "
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


_ENGINE = ("_batch", "_kernels", "_qpos", "_qvel", "_ctrl", "_act", "_load")
