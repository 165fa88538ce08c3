"""Episodic semi-gradient SARSA on tiles, compiled: choosing an action, and learning from a step.

Sutton and Barto, *Reinforcement Learning: An Introduction* (2018), section 10.1; with traces, section 12.7.
"""

from typing import NamedTuple

import numba
import numpy as np

from codrl_mj.agents.tile_coding import TileCoder, find_tiles

FORGOTTEN = 1e-3
"""Eligibility below which a trace is dropped."""


class Rates(NamedTuple):
    """How an agent learns in an episode."""

    step_size: float
    """Of each weight."""
    gamma: float
    """Discount factor."""
    trace_decay: float
    """lambda."""
    epsilon: float
    """Probability of a random action."""


class Traces(NamedTuple):
    """What the weights that were used lately are answerable for; made by `no_traces`."""

    eligibility: np.ndarray
    """Of every weight, by its flat index; 0 for most."""
    eligible: np.ndarray
    """Flat indices of the weights whose eligibility is not 0, of which only the first `used[0]` are meant."""
    used: np.ndarray
    """Their number, shape (1,)."""


def no_traces(size: int) -> Traces:
    """Empty traces, with room for `size` weights."""
    return Traces(np.zeros(size), np.zeros(size, dtype=np.int64), np.zeros(1, dtype=np.int64))


@numba.njit(nogil=True, error_model="numpy")
def action_value(weights: np.ndarray, tiles: np.ndarray, action: int) -> float:
    """Estimated return of an action: the sum of its weights over the active tiles.

    Args:
        weights: shape (tiles, actions).
        tiles: indices of the active ones, shape (n,).
        action: index of the action.
    """
    value = 0.0
    for tile in tiles:
        value += weights[tile, action]
    return value


@numba.njit(nogil=True, error_model="numpy")
def greedy_action(weights: np.ndarray, tiles: np.ndarray) -> int:
    """The best action; of equally good ones the first."""
    best, best_value = 0, action_value(weights, tiles, 0)
    for action in range(1, weights.shape[1]):
        value = action_value(weights, tiles, action)
        if value > best_value:
            best, best_value = action, value
    return best


@numba.njit(nogil=True, error_model="numpy")
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


@numba.njit(nogil=True, error_model="numpy")
def choose_actions(
    observations: np.ndarray,
    coder: TileCoder,
    weights: np.ndarray,
    deterministic: bool,
    epsilon: float,
    generator: np.random.Generator,
) -> np.ndarray:
    """An action for each of some observations, shape (N, k): greedy, or epsilon-greedy; shape (N,), int64."""
    tiles = np.empty(len(coder.displacements), dtype=np.int64)
    actions = np.empty(len(observations), dtype=np.int64)
    for row in range(len(observations)):
        find_tiles(observations[row], coder, tiles)
        if deterministic:
            actions[row] = greedy_action(weights, tiles)
        else:
            actions[row] = choose_action(weights, tiles, epsilon, generator)
    return actions


@numba.njit(nogil=True, error_model="numpy")
def begin(
    coder: TileCoder,
    weights: np.ndarray,
    traces: Traces,
    rates: Rates,
    generator: np.random.Generator,
    tiles: np.ndarray,
    observation: np.ndarray,
) -> int:
    """Begin an episode.

    Args:
        coder: finds tiles.
        weights: shape (tiles, actions).
        traces: are emptied.
        rates: how to learn.
        generator: draws.
        tiles: gets the active tiles, shape (n,).
        observation: the first, shape (k,).

    Returns:
        The first action.
    """
    for kept in range(traces.used[0]):  # loops over slices take numba longer to compile
        traces.eligibility[traces.eligible[kept]] = 0.0
    traces.used[0] = 0
    find_tiles(observation, coder, tiles)
    return choose_action(weights, tiles, rates.epsilon, generator)


@numba.njit(nogil=True, error_model="numpy")
def learn(
    coder: TileCoder,
    weights: np.ndarray,
    traces: Traces,
    rates: Rates,
    generator: np.random.Generator,
    tiles: np.ndarray,
    action: int,
    reward: float,
    observation: np.ndarray,
    terminated: bool,
) -> int:
    """Learn from a step, and choose the next action.

    The target is r + gamma q(s', a'), also where a time limit cuts the episode off; and r where the task ends it.

    Args:
        coder: finds tiles.
        weights: shape (tiles, actions); changed.
        traces: changed.
        rates: how to learn.
        generator: draws.
        tiles: tiles of the observation before the step, shape (n,); gets those after it, where the episode goes on.
        action: what was done.
        reward: what was earned.
        observation: what was seen after it, shape (k,).
        terminated: whether the task ended the episode.

    Returns:
        The next action; without meaning if the task ended the episode.
    """
    error = reward - action_value(weights, tiles, action)
    next_tiles, next_action = np.empty_like(tiles), 0
    if not terminated:
        find_tiles(observation, coder, next_tiles)
        next_action = choose_action(weights, next_tiles, rates.epsilon, generator)
        error += rates.gamma * action_value(weights, next_tiles, next_action)
    change = rates.step_size * error
    if rates.trace_decay > 0.0:
        _mark(weights.shape[1], traces, tiles, action, rates.gamma * rates.trace_decay)
        for kept in range(traces.used[0]):
            index = traces.eligible[kept]
            weights[index // weights.shape[1], index % weights.shape[1]] += change * traces.eligibility[index]
    else:
        for tile in tiles:
            weights[tile, action] += change
    for tiling in range(len(tiles)):
        tiles[tiling] = next_tiles[tiling]
    return next_action


@numba.njit(nogil=True, error_model="numpy")
def _mark(actions: int, traces: Traces, tiles: np.ndarray, action: int, decay: float) -> None:
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
