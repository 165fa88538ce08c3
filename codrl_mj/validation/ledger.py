"""Where the energy went: the flows of one run, from supply to moving mass, step by step."""

import dataclasses
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import Actuator, ActuatorModel, Motor
from codrl_mj.physics import Plant, hills, trace_names
from codrl_mj.tasks import Task
from codrl_mj.tasks.assets import asset_path
from codrl_mj.validation.continuous import gymnasium_equations


class Meter:
    """Kinetic and potential energy of a task's states: MuJoCo's own, on the model file as it is shipped.

    MuJoCo's `mj_energyPos` and `mj_energyVel` see gravity, springs and motion. A hill is a force of ours, which they do
    not know: its potential is minus the integral of the force that *Gymnasium's* environment shows along it, a
    Chebyshev interpolant of 48 samples, exact to rounding.
    """

    def __init__(self, task: Task) -> None:
        """Compile the model; a ValueError if it has a hill, and no twin to say how high it is."""
        self._model = mujoco.MjModel.from_xml_path(str(asset_path(task.asset)))
        self._data = mujoco.MjData(self._model)
        self._qpos, self._qvel = list(task.qpos), list(task.qvel)
        hilly = bool(hills(self._model))
        if hilly and task.twin is None:
            raise ValueError("its model has a hill, whose height only a twin knows")
        self._hill = hill_potential(task, float(self._model.body_mass[-1])) if hilly else None
        options = self._model.opt
        self.lossy = bool(self._model.dof_damping.any() or options.density or options.viscosity)
        """Whether joints are damped, or there is a medium."""

    def __call__(self, state: np.ndarray) -> float:
        """Energy of the state [J], up to a constant."""
        model, data = self._at(state)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return float(data.energy.sum()) + (0.0 if self._hill is None else float(self._hill(state[0])))

    def loss(self, state: np.ndarray) -> float:
        """What dampers and the medium take in the state [W]."""
        model, data = self._at(state)
        mujoco.mj_fwdVelocity(model, data)
        return -float((data.qfrc_damper + data.qfrc_fluid) @ data.qvel)

    def _at(self, state: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
        self._data.qpos[:], self._data.qvel[:] = state[self._qpos], state[self._qvel]
        mujoco.mj_fwdPosition(self._model, self._data)
        return self._model, self._data


def hill_potential(task: Task, mass: float) -> Callable[[float], float]:
    """The potential energy [J] of a car of the given mass [kg] over position [m] on Gymnasium's hill."""
    equations = gymnasium_equations(task)
    force = np.polynomial.Chebyshev.interpolate(
        lambda positions: np.array([-mass * equations(np.array([x, 0.0]), 0.0)[1] for x in positions]), 48, (-1.1, 0.5)
    )
    return force.integ()


@dataclasses.dataclass(frozen=True)
class Ledger:
    """Energies [J] up to each of some times of a run, each of shape (times,)."""

    time: np.ndarray
    """The times, ends of integration steps [s]."""
    supplied: np.ndarray
    """Integral of u*i; the voltage is held over a step, the current is taken linear in it. Sums over
    the motors, here and below."""
    copper: np.ndarray
    """Integral of R*i^2, by the trapezoidal rule."""
    magnetic: np.ndarray
    """L*i^2/2; no current at the start."""
    converted: np.ndarray
    """Integral of kE*omega*i, by the trapezoidal rule: what the back-EMF takes from the winding."""
    shaft: np.ndarray
    """Sum of force times displacement: the exact work of a force that is held over a step."""
    mechanical: np.ndarray
    """Kinetic and potential energy, less that at the start."""
    lost: np.ndarray
    """Integral of what dampers and the medium take, by the trapezoidal rule; zeros where there are none."""
    identity: float
    """Largest |(u - kE*omega - R*i)*(i + i')*dt/2 - L*(i'^2 - i^2)/2| of a step over the largest energy supplied."""

    @property
    def electrical_residual(self) -> np.ndarray:
        """Supplied, less copper loss, magnetic energy and what was converted [J]."""
        return self.supplied - self.copper - self.magnetic - self.converted

    @property
    def mechanical_residual(self) -> np.ndarray:
        """The shaft's work, less the change of kinetic and potential energy, and what was lost [J]."""
        return self.shaft - self.mechanical - self.lost

    @property
    def whole_residual(self) -> np.ndarray:
        """Supplied, less copper loss, magnetic energy, the change of kinetic and potential energy, and losses [J]."""
        return self.supplied - self.copper - self.magnetic - self.mechanical - self.lost


def keep(
    kind: type,
    task: Task,
    actuators: Sequence[ActuatorModel],
    start: np.ndarray,
    forces: np.ndarray,
    inner_steps: int,
    integrator: str,
    entries: int,
) -> Ledger:
    """Run and write down the energies, so many entries for each environment step, which divide its inner steps.

    The task's own bounds should not be reached: what they take is no entry of the ledger. Each force is held for one
    environment step. With ideal actuators all electrical entries are zero.
    """
    timestep = task.step_duration / inner_steps
    # an environment step of one integration step shows each of them, and leaves the motor as it is in between
    physics = kind(Plant(dataclasses.replace(task, step_duration=timestep), actuators, 1, integrator))
    physics.reset(start)
    traces, states = [], [start]
    for desired in forces.repeat(inner_steps, axis=0):
        physics.step(desired)
        traces.append(physics.trace[-1].T.copy())
        states.append(physics.state)
    columns = np.array(traces).swapaxes(0, 1)  # each of shape (steps, motors)
    signals = dict(zip(trace_names(physics.plant.family), columns, strict=True))
    current, voltage, force = signals["current"], signals["voltage"], signals["actual_force"]
    current, state = np.vstack([np.zeros_like(current[:1]), current]), np.array(states)

    motors = [actuator.motor if isinstance(actuator, Actuator) else Motor() for actuator in actuators]
    resistance, inductance, constant, arm = (
        np.array([getattr(motor, name) for motor in motors])
        for name in ("resistance", "inductance", "back_emf_constant", "arm_radius")
    )
    speeds = list(task.speeds)
    positions = [task.qpos[task.qvel.index(speed)] for speed in speeds]
    back_emf = constant * state[:, speeds] / arm
    mean = (current[1:] + current[:-1]) / 2
    magnetic = inductance * current**2 / 2
    supplied = np.cumsum(voltage * mean, axis=0).sum(axis=1) * timestep
    winding = (voltage - back_emf[:-1] - resistance * current[:-1]) * mean * timestep
    meter, every = Meter(task), inner_steps // entries
    kept = slice(every - 1, None, every)
    lost = np.array([[meter.loss(row)] for row in state]) if meter.lossy else np.zeros((len(state), 1))
    return Ledger(
        time=timestep * np.arange(1, len(force) + 1)[kept],
        supplied=supplied[kept],
        copper=(resistance * _integral(current**2, timestep)).sum(axis=1)[kept],
        magnetic=magnetic[1:].sum(axis=1)[kept],
        converted=_integral(back_emf * current, timestep).sum(axis=1)[kept],
        shaft=np.cumsum(force * np.diff(state[:, positions], axis=0), axis=0).sum(axis=1)[kept],
        mechanical=np.array([meter(row) for row in state[1:][kept]]) - meter(state[0]),
        lost=_integral(lost, timestep)[kept, 0],
        identity=float(np.abs(winding - np.diff(magnetic, axis=0)).max() / max(np.abs(supplied).max(), 1e-300)),
    )


def _integral(values: np.ndarray, timestep: float) -> np.ndarray:
    """The trapezoidal rule up to each step, of each column."""
    return np.cumsum(values[1:] + values[:-1], axis=0) * (timestep / 2)
