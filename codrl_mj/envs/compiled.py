"""A whole environment as compiled functions: one step, one reset, for loops that numba compiles.

`ActuatedEnv.step` is one call of `step`; an agent's own compiled loop may call the two directly:

    parts = compiled_env(env.unwrapped)  # None where this cannot be

    @njit(nogil=True)
    def episode(step, reset, forces, generator, low, high, observation, where):
        reset(generator, low, high, where)
        total, ended = 0.0, False
        while not ended:
            action = ...  # from observation
            outcome = step(forces[action], where)
            total, ended = total + outcome[0], outcome[1] or not outcome[2]
        return total

    env.reset(seed=0)  # seeds the generator, and makes sure that our callbacks are installed
    episode(parts.step, parts.reset, parts.forces, env.unwrapped.np_random, parts.low, parts.high,
    parts.observation,
            parts.where)

What it does is what `env.unwrapped` would do, bit for bit, and it leaves the environment where it
ends. The time limit is a wrapper's, and the loop's to keep. The environment must outlive the calls.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types

from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.compile_cache import njit
from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import f32, f64, floats, i64, internal, on_stack
from codrl_mj.envs.setup import FIRST_OPTION, NEEDS_KEY, ResolvedEnv
from codrl_mj.physics.compiled_task import Compiled, Outcomes, compiled_outcomes
from codrl_mj.physics.rows import Lane, Rows, load, store
from codrl_mj.physics.sharing import make_shared_kernel
from codrl_mj.physics.stepping import OBSERVATION, OPTIONS, Stepping, simulation_at


class VectorStep(NamedTuple):
    """Environment steps of many environments: what each is given, and what it fills."""

    forces: np.ndarray
    """Desired [N or N*m], shape (N,) or (N, motors)."""
    stepping: np.ndarray
    """Rows that earn and may end, shape (N,), bool; the others are about to be reset."""
    observations: np.ndarray
    """Shape (N, k), float32."""
    rewards: np.ndarray
    """Shape (N,)."""
    terminated: np.ndarray
    """Shape (N,), bool."""
    truncated: np.ndarray
    """Shape (N,), bool."""
    elapsed: np.ndarray
    """Steps of the present episodes, shape (N,)."""
    limit: np.ndarray
    """Steps after which an episode is truncated, shape (1,)."""
    options: np.ndarray
    """As `ResolvedEnv.options`."""
    signals: np.ndarray
    """The last row of the trace but for its ends, shape (columns, N, motors)."""


class Kernels(NamedTuple):
    """Compiled functions; `where` is that of `codrl_mj.physics.stepping`."""

    step: Compiled
    """(force, where) -> (reward, terminated, fine): takes one environment step under a desired
    force [N or N*m], or several, an array (n,), and fills the observation. `fine` says whether the
    simulation is still one of numbers; if not, the environment must be reset. What the actuators
    did is in the trace.
    """
    reset: Compiled
    """(generator, low, high, where) -> nothing: starts an episode from a state that the numpy
    `Generator` draws between `low` and `high` (see `Task.bounds`), and fills the observation.
    """
    step_rows: Compiled
    """`step` for every row, by threads that share them; its arguments are (rows, `VectorStep`)."""
    observe_rows: Compiled
    """(which (m,), lane, rows, observations (N, k)) -> nothing: observes rows where episodes start."""


class CompiledEnv(NamedTuple):
    """An environment for compiled loops; see the module's docstring."""

    step: Compiled
    """See `Kernels.step`."""
    reset: Compiled
    """See `Kernels.reset`."""
    where: int
    """The last argument of both."""
    observation: np.ndarray
    """What they fill, shape (k,), float32: live, and the environment's own too."""
    trace: np.ndarray
    """What the actuators did in the last step, shape (motors, columns): live; see `codrl_mj.physics.trace_names`."""
    forces: np.ndarray | None
    """Forces [N or N*m] of the discrete actions; None where the action space is a box."""
    low: np.ndarray
    """Lower bounds of the initial draws, without reset options."""
    high: np.ndarray
    """Upper bounds."""


def compiled_env(env: Any) -> CompiledEnv | None:
    """An environment's compiled parts.

    Returns:
        None where they would not be the whole of it: on physics that are Python, such as the
        analytic one, and where actuator or model are drawn at resets, which is Python too.
    """
    setup, physics = env.setup, env.physics
    if physics.stepping is None or setup.randomization.distributions:
        return None
    kernels, task = compiled_kernels(setup, physics), setup.task
    compiled_function(task.initial_state, task.state_names, "Task.state_names", types.float64[::1])
    low, high = setup.initial_bounds
    parts = kernels.step, kernels.reset, *bound(setup, physics), physics.trace[-1]
    return CompiledEnv(*parts, setup.commands.action_forces, low, high)


