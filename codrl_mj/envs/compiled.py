"""An environment's step and reset as compiled functions, for loops that numba compiles.

`ActuatedEnv.step` is one call of `step`; a compiled loop of an agent may call both directly:

    parts = compiled_env(env.unwrapped)  # None if the environment cannot be compiled

    @njit(nogil=True)
    def episode(step, reset, forces, generator, low, high, observation, pointers):
        reset(generator, low, high, pointers)
        total, ended = 0.0, False
        while not ended:
            action = ...  # from observation
            outcome = step(forces[action], pointers)
            total, ended = total + outcome[0], outcome[1] or not outcome[2]
        return total

    env.reset(seed=0)  # seeds the generator, and installs the package's callbacks
    episode(parts.step, parts.reset, parts.forces, env.unwrapped.np_random, parts.low, parts.high,
            parts.observation, parts.pointers)

The loop computes the same as `env.unwrapped` would, bit for bit, and leaves the environment in its
last state. The loop must apply the time limit itself, because Gymnasium applies it in a wrapper.
The environment must not be deleted during the calls.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numba
import numpy as np
from numba import types

from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.compile_cache import njit
from codrl_mj.engine.families import compiled_function
from codrl_mj.engine.memory import f32, f64, i64, internal, stack_floats, to_floats
from codrl_mj.envs.setup import FIRST_OPTION, NEEDS_KEY, ResolvedEnv
from codrl_mj.physics.base import Compiled, Force, NumbaTuple, Physics, Stepping
from codrl_mj.physics.compiled_task import Outcomes, compiled_outcomes
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics
from codrl_mj.physics.rows import BatchRows, Lane, load, store
from codrl_mj.physics.sharing import make_shared_kernel
from codrl_mj.physics.stepping import OBSERVATION, OPTIONS, simulation_at


class VectorStep(NamedTuple):
    """Inputs and outputs of one environment step of many environments."""

    forces: np.ndarray
    """Desired forces [N or N*m], shape (N,) or (N, motors)."""
    stepping: np.ndarray
    """True for environments that step, shape (N,), bool; the others are reset instead."""
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
    """Last row of the trace without force and speed, shape (columns, N, motors)."""


CompiledStep = Callable[[Force, int], tuple[float, bool, bool]]
CompiledReset = Callable[[np.random.Generator, np.ndarray, np.ndarray, int], None]


class Kernels(NamedTuple):
    """Compiled functions, from `_kernels`; `codrl_mj.physics.stepping` explains `pointers`."""

    step: CompiledStep
    """(force, pointers) -> (reward, terminated, is_finite): one environment step.

    The force [N or N*m] is the desired one; an array (n,) for several motors. The observation is
    filled. If `is_finite` is False, the simulation diverged and the environment must be reset. The
    actuators' signals are in the trace.
    """
    reset: CompiledReset
    """(generator, low, high, pointers) -> None: start an episode.

    The initial state is drawn by the numpy `Generator` between `low` and `high` (see
    `Task.bounds`); the observation is filled.
    """
    step_rows: Compiled
    """`step` for all rows, by several threads; the arguments are (rows, `VectorStep`)."""
    observe_rows: Compiled
    """(indices (m,), lane, rows, observations (N, k)) -> None: observe rows after a reset."""


class CompiledEnv(NamedTuple):
    """An environment for compiled loops; see the docstring of the module."""

    step: CompiledStep
    """See `Kernels.step`."""
    reset: CompiledReset
    """See `Kernels.reset`."""
    pointers: int
    """Address of the simulation's table of pointers: the last argument of both functions."""
    observation: np.ndarray
    """Observation, shape (k,), float32, that both functions fill; the environment's own array."""
    trace: np.ndarray
    """Actuators' signals of the last step, live, shape (motors, columns); see `trace_names`."""
    forces: np.ndarray | None
    """Forces [N or N*m] of the discrete actions; None for a box action space."""
    low: np.ndarray
    """Lower bounds of the initial draws, without reset options, shape (n,)."""
    high: np.ndarray
    """Upper bounds of the initial draws, without reset options, shape (n,)."""


class HasSetup(Protocol):
    """Environment of a task, such as `ActuatedEnv`."""

    physics: Physics

    @property
    def setup(self) -> ResolvedEnv:
        """Everything that follows from the configuration."""


def compiled_env(env: HasSetup) -> CompiledEnv | None:
    """Return an environment's compiled parts.

    Returns:
        The parts; None if the environment runs Python code, which is the case for a physics without
        compiled steps, such as the analytic one, and with randomization at resets.
    """
    setup, physics = env.setup, env.physics
    if physics.stepping is None or setup.randomization.distributions:
        return None
    kernels, task = compiled_kernels(setup, physics), setup.task
    # This raises a readable error if numba cannot compile the task's function.
    compiled_function(task.initial_state, task.state_names, "Task.state_names", types.float64[::1])
    low, high = setup.initial_bounds
    parts = kernels.step, kernels.reset, *bind_observation(setup, physics), physics.trace[-1]
    return CompiledEnv(*parts, setup.commands.action_forces, low, high)


def bind_observation(setup: ResolvedEnv, physics: Physics) -> tuple[int, np.ndarray]:
    """Connect a simulation to its observation array; return the table's address and the array."""
    _, observation = physics.bound_arrays or (
        None,
        np.empty(setup.observation_space.shape or (), np.float32),
    )
    # Both arrays must stay alive as long as compiled code may use their addresses, so the physics
    # holds references to them.
    physics.bound_arrays = options, observation = setup.options, observation
    physics.pointer_table[OPTIONS], physics.pointer_table[OBSERVATION] = (
        options.ctypes.data,
        observation.ctypes.data,
    )
    return physics.pointers, observation


