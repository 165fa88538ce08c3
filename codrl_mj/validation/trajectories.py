"""Whole runs under the same commands: MuJoCo with the motor in its callback against Gymnasium with the motor in Python.

A run is judged twice. Up to `HORIZON` the difference itself must stay below 1e-9. Over a whole episode, where a chaotic
task would enlarge even the smallest rounding beyond any fixed bound, the difference is measured against what rounding
becomes in the oracle itself along this run (see `codrl_mj.validation.growth`): what remains is the error made, not what
chaos made of it.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from codrl_mj.actuators import Actuator, ActuatorModel, Ideal
from codrl_mj.pages.plots import Curve, Plot
from codrl_mj.physics import SimulationDivergedError
from codrl_mj.tasks import Task, find_task, named_actuator
from codrl_mj.validation.compare import NO_TWIN, SEVERAL_MOTORS, Worst, both, differences, last_signals
from codrl_mj.validation.drives import FITTED, runs
from codrl_mj.validation.growth import ROUNDING, Growth, lyapunov_exponent
from codrl_mj.validation.outcome import Check, Skipped

TOLERANCE = 1e-9
"""Of the difference: rounding (1e-16), a thousand steps, and the growth of tasks that are not chaotic."""
ROUNDINGS = 30.0
"""Largest difference in standard deviations of the oracle's own accumulated rounding, of 2e-16 for each entry and step;
a step rounds some tens of numbers."""

UNLIMITED_STEPS = 200
"""Environment steps of a run of a task without a time limit."""
STARVED = "starved"
ACTUATORS = ("ideal", "paper", "weaker", STARVED)


def starved(task: Task) -> Actuator:
    """The paper's motor with 0.5 V and nothing against its back-EMF, both of which its loop hides otherwise."""
    (paper,) = task.paper
    loop = dataclasses.replace(paper.controller, max_voltage=0.5, bemf_compensation=False)
    return dataclasses.replace(paper, controller=loop)


@dataclasses.dataclass(frozen=True)
class _Run:
    """One run on both physics."""

    seed: int
    gaps: np.ndarray
    """Largest difference of state or force after each step."""
    entries: list[str]
    """In what."""
    growth: Growth
    """How errors grow along it."""
    error: str = ""
    """What ended it early."""


def _run(task: Task, actuator: ActuatorModel, integrator: str, steps: int, seed: int) -> _Run:
    mujoco, analytic = both(task, actuator, integrator)
    generator = np.random.default_rng(seed)
    initial = task.initial(generator, None)
    forces = task.max_force * generator.choice([-1.0, 1.0], steps)
    for physics in (mujoco, analytic):
        physics.reset(initial)
    growth = Growth(task, analytic, seed)
    gaps: list[float] = []
    entries: list[str] = []
    names = [*task.state_names, "force"]
    for force in forces.tolist():
        try:
            for physics in (mujoco, analytic):
                physics.step(force)
            delivered = [last_signals(physics)["actual_force"] for physics in (mujoco, analytic)]
            growth.follow(force)
        except SimulationDivergedError as error:
            return _Run(seed, np.array(gaps), entries, growth, str(error))
        state_gaps = differences(task, mujoco.state, analytic.state)
        all_gaps = np.append(state_gaps, abs(delivered[0] - delivered[1]) / task.max_force)
        worst = int(np.argmax(np.where(np.isnan(all_gaps), np.inf, all_gaps)))
        gaps.append(float(all_gaps[worst]))
        entries.append(names[worst])
    return _Run(seed, np.array(gaps), entries, growth)


def _judge(runs: list[_Run], steps: int, in_roundings: bool) -> Worst:
    worst = Worst()
    for run in runs:
        gaps = run.gaps[:steps]
        if in_roundings:
            gaps = gaps / run.growth.rounding[: len(gaps)]
        if len(gaps):
            index = int(np.argmax(np.where(np.isnan(gaps), np.inf, gaps)))
            worst.see(gaps[index], f"{run.entries[index]} at step {index + 1} of seed {run.seed}")
        if run.error and len(gaps) < steps:
            worst.see(math.inf, f"step {len(gaps) + 1} of seed {run.seed}: {run.error}")
            break
    return worst


def _plot(task: Task, run: _Run, title: str) -> Plot:
    times = task.step_duration * np.arange(1, len(run.gaps) + 1)
    exponent = lyapunov_exponent(np.array(run.growth.logarithms), task.step_duration)
    rounding = np.array(run.growth.rounding[: len(times)])
    curves = (
        Curve("difference found (0 is drawn at 1e-18)", times, np.maximum(run.gaps, 1e-18)),
        Curve("what rounding becomes in the oracle", times, rounding, reference=True),
        Curve(f"2e-16 × exp(λt), λ = {exponent:.3g} 1/s", times, ROUNDING * np.exp(exponent * times), reference=True),
        Curve(f"allowed: {ROUNDINGS:g} × rounding", times, ROUNDINGS * rounding, reference=True),
    )
    return Plot(title, "time [s]", "difference [relative]", curves, y_log=True)


def episodes(task: Task, actuator_name: str, integrator: str, seeds: range, longest: int = 999) -> Iterator[Check]:
    """Whole runs under the same random bang-bang commands; the task's ends are ignored, and a divergence fails.

    Args:
        task: the task.
        actuator_name: a named actuator, or `starved`.
        integrator: one of the task's integrators.
        seeds: one run each.
        longest: stop after so many environment steps.

    Yields:
        The check of the difference itself, and that of the difference in roundings, with a plot of the first run.
    """
    actuator = starved(task) if actuator_name == STARVED else named_actuator(actuator_name, task.name)
    oracle = task.oracle + ("" if isinstance(actuator, Ideal) else " and the motor in Python")
    steps = min(longest, task.max_episode_steps or UNLIMITED_STEPS)
    horizon = min(steps, (task.trials and task.trials.horizon) or steps)
    runs = [_run(task, actuator, integrator, steps, seed) for seed in seeds]
    described = f"{integrator}, {actuator_name} actuator"
    for name, length, in_roundings, tolerance, unit in (
        (f"run, {described}", horizon, False, TOLERANCE, "relative"),
        (f"run against rounding, {described}", steps, True, ROUNDINGS, "accumulated roundings"),
    ):
        worst = _judge(runs, length, in_roundings)
        plots = (_plot(task, runs[0], f"{task.name}, {described}"),) if in_roundings and len(runs[0].gaps) > 1 else ()
        count = length * len(seeds)
        yield Check(name, oracle, count, worst.value, tolerance, worst.where, "trajectories", task.name, unit, plots)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of this group.

    Args:
        task_name: the task.
        quick: one shorter run each instead of two whole episodes.
    """
    task = find_task(task_name)
    if task.twin is None or len(task.motors) > 1:
        yield Skipped("all checks", NO_TWIN if task.twin is None else SEVERAL_MOTORS, "trajectories", task.name)
        return
    actuators = ACTUATORS if task.paper else ACTUATORS[:1]
    if not task.paper:
        reason = "they are variations of the paper's actuator, of which it has none"
        yield Skipped(f"runs with the {', '.join(ACTUATORS[1:])} actuators", reason, "trajectories", task.name)
    for actuator in actuators:
        for integrator in task.integrators:
            shorter = 100 if task.motor_inner_steps > 1 else 200
            seeds, longest = (range(1), shorter) if quick else (range(2), 999)
            yield from episodes(task, actuator, integrator, seeds, longest)
    if task.name in FITTED:
        yield from runs(task, TOLERANCE, quick)
    else:
        yield Skipped("a run with a motor that one can buy", "none was chosen for it", "trajectories", task.name)
