"""Energy: what the supply gives is in the copper, in the winding's field, or in the moving masses.

Three balances, each over a run with the motor in the loop, on MuJoCo and on Gymnasium's dynamics:

- electrical: integral of u*i = integral of R*i^2 + L*i^2/2 + integral of kE*omega*i;
- mechanical: the work of the shaft = change of kinetic and potential energy (none of ours has friction), and what
  dampers and the medium take;
- whole: integral of u*i = integral of R*i^2 + L*i^2/2 + change of kinetic and potential energy, which holds only
  if what the back-EMF takes from the winding is what the shaft gives to the load: kE = kT, and one
  gear both ways. That gear may be a wrong one, which is for the first two to see.

A step of finite size balances only nearly: the residuals must vanish at the integrator's order,
which is first for the Euler variants and for everything that the winding, which takes Euler steps,
is part of. The mechanical balance under RK4 is of fourth order, because the work of a force held
over a step is known exactly (of second where there is damping, which the trapezoidal rule adds up).
It is checked without the motor, whose torques at one time depend on the step at first order, so
that runs of two steps do not see the same forces.

One balance holds at any step: an Euler step of the winding, times the mean current, is the identity
(u - kE*omega - R*i) (i + i') dt/2 = L (i'^2 - i^2)/2. It is checked to rounding over whole episodes
of the named actuators, bounds, walls and saturation included.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Motor
from codrl_mj.physics import SimulationConfig, SimulationDivergedError, hills, trace_names
from codrl_mj.tasks import Task, find_task
from codrl_mj.user_code import asset_path
from codrl_mj.validation.compare import (
    STAND_IN,
    actuators_named,
    forces_of,
    gymnasium_equations,
    is_ours,
    physics_of,
)
from codrl_mj.validation.convergence import (
    analogues,
    free_run,
    halvings,
    obstacle,
    refined,
)
from codrl_mj.validation.table import Case, Check, Family, Skipped, check, of_order, order
from codrl_mj.viz.pages.plots import Curve, Plot

ACTUATORS = ("paper", "weak", "weaker", "open_loop")
"""Whose runs are balanced step by step."""

_ROUNDING = 100 * float(np.finfo(float).eps)
"""Of the energies of a run: that of some hundred steps, which add up."""
_ENERGY = "MuJoCo's kinetic and potential energy (and Gymnasium's hill)"
BALANCES = {
    "electrical": "integral of u i = copper loss + L i^2/2 + integral of kE omega i",
    "mechanical": f"the shaft's work = change of {_ENERGY}",
    "whole": f"integral of u i = copper loss + L i^2/2 + change of {_ENERGY}",
}
"""Residuals of a `Ledger`, and what each balances."""


class Meter:
    """Kinetic and potential energy of a task's states: MuJoCo's own, on the model file as it is shipped.

    MuJoCo's `mj_energyPos` and `mj_energyVel` see gravity, springs and motion. A hill is a force of
    ours, which they do not know: its potential is minus the integral of the force that
    *Gymnasium's* environment shows along it, a Chebyshev interpolant of 48 samples, exact to
    rounding.
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
        return float(data.energy.sum()) + (
            0.0 if self._hill is None else float(self._hill(state[0]))
        )

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
        lambda positions: np.array(
            [-mass * equations(np.array([x, 0.0]), 0.0)[1] for x in positions]
        ),
        48,
        (-1.1, 0.5),
    )
    return force.integ()


