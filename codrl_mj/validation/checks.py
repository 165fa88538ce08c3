"""Cross-validation of a task's MuJoCo physics against the installed Gymnasium.

The oracle of every check is the analytic physics: an unmodified Gymnasium environment driven through its attributes.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np

from codrl_mj.motor import Actuator, named_actuator
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, Physics, SimulationDivergedError
from codrl_mj.physics.base import inner_step_count
from codrl_mj.tasks import Task, find_task
from codrl_mj.validation.outcome import Check

STATE_BOUNDS: dict[str, tuple[float, ...]] = {
    # beyond what an episode can reach: all angles, and speeds of a falling pole
    "pendulum": (2 * np.pi, 8.0),
    "cartpole": (4.8, 10.0, np.pi, 10.0),
    # at the task's limits, twice as fast, one RK4 step of Gymnasium amplifies rounding to 1e-12
    "acrobot": (np.pi, np.pi, 2 * np.pi, 4 * np.pi),
    "mountain_car": (1.2, 0.07),
    "mountain_car_continuous": (1.2, 0.07),
}
"""States are drawn uniformly within plus and minus these, in the units of the task's state."""

RUN_STEPS: dict[str, int] = {
    # chaotic: rounding grows to 1e-11 over these runs, and to 1e-6 over 500 steps
    "pendulum": 200,
    "acrobot": 100,
    "cartpole": 500,
    "mountain_car": 500,
    "mountain_car_continuous": 500,
}
"""Environment steps of each whole run."""


def _difference(task: Task, ours: np.ndarray, oracle: np.ndarray) -> tuple[float, str]:
    difference = np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle))
    worst = int(np.argmax(np.where(np.isnan(difference), np.inf, difference)))
    return float(difference[worst]), task.state_names[worst]


def _is_worse(difference: float, worst: float) -> bool:
    """Whether `difference` is the larger; a NaN is larger than anything, and stays."""
    return not (difference <= worst or math.isnan(worst))


def _build(kind: type, task: Task, actuator: Actuator | None, integrator: str) -> Physics:
    return kind(task, actuator, inner_step_count(task, actuator, None, None), integrator)


def one_step(task: Task, integrator: str, samples: int, seed: int) -> Check:
    """One integration step with an ideal actuator from random states under random forces; tolerance 1e-12.

    Args:
        task: the task.
        integrator: one of the task's integrators.
        samples: random states.
        seed: of the states and forces.
    """
    generator = np.random.default_rng(seed)
    bounds = np.array(STATE_BOUNDS[task.name])
    mujoco, analytic = (_build(kind, task, None, integrator) for kind in (MujocoPhysics, AnalyticPhysics))
    worst, where = 0.0, ""
    for _ in range(samples):
        state = generator.uniform(-bounds, bounds)
        force = float(generator.uniform(-task.max_force, task.max_force))
        for physics in (mujoco, analytic):
            physics.reset(state)
            physics.step(force)
        difference, entry = _difference(task, mujoco.state, analytic.state)
        if _is_worse(difference, worst):
            worst, where = difference, f"{entry} from {np.array2string(state, precision=3)}, force {force:.3g}"
    oracle = f"Gymnasium {task.gymnasium_id}"
    return Check(f"one step, {integrator}", oracle, samples, worst, 1e-12, where)


STARVED = "starved"


def _starved(task: Task) -> Actuator:
    paper = named_actuator("paper", task.name)
    assert paper is not None
    loop = dataclasses.replace(paper.controller, max_voltage=0.5, bemf_compensation=False)
    return dataclasses.replace(paper, controller=loop)


def episodes(task: Task, actuator: str, integrator: str, steps: int, seeds: range) -> Check:
    """Whole runs under the same random bang-bang forces, motor in the loop; tolerance 1e-9.

    Args:
        task: the task.
        actuator: a named actuator, or `starved`: the paper's with 0.5 V and nothing against its back-EMF, both of which
            the loop of the others hides.
        integrator: one of the task's integrators.
        steps: environment steps of each run; the task's ends are ignored, and a divergence fails.
        seeds: one run each.
    """
    resolved = _starved(task) if actuator == STARVED else named_actuator(actuator, task.name)
    mujoco, analytic = (_build(kind, task, resolved, integrator) for kind in (MujocoPhysics, AnalyticPhysics))
    oracle = f"Gymnasium {task.gymnasium_id}" + (" and the motor in Python" if resolved else "")
    name = f"{steps} steps, {integrator}, {actuator} actuator"
    worst, where = 0.0, ""
    for seed in seeds:
        generator = np.random.default_rng(seed)
        initial = task.initial(generator, None)
        forces = task.max_force * generator.choice([-1.0, 1.0], steps)
        for physics in (mujoco, analytic):
            physics.reset(initial)
        for index, force in enumerate(forces):
            try:
                delivered = [physics.step(float(force)).actual_force for physics in (mujoco, analytic)]
            except SimulationDivergedError as error:
                where = f"step {index + 1} of seed {seed}: {error}"
                return Check(name, oracle, steps * len(seeds), math.inf, 1e-9, where)
            difference, entry = _difference(task, mujoco.state, analytic.state)
            if not (gap := abs(delivered[0] - delivered[1]) / task.max_force) <= difference:
                difference, entry = gap, "force"
            if _is_worse(difference, worst):
                worst, where = difference, f"{entry} at step {index + 1} of seed {seed}"
    return Check(name, oracle, steps * len(seeds), worst, 1e-9, where)


def validate(
    task_name: str, samples: int = 10_000, runs: int = 4, on_check: Callable[[Check], None] | None = None
) -> list[Check]:
    """Cross-validate one task.

    Args:
        task_name: the task.
        samples: random states for the one-step check.
        runs: runs for each whole-run check.
        on_check: called with each outcome as it arrives.

    Raises:
        ValueError: unknown task, or a count below 1.
    """
    for name, value in (("samples", samples), ("runs", runs)):
        if value < 1:
            raise ValueError(f"{name} = {value}: must be >= 1")

    def checks(task: Task) -> Iterator[Check]:
        for integrator in task.integrators:
            yield one_step(task, integrator, samples, seed=0)
        for actuator in ("ideal", "paper", "weaker", STARVED):
            for integrator in task.integrators:
                yield episodes(task, actuator, integrator, RUN_STEPS[task.name], range(runs))

    outcomes = []
    for check in checks(find_task(task_name)):
        outcomes.append(check)
        if on_check is not None:
            on_check(check)
    return outcomes
