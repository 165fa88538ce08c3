"""Comparison of whole runs in MuJoCo with Gymnasium under the same commands.

In MuJoCo the motor runs in the callback; for Gymnasium it runs in plain Python. A run is checked
twice. Up to the horizon of `Task.reference_states` the difference itself must stay below 1e-9. Over
a whole episode a chaotic task enlarges even the smallest rounding beyond any fixed bound. There the
difference is divided by the growth of rounding errors in the oracle along the same run (`Growth`),
which separates the port's error from its amplification by chaos.
"""

import copy
import math
from collections.abc import Iterator

import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.physics import AnalyticPhysics, SimulationDivergedError, trace_names
from codrl_mj.plots import Curve, Plot
from codrl_mj.tasks import Task, find_task, named_actuator
from codrl_mj.validation.compare import differences, missing_oracle_reason, physics_pair
from codrl_mj.validation.motor_catalogue import TASK_MOTORS, task_motor_run
from codrl_mj.validation.table import Case, Check, Skipped, check

TOLERANCE = 1e-9
"""Largest difference up to the horizon, relative.

It allows for rounding (1e-16), a thousand steps, and the error growth of tasks that are not
chaotic.
"""
MAX_ROUNDINGS = 30.0
"""Largest difference over a whole run, in standard deviations of the oracle's accumulated rounding.

The oracle is assumed to round each entry by 2e-16 in each step; a real step rounds some tens of
numbers.
"""

UNLIMITED_STEPS = 200
"""Environment steps of a run of a task without a time limit."""
STARVED = "starved"
"""Name of the paper's motor with a low voltage limit and without back-EMF compensation."""
ACTUATORS = ("ideal", "paper", "weaker", STARVED)
"""Names of the actuators that are compared."""


DISPLACEMENT = 1e-7
"""Displacement of a state entry for finite differences, relative to max(1, size).

It is far above rounding, and small enough for the step to be linear in it.
"""
ROUNDING = float(np.finfo(float).eps)
"""Rounding error of a double, relative."""
NUM_CLOCK_ENTRIES = 2
"""Number of entries after the states in a snapshot of `AnalyticPhysics`: time and key."""


class Growth:
    """Recorder of the growth of rounding errors along a run of an analytic physics.

    The oracle's step is linearized along the run by finite differences: each entry of the states of
    mechanics and motor is displaced by a small amount, one at a time. The product of these matrices
    carries

    - one displacement, scaled back after every step: the mean rate of its growth is Benettin's
      estimate of the largest Lyapunov exponent, of the driven system along this run;
    - the covariance of independent rounding errors, one in every entry at every step:
      P <- M P M' + Q.
    """

    def __init__(self, task: Task, run: AnalyticPhysics, seed: int) -> None:
        """Start at the beginning of a run; the seed gives the direction of the displacement."""
        self._run = run
        self._displaced_run = copy.deepcopy(run)
        self._size = len(task.state_names)
        self._start = run.snapshot()
        entries = len(self._start) - NUM_CLOCK_ENTRIES
        direction = np.random.default_rng(seed).standard_normal(entries)
        self._direction = direction / np.linalg.norm(direction)
        self._covariance = np.zeros((entries, entries))
        self.logarithms = [0.0]
        """Logarithm of the displacement's growth since the beginning, after each step."""
        self.rounding: list[float] = []
        """Standard deviation of accumulated rounding after each step, relative to max(1, size)."""

    def follow(self, desired_force: float) -> None:
        """Linearize the step that the run has just taken."""
        displaced_run, size, entries = self._displaced_run, self._size, len(self._direction)
        end = self._run.snapshot()
        matrix = np.empty((entries, entries))
        for entry in range(entries):
            displacement = DISPLACEMENT * max(1.0, abs(self._start[entry]))
            displaced = self._start.copy()
            displaced[entry] += displacement
            displaced_run.restore(displaced)
            displaced_run.step(desired_force)
            gap = (displaced_run.snapshot() - end)[:entries]
            # Remove whole turns, in case only one of the two angles was wrapped.
            gap[:size] -= 2 * math.pi * np.round(gap[:size] / (2 * math.pi))
            matrix[:, entry] = gap / displacement
        new_direction = matrix @ self._direction
        length = float(np.linalg.norm(new_direction))
        self.logarithms.append(self.logarithms[-1] + math.log(max(length, ROUNDING)))
        # The displacement vanishes if a wall stops both states; then the direction is kept.
        self._direction = new_direction / length if length > ROUNDING else self._direction
        scale = np.maximum(1.0, np.abs(end[:entries]))
        self._covariance = matrix @ self._covariance @ matrix.T + np.diag((ROUNDING * scale) ** 2)
        self.rounding.append(float((np.sqrt(np.diag(self._covariance)) / scale)[:size].max()))
        self._start = end


