"""Tile coding: a point is represented by the tiles that contain it, one in each displaced grid.

Sutton and Barto, *Reinforcement Learning: An Introduction* (2018), section 9.5.4, with the
displacements of Sutton's tiles3: along axis j (from 0), tiling t is displaced by (2 j + 1) t / n
tiles, where n is the number of tilings. There is no hashing: every tile has a separate index.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.compile_cache import njit

MAX_TILES = 2**24
"""Largest total number of tiles: 128 MiB of weights for every action."""


class TileCoder(NamedTuple):
    """Tile coder with d axes and n tilings, for compiled functions; created by `make_coder`."""

    entries: np.ndarray
    """Observation entry of each axis and -1, or entries of an angle's cosine and sine, (d, 2)."""
    low: np.ndarray
    """Lower end of each axis, shape (d,)."""
    quanta: np.ndarray
    """Number of n-ths of a tile in a unit of each axis, shape (d,)."""
    last: np.ndarray
    """Number of n-ths of a tile from lower to upper end of each axis, shape (d,)."""
    cells: np.ndarray
    """Number of tiles of a tiling along each axis, shape (d,): the intervals, and 1 more unless the
    axis wraps.
    """
    strides: np.ndarray
    """Difference of the indices of neighboring tiles along each axis, shape (d,)."""
    displacements: np.ndarray
    """Displacement of each tiling along each axis [n-ths of a tile], shape (n, d)."""
    shift: int
    """Binary logarithm of the number of tilings, log2(n)."""
    size: int
    """Total number of tiles."""


def make_coder(
    low: Sequence[float],
    high: Sequence[float],
    tilings: int,
    intervals: Sequence[int],
    angles: int = 0,
) -> TileCoder:
    """Create a tile coder.

    The first `angles` axes are angles, each of which is a pair of cosine and sine in the
    observation; these axes wrap, and have no ends. The other axes are the following entries of the
    observation, in order; entries after the last axis are ignored.

    Args:
        low: lower ends of the axes that are not angles.
        high: upper ends of the axes that are not angles.
        tilings: number of tilings n, a power of 2.
        intervals: number of tiles between the ends of each axis.
        angles: number of angles.

    Raises:
        ValueError: a number or a length is out of bounds.
    """
    axes = len(intervals)
    if tilings < 1 or tilings & (tilings - 1):
        raise ValueError(
            f"tilings = {tilings}: must be a power of 2, so that the displacements of the tilings"
            " differ"
        )
    if not 0 <= angles <= axes:
        raise ValueError(f"angles = {angles}: must be from 0 to the number of intervals, {axes}")
    for name, ends in (("low", low), ("high", high)):
        if len(ends) != axes - angles:
            raise ValueError(
                f"{name} = {tuple(ends)}: must have {axes - angles} numbers, one for each interval"
                " except those of angles"
            )
    lower, upper = (
        np.append(np.full(angles, end), ends) for end, ends in ((-math.pi, low), (math.pi, high))
    )
    for axis, (lower_end, upper_end) in enumerate(zip(lower, upper, strict=True)):
        if not (np.isfinite(lower_end) and np.isfinite(upper_end) and lower_end < upper_end):
            raise ValueError(
                f"axis {axis} from {lower_end:g} to {upper_end:g}: must be finite, low < high; if"
                " the observation is not bounded, set low and high"
            )
    counts = np.array(intervals, dtype=np.int64)
    cells = counts + (np.arange(axes) >= angles)
    size = tilings * math.prod(cells.tolist())
    if size > MAX_TILES:
        raise ValueError(
            f"tilings = {tilings}, intervals = {tuple(intervals)}: {size} tiles: must be at most"
            f" {MAX_TILES}; take fewer"
        )
    entries = np.full((axes, 2), -1, dtype=np.int64)
    entries[:angles] = np.arange(2 * angles).reshape(angles, 2)
    entries[angles:, 0] = np.arange(2 * angles, axes + angles)
    strides = np.array(
        [math.prod(cells[axis + 1 :].tolist()) for axis in range(axes)], dtype=np.int64
    )
    return TileCoder(
        entries=entries,
        low=lower,
        quanta=tilings * counts / (upper - lower),
        last=tilings * counts,
        cells=cells,
        strides=strides,
        displacements=np.outer(np.arange(tilings), 2 * np.arange(axes) + 1) % tilings,
        shift=tilings.bit_length() - 1,
        size=size,
    )


@njit(nogil=True, error_model="numpy")
def find_tiles(observation: np.ndarray, coder: TileCoder, tiles: np.ndarray) -> None:
    """Write the indices of the tiles that contain an observation (k,) to `tiles` (n,).

    The index for tiling t is in [t, t + 1) * size / n. Entries beyond the ends of their axis are in
    the outer tiles; NaN counts as the lower end.
    """
    per_tiling = coder.size >> coder.shift
    for tiling in range(len(tiles)):
        tiles[tiling] = tiling * per_tiling
    for axis in range(len(coder.low)):
        first, second = coder.entries[axis]
        position = float(observation[first])
        if second >= 0:
            position = math.atan2(float(observation[second]), position)
        position = (position - coder.low[axis]) * coder.quanta[axis]
        quantum = 0
        if position >= coder.last[axis]:
            quantum = coder.last[axis]
        elif position > 0.0:
            quantum = int(position)
        for tiling in range(len(tiles)):
            cell = (quantum + coder.displacements[tiling, axis]) >> coder.shift
            # On an axis that wraps, the cell after the last one is the first, with the index 0.
            if cell < coder.cells[axis]:
                tiles[tiling] += cell * coder.strides[axis]


@njit(nogil=True, error_model="numpy")
def action_value(weights: np.ndarray, tiles: np.ndarray, action: int) -> float:
    """Return the estimated return of an action: the sum of its weights over the active tiles."""
    value = 0.0
    for tile in tiles:
        value += weights[tile, action]
    return value


@njit(nogil=True, error_model="numpy")
def choose_action(
    weights: np.ndarray, tiles: np.ndarray, epsilon: float, generator: np.random.Generator
) -> int:
    """Choose a random action with probability `epsilon`, otherwise the best action.

    One of equally good actions is chosen at random.
    """
    actions = weights.shape[1]
    if generator.random() < epsilon:
        return int(generator.random() * actions)
    best, best_value, num_best = 0, action_value(weights, tiles, 0), 1
    for action in range(1, actions):
        value = action_value(weights, tiles, action)
        if value > best_value:
            best, best_value, num_best = action, value, 1
        elif value == best_value:
            num_best += 1
            # The k-th of equally good actions replaces the earlier ones with the probability 1/k,
            # so that each is chosen with the same probability.
            if generator.random() * num_best < 1.0:
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
    """Choose actions (N,) for observations (N, k).

    With `deterministic` each is the first of the best actions; otherwise see `choose_action`.
    """
    tiles = np.empty(len(coder.displacements), dtype=np.int64)
    actions = np.empty(len(observations), dtype=np.int64)
    for row in range(len(observations)):
        find_tiles(observations[row], coder, tiles)
        if deterministic:
            actions[row] = 0
            for action in range(1, weights.shape[1]):
                if action_value(weights, tiles, action) > action_value(
                    weights, tiles, actions[row]
                ):
                    actions[row] = action
        else:
            actions[row] = choose_action(weights, tiles, epsilon, generator)
    return actions