@dataclasses.dataclass(frozen=True)
class Ledger:
    """Energies [J] up to each of some times of a run, each of shape (times,)."""

    time: np.ndarray
    """The times, ends of integration steps [s]."""
    supplied: np.ndarray
    """Integral of u*i; the voltage is held over a step, the current is taken linear in it. Sums
    over the motors, here and below.
    """
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

    def residual(self, balance: str) -> np.ndarray:
        """What one of `BALANCES` leaves over [J]."""
        given = (
            self.shaft if balance == "mechanical" else self.supplied - self.copper - self.magnetic
        )
        return (
            given - self.converted
            if balance == "electrical"
            else given - self.mechanical - self.lost
        )


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

    The task's own bounds should not be reached: what they take is no entry of the ledger. Each
    force is held for one environment step. With ideal actuators all electrical entries are zero.
    """
    timestep = task.step_duration / inner_steps
    # an environment step of one integration step shows each of them, and leaves the motor as it is
    # in between
    physics = kind(
        SimulationConfig(
            dataclasses.replace(task, step_duration=timestep), actuators, 1, integrator
        )
    )
    physics.reset(start)
    traces, states = [], [start]
    for desired in forces.repeat(inner_steps, axis=0):
        physics.step(desired)
        traces.append(physics.trace[-1].T.copy())
        states.append(physics.state)
    columns = np.array(traces).swapaxes(0, 1)  # each of shape (steps, motors)
    signals = dict(zip(trace_names(physics.simulation.family), columns, strict=True))
    current, voltage, force = signals["current"], signals["voltage"], signals["actual_force"]
    current, state = np.vstack([np.zeros_like(current[:1]), current]), np.array(states)

    motors = [
        actuator.motor if isinstance(actuator, DCMotorActuator) else Motor()
        for actuator in actuators
    ]
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
    lost = (
        np.array([[meter.loss(row)] for row in state]) if meter.lossy else np.zeros((len(state), 1))
    )
    return Ledger(
        time=timestep * np.arange(1, len(force) + 1)[kept],
        supplied=supplied[kept],
        copper=(resistance * _integral(current**2, timestep)).sum(axis=1)[kept],
        magnetic=magnetic[1:].sum(axis=1)[kept],
        converted=_integral(back_emf * current, timestep).sum(axis=1)[kept],
        shaft=np.cumsum(force * np.diff(state[:, positions], axis=0), axis=0).sum(axis=1)[kept],
        mechanical=np.array([meter(row) for row in state[1:][kept]]) - meter(state[0]),
        lost=_integral(lost, timestep)[kept, 0],
        identity=float(
            np.abs(winding - np.diff(magnetic, axis=0)).max() / max(np.abs(supplied).max(), 1e-300)
        ),
    )


def _integral(values: np.ndarray, timestep: float) -> np.ndarray:
    """The trapezoidal rule up to each step, of each column."""
    return np.cumsum(values[1:] + values[:-1], axis=0) * (timestep / 2)


@check(
    "energy", Check("winding, step by step", "identity of one Euler step of the RL circuit", 1e-13)
)
def step_by_step(task: Task, quick: bool) -> Iterator[Case]:
    """Tolerance 1e-13 of the energy supplied: the rounding of some ten operations a step."""
    steps = 20 if quick else 100
    samples = steps * task.motor_inner_steps
    for name in ACTUATORS if task.paper else (STAND_IN,):
        actuators = actuators_named(name, task)
        generator = np.random.default_rng(5)
        forces = forces_of(task, generator.choice([-1.0, 1.0], steps * len(task.motors)))
        start = task.initial(generator, None)
        for label, kind in physics_of(task):
            where = f"{name} actuator, {label}"
            try:
                ledger = keep(
                    kind,
                    task,
                    actuators,
                    start,
                    forces,
                    task.motor_inner_steps,
                    task.integrators[0],
                    1,
                )
            except SimulationDivergedError as error:
                yield Case(math.inf, f"{where}: {error}", samples)
            else:
                yield Case(ledger.identity, where, samples)


def _kept(
    task: Task, integrator: str, actuators: Sequence[ActuatorModel], counts: np.ndarray
) -> dict[str, list[Ledger]]:
    """Ledgers of the task's free run at every number of inner steps, all at the times of the coarsest."""
    start, _, forces = free_run(task)
    return {
        label: [
            keep(kind, task, actuators, start, forces, int(count), integrator, int(counts[0]))
            for count in counts
        ]
        for label, kind in physics_of(task)
    }


