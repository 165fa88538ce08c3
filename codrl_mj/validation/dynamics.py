"""Accelerations and one-step maps against the installed Gymnasium: random states, dense grids, bounds, extreme forces.

The oracle is an unmodified Gymnasium environment that is driven through its attributes, none of its equations copied.
"""

import itertools
import math
from collections.abc import Iterator

import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationDivergedError
from codrl_mj.tasks import Task, find_task
from codrl_mj.validation.compare import Worst, both, largest, twin_of
from codrl_mj.validation.outcome import Check

TOLERANCE = 1e-12
"""One step rounds some tens of numbers to 1e-16; an RK4 step at the speed limits amplifies that a hundredfold."""

EXTREME = 10.0
"""Extreme forces are this many times the largest that a task asks for."""

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


def _around(value: float) -> tuple[float, ...]:
    """A bound, the numbers next to it on both sides, and one just inside; and all of them negated."""
    numbers = (value, math.nextafter(value, math.inf), math.nextafter(value, 0.0), 0.999 * value)
    return (*numbers, *(-number for number in numbers))


EDGES: dict[str, tuple[tuple[float, ...], ...]] = {
    "pendulum": ((*_around(math.pi), 0.0, math.pi / 2, -2 * math.pi), (*_around(8.0), 0.0)),
    "cartpole": (
        (-4.8, -2.4, 0.0, 2.4, 4.8),
        (-10.0, 0.0, 10.0),
        (*_around(math.pi), 0.0, math.pi / 2, 0.2094),
        (-10.0, 0.0, 10.0),
    ),
    # on the cut of the angles, and faster than the first link may turn after the step
    "acrobot": ((*_around(math.pi), 0.0), (*_around(math.pi), 0.0), (-4 * math.pi, -1.0, 4 * math.pi), (-6.0, 6.0)),
    "mountain_car": ((-1.2, -1.2 + 1e-9, -1.19, -0.5, 0.0, 0.5, 0.59, 0.6), (*_around(0.07), 1e-9, -1e-9, 0.0)),
}
"""States on the walls, on the speed limits, on the cut of wrapped angles, and beside them: values of each entry."""
EDGES["mountain_car_continuous"] = EDGES["mountain_car"]


