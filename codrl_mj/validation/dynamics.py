"""Accelerations and one-step maps against the installed Gymnasium: random states, dense grids, bounds, extreme forces.

The oracle is an unmodified Gymnasium environment that is driven through its attributes, none of its
equations copied.
"""

import itertools
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationDivergedError
from codrl_mj.tasks import Task, find_task
from codrl_mj.tasks.reference_env import ReferenceStates
from codrl_mj.validation.compare import both, differences, gymnasium_equations, without_oracle
from codrl_mj.validation.table import Case, Check, Skipped, check

TOLERANCE = 1e-12
"""One step rounds some tens of numbers to 1e-16; an RK4 step at the speed limits amplifies that a hundredfold."""

EXTREME = 10.0
"""Extreme forces are this many times the largest that a task asks for."""


def grid(bounds: Sequence[float], points: int) -> np.ndarray:
    """States on a dense grid within bounds to either side, ends included: shape (points to the power n, n)."""
    axes = [np.linspace(-bound, bound, points) for bound in bounds]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _crossed(states: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every state with every force."""
    return np.repeat(states, len(forces), axis=0), np.tile(forces, len(states))


def _after_one_step(
    physics: MujocoPhysics | AnalyticPhysics, states: np.ndarray, forces: np.ndarray
) -> np.ndarray:
    """The state one environment step after each state under each force; NaN where the simulation diverged."""
    after = np.full_like(states, np.nan)
    for row, (state, force) in enumerate(zip(states, forces.tolist(), strict=True)):
        physics.reset(state)
        try:
            physics.step(force)
        except SimulationDivergedError:
            continue
        after[row] = physics.state
    return after


def _of_each(
    gaps: np.ndarray, names: Sequence[str], states: np.ndarray, forces: np.ndarray
) -> Case:
    """Gaps of shape (states, names), each said with its state and force."""

    def where(at: int) -> str:
        row, entry = divmod(at, len(names))
        return (
            f"{names[entry]} {np.array2string(states[row], precision=3)}, force {forces[row]:.3g}"
        )

    return Case(gaps, where, len(states))


def _stepped(
    task: Task, integrator: str, states: np.ndarray, forces: np.ndarray, limit: float
) -> Case:
    """One step from the states under the forces, which MuJoCo limits itself and Gymnasium is given limited."""
    physics, analytic = both(task, IDEAL, integrator, max_force=limit)
    ours = _after_one_step(physics, states, forces)
    oracle = _after_one_step(analytic, states, np.clip(forces, -limit, limit))

    return _of_each(
        differences(task, ours, oracle),
        [f"{name} from" for name in task.state_names],
        states,
        forces,
    )


@check(
    "dynamics",
    *(
        Check(f"one step{where}, {{integrator}}", "{task.oracle}", TOLERANCE)
        for where in ("", " at the bounds", " beyond the force limit")
    ),
)
def one_step(
    task: Task, trials: ReferenceStates, integrator: str, quick: bool
) -> Iterator[tuple[Case, ...]]:
    """One integration step with an ideal actuator: from random states under random forces.

    And from the task's edges under no, full and extreme forces, which MuJoCo is allowed there; and
    from a grid under commands up to `EXTREME` times the limit, against Gymnasium under the limit.
    """
    generator, limit, flat = np.random.default_rng(0), task.max_force, len(task.state_names) == 2
    bounds, samples = np.array(trials.bounds), 200 if quick else 10_000
    states = generator.uniform(-bounds, bounds, (samples, len(bounds)))
    forces = generator.uniform(-limit, limit, samples)
    edges = np.array(list(itertools.product(*trials.edges)))[:: 5 if quick and not flat else 1]
    at_edges = _crossed(edges, limit * np.array([-EXTREME, -1.0, 0.0, 1.0, EXTREME]))
    points = grid(trials.bounds, 3 if quick else (21 if flat else 5))
    beyond = _crossed(points, limit * np.array([-EXTREME, -1.001, 1.001, EXTREME]))
    yield (
        _stepped(task, integrator, states, forces, limit),
        _stepped(task, integrator, *at_edges, EXTREME * limit),
        _stepped(task, integrator, *beyond, limit),
    )


@check("dynamics", Check("accelerations", "{task.oracle}", TOLERANCE))
def accelerations(task: Task, trials: ReferenceStates, points: int) -> Iterator[Case]:
    """MuJoCo's `qacc` over a dense grid of states, under no, half, full and extreme forces."""
    states, forces = _crossed(
        grid(trials.bounds, points), task.max_force * np.array([-EXTREME, -1.0, 0.0, 0.5, EXTREME])
    )
    physics, _ = both(task, IDEAL, task.integrators[0], max_force=EXTREME * task.max_force)
    equations, velocities = gymnasium_equations(task, dt=1.0), list(task.qvel)
    ours, oracle = (np.empty((len(states), len(task.qvel))) for _ in range(2))
    for row, (state, force) in enumerate(zip(states, forces.tolist(), strict=True)):
        physics.reset(state)
        physics.data.ctrl[0] = force
        mujoco.mj_forward(physics.model, physics.data)
        ours[row] = physics.data.qacc
        oracle[row] = equations(state, force)[velocities]

    names = [f"d{task.state_names[entry].partition(' ')[0]}/dt at" for entry in velocities]
    yield _of_each(np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle)), names, states, forces)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of this group."""
    task = find_task(task_name)
    missing = without_oracle(task)
    if missing or task.reference_states is None:
        yield Skipped(
            "all checks", missing or "it names no states to try it in: Task.reference_states"
        )
        return
    flat = len(task.state_names) == 2
    points = (9 if flat else 3) if quick else (51 if flat else 7)
    yield from accelerations(task, task.reference_states, points)
    for integrator in task.integrators:
        yield from one_step(task, task.reference_states, integrator, quick)