def bound(setup: ResolvedEnv, physics: Any) -> tuple[int, np.ndarray]:
    """The address of a simulation whose steps are compiled, and the observation that they fill."""
    _, seen = physics.bound_arrays or (None, np.empty(setup.observation_space.shape or (), np.float32))
    physics.bound_arrays = options, seen = setup.options, seen
    physics.pointer_table[OPTIONS], physics.pointer_table[OBSERVATION] = options.ctypes.data, seen.ctypes.data
    return physics.pointers, seen


def compiled_kernels(setup: ResolvedEnv, physics: Any) -> Kernels:
    """The functions for environments of one kind, whose simulation's steps are compiled; compiled once a process."""
    task = setup.task
    sensors = len(setup.plant.family.OBSERVED) if setup.sensors else 0
    single, size = len(task.motors) == 1, len(task.state_names)
    sizes = size, len(setup.observation_names), len(setup.config.options)
    return _kernels(
        physics.stepping, compiled_outcomes(task), task.initial_state, single, sensors, *sizes
    )


@functools.cache
def _kernels(
    stepping: Stepping,
    outcomes: Outcomes,
    initial_state: Callable[..., Any],
    single: bool,
    sensors: int,
    size: int,
    seen_size: int,
    options_size: int,
) -> Kernels:
    advance, start, read, observed = stepping
    observe, rewarded, ended = outcomes.observe, outcomes.reward, outcomes.terminated
    compiled = njit(nogil=True, error_model="numpy")
    initial_entries = internal(initial_state)

    @internal
    def look(row: np.ndarray, state: np.ndarray, where: int) -> None:
        observation = numba.carray(f32(i64(where)[OBSERVATION]), seen_size)
        read(state, where)
        observe(state, observation)
        if sensors > 0:
            seen = numba.carray(on_stack(len(row) * sensors), (len(row), sensors))
            observed(row, seen, where)
            first = len(observation) - seen.size
            for motor in range(len(row)):
                for entry in range(sensors):
                    observation[first + motor * sensors + entry] = seen[motor, entry]

    @compiled
    def step(force: Any, where: int) -> tuple[float, bool, bool]:
        before, after = numba.carray(on_stack(size), size), numba.carray(on_stack(size), size)
        read(before, where)
        fine = advance(force, where)
        trace = simulation_at(where)[4]
        last = trace[len(trace) - 1]
        look(last, after, where)
        own = numba.carray(f64(i64(where)[OPTIONS] + 8 * FIRST_OPTION), options_size)
        if single:  # decided where it is compiled: one is a number, several are an array
            return rewarded(before, last[0, 1], after, own), ended(after), fine
        return rewarded(before, last[:, 1], after, own), ended(after), fine

    @compiled
    def reset(
        generator: np.random.Generator, low: np.ndarray, high: np.ndarray, where: int
    ) -> None:
        draws, state = np.empty(len(low)), np.empty(size)
        for entry in range(len(low)):
            draws[entry] = low[entry] + (high[entry] - low[entry]) * generator.random()
        entries = floats(initial_entries(draws))
        for entry in range(size):
            state[entry] = entries[entry]
        key = (
            generator.random() * MAX_KEY if f64(i64(where)[OPTIONS])[NEEDS_KEY] != 0.0 else 0.0
        )
        start(state, key, where)
        look(np.zeros(simulation_at(where)[4].shape[1:]), state, where)

    @internal
    def step_some(first: int, end: int, lane: Any, rows: Any, steps: Any) -> int:
        steps, lane, rows, broken = VectorStep(*steps), Lane(*lane), Rows(*rows), 0
        stepping, observations, signals, elapsed = (
            steps.stepping,
            steps.observations,
            steps.signals,
            steps.elapsed,
        )
        where, last = lane.pointer_table.ctypes.data, lane.trace[len(lane.trace) - 1]
        lane.pointer_table[OPTIONS] = steps.options.ctypes.data
        for row in range(first, end):
            load(rows, row, lane)
            lane.pointer_table[OBSERVATION] = observations[row].ctypes.data
            reward, over, fine = step(steps.forces[row], where)
            store(rows, row, lane)
            elapsed[row] += 1
            steps.rewards[row] = reward if stepping[row] else 0.0
            steps.terminated[row] = over and stepping[row]
            steps.truncated[row] = elapsed[row] >= steps.limit[0] and stepping[row]
            broken += not fine
            for motor in range(len(last)):
                for column in range(len(signals)):
                    signals[column, row, motor] = last[motor, 1 + column]
        return broken

    @compiled
    def observe_rows(which: np.ndarray, lane: Any, rows: Any, observations: np.ndarray) -> None:
        lane, rows = Lane(*lane), Rows(*rows)
        nothing, state = np.zeros(lane.trace.shape[1:]), np.empty(size)
        for row in which:
            load(rows, row, lane)
            lane.pointer_table[OBSERVATION] = observations[row].ctypes.data
            look(nothing, state, lane.pointer_table.ctypes.data)

    return Kernels(step, reset, make_shared_kernel(step_some), observe_rows)
