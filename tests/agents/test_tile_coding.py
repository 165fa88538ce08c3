"""Tiles against their exact geometry, and against the displacements of Sutton's tiles3."""

import itertools
import math
import operator
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.agents.tile_coding import find_tiles, make_coder
from codrl_mj.tasks import find_task

SPACE = find_task("mountain_car").observation_space
PAPER = make_coder(SPACE.low, SPACE.high, 8, (8, 8))
INTERVALS = (3, 5, 2)
COUNTS = tuple(count + 1 for count in INTERVALS)
# Tiles have the width 1, so that nothing is rounded.
EXACT = make_coder((0, 0, 0), INTERVALS, 16, INTERVALS)


def _tiles(coder, observation, dtype=np.float64):
    tiles = np.full(len(coder.displacements), -1)
    find_tiles(np.array(observation, dtype), coder, tiles)
    return tiles.tolist()


@given(st.tuples(*(st.floats(0, count) for count in INTERVALS)))
def test_a_point_lies_in_one_tile_of_each_displaced_grid(point):
    expected = []
    for tiling in range(16):
        displacements = (Fraction((2 * axis + 1) * tiling % 16, 16) for axis in range(3))
        cells = [
            math.floor(Fraction(x) + shift) for x, shift in zip(point, displacements, strict=True)
        ]
        expected.append(np.ravel_multi_index((tiling, *cells), (16, *COUNTS)))
    assert _tiles(EXACT, point) == expected


def test_the_papers_table_has_1944_weights_and_every_one_is_used():
    """The ninth tiles of the first grid contain only the upper bounds."""
    eighths = [*((np.arange(64) + 0.5) / 64), 2.0]
    used = set()
    for point in itertools.product(eighths, eighths):
        used.update(_tiles(PAPER, SPACE.low + np.array(point) * (SPACE.high - SPACE.low)))
    assert used == set(range(PAPER.size))
    assert PAPER.size * 3 == 1944


def test_two_states_share_a_tile_exactly_if_they_do_in_suttons_tiles3():
    """In tiles3 coordinate j of tiling t is (floor(n x) + t (1 + 2 j)) // n, for x in tiles."""
    generator = np.random.default_rng(0)
    ours, theirs = {}, {}
    for point in generator.uniform(0, 1, (2000, 2)):
        quanta = np.floor(point * 64).astype(int)
        for tiling, tile in enumerate(
            _tiles(PAPER, SPACE.low + (SPACE.high - SPACE.low).astype(float) * point)
        ):
            coordinates = tiling, *((quanta + tiling * np.array([1, 3])) // 8).tolist()
            assert ours.setdefault(tile, coordinates) == coordinates
            assert theirs.setdefault(coordinates, tile) == tile
    assert len(ours) > 8 * 64


@given(
    st.floats(allow_nan=True, allow_infinity=True), st.floats(allow_nan=True, allow_infinity=True)
)
def test_points_outside_lie_in_the_outer_tiles_and_nan_at_the_lower_end(position, velocity):
    inside = [
        low if math.isnan(entry) else min(max(entry, low), high)
        for entry, low, high in zip(
            (position, velocity), SPACE.low.tolist(), SPACE.high.tolist(), strict=True
        )
    ]
    assert _tiles(PAPER, (position, velocity)) == _tiles(PAPER, inside)


def test_float32_observations_have_the_tiles_of_their_float64_values():
    for point in (
        np.random.default_rng(1).uniform(SPACE.low, SPACE.high, (100, 2)).astype(np.float32)
    ):
        assert _tiles(PAPER, point, np.float32) == _tiles(PAPER, point.astype(np.float64))


def _cos_sin(angle):
    return math.cos(angle), math.sin(angle)


@given(st.floats(-math.pi, math.pi))
def test_an_angle_has_the_tiles_of_its_value(angle):
    wrapping = make_coder((), (), 8, (4,), angles=1)
    plain = make_coder((-math.pi,), (math.pi,), 8, (4,))
    # The coder computes the angle from its sine and cosine, with the same rounding.
    angle = math.atan2(math.sin(angle), math.cos(angle))
    # With an angle the fifth tile is the first.
    expected = [tile % 5 % 4 + tile // 5 * 4 for tile in _tiles(plain, [angle])]
    assert _tiles(wrapping, _cos_sin(angle)) == expected


def test_angles_have_no_seam():
    coder, step = make_coder((-1,), (1,), 8, (4, 2), angles=1), 2 * math.pi / 32
    assert coder.size == 8 * 4 * 3
    for index in range(64):
        tiles, next_tiles = (
            _tiles(coder, (*_cos_sin((index + half) * step), 0.0)) for half in (0.5, 1.5)
        )
        assert sum(map(operator.eq, tiles, next_tiles)) == 7


def test_entries_after_the_last_axis_are_ignored():
    assert _tiles(PAPER, (0.1, 0.02, 5.0, -7.0)) == _tiles(PAPER, (0.1, 0.02))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0,), (1,), 6, (4,)), "tilings = 6: must be a power of 2"),
        (((0,), (1,), 0, (4,)), "tilings = 0: must be a power of 2"),
        (((1,), (1,), 8, (4,)), "axis 0 from 1 to 1: must be finite, low < high"),
        (((0,), (np.inf,), 8, (4,)), "axis 0 from 0 to inf: must be finite"),
        (((0,), (1, 2), 8, (4,)), r"high = \(1, 2\): must have 1 numbers"),
        (((0,), (1,), 8, (4,), 2), "angles = 2: must be from 0 to the number of intervals, 1"),
        (((0,) * 8, (1,) * 8, 32, (9,) * 8), "must be at most 16777216; take fewer"),
    ],
)
def test_invalid_tilings_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_coder(*arguments)
