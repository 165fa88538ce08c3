"""A whole environment as compiled functions: one step, one reset, for loops that numba compiles.

`ActuatedEnv.step` is one call of `step`; an agent's own compiled loop may call the two directly:

    parts = compiled_env(env.unwrapped)  # None where this cannot be

    @numba.njit(nogil=True)
    def episode(step, reset, forces, generator, low, high, observation, arguments):
        reset(generator, low, high, observation, *arguments)
        total, ended = 0.0, False
        while not ended:
            action = ...  # from observation
            outcome = step(forces[action], observation, *arguments)
            total, ended = total + outcome[0], outcome[1] or not outcome[2]
        return total

    env.reset(seed=0)  # seeds the generator, and makes sure that our callbacks are installed
    observation = np.empty(env.observation_space.shape, np.float32)
    episode(parts.step, parts.reset, parts.forces, env.unwrapped.np_random, parts.low, parts.high, observation,
            parts.arguments)

What it does is what `env.unwrapped` would do, bit for bit, and it leaves the environment where it ends. The time limit
is a wrapper's, and the loop's to keep. The environment must outlive the calls.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

from codrl_mj.envs.outcomes import Outcomes, compiled_outcomes
from codrl_mj.envs.setup import Setup
from codrl_mj.motor.noise import LARGEST_KEY
from codrl_mj.physics import MujocoPhysics
from codrl_mj.physics.constrain import Compiled
from codrl_mj.physics.stepping import Stepping

INTERFACE_NAMES = ("observes_actuator", "commands_voltage", "is_random")
"""What the vector `interface` begins with: whether the observation ends with measured and reference current, whether
the agent commands the voltage, and whether an episode's disturbances need a key. The task's options follow."""
OBSERVES, VOLTAGE, RANDOM = range(len(INTERFACE_NAMES))
OPTIONS = len(INTERFACE_NAMES)


class Kernels(NamedTuple):
    """Compiled functions; `arguments` are (interface, *those of `codrl_mj.physics.stepping`)."""

    step: Compiled
    """(force, observation (k,) float32, *arguments) -> (reward, terminated, fine, *signals): takes one environment step
    under a desired force [N or N*m] and fills the observation. `fine` says whether the simulation is still one of
    numbers; if not, the environment must be reset. The signals are in the order of `codrl_mj.physics.Signals`."""
    reset: Compiled
    """(generator, low, high, observation, *arguments) -> nothing: starts an episode from a state that the numpy
    `Generator` draws between `low` and `high` (see `Task.initial_bounds`), and fills the observation."""


class CompiledEnv(NamedTuple):
    """An environment for compiled loops; see the module's docstring."""

    step: Compiled
    """See `Kernels.step`."""
    reset: Compiled
    """See `Kernels.reset`."""
    arguments: tuple[Any, ...]
    """The last arguments of both."""
    forces: np.ndarray | None
    """Forces [N or N*m] of the discrete actions; None where the action space is a box."""
    low: np.ndarray
    """Lower bounds of the initial draws, without reset options."""
    high: np.ndarray
    """Upper bounds."""


def compiled_env(env: Any) -> CompiledEnv | None:
    """An environment's compiled parts.

    Args:
        env: an `ActuatedEnv` (`env.unwrapped` of what `gymnasium.make` returns).

    Returns:
        None where they would not be the whole of it: on analytic physics, which are Python, and where actuator or model
        are drawn at resets, which is Python too.
    """
    setup, physics = env.setup, env.physics
    if not isinstance(physics, MujocoPhysics) or setup.randomization is not None:
        return None
    kernels = compiled_kernels(setup, physics)
    low, high = setup.task.initial_bounds(None)
    return CompiledEnv(kernels.step, kernels.reset, arguments(setup, physics), setup.action_forces, low, high)


def arguments(setup: Setup, physics: MujocoPhysics) -> tuple[Any, ...]:
    """The last arguments of an environment's kernels.

    Args:
        setup: the environment's.
        physics: its simulation.
    """
    kind = setup.observe_actuator, setup.command == "voltage", setup.disturbances.random
    return (np.array([*kind, *setup.options], dtype=np.float64), *physics.arguments)


def compiled_kernels(setup: Setup, physics: MujocoPhysics) -> Kernels:
    """The functions for environments of one kind; compiled as they are used, once a process.

    Args:
        setup: the environment's.
        physics: its simulation.
    """
    task = setup.task
    return _kernels(physics.stepping, compiled_outcomes(task), task.initial_state, len(task.state_names))


@functools.cache
def _kernels(stepping: Stepping, outcomes: Outcomes, initial_state: Callable[..., Any], size: int) -> Kernels:
    advance, start, read, sensed = stepping
    observe, rewarded, ended = outcomes.observe, outcomes.reward, outcomes.terminated
    compiled = numba.njit(nogil=True, error_model="numpy")
    initial_entries = compiled(initial_state)

    @compiled
    def observe_currents(observation: np.ndarray, measured: float, reference: float, interface: np.ndarray) -> None:
        observation[-2] = measured
        observation[-1] = measured if interface[VOLTAGE] != 0.0 else reference  # as `Setup.signals` has it

    @compiled
    def step(
        force: float,
        observation: np.ndarray,
        interface: np.ndarray,
        model: int,
        data: int,
        settings: np.ndarray,
        memory: np.ndarray,
        trace: np.ndarray,
    ) -> tuple[float, bool, bool, float, float, float, float, float, bool]:
        before, after = np.empty(size), np.empty(size)
        read(before, model, data, settings, memory, trace)
        fine, desired, actual, current, reference, voltage, saturated = advance(
            force, model, data, settings, memory, trace
        )
        read(after, model, data, settings, memory, trace)
        observe(after, observation)
        if interface[OBSERVES] != 0.0:
            measured = sensed(current, model, data, settings, memory, trace)
            observe_currents(observation, measured, reference, interface)
        if interface[VOLTAGE] != 0.0:
            desired, reference = actual, current
        reward = rewarded(before, actual, after, interface[OPTIONS:])
        return reward, ended(after), fine, desired, actual, current, reference, voltage, saturated

    @compiled
    def reset(
        generator: np.random.Generator,
        low: np.ndarray,
        high: np.ndarray,
        observation: np.ndarray,
        interface: np.ndarray,
        model: int,
        data: int,
        settings: np.ndarray,
        memory: np.ndarray,
        trace: np.ndarray,
    ) -> None:
        draws, state = np.empty(len(low)), np.empty(size)
        for entry in range(len(low)):
            draws[entry] = low[entry] + (high[entry] - low[entry]) * generator.random()
        entries = initial_entries(draws)
        for entry in range(size):
            state[entry] = entries[entry]
        key = generator.random() * LARGEST_KEY if interface[RANDOM] != 0.0 else 0.0
        start(state, key, model, data, settings, memory, trace)
        observe(state, observation)
        if interface[OBSERVES] != 0.0:
            observe_currents(observation, sensed(0.0, model, data, settings, memory, trace), 0.0, interface)

    return Kernels(step, reset)
