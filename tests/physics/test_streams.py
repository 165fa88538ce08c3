"""Streams draw, seed and save as NumPy's generators do one by one."""

import numpy as np
import pytest
from gymnasium.utils import seeding

from codrl_mj.physics.streams import WORDS, Streams

SIZE = 5


def _seeded(seeds=range(SIZE)):
    """Streams with seeds, and the same generators one by one."""
    streams = Streams(SIZE)
    streams.seed(np.arange(SIZE), list(seeds))
    return streams, [seeding.np_random(seed)[0] for seed in seeds]


def _one_by_one(generators, rows, count):
    return np.array([generators[row].random(count) for row in rows])


def _words(generator):
    """A generator's state as two 128-bit integers and its spare half."""
    pcg = generator.bit_generator.state
    return pcg["state"]["state"], pcg["state"]["inc"], pcg["has_uint32"], pcg["uinteger"]


def test_draws_are_numpys_one_by_one_from_any_rows_in_any_order():
    streams, generators = _seeded()
    for rows, count in (([0, 1, 2, 3, 4], 3), ([2], 1), ([4, 1], 7), ([0], 0), ([], 3), ([3, 0, 4], 2)):
        drawn = streams.random(np.array(rows, dtype=np.int64), count)
        assert drawn.shape == (len(rows), count)
        expected = _one_by_one(generators, rows, count) if rows else drawn
        np.testing.assert_array_equal(drawn, expected)
    for stream, generator in zip(streams.generators, generators, strict=True):
        assert _words(stream) == _words(generator)


def test_draws_through_the_generators_and_through_the_streams_are_one_sequence():
    streams, generators = _seeded()
    np.testing.assert_array_equal(streams.generators[2].normal(size=4), generators[2].normal(size=4))
    np.testing.assert_array_equal(streams.random(np.array([2]), 3)[0], generators[2].random(3))
    assert streams.generators[2].integers(10) == generators[2].integers(10)
    np.testing.assert_array_equal(streams.random(np.array([2]), 3)[0], generators[2].random(3))


def test_seeding_some_streams_leaves_the_others():
    streams, generators = _seeded()
    streams.random(np.arange(SIZE), 2)
    _one_by_one(generators, range(SIZE), 2)
    streams.seed(np.array([3, 0]), [77, None])
    generators[3] = seeding.np_random(77)[0]
    np.testing.assert_array_equal(streams.random(np.arange(SIZE), 2), _one_by_one(generators, range(SIZE), 2))


def test_a_seed_for_each_row_or_none_at_all():
    with pytest.raises(ValueError, match="zip"):
        Streams(2).seed(np.arange(2), [1])


def test_unseeded_streams_differ_from_each_other():
    drawn = Streams(SIZE).random(np.arange(SIZE), 1)
    assert len(np.unique(drawn)) == SIZE


def test_the_state_is_numpys_and_restores_every_draw_spare_half_included():
    streams, _ = _seeded()
    streams.generators[1].integers(10, dtype=np.int32)  # leaves half of a 64-bit draw for the next
    state = streams.state()
    assert state.shape == (SIZE, WORDS)
    assert state.dtype == np.uint64
    for row, generator in zip(state.tolist(), streams.generators, strict=True):
        words = _words(generator)
        assert (row[0] << 64 | row[1], row[2] << 64 | row[3], row[4], row[5]) == words
    assert state[1, 4] == 1
    assert state[0, 4] == 0
    kept = state.copy()
    halves = [generator.integers(1000, size=3, dtype=np.int32) for generator in streams.generators]
    drawn = streams.random(np.arange(SIZE), 4)
    np.testing.assert_array_equal(state, kept)  # a copy
    other = Streams(SIZE)
    other.set_state(state)
    np.testing.assert_array_equal(other.state(), state)
    again = [generator.integers(1000, size=3, dtype=np.int32) for generator in other.generators]
    np.testing.assert_array_equal(again, halves)
    np.testing.assert_array_equal(other.random(np.arange(SIZE), 4), drawn)
