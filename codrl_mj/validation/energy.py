"""Energy balances of supply, winding and mechanics.

Three balances, each over a run with the motor in the loop, in MuJoCo and on Gymnasium's dynamics:

- electrical: integral of u*i = integral of R*i^2 + L*i^2/2 + integral of kE*omega*i;
- mechanical: the work of the shaft = change of kinetic and potential energy + loss in dampers and
  medium (the built-in tasks have no friction);
- whole: integral of u*i = integral of R*i^2 + L*i^2/2 + change of kinetic and potential energy. It
  holds only if the power that the back-EMF takes from the winding equals the power of the shaft:
  kE = kT, and the same gear in both directions. Only the first two balances find a wrong gear
  ratio.

With a finite step the balances hold only approximately: the residuals must vanish at the
integrator's order. The order is first for the Euler variants and for every balance with the
winding, which takes Euler steps. The mechanical balance under RK4 is of fourth order, because the
work of a force held over a step is known exactly. With damping it is of second order, because the
loss is integrated by the trapezoidal rule. It is checked without the motor: a motor's torque
depends on the step size at first order, so that runs with two step sizes would have different
forces.

One balance holds at any step: an Euler step of the winding, times the mean current, is the identity
(u - kE*omega - R*i) (i + i') dt/2 = L (i'^2 - i^2)/2. It is checked to rounding over whole episodes
of the named actuators, including bounds, walls and saturation.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Motor
from codrl_mj.physics import SimulationConfig, SimulationDivergedError, hills, trace_names
from codrl_mj.plots import Curve, Plot
from codrl_mj.tasks import Task, find_task
from codrl_mj.user_code import asset_path
from codrl_mj.validation.compare import (
    FALLBACK_ACTUATOR,
    gymnasium_equations,
    is_built_in,
    named_actuators,
    physics_classes,
    scaled_forces,
)
from codrl_mj.validation.convergence import (
    coarsest_passing,
    continuous_actuators,
    free_run,
    halving_range,
    nonsmooth_reason,
)
from codrl_mj.validation.table import (
    Case,
    Check,
    ConvergenceSeries,
    Skipped,
    check,
    order_case,
    order_check,
)

ACTUATORS = ("paper", "weak", "weaker", "open_loop")
"""Named actuators whose runs are balanced step by step."""

_ROUNDING = 100 * float(np.finfo(float).eps)
"""Rounding error of a run's energies, relative: some hundred steps add up."""
_ENERGY = "MuJoCo's kinetic and potential energy (and Gymnasium's hill)"
BALANCES = {
    "electrical": "integral of u i = copper loss + L i^2/2 + integral of kE omega i",
    "mechanical": f"the shaft's work = change of {_ENERGY}",
    "whole": f"integral of u i = copper loss + L i^2/2 + change of {_ENERGY}",
}
"""Name of each balance of a `Ledger` -> its equation."""


class Meter:
    """Kinetic and potential energy of a task's states, by MuJoCo on the original model file.

    MuJoCo's `mj_energyPos` and `mj_energyVel` include gravity, springs and motion. They do not
    include a hill, which is a force of codrl_mj. Its potential is minus the integral of the force
    in *Gymnasium's* environment along the hill. The force is a Chebyshev interpolant of 48 samples,
    which is exact to rounding.
    """

    def __init__(self, task: Task) -> None:
        """Compile the model of a task.

        Raises:
            ValueError: the model has a hill, but the task has no reference environment.
        """
        self._model = mujoco.MjModel.from_xml_path(str(asset_path(task.asset)))
        self._data = mujoco.MjData(self._model)
        self._qpos, self._qvel = list(task.qpos), list(task.qvel)
        hilly = bool(hills(self._model))
        if hilly and task.reference_env is None:
            raise ValueError(
                "the model has a hill, whose height can only be read from a reference environment"
            )
        self._hill = hill_potential(task, float(self._model.body_mass[-1])) if hilly else None
        options = self._model.opt
        self.lossy = bool(self._model.dof_damping.any() or options.density or options.viscosity)
        """True if joints are damped or there is a medium."""

    def __call__(self, state: np.ndarray) -> float:
        """Return the energy of a state [J], up to a constant."""
        model, data = self._set_state(state)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return float(data.energy.sum()) + (
            0.0 if self._hill is None else float(self._hill(state[0]))
        )

    def loss(self, state: np.ndarray) -> float:
        """Return the power lost to dampers and medium in a state [W]."""
        model, data = self._set_state(state)
        mujoco.mj_fwdVelocity(model, data)
        return -float((data.qfrc_damper + data.qfrc_fluid) @ data.qvel)

    def _set_state(self, state: np.ndarray) -> tuple[mujoco.MjModel, mujoco.MjData]:
        self._data.qpos[:], self._data.qvel[:] = state[self._qpos], state[self._qvel]
        mujoco.mj_fwdPosition(self._model, self._data)
        return self._model, self._data