def compiled_kernels(setup: ResolvedEnv, physics: Physics | MujocoBatchPhysics) -> Kernels:
    """Return the functions for environments of one kind; they are compiled once per process."""
    task = setup.task
    assert physics.stepping is not None
    sensors = len(setup.simulation.family.OBSERVED) if setup.sensors else 0
    has_single_motor, size = len(task.motors) == 1, len(task.state_names)
    sizes = size, len(setup.observation_names), len(setup.config.options)
    return _kernels(
        physics.stepping,
        compiled_outcomes(task),
        task.initial_state,
        has_single_motor,
        sensors,
        *sizes,
    )


@functools.cache
def _kernels(
    stepping: Stepping,
    outcomes: Outcomes,
    initial_state: Compiled,
    has_single_motor: bool,
    sensors: int,
    size: int,
    observation_size: int,
    options_size: int,
) -> Kernels:
    simulate, start, read, read_sensors = stepping
    observe, reward_of, is_terminated = outcomes.observe, outcomes.reward, outcomes.terminated
    jit = njit(nogil=True, error_model="numpy")
    initial_entries = internal(initial_state)

    @internal
    def observe_row(row: np.ndarray, state: np.ndarray, pointers: int) -> None:
        observation = numba.carray(f32(i64(pointers)[OBSERVATION]), observation_size)
        read(state, pointers)
        observe(state, observation)
        if sensors > 0:
            sensor_values = numba.carray(stack_floats(len(row) * sensors), (len(row), sensors))
            read_sensors(row, sensor_values, pointers)
            first = len(observation) - sensor_values.size
            for motor in range(len(row)):
                for entry in range(sensors):
                    observation[first + motor * sensors + entry] = sensor_values[motor, entry]

    @jit
    def step(force: Force, pointers: int) -> tuple[float, bool, bool]:
        before, after = (
            numba.carray(stack_floats(size), size),
            numba.carray(stack_floats(size), size),
        )
        read(before, pointers)
        is_finite = simulate(force, pointers)
        trace = simulation_at(pointers)[4]
        last = trace[len(trace) - 1]
        observe_row(last, after, pointers)
        options = numba.carray(f64(i64(pointers)[OPTIONS] + 8 * FIRST_OPTION), options_size)
        # The condition is constant at compilation: one motor's force is a number, several are an
        # array.
        if has_single_motor:
            return reward_of(before, last[0, 1], after, options), is_terminated(after), is_finite
        return reward_of(before, last[:, 1], after, options), is_terminated(after), is_finite

    @jit
    def reset(
        generator: np.random.Generator, low: np.ndarray, high: np.ndarray, pointers: int
    ) -> None:
        draws, state = np.empty(len(low)), np.empty(size)
        for entry in range(len(low)):
            draws[entry] = low[entry] + (high[entry] - low[entry]) * generator.random()
        entries = to_floats(initial_entries(draws))
        for entry in range(size):
            state[entry] = entries[entry]
        # The key is drawn only if it is needed. Each draw advances the generator, and Gymnasium's
        # environment draws no key: later episodes would start in other states than its episodes.
        key = generator.random() * MAX_KEY if f64(i64(pointers)[OPTIONS])[NEEDS_KEY] != 0.0 else 0.0
        start(state, key, pointers)
        observe_row(np.zeros(simulation_at(pointers)[4].shape[1:]), state, pointers)

    @internal
    def step_range(
        first: int, end: int, lane: NumbaTuple, rows: NumbaTuple, steps: NumbaTuple
    ) -> int:
        # The batch passes plain tuples; they become named tuples again to be readable.
        steps, lane, rows, num_diverged = VectorStep(*steps), Lane(*lane), BatchRows(*rows), 0
        stepping, observations, signals, elapsed = (
            steps.stepping,
            steps.observations,
            steps.signals,
            steps.elapsed,
        )
        pointers, last = lane.pointer_table.ctypes.data, lane.trace[len(lane.trace) - 1]
        lane.pointer_table[OPTIONS] = steps.options.ctypes.data
        for row in range(first, end):
            load(rows, row, lane)
            lane.pointer_table[OBSERVATION] = observations[row].ctypes.data
            reward, terminated, is_finite = step(steps.forces[row], pointers)
            store(rows, row, lane)
            elapsed[row] += 1
            steps.rewards[row] = reward if stepping[row] else 0.0
            steps.terminated[row] = terminated and stepping[row]
            steps.truncated[row] = elapsed[row] >= steps.limit[0] and stepping[row]
            num_diverged += not is_finite
            for motor in range(len(last)):
                for column in range(len(signals)):
                    signals[column, row, motor] = last[motor, 1 + column]
        return num_diverged

    @jit
    def observe_rows(
        indices: np.ndarray, lane: NumbaTuple, rows: NumbaTuple, observations: np.ndarray
    ) -> None:
        lane, rows = Lane(*lane), BatchRows(*rows)
        no_signals, state = np.zeros(lane.trace.shape[1:]), np.empty(size)
        for row in indices:
            load(rows, row, lane)
            lane.pointer_table[OBSERVATION] = observations[row].ctypes.data
            observe_row(no_signals, state, lane.pointer_table.ctypes.data)

    return Kernels(step, reset, make_shared_kernel(step_range), observe_rows)
