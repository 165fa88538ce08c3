"""Tile coding: a point in space as the tiles that it lies in, one in each of several displaced grids; actions by tiles.

Sutton and Barto, *Reinforcement Learning: An Introduction* (2018), section 9.5.4, with the
displacements of Sutton's tiles3: along axis j (from 0), tiling t is displaced by (2 j + 1) t n-ths
of a tile, where n is the number of tilings. Without hashing: every tile has an index of its own.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.compile_cache import njit

LARGEST_TABLE = 2**24
"""Most tiles in all: 128 MiB of weights for every action."""


class TileCoder(NamedTuple):
    """How observations become tiles, with d axes and n tilings; made by `make_coder`, for compiled functions."""

    entries: np.ndarray
    """Observation entry of each axis, and -1; or the entries of an angle's cosine and sine; shape (d, 2)."""
    low: np.ndarray
    """Lower end of each axis, shape (d,)."""
    quanta: np.ndarray
    """n-ths of a tile in one unit of each axis, shape (d,)."""
    last: np.ndarray
    """n-ths of a tile from lower to upper end of each axis, shape (d,)."""
    cells: np.ndarray
    """Tiles of one tiling along each axis, shape (d,): the intervals, and one more where the axis does not wrap."""
    strides: np.ndarray
    """By how much the tile's index grows from one tile to the next along each axis, shape (d,)."""
    displacements: np.ndarray
    """Displacement of each tiling along each axis [n-ths of a tile], shape (n, d)."""
    shift: int
    """log2(n)."""
    size: int
    """Tiles in all."""


def make_coder(
    low: Sequence[float],
    high: Sequence[float],
    tilings: int,
    intervals: Sequence[int],
    angles: int = 0,
) -> TileCoder:
    """A tile coder, with so many intervals between lower and upper end of every axis, and n tilings, a power of 2.

    The first `angles` axes are angles, each of which the observation has as its cosine and sine;
    these axes wrap, and have no ends to be given. The other axes are the observation's further
    entries in their order; entries beyond the last axis are ignored.
    """
    axes = len(intervals)
    if tilings < 1 or tilings & (tilings - 1):
        raise ValueError(
            f"tilings = {tilings}: must be a power of 2, for the displacements of the tilings to"
            " differ"
        )
    if not 0 <= angles <= axes:
        raise ValueError(f"angles = {angles}: must be from 0 to the number of intervals, {axes}")
    for name, ends in (("low", low), ("high", high)):
        if len(ends) != axes - angles:
            raise ValueError(
                f"{name} = {tuple(ends)}: must have {axes - angles} numbers, one for each interval"
                " but the angles'"
            )
    lower, upper = (
        np.append(np.full(angles, end), ends) for end, ends in ((-math.pi, low), (math.pi, high))
    )
    for axis, (least, most) in enumerate(zip(lower, upper, strict=True)):
        if not (np.isfinite(least) and np.isfinite(most) and least < most):
            raise ValueError(
                f"axis {axis} from {least:g} to {most:g}: must be finite, low < high; where the"
                " observation is not bounded, set low and high"
            )
    counts = np.array(intervals, dtype=np.int64)
    cells = counts + (np.arange(axes) >= angles)
    size = tilings * math.prod(cells.tolist())
    if size > LARGEST_TABLE:
        raise ValueError(
            f"tilings = {tilings}, intervals = {tuple(intervals)}: {size} tiles: must be at most"
            f" {LARGEST_TABLE}; take fewer"
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
    """Find the tiles (n,) of an observation (k,), one of each tiling: that of tiling t is in [t, t + 1) * size / n.

    Entries outside the ends of their axis count as at the nearer end, and so lie in the outer
    tiles; NaN counts as at the lower end.
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
            if cell < coder.cells[axis]:  # beyond is the first tile again, of an axis that wraps
                tiles[tiling] += cell * coder.strides[axis]


@njit(nogil=True, error_model="numpy")
def action_value(weights: np.ndarray, tiles: np.ndarray, action: int) -> float:
    """Estimated return of an action: the sum of its weights over the active tiles."""
    value = 0.0
    for tile in tiles:
        value += weights[tile, action]
    return value


@njit(nogil=True, error_model="numpy")
def choose_action(
    weights: np.ndarray, tiles: np.ndarray, epsilon: float, generator: np.random.Generator
) -> int:
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
                if action_value(weights, tiles, action) > action_value(
                    weights, tiles, actions[row]
                ):
                    actions[row] = action
        else:
            actions[row] = choose_action(weights, tiles, epsilon, generator)
    return actions
