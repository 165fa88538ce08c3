"""Energy: what the supply gives is in the copper, in the winding's field, or in the moving masses.

Three balances, each over a run with the motor in the loop, on MuJoCo and on Gymnasium's dynamics:

- electrical: integral of u*i = integral of R*i^2 + L*i^2/2 + integral of kE*omega*i;
- mechanical: the work of the shaft = change of kinetic and potential energy (none of ours has friction), and what
  dampers and the medium take;
- whole: integral of u*i = integral of R*i^2 + L*i^2/2 + change of kinetic and potential energy, which holds only
  if what the back-EMF takes from the winding is what the shaft gives to the load: kE = kT, and one gear both ways. That
  gear may be a wrong one, which is for the first two to see.

A step of finite size balances only nearly: the residuals must vanish at the integrator's order, which is first for the
Euler variants and for everything that the winding, which takes Euler steps, is part of. The mechanical balance under
RK4 is of fourth order, because the work of a force held over a step is known exactly (of second where there is
damping, which the trapezoidal rule adds up). It is checked without the motor,
whose torques at one time depend on the step at first order, so that runs of two steps do not see the same forces.

One balance holds at any step: an Euler step of the winding, times the mean current, is the identity
(u - kE*omega - R*i) (i + i') dt/2 = L (i'^2 - i^2)/2. It is checked to rounding over whole episodes of the named
actuators, bounds, walls and saturation included.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.pages.plots import Curve, Plot
from codrl_mj.physics import SimulationDivergedError
from codrl_mj.tasks import Task, find_task
from codrl_mj.validation.compare import STAND_IN, actuators_named, forces_of, physics_of
from codrl_mj.validation.convergence import analogues, free_run, ideals, obstacle
from codrl_mj.validation.ledger import Ledger, Meter, keep
from codrl_mj.validation.table import Case, Check, Family, Oracle, Skipped, check, of_order, order

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


@check("energy", Oracle("winding, step by step", "identity of one Euler step of the RL circuit", 1e-13))
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
                ledger = keep(kind, task, actuators, start, forces, task.motor_inner_steps, task.integrators[0], 1)
            except SimulationDivergedError as error:
                yield Case(math.inf, f"{where}: {error}", samples)
            else:
                yield Case(ledger.identity, where, samples)


def _balance_plot(task: Task, integrator: str, ledger: Ledger) -> Plot:
    flows = {
        "supplied: integral of u i": ledger.supplied,
        "copper loss": ledger.copper,
        "magnetic energy": ledger.magnetic,
        "kinetic + potential energy": ledger.mechanical,
        "residual": ledger.whole_residual,
    }
    if ledger.lost.any():
        flows["dampers and medium"] = ledger.lost
    curves = tuple(Curve(label, ledger.time, values) for label, values in flows.items())
    title = f"{task.name} in MuJoCo, {integrator}: energy at the coarsest step"
    return Plot(title, "time [s]", "energy [J]", curves)


def _kept(
    task: Task, integrator: str, actuators: Sequence[ActuatorModel], counts: np.ndarray
) -> dict[str, list[Ledger]]:
    """Ledgers of the task's free run at every number of inner steps, all at the times of the coarsest."""
    start, _, forces = free_run(task)
    return {
        label: [keep(kind, task, actuators, start, forces, int(count), integrator, int(counts[0])) for count in counts]
        for label, kind in physics_of(task)
    }


@check(
    "energy",
    *(order(f"order, {name} balance, {{integrator}}", oracle) for name, oracle in BALANCES.items()),
)
def balances(task: Task, integrator: str, quick: bool) -> Iterator[tuple[Case, ...]]:
    """The residuals vanish at the integrator's order."""
    actuators, meter = analogues(task), Meter(task)
    resolved = task.step_duration / (min(one.motor.electrical_time_constant for one in actuators) / 25)
    counts = 2 ** (math.ceil(math.log2(max(resolved, 64))) + np.arange(4 if quick else 5))
    ledgers = _kept(task, integrator, actuators, counts)
    cases = []
    for balance in BALANCES:
        kept, steps, promised, rounding = ledgers, counts, 1.0, 0.0
        if exact := (balance, integrator) == ("mechanical", "rk4"):
            steps, promised = 2 ** np.arange(3, 7), 2.0 if meter.lossy else 4.0  # finer ones reach rounding
            kept = _kept(task, integrator, ideals(task), steps)
        families = []
        for label, of_steps in kept.items():
            residuals = [float(np.abs(getattr(ledger, f"{balance}_residual")).max()) for ledger in of_steps]
            if exact:
                sizes = [np.abs(one).max() for one in (of_steps[-1].shaft, of_steps[-1].mechanical)]
                rounding = _ROUNDING * float(max(abs(meter(free_run(task)[0])), *sizes))
            families.append(Family(label, task.step_duration / steps, np.array(residuals), rounding))
        title = f"{task.name}, {integrator}: {balance} balance"
        case = of_order(promised, families, title, "integration step [s]", "largest residual of the run [J]")
        if balance == "whole":
            case = case._replace(plots=(*case.plots, _balance_plot(task, integrator, ledgers["MuJoCo"][0])))
        cases.append(case)
    yield tuple(cases)


@check("energy", order("order of the balances, {integrator}", "energy"))
def diverged(error: str) -> Iterator[Case]:
    """What is left of the balances of a run that broke down."""
    yield Case(math.inf, error, 0)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of energy."""
    task = find_task(task_name)
    try:
        Meter(task)
    except ValueError as error:
        yield Skipped("all checks", str(error), "energy", task.name)
        return
    yield from step_by_step(task, quick)
    reason = obstacle(task)
    if reason:
        yield Skipped("the balances of a whole run", reason, "energy", task.name)
        return
    for integrator in task.integrators:
        try:
            yield from balances(task, integrator, quick)
        except SimulationDivergedError as error:
            yield from diverged.of(task.name, integrator=integrator)(str(error))
