"""Threads that share the rows of a batch, step after step.

One thread leads: it begins a turn, takes part in it and ends it. Others help: they look out for turns in compiled code,
where none of them needs the interpreter, and sleep when none has begun for a while. They meet at a board of the batch.
"""

import atexit
import os
import threading
import time
from collections.abc import Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np

from codrl_mj.engine.memory import count_on, internal
from codrl_mj.kept import njit
from codrl_mj.physics.compiled_task import Compiled

_WORTH_WAKING = 64
"""Integration steps of a thread's that are worth waking it."""
_PATIENCE = 200_000
"""Looks at a number for which a thread waits before it sleeps: about a millisecond."""
CLAIMED, BROKEN, TURN, HELPING = range(0, 32, 8)
"""What a board counts, a cache line each: rows that were taken, simulations no longer of numbers, turns that began and
that ended, and threads that help in the present one."""


def apart(array: np.ndarray) -> np.ndarray:
    """A copy on cache lines of its own: what threads write in turn would slow them down severalfold."""
    room = np.empty(array.nbytes + 128, np.uint8)
    start = -room.ctypes.data % 64
    copy = room[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def new_board() -> np.ndarray:
    """Where threads meet that share the rows of one batch."""
    return apart(np.zeros(32, np.int64))


@internal
def _counted(board: np.ndarray, entry: int, more: int) -> int:
    """Count so many more; returns what was counted before."""
    return count_on(board[entry:].ctypes.data, more)


@internal
def _begun(board: np.ndarray) -> int:
    """Begin a turn."""
    board[CLAIMED] = board[BROKEN] = 0
    return _counted(board, TURN, 1) + 1


@internal
def _ended(board: np.ndarray) -> bool:
    """End it; whether nobody helps in it any more, after a short wait."""
    _counted(board, TURN, 1)
    patience = _PATIENCE
    while patience and _counted(board, HELPING, 0):
        patience -= 1
    return patience > 0


@internal
def _joined(board: np.ndarray, last: int) -> int:
    """The turn that a thread now helps in, other than its last; 0 if none began in a short while."""
    for _ in range(_PATIENCE):
        turn = _counted(board, TURN, 0)
        if turn % 2 == 1 and turn != last:
            _counted(board, HELPING, 1)
            if _counted(board, TURN, 0) == turn:
                return turn
            _counted(board, HELPING, -1)  # it had ended
    return 0


def shared(do: Compiled) -> Compiled:
    """What shares rows: (whether it leads, board, rows, threads, lane, arguments) -> whether nobody helps any more.

    It leads one turn; or it helps in turns as they come, until none has begun in a short while. `do` is a compiled
    function (first row, last and past it, lane, *arguments) -> simulations no longer of numbers. Threads claim rows
    until there are none left, fewer the fewer are left: nobody waits long for another, or at all for one that is late.
    """

    @internal
    def work(board: np.ndarray, count: int, threads: int, lane: Any, arguments: Any) -> None:
        first = 0
        while first < count:
            left = count - _counted(board, CLAIMED, 0)
            more = count if threads == 1 else max(1, left // (4 * threads))
            first = _counted(board, CLAIMED, more)
            if first < count:
                _counted(board, BROKEN, do(first, min(first + more, count), lane, *arguments))

    @njit(nogil=True, error_model="numpy")
    def take_part(leads: bool, board: np.ndarray, count: int, threads: int, lane: Any, arguments: Any) -> bool:
        turn = _begun(board) if leads else _joined(board, 0)
        while turn:
            work(board, count, threads, lane, arguments)
            if leads:
                return _ended(board)
            _counted(board, HELPING, -1)
            turn = _joined(board, turn)
        return False

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
        worker.thread.join()


def share(function: Compiled, board: np.ndarray, lanes: Sequence[Any], count: int, steps: int, *arguments: Any) -> bool:
    """Do what is `shared` to so many rows, of `steps` integration steps each, on as many threads as there are lanes.

    Whoever has a board gives the same lanes and arguments with it each time. Returns whether a simulation is no longer
    one of numbers.
    """
    threads = min(len(lanes), 1 + count * steps // _WORTH_WAKING)
    for at in range(threads - 1):
        if at == len(_WORKERS):
            _WORKERS.append(_Worker())
        if (worker := _WORKERS[at]).board is not board:
            worker.board = board
            worker.tasks.put((function, board, count, threads, lanes[at + 1], arguments))
    alone = function(True, board, count, threads, lanes[0], arguments)
    while not alone:
        time.sleep(1e-5)  # whoever still helps may need this CPU
        alone = board[HELPING] == 0
    return bool(board[BROKEN])