def _run(
    task: Task, actuator: ActuatorModel, integrator: str, steps: int, seed: int
) -> tuple[np.ndarray, list[str], Growth]:
    """Simulate a run with both physics.

    Returns:
        The largest difference of state or force after each step, infinity for a step that diverged;
        a description of each; and the growth of rounding errors along the run.
    """
    mujoco, analytic = physics_pair(task, actuator, integrator)
    generator = np.random.default_rng(seed)
    initial = task.draw_initial_state(generator, None)
    forces = task.max_force * generator.choice([-1.0, 1.0], steps)
    for physics in (mujoco, analytic):
        physics.reset(initial)
    growth = Growth(task, analytic, seed)
    gaps: list[float] = []
    descriptions: list[str] = []
    names = [*task.state_names, "force"]
    for step, force in enumerate(forces.tolist(), 1):
        try:
            for physics in (mujoco, analytic):
                physics.step(force)
            column = trace_names(analytic.simulation.family).index("actual_force")
            delivered = [float(physics.trace[-1, 0, column]) for physics in (mujoco, analytic)]
            growth.follow(force)
        except SimulationDivergedError as error:
            gaps.append(math.inf)
            descriptions.append(f"step {step} of seed {seed}: {error}")
            break
        state_gaps = differences(task, mujoco.state, analytic.state)
        all_gaps = np.append(state_gaps, abs(delivered[0] - delivered[1]) / task.max_force)
        # argmax returns the index of a NaN if there is one.
        worst = int(np.argmax(all_gaps))
        gaps.append(float(all_gaps[worst]))
        descriptions.append(f"{names[worst]} at step {step} of seed {seed}")
    return np.array(gaps), descriptions, growth


def _plot(task: Task, gaps: np.ndarray, growth: Growth, title: str) -> Plot:
    rounding = np.array(growth.rounding)
    times = task.step_duration * np.arange(1, len(rounding) + 1)
    starts = task.step_duration * np.arange(len(growth.logarithms))
    # The slope is the estimate of the largest Lyapunov exponent [1/s].
    exponent, _ = np.polyfit(starts, growth.logarithms, 1)
    curves = (
        Curve(
            "difference (0 is drawn at 1e-18)",
            times,
            np.maximum(gaps[: len(rounding)], 1e-18),
        ),
        Curve("accumulated rounding of the oracle", times, rounding, reference=True),
        Curve(
            f"2e-16 × exp(λt), λ = {exponent:.3g} 1/s",
            times,
            ROUNDING * np.exp(exponent * times),
            reference=True,
        ),
        Curve(
            f"allowed: {MAX_ROUNDINGS:g} × rounding",
            times,
            MAX_ROUNDINGS * rounding,
            reference=True,
        ),
    )
    return Plot(title, "time [s]", "difference [relative]", curves, y_log=True)


_NAME, _ORACLE = "{integrator}, {actuator_name} actuator", "{task.oracle}{motor}"


@check(
    "trajectories",
    Check(f"run, {_NAME}", _ORACLE, TOLERANCE),
    Check(f"run against rounding, {_NAME}", _ORACLE, MAX_ROUNDINGS, "accumulated roundings"),
)
def whole_runs(
    task: Task, actuator_name: str, integrator: str, seeds: range, max_steps: int
) -> Iterator[tuple[Case, ...]]:
    """Compare runs under the same random bang-bang commands.

    The first row has the difference itself up to the horizon, the second the difference of the
    whole run in accumulated roundings. Terminations are ignored, and a divergence fails. `starved`
    is the paper's motor with a limit of 0.5 V and without back-EMF compensation: otherwise the loop
    would hide errors of both. The first run has a plot.
    """
    actuator = named_actuator("paper" if actuator_name == STARVED else actuator_name, task.name)
    if actuator_name == STARVED:
        actuator = actuator.replaced(
            {"controller.max_voltage": 0.5, "controller.bemf_compensation": False}
        )
    steps = min(max_steps, task.max_episode_steps or UNLIMITED_STEPS)
    horizon = min(steps, (task.reference_states and task.reference_states.horizon) or steps)
    for seed in seeds:
        gaps, descriptions, growth = _run(task, actuator, integrator, steps, seed)
        in_roundings = gaps / np.append(growth.rounding, np.ones(len(gaps) - len(growth.rounding)))
        title = f"{task.name}, {integrator}, {actuator_name} actuator"
        plots = (
            (_plot(task, gaps, growth, title),)
            if seed == seeds[0] and len(growth.rounding) > 1
            else ()
        )
        yield (
            Case(gaps[:horizon], descriptions.__getitem__, horizon),
            Case(in_roundings, descriptions.__getitem__, steps, plots),
        )


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """Run the trajectory checks of a task."""
    task = find_task(task_name)
    if missing_oracle := missing_oracle_reason(task):
        yield Skipped("all checks", missing_oracle)
        return
    actuators = ACTUATORS if task.paper else ACTUATORS[:1]
    if not task.paper:
        reason = "they are variations of the paper's actuator, and the task has none"
        yield Skipped(f"runs with the {', '.join(ACTUATORS[1:])} actuators", reason)
    for actuator in actuators:
        for integrator in task.integrators:
            motor_steps = 100 if task.motor_inner_steps > 1 else 200
            seeds, max_steps = (range(1), motor_steps) if quick else (range(2), 999)
            motor = "" if actuator == "ideal" else " and the motor in Python"
            yield from whole_runs(task, actuator, integrator, seeds, max_steps, motor=motor)
    if task.name in TASK_MOTORS:
        for integrator in task.integrators:
            yield from task_motor_run(task, integrator, quick, motor=TASK_MOTORS[task.name][0])
    else:
        yield Skipped("a run with an off-the-shelf motor", "none was chosen for this task")
