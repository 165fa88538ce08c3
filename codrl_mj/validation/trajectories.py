"""Whole runs under the same commands: MuJoCo with the motor in its callback against Gymnasium with the motor in Python.

A run is judged twice. Up to the horizon of `Task.trials` the difference itself must stay below
1e-9. Over a whole episode, where a chaotic task would enlarge even the smallest rounding beyond any
fixed bound, the difference is measured against what rounding becomes in the oracle itself along
this run (`Growth`): what remains is the error made, not what chaos made of it.
"""

import copy
import math
from collections.abc import Iterator

import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.physics import AnalyticPhysics, SimulationDivergedError, trace_names
from codrl_mj.tasks import Task, find_task, named_actuator
from codrl_mj.validation.compare import both, differences, without_oracle
from codrl_mj.validation.motor_catalogue import FITTED, fitted_run
from codrl_mj.validation.table import Case, Check, Skipped, check
from codrl_mj.viz.pages.plots import Curve, Plot

TOLERANCE = 1e-9
"""Of the difference: rounding (1e-16), a thousand steps, and the growth of tasks that are not chaotic."""
ROUNDINGS = 30.0
"""Largest difference in standard deviations of the oracle's own accumulated rounding, of 2e-16 for
each entry and step; a step rounds some tens of numbers.
"""

UNLIMITED_STEPS = 200
"""Environment steps of a run of a task without a time limit."""
STARVED = "starved"
ACTUATORS = ("ideal", "paper", "weaker", STARVED)


APART = 1e-7
"""A displacement, relative to max(1, size): far above rounding, far below anything that bends."""
ROUNDING = float(np.finfo(float).eps)
CLOCK = 2
"""A snapshot of `AnalyticPhysics` ends with time and key; before them are the states of mechanics and motor."""


class Growth:
    """Follows an analytic physics and records how errors grow along its run: what rounding becomes.

    The oracle's step is linearised along the run by finite differences: the state of mechanics and
    motor is displaced by a small amount along each of its entries, the rest being as in the run.
    The product of these matrices carries

    - one displacement, scaled back after every step: the mean rate of its growth is Benettin's estimate of the largest
      Lyapunov exponent, of the driven system along this run;
    - the covariance of independent rounding errors, one in every entry at every step: P <- M P M' + Q.
    """

    def __init__(self, task: Task, run: AnalyticPhysics, seed: int) -> None:
        """Follow a run from its beginning; the seed is of the direction of the first displacement."""
        self._run = run
        self._twin = copy.deepcopy(run)
        self._size = len(task.state_names)
        self._start = run.snapshot()
        entries = len(self._start) - CLOCK
        direction = np.random.default_rng(seed).standard_normal(entries)
        self._direction = direction / np.linalg.norm(direction)
        self._covariance = np.zeros((entries, entries))
        self.logarithms = [0.0]
        """Logarithm of the displacement's growth since the beginning, after each step."""
        self.rounding: list[float] = []
        """Standard deviation of the accumulated rounding errors after each step, relative to max(1, size)."""

    def follow(self, desired_force: float) -> None:
        """The run has just taken a step: linearise it."""
        twin, size, entries = self._twin, self._size, len(self._direction)
        end = self._run.snapshot()
        matrix = np.empty((entries, entries))
        for entry in range(entries):
            apart = APART * max(1.0, abs(self._start[entry]))
            displaced = self._start.copy()
            displaced[entry] += apart
            twin.restore(displaced)
            twin.step(desired_force)
            gap = (twin.snapshot() - end)[:entries]
            gap[:size] -= (
                2 * math.pi * np.round(gap[:size] / (2 * math.pi))
            )  # one of them was wrapped
            matrix[:, entry] = gap / apart
        moved = matrix @ self._direction
        length = float(np.linalg.norm(moved))
        self.logarithms.append(self.logarithms[-1] + math.log(max(length, ROUNDING)))
        self._direction = (
            moved / length if length > ROUNDING else self._direction
        )  # a wall stopped both
        scale = np.maximum(1.0, np.abs(end[:entries]))
        self._covariance = matrix @ self._covariance @ matrix.T + np.diag((ROUNDING * scale) ** 2)
        self.rounding.append(float((np.sqrt(np.diag(self._covariance)) / scale)[:size].max()))
        self._start = end