def grid(task: Task, points: int) -> np.ndarray:
    """States on a dense grid over `STATE_BOUNDS`, both ends included: shape (points to the power n, n)."""
    axes = [np.linspace(-bound, bound, points) for bound in STATE_BOUNDS[task.name]]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _crossed(states: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every state with every force."""
    return np.repeat(states, len(forces), axis=0), np.tile(forces, len(states))


def _after_one_step(physics: MujocoPhysics | AnalyticPhysics, states: np.ndarray, forces: np.ndarray) -> np.ndarray:
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


def _check(
    task: Task, name: str, ours: np.ndarray, oracle: np.ndarray, states: np.ndarray, forces: np.ndarray
) -> Check:
    worst = Worst()
    difference, row, entry = largest(task, ours, oracle)
    worst.see(difference, f"{entry} from {np.array2string(states[row], precision=3)}, force {forces[row]:.3g}")
    source = f"Gymnasium {task.gymnasium_id}"
    return Check(name, source, len(states), worst.value, TOLERANCE, worst.where, "dynamics", task.name)


def one_step(task: Task, integrator: str, samples: int, seed: int = 0) -> Check:
    """One integration step with an ideal actuator, from random states under random forces.

    Args:
        task: the task.
        integrator: one of the task's integrators.
        samples: random states.
        seed: of the states and forces.
    """
    generator = np.random.default_rng(seed)
    bounds = np.array(STATE_BOUNDS[task.name])
    states = generator.uniform(-bounds, bounds, (samples, len(bounds)))
    forces = generator.uniform(-task.max_force, task.max_force, samples)
    ours, oracle = (_after_one_step(physics, states, forces) for physics in both(task, IDEAL, integrator))
    return _check(task, f"one step, {integrator}", ours, oracle, states, forces)


def one_step_at_the_bounds(task: Task, integrator: str, stride: int = 1) -> Check:
    """One step from `EDGES` under no, full and extreme forces, which MuJoCo is allowed here.

    Args:
        task: the task.
        integrator: one of the task's integrators.
        stride: take every so many of the states.
    """
    states, forces = _crossed(
        np.array(list(itertools.product(*EDGES[task.name])))[::stride],
        task.max_force * np.array([-EXTREME, -1.0, 0.0, 1.0, EXTREME]),
    )
    physics = both(task, IDEAL, integrator, max_force=EXTREME * task.max_force)
    ours, oracle = (_after_one_step(each, states, forces) for each in physics)
    return _check(task, f"one step at the bounds, {integrator}", ours, oracle, states, forces)


def one_step_beyond_the_force_limit(task: Task, integrator: str, points: int) -> Check:
    """One step under commands up to `EXTREME` times the limit, against Gymnasium under the force clipped to the limit.

    Args:
        task: the task.
        integrator: one of the task's integrators.
        points: grid points along each state entry.
    """
    states, forces = _crossed(grid(task, points), task.max_force * np.array([-EXTREME, -1.001, 1.001, EXTREME]))
    mujoco_physics, analytic = both(task, IDEAL, integrator)
    ours = _after_one_step(mujoco_physics, states, forces)
    oracle = _after_one_step(analytic, states, np.clip(forces, -task.max_force, task.max_force))
    return _check(task, f"one step beyond the force limit, {integrator}", ours, oracle, states, forces)


class _GymnasiumAcceleration:
    """The acceleration (state, force) -> one number for each velocity, of an unmodified Gymnasium environment."""

    def __init__(self, task: Task) -> None:
        self._driver = twin_of(task)
        self._velocities = list(task.qvel)
        self._env = env = self._driver._env
        self._derivative = getattr(env, "_dsdt", None)  # Acrobot's own equations of motion
        if self._derivative is None:
            # one explicit step of 1 s changes the velocities by the accelerations, where nothing bounds them
            for owner, name, value in (
                (env, "max_speed", math.inf),
                (self._driver, "_max_speed", math.inf),
                (env, "min_position", -math.inf),
                (env, "max_position", math.inf),
            ):
                if hasattr(owner, name):
                    setattr(owner, name, value)

    def __call__(self, state: np.ndarray, force: float) -> np.ndarray:
        if self._derivative is not None:
            return np.array(self._derivative(np.append(state, force)))[self._velocities]
        after = np.array(self._driver(state, force, 1.0, "euler"))
        return (after - state)[self._velocities]


def accelerations(task: Task, points: int) -> Check:
    """MuJoCo's `qacc` over a dense grid of states, under no, half, full and extreme forces.

    Args:
        task: the task.
        points: grid points along each state entry.
    """
    states, forces = _crossed(grid(task, points), task.max_force * np.array([-EXTREME, -1.0, 0.0, 0.5, EXTREME]))
    physics, _ = both(task, IDEAL, task.integrators[0], max_force=EXTREME * task.max_force)
    acceleration = _GymnasiumAcceleration(task)
    ours, oracle = (np.empty((len(states), len(task.qvel))) for _ in range(2))
    for row, (state, force) in enumerate(zip(states, forces.tolist(), strict=True)):
        physics.reset(state)
        physics.data.ctrl[0] = force
        mujoco.mj_forward(physics.model, physics.data)
        ours[row] = physics.data.qacc
        oracle[row] = acceleration(state, force)
    worst = Worst()
    gaps = np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle))
    row, entry = divmod(int(np.argmax(np.where(np.isnan(gaps), np.inf, gaps))), gaps.shape[1])
    name = task.state_names[task.qvel[entry]].partition(" ")[0]
    worst.see(gaps[row, entry], f"d{name}/dt at {np.array2string(states[row], precision=3)}, force {forces[row]:.3g}")
    source = f"Gymnasium {task.gymnasium_id}"
    return Check("accelerations", source, len(states), worst.value, TOLERANCE, worst.where, "dynamics", task.name)


def checks(task_name: str | None, quick: bool = False) -> Iterator[Check]:
    """The checks of this group.

    Args:
        task_name: the task; None, which has no dynamics, has no checks.
        quick: fewer states.
    """
    if task_name is None:
        return
    task = find_task(task_name)
    flat = len(task.state_names) == 2
    points = (9 if flat else 3) if quick else (51 if flat else 7)
    yield accelerations(task, points)
    for integrator in task.integrators:
        yield one_step(task, integrator, 200 if quick else 10_000)
        yield one_step_at_the_bounds(task, integrator, stride=5 if quick and not flat else 1)
        yield one_step_beyond_the_force_limit(task, integrator, 3 if quick else (21 if flat else 5))