def hill_potential(task: Task, mass: float) -> Callable[[float], float]:
    """Return a car's potential energy [J] over position [m] on Gymnasium's hill; mass in kg."""
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
    """Energies [J] since the start of a run at several times, each of shape (times,).

    Electrical energies are sums over the motors.
    """

    time: np.ndarray
    """Times, ends of integration steps [s]."""
    supplied: np.ndarray
    """Integral of u*i; over a step the voltage is constant and the current taken as linear."""
    copper: np.ndarray
    """Integral of R*i^2, by the trapezoidal rule."""
    magnetic: np.ndarray
    """L*i^2/2; there is no current at the start."""
    converted: np.ndarray
    """Integral of kE*omega*i, by the trapezoidal rule: the energy that the back-EMF takes."""
    shaft: np.ndarray
    """Sum of force times displacement: the exact work of a force that is held over a step."""
    mechanical: np.ndarray
    """Kinetic and potential energy, minus that at the start."""
    lost: np.ndarray
    """Integral of the loss in dampers and medium, by the trapezoidal rule; zeros without any."""
    identity_error: float
    """Largest error of the winding's identity in a step, relative to the largest energy supplied.

    The error is |(u - kE*omega - R*i)*(i + i')*dt/2 - L*(i'^2 - i^2)/2|.
    """

    def residual(self, balance: str) -> np.ndarray:
        """Return the residual of one of `BALANCES` [J]."""
        remaining = (
            self.shaft if balance == "mechanical" else self.supplied - self.copper - self.magnetic
        )
        residual: np.ndarray = (
            remaining - self.converted
            if balance == "electrical"
            else remaining - self.mechanical - self.lost
        )
        return residual


def record_energies(
    kind: type,
    task: Task,
    actuators: Sequence[ActuatorModel],
    start: np.ndarray,
    forces: np.ndarray,
    inner_steps: int,
    integrator: str,
    entries: int,
) -> Ledger:
    """Simulate a run and record its energies.

    Each force is held for one environment step, in which `entries` times are recorded; `entries`
    must divide `inner_steps`. The task's bounds should not be reached: the energy that they take is
    not recorded. With ideal actuators all electrical energies are zero.
    """
    timestep = task.step_duration / inner_steps
    # An environment step is shortened to one integration step. The physics then shows the state
    # after each of them, and the motor continues without a reset.
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
    # Each signal has the shape (steps, motors).
    columns = np.array(traces).swapaxes(0, 1)
    signals = dict(zip(trace_names(physics.simulation.family), columns, strict=True))
    current, voltage, force = signals["current"], signals["voltage"], signals["actual_force"]
    current, state = np.vstack([np.zeros_like(current[:1]), current]), np.array(states)

    motors = [
        actuator.motor if isinstance(actuator, DCMotorActuator) else Motor()
        for actuator in actuators
    ]
    resistance, inductance, back_emf_constant, arm = (
        np.array([getattr(motor, name) for motor in motors])
        for name in ("resistance", "inductance", "back_emf_constant", "arm_radius")
    )
    speeds = list(task.speed_indices)
    positions = [task.qpos[task.qvel.index(speed)] for speed in speeds]
    back_emf = back_emf_constant * state[:, speeds] / arm
    mean_current = (current[1:] + current[:-1]) / 2
    magnetic = inductance * current**2 / 2
    supplied = np.cumsum(voltage * mean_current, axis=0).sum(axis=1) * timestep
    winding = (voltage - back_emf[:-1] - resistance * current[:-1]) * mean_current * timestep
    meter, steps_per_entry = Meter(task), inner_steps // entries
    recorded = slice(steps_per_entry - 1, None, steps_per_entry)
    lost = (
        np.array([[meter.loss(row)] for row in state]) if meter.lossy else np.zeros((len(state), 1))
    )
    return Ledger(
        time=timestep * np.arange(1, len(force) + 1)[recorded],
        supplied=supplied[recorded],
        copper=(resistance * _integral(current**2, timestep)).sum(axis=1)[recorded],
        magnetic=magnetic[1:].sum(axis=1)[recorded],
        converted=_integral(back_emf * current, timestep).sum(axis=1)[recorded],
        shaft=np.cumsum(force * np.diff(state[:, positions], axis=0), axis=0).sum(axis=1)[recorded],
        mechanical=np.array([meter(row) for row in state[1:][recorded]]) - meter(state[0]),
        lost=_integral(lost, timestep)[recorded, 0],
        identity_error=float(
            # The lower bound avoids 0/0 with ideal actuators.
            np.abs(winding - np.diff(magnetic, axis=0)).max() / max(np.abs(supplied).max(), 1e-300)
        ),
    )


def _integral(values: np.ndarray, timestep: float) -> np.ndarray:
    """Return the integral of each column up to each step, by the trapezoidal rule."""
    return np.cumsum(values[1:] + values[:-1], axis=0) * (timestep / 2)


