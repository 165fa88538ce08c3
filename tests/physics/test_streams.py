"""Streams draw and save as NumPy's generators do one by one; how environments use them, the faces' tests see."""

import numpy as np
from gymnasium.utils import seeding

from codrl_mj.physics.streams import WORDS, Streams

SIZE = 5


def _seeded():
    """Streams with seeds, and the same generators one by one."""
    streams = Streams(SIZE)
    streams.seed(np.arange(SIZE), list(range(SIZE)))
    return streams, [seeding.np_random(seed)[0] for seed in range(SIZE)]


def test_draws_are_numpys_one_by_one_from_any_rows_in_any_order_and_between_the_users_own():
    streams, generators = _seeded()
    for rows, count in (
        ([0, 1, 2, 3, 4], 3),
        ([2], 1),
        ([4, 1], 7),
        ([0], 0),
        ([], 3),
        ([3, 0, 4], 2),
    ):
        drawn = streams.random(np.array(rows, dtype=np.int64), count)
        assert drawn.shape == (len(rows), count)
        for values, row in zip(drawn, rows, strict=True):
            np.testing.assert_array_equal(values, generators[row].random(count))
        for stream, generator in zip(streams.generators, generators, strict=True):
            assert stream.integers(1000) == generator.integers(1000)
            np.testing.assert_array_equal(stream.normal(size=4), generator.normal(size=4))


def test_unseeded_streams_differ_from_each_other():
    assert len(np.unique(Streams(SIZE).random(np.arange(SIZE), 1))) == SIZE


def test_the_state_is_numpys_and_restores_every_draw_spare_half_included():
    streams, _ = _seeded()
    streams.generators[1].integers(10, dtype=np.int32)  # leaves half of a 64-bit draw for the next
    state = streams.state()
    assert (state.shape, state.dtype) == ((SIZE, WORDS), np.uint64)
    for row, generator in zip(state.tolist(), streams.generators, strict=True):
        pcg = generator.bit_generator.state
        assert row[0] << 64 | row[1] == pcg["state"]["state"]
        assert row[2] << 64 | row[3] == pcg["state"]["inc"]
        assert row[4:] == [pcg["has_uint32"], pcg["uinteger"]]
    assert (state[0, 4], state[1, 4]) == (0, 1)
    kept, other = state.copy(), Streams(SIZE)
    other.set_state(state)
    for _ in range(3):
        for stream, again in zip(streams.generators, other.generators, strict=True):
            assert stream.integers(1000, dtype=np.int32) == again.integers(1000, dtype=np.int32)
    np.testing.assert_array_equal(
        streams.random(np.arange(SIZE), 4), other.random(np.arange(SIZE), 4)
    )
    np.testing.assert_array_equal(state, kept)  # a copy
