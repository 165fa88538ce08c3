"""Sharing of rows among threads: each row is processed once per turn, even if threads sleep."""

import os
import subprocess
import sys
import time

import numba
import numpy as np
import pytest

from codrl_mj.physics.sharing import (
    _WORKERS,
    cache_aligned_copy,
    make_shared_kernel,
    new_board,
    run_shared,
)


@numba.njit
def _count_rows(first, end, lane, counts, rounds):
    for row in range(first, end):
        value = 1.0
        for _ in range(rounds):
            value = np.sqrt(value + row)
        counts[row] += 1
        lane[0][0] += value > 0.0
    return first <= 7 < end


@pytest.fixture(scope="module")
def work():
    return make_shared_kernel(_count_rows)


class _Batch:
    """BatchRows, and lanes that count the rows they processed."""

    def __init__(self, count, threads, rounds=0):
        self.board, self.lanes = (
            new_board(),
            [(cache_aligned_copy(np.zeros(1, np.int64)),) for _ in range(threads)],
        )
        self.counts, self.rounds = np.zeros(count, np.int64), rounds

    def turn(self, work, steps=1000):
        return run_shared(
            work, self.board, self.lanes, len(self.counts), steps, self.counts, self.rounds
        )

    @property
    def by_lane(self):
        return [int(lane[0][0]) for lane in self.lanes]

    def is_helped(self, work):
        """Return True if a second thread processes some of the rows, once it gets a CPU."""
        before = self.by_lane[1]
        for _ in range(1000):
            self.turn(work)
            if self.by_lane[1] > before:
                return True
        return False


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [1, 8, 1000])
def test_each_row_is_processed_once_per_turn(work, count, threads):
    batch = _Batch(count, threads)
    for turn in range(300):
        # The kernel reports row 7 as diverged.
        assert batch.turn(work) == (count > 7)
        np.testing.assert_array_equal(batch.counts, turn + 1)
        if turn % 100 == 50:
            # This is long enough for all threads to fall asleep.
            time.sleep(0.01)
    assert sum(batch.by_lane) == 300 * count


def test_alternating_batches_do_not_mix(work):
    first, second = _Batch(500, 2), _Batch(70, 3)
    for turn in range(200):
        first.turn(work)
        second.turn(work)
        np.testing.assert_array_equal(first.counts, turn + 1)
        np.testing.assert_array_equal(second.counts, turn + 1)
        assert all(worker.tasks.qsize() <= 1 for worker in _WORKERS)


def test_threads_help_again_after_they_slept(work):
    batch = _Batch(400, 2, rounds=5_000)
    for _ in range(3):
        assert batch.is_helped(work)
        time.sleep(0.05)


def test_small_batches_wake_no_other_thread(work):
    batch = _Batch(8, 2, rounds=5_000)
    for _ in range(20):
        batch.turn(work, steps=1)
    assert batch.by_lane == [160, 0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_has_its_own_helpers(work):
    batch = _Batch(400, 2, rounds=5_000)
    batch.turn(work)
    child = os.fork()
    if not child:
        is_correct = False
        try:
            is_correct = batch.is_helped(work) and (batch.counts == batch.counts[0]).all()
        finally:
            os._exit(0 if is_correct else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_a_process_ends_while_helpers_wait_for_the_next_turn():
    code = (
        "import codrl_mj, gymnasium\nenvs = gymnasium.make_vec('codrl_mj/Pendulum-v0', 256,"
        " 'vector_entry_point', num_threads=2)\nenvs.reset(seed=0)\nfor _ in range(20):"
        " envs.step(envs.action_space.sample())\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
