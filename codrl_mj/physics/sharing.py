"""Threads that share the rows of a batch, step after step.

One thread leads: it begins a turn, takes part in it and ends it. Others help: they look out for
turns in compiled code, where none of them needs the interpreter, and sleep when none has begun for
a while. They meet at a board of the batch.
"""

import atexit
import contextlib
import ctypes
import os
import threading
from collections.abc import Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np
from numba import types

from codrl_mj.compile_cache import external, njit
from codrl_mj.engine.memory import count_on, internal, look
from codrl_mj.physics.compiled_task import Compiled

_WORTH_WAKING = 64
"""Integration steps of a thread's that are worth waking it."""
_PATIENCE, _AT_ONCE = 1000, 500
"""How often a thread looks for the next turn before it sleeps: about a millisecond; and before it
offers its CPU to those who have none.
"""
_offer_cpu = external(
    "offer_cpu",
    ctypes.windll.kernel32.SwitchToThread if os.name == "nt" else ctypes.CDLL(None).sched_yield,  # type: ignore[attr-defined]
    types.int32(),
)
CLAIMED, BROKEN, TURN, HELPING = range(0, 32, 8)
"""What a board counts, a cache line each: rows that were taken, simulations no longer of numbers,
turns that began and that ended (so it is odd while one goes on), and threads that help in the
present one.
"""


def num_cpus() -> int:
    """How many CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cache_aligned_copy(array: np.ndarray) -> np.ndarray:
    """A copy on cache lines of its own: what threads write in turn would slow them down severalfold."""
    room = np.empty(array.nbytes + 128, np.uint8)
    start = -room.ctypes.data % 64
    copy = room[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def new_board() -> np.ndarray:
    """Where threads meet that share the rows of one batch."""
    return cache_aligned_copy(np.zeros(32, np.int64))


@internal
def _counted(board: np.ndarray, entry: int, more: int) -> int:
    """Count so many more; returns what was counted before."""
    return count_on(board[entry:].ctypes.data, more)


@internal
def _seen(board: np.ndarray, entry: int) -> int:
    """What is counted at present."""
    return look(board[entry:].ctypes.data)


@internal
def _alone(board: np.ndarray) -> None:
    """Wait until nobody helps."""
    looks = 0
    while _seen(board, HELPING):
        looks += 1
        if looks % _AT_ONCE == 0:
            _offer_cpu()


@internal
def _begun(board: np.ndarray) -> int:
    """Begin a turn."""
    board[CLAIMED] = board[BROKEN] = 0
    return _counted(board, TURN, 1) + 1


@internal
def _joined(board: np.ndarray, last: int) -> int:
    """The turn that a thread now helps in, other than its last; 0 if none began in a short while."""
    for _ in range(_PATIENCE):
        for _ in range(_AT_ONCE):
            turn = _seen(board, TURN)
            if turn % 2 == 1 and turn != last:
                _counted(board, HELPING, 1)
                if _seen(board, TURN) == turn:
                    return turn
                _counted(board, HELPING, -1)  # it had ended
        _offer_cpu()
    return 0


def make_shared_kernel(do: Compiled) -> Compiled:
    """What shares rows: (whether it leads, board, rows, threads, lane, arguments) -> nothing.

    It leads one turn; or it helps in turns as they come, until none has begun in a short while.
    `do` is a compiled function (first row, last and past it, lane, *arguments) -> simulations no
    longer of numbers. Threads claim rows until there are none left, fewer the fewer are left:
    nobody waits long for another, or at all for one that is late.
    """

    @internal
    def work(board: np.ndarray, count: int, threads: int, lane: Any, arguments: Any) -> None:
        first = 0
        while first < count:
            left = count - _seen(board, CLAIMED)
            more = count if threads == 1 else max(1, left // (4 * threads))
            first = _counted(board, CLAIMED, more)
            if first < count:
                _counted(board, BROKEN, do(first, min(first + more, count), lane, *arguments))

    @njit(nogil=True, error_model="numpy")
    def take_part(
        leads: bool, board: np.ndarray, count: int, threads: int, lane: Any, arguments: Any
    ) -> None:
        turn = _begun(board) if leads else _joined(board, 0)
        while turn:
            work(board, count, threads, lane, arguments)
            _counted(board, TURN if leads else HELPING, 1 if leads else -1)
            turn = 0 if leads else _joined(board, turn)
        if leads:
            _alone(board)

    return take_part


class _Worker:
    """A thread that helps others, one batch at a time."""

    def __init__(self) -> None:
        self.board: np.ndarray | None = None
        """Of the batch that it helps with, or was last asked to."""
        self.tasks: SimpleQueue[Any] = SimpleQueue()
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()

    def _work(self) -> None:
        while (task := self.tasks.get()) is not None:
            function, board, *arguments = task
            with contextlib.suppress(Exception):  # before it helps; whoever leads meets the same
                function(False, board, *arguments)
            if self.board is board:
                self.board = None
            del task, board, arguments  # which would be kept for as long as it sleeps


_WORKERS: list[_Worker] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_WORKERS.clear)  # threads do not survive it


@atexit.register
def _dismiss() -> None:
    """End the workers while there is an interpreter."""
    for worker in _WORKERS:
        worker.tasks.put(None)
        worker.thread.join(1.0)


def run_shared(
    function: Compiled,
    board: np.ndarray,
    lanes: Sequence[Any],
    count: int,
    steps: int,
    *arguments: Any,
) -> bool:
    """Do what is `shared` to so many rows, of `steps` integration steps each, on as many threads as there are lanes.

    Whoever has a board gives the same lanes and arguments with it each time. Returns whether a
    simulation is no longer one of numbers.
    """
    threads = min(len(lanes), 1 + count * steps // _WORTH_WAKING)
    for at in range(threads - 1):
        if at == len(_WORKERS):
            _WORKERS.append(_Worker())
        worker = _WORKERS[at]
        if (
            worker.board is not board and worker.tasks.empty()
        ):  # it helps one batch of several that take turns
            worker.board = board
            worker.tasks.put((function, board, count, threads, lanes[at + 1], arguments))
    function(True, board, count, threads, lanes[0], arguments)
    return bool(board[BROKEN])