@check(
    "energy",
    *(order(f"order, {name} balance, {{integrator}}", oracle) for name, oracle in BALANCES.items()),
)
def balances(
    task: Task, integrator: str, quick: bool, unknown: str = ""
) -> Iterator[tuple[Case, ...]]:
    """The residuals vanish at the integrator's order."""
    actuators, meter = analogues(task), Meter(task)
    resolved = task.step_duration / (
        min(one.motor.electrical_time_constant for one in actuators) / 25
    )

    @functools.cache
    def ledgers(exact: bool, finer: int) -> tuple[np.ndarray, dict[str, list[Ledger]]]:
        if exact:
            steps = 2 ** (np.arange(3, 7) + finer)  # finer ones reach rounding
            return steps, _kept(task, integrator, actuators_named("ideal", task), steps)
        steps = 2 ** (
            math.ceil(math.log2(max(resolved, 64))) + np.arange(4 if quick else 5) + finer
        )
        return steps, _kept(task, integrator, actuators, steps)

    def judged(balance: str, finer: int) -> Case:
        exact = (balance, integrator) == ("mechanical", "rk4")
        steps, kept = ledgers(exact, finer - halvings(task)[0])
        promised, rounding = (2.0 if meter.lossy else 4.0) if exact else 1.0, 0.0
        families = []
        for label, of_steps in kept.items():
            residuals = [float(np.abs(ledger.residual(balance)).max()) for ledger in of_steps]
            if exact:
                sizes = [np.abs(one).max() for one in (of_steps[-1].shaft, of_steps[-1].mechanical)]
                rounding = _ROUNDING * float(max(abs(meter(free_run(task)[0])), *sizes))
            families.append(
                Family(label, task.step_duration / steps, np.array(residuals), rounding)
            )
        title = f"{task.name}, {integrator}: {balance} balance"
        case = of_order(
            promised, families, title, "integration step [s]", "largest residual of the run [J]"
        )
        return (
            case._replace(plots=(*case.plots, _flows(task, integrator, kept)))
            if balance == "whole"
            else case
        )

    of_each = {balance: functools.partial(judged, balance) for balance in BALANCES}
    # Small damping, whose integral is of second order, shows only where the fourth order's errors
    # are far below it.
    yield tuple(
        refined(task, one, 0 if unknown and name != "electrical" else 6)
        for name, one in of_each.items()
    )


def _flows(task: Task, integrator: str, kept: dict[str, list[Ledger]]) -> Plot:
    """Return a plot of where the energy goes."""
    ledger = kept["MuJoCo"][0]
    flows = {
        "supplied: integral of u i": ledger.supplied,
        "copper loss": ledger.copper,
        "magnetic energy": ledger.magnetic,
        "kinetic + potential energy": ledger.mechanical,
        "residual": ledger.residual("whole"),
    }
    if ledger.lost.any():
        flows["dampers and medium"] = ledger.lost
    curves = tuple(Curve(label, ledger.time, values) for label, values in flows.items())
    title = f"{task.name} in MuJoCo, {integrator}: energy at the coarsest step"
    return Plot(title, "time [s]", "energy [J]", curves)


def unnamed(task: Task) -> str:
    """Return why no balance can hold in somebody's model: energy comes and goes that no entry names; or nothing."""
    model = mujoco.MjModel.from_xml_path(str(asset_path(task.asset)))
    sources = {
        "gravity compensation": model.body_gravcomp.any(),
        "actuators besides the task's motors": model.nactuator > len(task.motors),
        "plugins": model.nplugin,
    }
    found = " and ".join(name for name, there in sources.items() if there)
    return (
        f"the model has {found}, whose energy no balance knows: leave that out to have it checked"
        if found
        else ""
    )


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of energy."""
    task = find_task(task_name)
    try:
        Meter(task)
    except ValueError as error:
        yield Skipped("all checks", str(error))
        return
    yield from step_by_step(task, quick)
    reason = obstacle(task)
    if reason:
        yield Skipped("the balances of a whole run", reason)
        return
    unknown = "" if is_ours(task) else unnamed(task)
    for integrator in task.integrators:
        for outcome in balances(task, integrator, quick, unknown):
            yield (
                Skipped(outcome.name, unknown)
                if unknown and "electrical" not in outcome.name
                else outcome
            )
