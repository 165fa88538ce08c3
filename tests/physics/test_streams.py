"""Streams against single NumPy generators: draws and states."""

import numpy as np
from gymnasium.utils import seeding

from codrl_mj.physics.streams import WORDS, Streams

SIZE = 5


def _seeded():
    """Return seeded streams, and the same generators separately."""
    streams = Streams(SIZE)
    streams.seed(np.arange(SIZE), list(range(SIZE)))
    return streams, [seeding.np_random(seed)[0] for seed in range(SIZE)]


def test_draws_equal_those_of_single_generators():
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


def test_unseeded_streams_differ():
    assert len(np.unique(Streams(SIZE).random(np.arange(SIZE), 1))) == SIZE


def test_the_state_restores_every_draw_including_the_spare_half():
    streams, _ = _seeded()
    # This leaves half of a 64-bit draw for the next one.
    streams.generators[1].integers(10, dtype=np.int32)
    state = streams.state()
    assert (state.shape, state.dtype) == ((SIZE, WORDS), np.uint64)
    for row, generator in zip(state.tolist(), streams.generators, strict=True):
        pcg = generator.bit_generator.state
        assert row[0] << 64 | row[1] == pcg["state"]["state"]
        assert row[2] << 64 | row[3] == pcg["state"]["inc"]
        assert row[4:] == [pcg["has_uint32"], pcg["uinteger"]]
    assert (state[0, 4], state[1, 4]) == (0, 1)
    copy_of_state, second = state.copy(), Streams(SIZE)
    second.set_state(state)
    for _ in range(3):
        for stream, restored in zip(streams.generators, second.generators, strict=True):
            assert stream.integers(1000, dtype=np.int32) == restored.integers(1000, dtype=np.int32)
    np.testing.assert_array_equal(
        streams.random(np.arange(SIZE), 4), second.random(np.arange(SIZE), 4)
    )
    # The state is a copy.
    np.testing.assert_array_equal(state, copy_of_state)