@check(
    "energy", Check("winding, step by step", "identity of one Euler step of the RL circuit", 1e-13)
)
def step_by_step(task: Task, quick: bool) -> Iterator[Case]:
    """Check the winding's energy identity in every step.

    Tolerance 1e-13 of the energy supplied: the rounding of some ten operations a step.
    """
    steps = 20 if quick else 100
    samples = steps * task.motor_inner_steps
    for name in ACTUATORS if task.paper else (FALLBACK_ACTUATOR,):
        actuators = named_actuators(name, task)
        generator = np.random.default_rng(5)
        forces = scaled_forces(task, generator.choice([-1.0, 1.0], steps * len(task.motors)))
        start = task.draw_initial_state(generator, None)
        for label, kind in physics_classes(task):
            where = f"{name} actuator, {label}"
            try:
                ledger = record_energies(
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
                yield Case(ledger.identity_error, where, samples)


def _ledgers(
    task: Task, integrator: str, actuators: Sequence[ActuatorModel], counts: np.ndarray
) -> dict[str, list[Ledger]]:
    """Return the ledgers of the free run for all step counts, at the times of the coarsest."""
    start, _, forces = free_run(task)
    return {
        label: [
            record_energies(
                kind, task, actuators, start, forces, int(count), integrator, int(counts[0])
            )
            for count in counts
        ]
        for label, kind in physics_classes(task)
    }


@check(
    "energy",
    *(
        order_check(f"order, {name} balance, {{integrator}}", oracle)
        for name, oracle in BALANCES.items()
    ),
)
def balances(
    task: Task, integrator: str, quick: bool, unbalanced: str = ""
) -> Iterator[tuple[Case, ...]]:
    """Check that the residuals of the balances vanish at the integrator's order."""
    actuators, meter = continuous_actuators(task), Meter(task)
    min_steps = task.step_duration / (
        min(actuator.motor.electrical_time_constant for actuator in actuators) / 25
    )

    @functools.cache
    def ledgers(exact: bool, extra_halvings: int) -> tuple[np.ndarray, dict[str, list[Ledger]]]:
        if exact:
            # At fourth order, shorter steps would reach rounding.
            steps = 2 ** (np.arange(3, 7) + extra_halvings)
            return steps, _ledgers(task, integrator, named_actuators("ideal", task), steps)
        steps = 2 ** (
            math.ceil(math.log2(max(min_steps, 64))) + np.arange(4 if quick else 5) + extra_halvings
        )
        return steps, _ledgers(task, integrator, actuators, steps)

    def evaluate(balance: str, extra_halvings: int) -> Case:
        exact = (balance, integrator) == ("mechanical", "rk4")
        steps, ledgers_by_physics = ledgers(exact, extra_halvings - halving_range(task)[0])
        promised, rounding = (2.0 if meter.lossy else 4.0) if exact else 1.0, 0.0
        series = []
        for label, physics_ledgers in ledgers_by_physics.items():
            residuals = [
                float(np.abs(ledger.residual(balance)).max()) for ledger in physics_ledgers
            ]
            if exact:
                sizes = [
                    np.abs(energies).max()
                    for energies in (physics_ledgers[-1].shaft, physics_ledgers[-1].mechanical)
                ]
                rounding = _ROUNDING * float(max(abs(meter(free_run(task)[0])), *sizes))
            series.append(
                ConvergenceSeries(label, task.step_duration / steps, np.array(residuals), rounding)
            )
        title = f"{task.name}, {integrator}: {balance} balance"
        case = order_case(
            promised, series, title, "integration step [s]", "largest residual of the run [J]"
        )
        return (
            case._replace(plots=(*case.plots, _plot_energies(task, integrator, ledgers_by_physics)))
            if balance == "whole"
            else case
        )

    of_each = {balance: functools.partial(evaluate, balance) for balance in BALANCES}
    # The integral of the damping loss is of second order. If the damping is small, this order shows
    # only at steps at which the fourth-order errors are far below it.
    yield tuple(
        coarsest_passing(task, evaluate_steps, 0 if unbalanced and name != "electrical" else 6)
        for name, evaluate_steps in of_each.items()
    )


def _plot_energies(task: Task, integrator: str, ledgers: dict[str, list[Ledger]]) -> Plot:
    """Return a plot of the energies over time."""
    ledger = ledgers["MuJoCo"][0]
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


def unbalanced_energy(task: Task) -> str:
    """Return the reason why the balances cannot hold in a custom model, or ""."""
    model = mujoco.MjModel.from_xml_path(str(asset_path(task.asset)))
    sources = {
        "gravity compensation": model.body_gravcomp.any(),
        "actuators besides the task's motors": model.nactuator > len(task.motors),
        "plugins": model.nplugin,
    }
    names = " and ".join(name for name, is_used in sources.items() if is_used)
    return (
        f"the model has {names}, whose energy is in no balance: remove it to run these checks"
        if names
        else ""
    )


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """Run the energy checks of a task."""
    task = find_task(task_name)
    try:
        Meter(task)
    except ValueError as error:
        yield Skipped("all checks", str(error))
        return
    yield from step_by_step(task, quick)
    reason = nonsmooth_reason(task)
    if reason:
        yield Skipped("the balances of a whole run", reason)
        return
    unbalanced = "" if is_built_in(task) else unbalanced_energy(task)
    for integrator in task.integrators:
        for outcome in balances(task, integrator, quick, unbalanced):
            yield (
                Skipped(outcome.name, unbalanced)
                if unbalanced and "electrical" not in outcome.name
                else outcome
            )
