"""Comparison of accelerations and single steps with the installed Gymnasium.

States are random, on dense grids and at the bounds; forces go beyond the limit. The oracle is an
unmodified Gymnasium environment whose state is set through its attributes; none of its equations is
copied.
"""

import itertools
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationDivergedError
from codrl_mj.tasks import Task, find_task
from codrl_mj.tasks.base import Options
from codrl_mj.tasks.reference_env import ReferenceStates
from codrl_mj.validation.compare import (
    differences,
    gymnasium_equations,
    missing_oracle_reason,
    physics_pair,
)
from codrl_mj.validation.table import Case, Check, Skipped, check

TOLERANCE = 1e-12
"""Tolerance of one step, relative.

A step rounds some tens of numbers to 1e-16; an RK4 step at the speed limits amplifies that a
hundredfold.
"""

EXTREME = 10.0
"""Ratio of extreme forces to the largest force of a task."""


def grid(bounds: Sequence[float], points: int) -> np.ndarray:
    """Return a dense grid of states within +-bounds, ends included, shape (points**n, n)."""
    axes = [np.linspace(-bound, bound, points) for bound in bounds]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _crossed(states: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of a state and a force, as two arrays of equal length."""
    return np.repeat(states, len(forces), axis=0), np.tile(forces, len(states))


def _after_one_step(
    physics: MujocoPhysics | AnalyticPhysics, states: np.ndarray, forces: np.ndarray
) -> np.ndarray:
    """Return the states one environment step later; NaN where the simulation diverged."""
    after = np.full_like(states, np.nan)
    for row, (state, force) in enumerate(zip(states, forces.tolist(), strict=True)):
        physics.reset(state)
        try:
            physics.step(force)
        except SimulationDivergedError:
            continue
        after[row] = physics.state
    return after


def _state_case(
    gaps: np.ndarray, names: Sequence[str], states: np.ndarray, forces: np.ndarray
) -> Case:
    """Return a case of differences (states, names), each described by its state and force."""

    def describe(index: int) -> str:
        row, entry = divmod(index, len(names))
        return (
            f"{names[entry]} {np.array2string(states[row], precision=3)}, force {forces[row]:.3g}"
        )

    return Case(gaps, describe, len(states))


def _stepped(
    task: Task, integrator: str, states: np.ndarray, forces: np.ndarray, limit: float
) -> Case:
    """Compare one step; MuJoCo limits the forces, Gymnasium gets them clipped."""
    physics, analytic = physics_pair(task, IDEAL, integrator, max_force=limit)
    ours = _after_one_step(physics, states, forces)
    oracle = _after_one_step(analytic, states, np.clip(forces, -limit, limit))

    return _state_case(
        differences(task, ours, oracle),
        [f"{name} from" for name in task.state_names],
        states,
        forces,
    )


@check(
    "dynamics",
    *(
        Check(f"one step{region}, {{integrator}}", "{task.oracle}", TOLERANCE)
        for region in ("", " at the bounds", " beyond the force limit")
    ),
)
def one_step(
    task: Task, reference: ReferenceStates, integrator: str, quick: bool
) -> Iterator[tuple[Case, ...]]:
    """Compare one integration step with an ideal actuator.

    The three cases are random states under random forces; the task's edges under no, full and
    extreme forces, with MuJoCo's force limit raised to the extreme ones; and a grid of states under
    commands up to `EXTREME` times the limit, where Gymnasium gets the limited force.
    """
    generator = np.random.default_rng(0)
    limit = task.max_force
    is_planar = len(task.state_names) == 2
    bounds, samples = np.array(reference.bounds), 200 if quick else 10_000
    states = generator.uniform(-bounds, bounds, (samples, len(bounds)))
    forces = generator.uniform(-limit, limit, samples)
    edges = np.array(list(itertools.product(*reference.edges)))[
        :: 5 if quick and not is_planar else 1
    ]
    at_edges = _crossed(edges, limit * np.array([-EXTREME, -1.0, 0.0, 1.0, EXTREME]))
    grid_states = grid(reference.bounds, 3 if quick else (21 if is_planar else 5))
    beyond = _crossed(grid_states, limit * np.array([-EXTREME, -1.001, 1.001, EXTREME]))
    yield (
        _stepped(task, integrator, states, forces, limit),
        _stepped(task, integrator, *at_edges, EXTREME * limit),
        _stepped(task, integrator, *beyond, limit),
    )


@check("dynamics", Check("accelerations", "{task.oracle}", TOLERANCE))
def accelerations(task: Task, reference: ReferenceStates, points: int) -> Iterator[Case]:
    """Compare `qacc` on a dense grid of states, under no, half, full and extreme forces."""
    yield _accelerations(task, reference, points)


@check("dynamics", Check("accelerations with other options", "{task.oracle}", TOLERANCE))
def accelerations_with_options(
    task: Task, reference: ReferenceStates, points: int
) -> Iterator[Case]:
    """Compare `qacc` as `accelerations` does, with each of the task's `reference_options`."""
    for options in task.reference_options:
        yield _accelerations(task, reference, points, options)


def _accelerations(
    task: Task, reference: ReferenceStates, points: int, options: Options = None
) -> Case:
    """Compare `qacc` with options of the task; None for their defaults."""
    states, forces = _crossed(
        grid(reference.bounds, points),
        task.max_force * np.array([-EXTREME, -1.0, 0.0, 0.5, EXTREME]),
    )
    physics, _ = physics_pair(
        task, IDEAL, task.integrators[0], max_force=EXTREME * task.max_force, options=options
    )
    equations = gymnasium_equations(task, dt=1.0, options=options)
    velocities = list(task.qvel)
    ours, oracle = (np.empty((len(states), len(task.qvel))) for _ in range(2))
    for row, (state, force) in enumerate(zip(states, forces.tolist(), strict=True)):
        physics.reset(state)
        physics.data.ctrl[0] = force
        mujoco.mj_forward(physics.model, physics.data)
        ours[row] = physics.data.qacc
        oracle[row] = equations(state, force)[velocities]

    # A state's name may have its unit behind a space, which would not fit into "d.../dt".
    names = [f"d{task.state_names[entry].partition(' ')[0]}/dt at" for entry in velocities]
    return _state_case(
        np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle)), names, states, forces
    )


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """Run the dynamics checks of a task."""
    task = find_task(task_name)
    reason = missing_oracle_reason(task)
    if reason or task.reference_states is None:
        yield Skipped(
            "all checks", reason or "the task names no states for it: set Task.reference_states"
        )
        return
    is_planar = len(task.state_names) == 2
    points = (9 if is_planar else 3) if quick else (51 if is_planar else 7)
    yield from accelerations(task, task.reference_states, points)
    yield from accelerations_with_options(task, task.reference_states, points)
    for integrator in task.integrators:
        yield from one_step(task, task.reference_states, integrator, quick)
