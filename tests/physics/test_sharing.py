"""Threads share rows: each row is done once in each turn, whoever sleeps, comes late or is busy with another batch."""

import os
import subprocess
import sys
import time

import numba
import numpy as np
import pytest

from codrl_mj.physics.sharing import _WORKERS, cache_aligned_copy, new_board, run_shared, make_shared_kernel


@numba.njit
def _do(first, end, lane, done, rounds):
    for row in range(first, end):
        value = 1.0
        for _ in range(rounds):
            value = np.sqrt(value + row)
        done[row] += 1
        lane[0][0] += value > 0.0
    return first <= 7 < end


@pytest.fixture(scope="module")
def work():
    return make_shared_kernel(_do)


class _Batch:
    """Rows, and lanes that count what they did."""

    def __init__(self, count, threads, rounds=0):
        self.board, self.lanes = (
            new_board(),
            [(cache_aligned_copy(np.zeros(1, np.int64)),) for _ in range(threads)],
        )
        self.done, self.rounds = np.zeros(count, np.int64), rounds

    def turn(self, work, steps=1000):
        return run_shared(work, self.board, self.lanes, len(self.done), steps, self.done, self.rounds)

    @property
    def by_lane(self):
        return [int(lane[0][0]) for lane in self.lanes]

    def is_helped(self, work):
        """Whether a second thread does some of the rows, once it gets a CPU."""
        before = self.by_lane[1]
        for _ in range(1000):
            self.turn(work)
            if self.by_lane[1] > before:
                return True
        return False


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [1, 8, 1000])
def test_each_row_is_done_once_a_turn(work, count, threads):
    batch = _Batch(count, threads)
    for turn in range(300):
        assert batch.turn(work) == (count > 7)  # row 7 says that it broke
        np.testing.assert_array_equal(batch.done, turn + 1)
        if turn % 100 == 50:
            time.sleep(0.01)  # long enough for all to fall asleep
    assert sum(batch.by_lane) == 300 * count


def test_batches_that_take_turns_do_not_mix(work):
    one, other = _Batch(500, 2), _Batch(70, 3)
    for turn in range(200):
        one.turn(work)
        other.turn(work)
        np.testing.assert_array_equal(one.done, turn + 1)
        np.testing.assert_array_equal(other.done, turn + 1)
        assert all(worker.tasks.qsize() <= 1 for worker in _WORKERS)


def test_others_help_again_after_they_slept(work):
    batch = _Batch(400, 2, rounds=5_000)
    for _ in range(3):
        assert batch.is_helped(work)
        time.sleep(0.05)


def test_what_is_too_little_to_wake_anybody_is_done_alone(work):
    batch = _Batch(8, 2, rounds=5_000)
    for _ in range(20):
        batch.turn(work, steps=1)
    assert batch.by_lane == [160, 0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_has_helpers_of_its_own(work):
    batch = _Batch(400, 2, rounds=5_000)
    batch.turn(work)
    child = os.fork()
    if not child:
        fine = False
        try:
            fine = batch.is_helped(work) and (batch.done == batch.done[0]).all()
        finally:
            os._exit(0 if fine else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_a_process_ends_while_others_wait_for_its_next_turn():
    code = (
        "import codrl_mj, gymnasium\nenvs = gymnasium.make_vec('codrl_mj/Pendulum-v0', 256,"
        " 'vector_entry_point', num_threads=2)\nenvs.reset(seed=0)\nfor _ in range(20):"
        " envs.step(envs.action_space.sample())\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
