"""Episodic semi-gradient SARSA on tiles, compiled: choosing an action, learning from a step, and whole episodes.

Sutton and Barto, *Reinforcement Learning: An Introduction* (2018), section 10.1; with traces, section 12.7.
"""

from typing import Any, NamedTuple

import numpy as np

from codrl_mj.agents.tile_coding import TileCoder, find_tiles
from codrl_mj.kept import njit

FORGOTTEN = 1e-3
"""Eligibility below which a trace is dropped."""


class Traces(NamedTuple):
    """What the weights that were used lately are answerable for; made by `no_traces`."""

    eligibility: np.ndarray
    """Of every weight, by its flat index; 0 for most."""
    eligible: np.ndarray
    """Flat indices of the weights whose eligibility is not 0, of which only the first `used[0]` are meant."""
    used: np.ndarray
    """Their number, shape (1,)."""


class Learner(NamedTuple):
    """An agent in an episode: what it knows, where it is, and how it learns. Its arrays change.

    Its generator is no part of it: with one in a tuple, numba takes 0.1 ms to find out what a call's arguments are.
    """

    coder: TileCoder
    """Finds tiles."""
    weights: np.ndarray
    """Shape (tiles, actions)."""
    traces: Traces
    """Of the weights."""
    tiles: np.ndarray
    """Indices of the active ones, in which the present observation lies, shape (n,)."""
    step_size: float
    """Of each weight."""
    gamma: float
    """Discount factor."""
    trace_decay: float
    """lambda."""
    epsilon: float
    """Probability of a random action."""


def no_traces(size: int) -> Traces:
    """Empty traces, with room for `size` weights."""
    return Traces(np.zeros(size), np.zeros(size, dtype=np.int64), np.zeros(1, dtype=np.int64))


@njit(nogil=True, error_model="numpy")
def action_value(weights: np.ndarray, tiles: np.ndarray, action: int) -> float:
    """Estimated return of an action: the sum of its weights over the active tiles."""
    value = 0.0
    for tile in tiles:
        value += weights[tile, action]
    return value


@njit(nogil=True, error_model="numpy")
def choose_action(weights: np.ndarray, tiles: np.ndarray, epsilon: float, generator: np.random.Generator) -> int:
    """An action at random with probability `epsilon`, else the best; of equally good ones one at random."""
    actions = weights.shape[1]
    if generator.random() < epsilon:
        return int(generator.random() * actions)
    best, best_value, equals = 0, action_value(weights, tiles, 0), 1
    for action in range(1, actions):
        value = action_value(weights, tiles, action)
        if value > best_value:
            best, best_value, equals = action, value, 1
        elif value == best_value:
            equals += 1
            if generator.random() * equals < 1.0:
                best = action
    return best


@njit(nogil=True, error_model="numpy")
def choose_actions(
    observations: np.ndarray,
    coder: TileCoder,
    weights: np.ndarray,
    deterministic: bool,
    epsilon: float,
    generator: np.random.Generator,
) -> np.ndarray:
    """Actions (N,) for observations (N, k): the best, of equally good ones the first; or as `choose_action` does."""
    tiles = np.empty(len(coder.displacements), dtype=np.int64)
    actions = np.empty(len(observations), dtype=np.int64)
    for row in range(len(observations)):
        find_tiles(observations[row], coder, tiles)
        if deterministic:
            actions[row] = 0
            for action in range(1, weights.shape[1]):
                if action_value(weights, tiles, action) > action_value(weights, tiles, actions[row]):
                    actions[row] = action
        else:
            actions[row] = choose_action(weights, tiles, epsilon, generator)
    return actions


@njit(nogil=True, error_model="numpy")
def begin(learner: Learner, generator: np.random.Generator, observation: np.ndarray) -> int:
    """Begin an episode with its first observation (k,): no traces are left. The first action."""
    traces = learner.traces
    for kept in range(traces.used[0]):  # loops over slices take numba longer to compile
        traces.eligibility[traces.eligible[kept]] = 0.0
    traces.used[0] = 0
    find_tiles(observation, learner.coder, learner.tiles)
    return choose_action(learner.weights, learner.tiles, learner.epsilon, generator)


@njit(nogil=True, error_model="numpy")
def learn(
    learner: Learner,
    generator: np.random.Generator,
    action: int,
    reward: float,
    observation: np.ndarray,
    terminated: bool,
) -> int:
    """Learn from a step that led to an observation (k,), and choose the next action, without meaning at the end.

    The target is r + gamma q(s', a'), also where a time limit cuts the episode off; and r where the task ends it.
    """
    weights, traces, tiles = learner.weights, learner.traces, learner.tiles
    error = reward - action_value(weights, tiles, action)
    next_tiles, next_action = np.empty_like(tiles), 0
    if not terminated:
        find_tiles(observation, learner.coder, next_tiles)
        next_action = choose_action(weights, next_tiles, learner.epsilon, generator)
        error += learner.gamma * action_value(weights, next_tiles, next_action)
    change = learner.step_size * error
    if learner.trace_decay > 0.0:
        _mark(traces, tiles, action, weights.shape[1], learner.gamma * learner.trace_decay)
        for kept in range(traces.used[0]):
            index = traces.eligible[kept]
            weights[index // weights.shape[1], index % weights.shape[1]] += change * traces.eligibility[index]
    else:
        for tile in tiles:
            weights[tile, action] += change
    for tiling in range(len(tiles)):
        tiles[tiling] = next_tiles[tiling]
    return next_action


@njit(nogil=True, error_model="numpy")
def _mark(traces: Traces, tiles: np.ndarray, action: int, actions: int, decay: float) -> None:
    """Fade the traces, drop the faintest, and set those of the weights in use to 1 (replacing traces)."""
    kept = 0
    for position in range(traces.used[0]):
        index = traces.eligible[position]
        faded = traces.eligibility[index] * decay
        if faded < FORGOTTEN:
            traces.eligibility[index] = 0.0
        else:
            traces.eligibility[index] = faded
            traces.eligible[kept] = index
            kept += 1
    for tile in tiles:
        index = tile * actions + action
        if traces.eligibility[index] == 0.0:
            traces.eligible[kept] = index
            kept += 1
        traces.eligibility[index] = 1.0
    traces.used[0] = kept


@njit(nogil=True, error_model="numpy")
def run_episode(
    learner: Learner,
    generator: np.random.Generator,
    step: Any,
    forces: np.ndarray,
    observation: np.ndarray,
    record: np.ndarray,
    arguments: tuple[Any, ...],
) -> tuple[float, int, bool, bool]:
    """Learn from an episode of an environment's compiled `step`, from its first observation (k,), which gets the last.

    `record`, as long as the time limit, gets the trace's last row of each step. Sum of the rewards, steps, whether the
    task ended the episode, and whether the simulation was fine throughout.
    """
    action = begin(learner, generator, observation)
    total, length, terminated = 0.0, 0, False
    while not terminated and length < len(record):
        force = forces[action]
        reward, terminated, fine = step(force, observation, *arguments)
        if not fine:
            return total, length, False, False
        trace = arguments[-1]
        record[length] = trace[-1, 0]
        record[length, 0] = force  # as it was asked for, before anything disturbed it
        total, length = total + reward, length + 1
        seen_reward = float(np.float32(reward))  # what Stable-Baselines3's environments hand out
        action = learn(learner, generator, action, seen_reward, observation, terminated)
    return total, length, terminated, True
