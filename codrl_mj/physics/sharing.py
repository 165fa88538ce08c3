"""Threads that share the rows of a batch, step after step.

In a turn, threads process all rows once. One thread leads: it begins a turn, takes part in it and
ends it. The others help: they wait for turns in compiled code, where they do not need the
interpreter, and sleep if no turn has started for a while. The threads communicate through a board
of counters for each batch.
"""

import atexit
import contextlib
import ctypes
import os
import threading
from collections.abc import Sequence
from queue import SimpleQueue

import numpy as np
from numba import types

from codrl_mj.boundary import Argument
from codrl_mj.compile_cache import external_function, njit
from codrl_mj.engine.memory import atomic_add, atomic_load, internal
from codrl_mj.physics.base import Compiled, NumbaTuple

_MIN_STEPS_PER_THREAD = 64
"""Number of integration steps per thread below which waking another thread does not pay."""
_ROUNDS_BEFORE_SLEEP, _POLLS_PER_ROUND = 1000, 500
"""Number of rounds in which a thread polls for the next turn before it sleeps, about a millisecond
in total; and number of polls per round, after which it yields its CPU.
"""
_yield_cpu = external_function(
    "offer_cpu",
    ctypes.windll.kernel32.SwitchToThread if os.name == "nt" else ctypes.CDLL(None).sched_yield,  # type: ignore[attr-defined]
    types.int32(),
)
CLAIMED, DIVERGED, TURN, HELPING = range(0, 32, 8)
"""Indices of a board's counters, each in its own cache line: rows claimed, simulations that
diverged, turns started plus turns ended (odd during a turn), and threads that help in the present
turn.
"""


def num_cpus() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cache_aligned_copy(array: np.ndarray) -> np.ndarray:
    """Return a copy on its own cache lines; writes to shared lines are several times slower."""
    buffer = np.empty(array.nbytes + 128, np.uint8)
    start = -buffer.ctypes.data % 64
    copy = buffer[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def new_board() -> np.ndarray:
    """Return a new board, the counters of the threads that share a batch."""
    return cache_aligned_copy(np.zeros(32, np.int64))


@internal
def _add(board: np.ndarray, entry: int, increment: int) -> int:
    """Add to a counter atomically; return its previous value."""
    return atomic_add(board[entry:].ctypes.data, increment)


@internal
def _read(board: np.ndarray, entry: int) -> int:
    """Return a counter's present value."""
    return atomic_load(board[entry:].ctypes.data)


@internal
def _wait_for_helpers(board: np.ndarray) -> None:
    """Wait until no thread helps."""
    polls = 0
    while _read(board, HELPING):
        polls += 1
        if polls % _POLLS_PER_ROUND == 0:
            _yield_cpu()


@internal
def _begin_turn(board: np.ndarray) -> int:
    """Begin a turn; return its number."""
    board[CLAIMED] = board[DIVERGED] = 0
    return _add(board, TURN, 1) + 1


@internal
def _join_turn(board: np.ndarray, last: int) -> int:
    """Join a turn other than the last one as a helper; return 0 if none starts in time."""
    for _ in range(_ROUNDS_BEFORE_SLEEP):
        for _ in range(_POLLS_PER_ROUND):
            turn = _read(board, TURN)
            if turn % 2 == 1 and turn != last:
                # The turn may have ended since the first poll; then the thread must not count as a
                # helper.
                _add(board, HELPING, 1)
                if _read(board, TURN) == turn:
                    return turn
                _add(board, HELPING, -1)
        _yield_cpu()
    return 0


def make_shared_kernel(function: Compiled) -> Compiled:
    """Return a kernel (leads, board, rows, threads, lane, arguments) -> None that shares rows.

    A leader runs one turn; a helper joins turns until none starts for a while. `function` is a
    compiled function (first row, end row, lane, *arguments) -> number of simulations that diverged.
    Threads claim rows until none are left. Portions become smaller as fewer rows are left, so no
    thread waits long for another, and a thread that starts late delays no other.
    """

    @internal
    def work(
        board: np.ndarray, count: int, threads: int, lane: NumbaTuple, arguments: NumbaTuple
    ) -> None:
        first = 0
        while first < count:
            remaining = count - _read(board, CLAIMED)
            claimed = count if threads == 1 else max(1, remaining // (4 * threads))
            first = _add(board, CLAIMED, claimed)
            if first < count:
                _add(
                    board, DIVERGED, function(first, min(first + claimed, count), lane, *arguments)
                )

    @njit(nogil=True, error_model="numpy")
    def take_part(
        leads: bool,
        board: np.ndarray,
        count: int,
        threads: int,
        lane: NumbaTuple,
        arguments: NumbaTuple,
    ) -> None:
        turn = _begin_turn(board) if leads else _join_turn(board, 0)
        while turn:
            work(board, count, threads, lane, arguments)
            _add(board, TURN if leads else HELPING, 1 if leads else -1)
            turn = 0 if leads else _join_turn(board, turn)
        if leads:
            _wait_for_helpers(board)

    return take_part


class _Worker:
    """Thread that helps with one batch at a time."""

    def __init__(self) -> None:
        self.board: np.ndarray | None = None
        """Board of the batch that this thread helps; None if it has stopped helping."""
        self.tasks: SimpleQueue[NumbaTuple] = SimpleQueue()
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()

    def _work(self) -> None:
        while (task := self.tasks.get()) is not None:
            function, board, *arguments = task
            # An error can occur only before the thread helps, and the leader raises it as well.
            with contextlib.suppress(Exception):
                function(False, board, *arguments)
            if self.board is board:
                self.board = None
            # References in this frame would keep the arguments alive while the thread sleeps.
            del task, board, arguments


_WORKERS: list[_Worker] = []
# Threads do not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_WORKERS.clear)


@atexit.register
def _stop_workers() -> None:
    """Stop the workers while the interpreter still runs."""
    for worker in _WORKERS:
        worker.tasks.put(None)
        worker.thread.join(1.0)


def run_shared(
    function: Compiled,
    board: np.ndarray,
    lanes: Sequence[NumbaTuple],
    count: int,
    steps: int,
    *arguments: Argument,
) -> bool:
    """Run a kernel of `make_shared_kernel` on rows of `steps` integration steps each.

    There are at most as many threads as lanes. A board must always be used with the same lanes and
    arguments. Return True if a simulation diverged.
    """
    threads = min(len(lanes), 1 + count * steps // _MIN_STEPS_PER_THREAD)
    for helper_index in range(threads - 1):
        if helper_index == len(_WORKERS):
            _WORKERS.append(_Worker())
        worker = _WORKERS[helper_index]
        # A worker stays with its batch: if several batches step alternately, it helps only one.
        if worker.board is not board and worker.tasks.empty():
            worker.board = board
            worker.tasks.put((function, board, count, threads, lanes[helper_index + 1], arguments))
    function(True, board, count, threads, lanes[0], arguments)
    return bool(board[DIVERGED])
