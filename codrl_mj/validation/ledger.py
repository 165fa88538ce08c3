"""Where the energy went: the flows of one run, from supply to moving mass, step by step."""

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np

from codrl_mj.actuators import Actuator, ActuatorModel, Motor
from codrl_mj.tasks import Task
from codrl_mj.tasks.assets import asset_path
from codrl_mj.validation.compare import last_signals
from codrl_mj.validation.continuous import gymnasium_equations

HILL_TASKS = ("mountain_car", "mountain_car_continuous")
"""Tasks whose hill is a force of ours, which MuJoCo's potential energy does not know."""


class Meter:
    """Kinetic and potential energy of a task's states: MuJoCo's own, on the model file as it is shipped.

    MuJoCo's `mj_energyPos` and `mj_energyVel` see gravity and motion. The hill's potential is minus the integral of the
    force that *Gymnasium's* environment shows along it: a Chebyshev interpolant of 48 samples, exact to rounding.
    """

    def __init__(self, task: Task) -> None:
        """Compile the model."""
        self._model = mujoco.MjModel.from_xml_path(str(asset_path(task.asset)))
        self._data = mujoco.MjData(self._model)
        self._qpos, self._qvel = list(task.qpos), list(task.qvel)
        self._hill = hill_potential(task, float(self._model.body_mass[-1])) if task.name in HILL_TASKS else None

    def __call__(self, state: np.ndarray) -> float:
        """Energy of the state [J], up to a constant."""
        model, data = self._model, self._data
        data.qpos[:], data.qvel[:] = state[self._qpos], state[self._qvel]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return float(data.energy.sum()) + (0.0 if self._hill is None else float(self._hill(state[0])))


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
    """Integral of u*i; the voltage is held over a step, the current is taken linear in it."""
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
    identity: float
    """Largest |(u - kE*omega - R*i)*(i + i')*dt/2 - L*(i'^2 - i^2)/2| of a step over the largest energy supplied."""

    @property
    def electrical_residual(self) -> np.ndarray:
        """Supplied, less copper loss, magnetic energy and what was converted [J]."""
        return self.supplied - self.copper - self.magnetic - self.converted

    @property
    def mechanical_residual(self) -> np.ndarray:
        """The shaft's work, less the change of kinetic and potential energy [J]; no run has any other loss."""
        return self.shaft - self.mechanical

    @property
    def whole_residual(self) -> np.ndarray:
        """Supplied, less copper loss, magnetic energy and the change of kinetic and potential energy [J]."""
        return self.supplied - self.copper - self.magnetic - self.mechanical


def keep(
    kind: type,
    task: Task,
    actuator: ActuatorModel,
    start: np.ndarray,
    forces: np.ndarray,
    inner_steps: int,
    integrator: str,
    entries: int,
) -> Ledger:
    """Run and write down the energies.

    Args:
        kind: `MujocoPhysics` or `AnalyticPhysics`.
        task: the task; its own bounds should not be reached: what they take is no entry of the ledger.
        actuator: a motor under its loop; with the ideal one all electrical entries are zero.
        start: initial state.
        forces: desired forces, each held for one environment step.
        inner_steps: integration steps to an environment step.
        integrator: one of the task's.
        entries: of the ledger for each environment step; must divide `inner_steps`.
    """
    timestep = task.step_duration / inner_steps
    # an environment step of one integration step shows each of them, and leaves the motor as it is in between
    physics = kind(dataclasses.replace(task, step_duration=timestep), [actuator], 1, integrator)
    physics.reset(start)
    rows = []
    for force in forces.repeat(inner_steps):
        physics.step(float(force))
        signals = last_signals(physics)
        rows.append((signals["current"], signals["voltage"], signals["actual_force"], *physics.state))
    current, voltage, force, *states = np.array(rows).T
    current, state = np.concatenate([[0.0], current]), np.vstack([start, np.array(states).T])

    motor, speed = actuator.motor if isinstance(actuator, Actuator) else Motor(), task.speeds[0]
    position = task.qpos[task.qvel.index(speed)]
    back_emf = motor.back_emf_constant * state[:, speed] / motor.arm_radius
    mean = (current[1:] + current[:-1]) / 2
    magnetic = motor.inductance * current**2 / 2
    supplied = np.cumsum(voltage * mean) * timestep
    winding = (voltage - back_emf[:-1] - motor.resistance * current[:-1]) * mean * timestep
    meter, every = Meter(task), inner_steps // entries
    kept = slice(every - 1, None, every)
    return Ledger(
        time=timestep * np.arange(1, len(force) + 1)[kept],
        supplied=supplied[kept],
        copper=motor.resistance * _integral(current**2, timestep)[kept],
        magnetic=magnetic[1:][kept],
        converted=_integral(back_emf * current, timestep)[kept],
        shaft=np.cumsum(force * np.diff(state[:, position]))[kept],
        mechanical=np.array([meter(row) for row in state[1:][kept]]) - meter(state[0]),
        identity=float(np.abs(winding - np.diff(magnetic)).max() / max(np.abs(supplied).max(), 1e-300)),
    )


def _integral(values: np.ndarray, timestep: float) -> np.ndarray:
    """The trapezoidal rule up to each step."""
    return np.cumsum(values[1:] + values[:-1]) * (timestep / 2)
