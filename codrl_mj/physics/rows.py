"""Rows of states that threads put, one after the other, into simulations of their own.

What differs between two simulations of a task is a row of arrays: the engine's state, fields of the model, the arms and
the disturbances' memory. A thread has one simulation (`Lane`); it loads a row, does to it what is to be done to any
simulation, and stores the row again.
"""

import functools
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import mujoco
import numpy as np

from codrl_mj.engine.layout import address_of, addresses, engine_function
from codrl_mj.engine.memory import copy_bytes, count_on, f64, internal
from codrl_mj.kept import njit
from codrl_mj.physics.mujoco_single import ARM, MujocoPhysics

STATE = mujoco.mjtState
INTEGRATION = int(STATE.mjSTATE_INTEGRATION)
_MOVING = {
    "time": STATE.mjSTATE_TIME,
    "qpos": STATE.mjSTATE_QPOS,
    "qvel": STATE.mjSTATE_QVEL,
    "act": STATE.mjSTATE_ACT,
    "history": STATE.mjSTATE_HISTORY,
    "qacc_warmstart": STATE.mjSTATE_WARMSTART,
    "ctrl": STATE.mjSTATE_CTRL,
    "qfrc_applied": STATE.mjSTATE_QFRC_APPLIED,
    "plugin_state": STATE.mjSTATE_PLUGIN,
}
"""Parts of MuJoCo's state that an environment step changes; nobody changes the others."""
_AT_ONCE = 64
"""Rows that a thread takes at most; and integration steps of a thread's that are worth waking it."""


class Rows(NamedTuple):
    """What the simulations are, a row each."""

    states: np.ndarray
    """The engine's, shape (N, k), entries as in mjSTATE_INTEGRATION."""
    arms: np.ndarray
    """[m], shape (N, motors)."""
    memory: np.ndarray
    """The disturbances', shape (N, motors, l)."""


class Lane(NamedTuple):
    """A thread's simulation, and what of a row goes where in it."""

    fields: np.ndarray
    """For each field of the model that the rows have: its address, that of the first row's value, bytes from row to row
    and bytes of a value; shape (f, 4)."""
    parts: np.ndarray
    """For each part of the state: its address in the data, its first entry in a row, its length; shape (p, 3)."""
    model: int
    data: int
    settings: np.ndarray
    memory: np.ndarray
    trace: np.ndarray
    """These are the simulation's arguments, see `codrl_mj.physics.stepping`."""


def part(model: mujoco.MjModel, name: str) -> slice:
    """Where a row of states has a part of the engine's state, by its name in the data."""
    flag = int(_MOVING[name])
    first = mujoco.mj_stateSize(model, INTEGRATION & (flag - 1))
    return slice(first, first + mujoco.mj_stateSize(model, flag))


def lane(physics: MujocoPhysics, data: mujoco.MjData, fields: Mapping[str, np.ndarray]) -> Lane:
    """The lane of other data, with a model of its own, for simulations like this one; the rows have these fields."""
    _, _, settings, memory, trace = physics.arguments
    rows = [
        (address_of(data.model, name), rows.ctypes.data, rows.strides[0], rows[0].nbytes)
        for name, rows in fields.items()
    ]
    parts = [(name, part(data.model, name)) for name in _MOVING]
    live = [(address_of(data, name), one.start, one.stop - one.start) for name, one in parts]
    own = settings.copy(), memory, trace.copy()
    return Lane(np.array(rows, np.int64).reshape(-1, 4), np.array(live, np.int64), *addresses(data), *own)


@internal
def load_fields(row: int, lane: Lane) -> None:
    """Give the lane's model what a row has of it."""
    for field in range(len(lane.fields)):
        target, first, stride, size = lane.fields[field]
        copy_bytes(target, first + row * stride, size)


@internal
def load(rows: Rows, row: int, lane: Lane) -> None:
    """Make the lane's simulation the one of a row, but for its disturbances' memory, which a step is given."""
    load_fields(row, lane)
    state = rows.states.ctypes.data + row * rows.states.strides[0]
    for which in range(len(lane.parts)):
        live, kept = f64(lane.parts[which, 0]), f64(state + 8 * lane.parts[which, 1])
        for entry in range(lane.parts[which, 2]):
            live[entry] = kept[entry]
    for motor in range(len(lane.settings)):
        lane.settings[motor, ARM] = rows.arms[row, motor]


@internal
def store(rows: Rows, row: int, lane: Lane) -> None:
    """Keep the state of the lane's simulation in a row."""
    state = rows.states.ctypes.data + row * rows.states.strides[0]
    for which in range(len(lane.parts)):
        live, kept = f64(lane.parts[which, 0]), f64(state + 8 * lane.parts[which, 1])
        for entry in range(lane.parts[which, 2]):
            kept[entry] = live[entry]


_set_const = engine_function("mj_setConst")


@njit(nogil=True, error_model="numpy")
def derive_fields(rows: np.ndarray, lane: Any, derived: np.ndarray) -> None:
    """Fill the fields that MuJoCo derives from others, by their indices in `Lane.fields`, of rows (m,)."""
    lane = Lane(*lane)
    for row in rows:
        load_fields(row, lane)
        _set_const(lane.model, lane.data)
        for field in derived:
            source, first, stride, size = lane.fields[field]
            copy_bytes(first + row * stride, source, size)


CLAIMED, DONE, BROKEN = range(3)
"""What a tally counts: rows that a thread has taken, rows that are done, simulations no longer of numbers."""


@internal
def tallied(tally: np.ndarray, entry: int, more: int) -> int:
    """Count so many more; returns what was counted before, as the first of the rows that a thread claims."""
    return count_on(tally[entry:].ctypes.data, more)


@njit(nogil=True)
def _await(tally: np.ndarray, count: int) -> bool:
    """Whether all rows are done, after a short wait for others."""
    patience = 2000
    while patience and tallied(tally, DONE, 0) != count:
        patience -= 1
    return patience > 0


@functools.cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)  # threads do not survive it


def share(function: Any, lanes: Sequence[tuple[Any, ...]], count: int, steps: int, *arguments: Any) -> bool:
    """Do something to so many rows, of `steps` integration steps each, on as many threads as there are lanes.

    `function` is compiled: (tally, rows to claim at once, lane, *arguments) -> nothing. It claims rows until there are
    none left, so that one that comes late finds nothing to do, and nobody waits for it. Returns whether a simulation is
    no longer one of numbers.
    """
    needed = min(len(lanes), 1 + count * steps // _AT_ONCE)
    tally = np.zeros(3, np.int64)
    at_once = count if needed == 1 else max(1, min(_AT_ONCE, count // (8 * needed)))
    others = [_threads(len(lanes) - 1).submit(function, tally, at_once, one, *arguments) for one in lanes[1:needed]]
    function(tally, at_once, lanes[0], *arguments)
    if others and not _await(tally, count):
        for one in others:
            if not one.cancel():
                one.result()
    return bool(tally[BROKEN])