def _run(
    task: Task, actuator: ActuatorModel, integrator: str, steps: int, seed: int
) -> tuple[np.ndarray, list[str], Growth]:
    """One run on both physics, and how errors grow along it.

    The largest difference of state or force after each step, and in what it was; of a step that
    diverged infinity.
    """
    mujoco, analytic = both(task, actuator, integrator)
    generator = np.random.default_rng(seed)
    initial = task.initial(generator, None)
    forces = task.max_force * generator.choice([-1.0, 1.0], steps)
    for physics in (mujoco, analytic):
        physics.reset(initial)
    growth = Growth(task, analytic, seed)
    gaps: list[float] = []
    where: list[str] = []
    names = [*task.state_names, "force"]
    for step, force in enumerate(forces.tolist(), 1):
        try:
            for physics in (mujoco, analytic):
                physics.step(force)
            at = trace_names(analytic.simulation.family).index("actual_force")
            delivered = [float(physics.trace[-1, 0, at]) for physics in (mujoco, analytic)]
            growth.follow(force)
        except SimulationDivergedError as error:
            gaps.append(math.inf)
            where.append(f"step {step} of seed {seed}: {error}")
            break
        state_gaps = differences(task, mujoco.state, analytic.state)
        all_gaps = np.append(state_gaps, abs(delivered[0] - delivered[1]) / task.max_force)
        worst = int(np.argmax(all_gaps))  # a NaN, if there is one
        gaps.append(float(all_gaps[worst]))
        where.append(f"{names[worst]} at step {step} of seed {seed}")
    return np.array(gaps), where, growth


def _plot(task: Task, gaps: np.ndarray, growth: Growth, title: str) -> Plot:
    rounding = np.array(growth.rounding)
    times = task.step_duration * np.arange(1, len(rounding) + 1)
    begins = task.step_duration * np.arange(len(growth.logarithms))
    exponent, _ = np.polyfit(begins, growth.logarithms, 1)  # Lyapunov's [1/s]
    curves = (
        Curve(
            "difference found (0 is drawn at 1e-18)",
            times,
            np.maximum(gaps[: len(rounding)], 1e-18),
        ),
        Curve("what rounding becomes in the oracle", times, rounding, reference=True),
        Curve(
            f"2e-16 × exp(λt), λ = {exponent:.3g} 1/s",
            times,
            ROUNDING * np.exp(exponent * times),
            reference=True,
        ),
        Curve(f"allowed: {ROUNDINGS:g} × rounding", times, ROUNDINGS * rounding, reference=True),
    )
    return Plot(title, "time [s]", "difference [relative]", curves, y_log=True)


_NAME, _ORACLE = "{integrator}, {actuator_name} actuator", "{task.oracle}{motor}"


@check(
    "trajectories",
    Check(f"run, {_NAME}", _ORACLE, TOLERANCE),
    Check(f"run against rounding, {_NAME}", _ORACLE, ROUNDINGS, "accumulated roundings"),
)
def whole_runs(
    task: Task, actuator_name: str, integrator: str, seeds: range, longest: int
) -> Iterator[tuple[Case, ...]]:
    """Runs under the same random bang-bang commands: the difference itself up to the horizon, and all in roundings.

    The task's ends are ignored, and a divergence fails. `starved` is the paper's motor with 0.5 V
    and nothing against its back-EMF, both of which its loop hides otherwise. There is a plot of the
    first run.
    """
    actuator = named_actuator("paper" if actuator_name == STARVED else actuator_name, task.name)
    if actuator_name == STARVED:
        actuator = actuator.replaced(
            {"controller.max_voltage": 0.5, "controller.bemf_compensation": False}
        )
    steps = min(longest, task.max_episode_steps or UNLIMITED_STEPS)
    horizon = min(steps, (task.trials and task.trials.horizon) or steps)
    for seed in seeds:
        gaps, where, growth = _run(task, actuator, integrator, steps, seed)
        in_roundings = gaps / np.append(growth.rounding, np.ones(len(gaps) - len(growth.rounding)))
        title = f"{task.name}, {integrator}, {actuator_name} actuator"
        plots = (
            (_plot(task, gaps, growth, title),)
            if seed == seeds[0] and len(growth.rounding) > 1
            else ()
        )
        yield (
            Case(gaps[:horizon], where.__getitem__, horizon),
            Case(in_roundings, where.__getitem__, steps, plots),
        )


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of this group."""
    task = find_task(task_name)
    if missing := without_oracle(task):
        yield Skipped("all checks", missing)
        return
    actuators = ACTUATORS if task.paper else ACTUATORS[:1]
    if not task.paper:
        reason = "they are variations of the paper's actuator, of which it has none"
        yield Skipped(f"runs with the {', '.join(ACTUATORS[1:])} actuators", reason)
    for actuator in actuators:
        for integrator in task.integrators:
            shorter = 100 if task.motor_inner_steps > 1 else 200
            seeds, longest = (range(1), shorter) if quick else (range(2), 999)
            motor = "" if actuator == "ideal" else " and the motor in Python"
            yield from whole_runs(task, actuator, integrator, seeds, longest, motor=motor)
    if task.name in FITTED:
        for integrator in task.integrators:
            yield from fitted_run(task, integrator, quick, motor=FITTED[task.name][0])
    else:
        yield Skipped("a run with an off-the-shelf motor", "none was chosen for it")
