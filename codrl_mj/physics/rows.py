"""Rows of states that threads put, one after the other, into simulations of their own.

What differs between two simulations of a task is a row of arrays: the engine's state, fields of the
model, the arms and the disturbances' memory. A thread has one simulation (`Lane`); it loads a row,
does to it what is to be done to any simulation, and stores the row again.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from codrl_mj.compile_cache import njit
from codrl_mj.engine.layout import address_of, addresses, engine_function
from codrl_mj.engine.memory import copy_bytes, f64, internal
from codrl_mj.physics.mujoco_single import ARM, MujocoPhysics
from codrl_mj.physics.sharing import cache_aligned_copy
from codrl_mj.physics.stepping import PointerTable

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
_MEMORY = PointerTable._fields.index("memory")


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
    """For each field of the model that the rows have: its address, that of the first row's value,
    bytes from row to row and bytes of a value; shape (f, 4).
    """
    parts: np.ndarray
    """For each part of the state: its address in the data, its first entry in a row, its length; shape (p, 3)."""
    pointer_table: np.ndarray
    """The simulation's, see `codrl_mj.physics.stepping`."""
    settings: np.ndarray
    """The lane's own copy; likewise the next."""
    trace: np.ndarray


def state_slice(model: mujoco.MjModel, name: str) -> slice:
    """Where a row of states has a part of the engine's state, by its name in the data."""
    flag = int(_MOVING[name])
    first = mujoco.mj_stateSize(model, INTEGRATION & (flag - 1))
    return slice(first, first + mujoco.mj_stateSize(model, flag))


def make_lane(physics: MujocoPhysics, data: mujoco.MjData, fields: Mapping[str, np.ndarray]) -> Lane:
    """The lane of other data, with a model of its own, for simulations like this one; the rows have these fields."""
    rows = [
        (address_of(data.model, name), values.ctypes.data, values.strides[0], values[0].nbytes)
        for name, values in fields.items()
    ]
    parts = [(name, state_slice(data.model, name)) for name in _MOVING]
    live = [(address_of(data, name), one.start, one.stop - one.start) for name, one in parts]
    settings, trace = cache_aligned_copy(physics.settings), cache_aligned_copy(physics.trace)
    model, live_data = addresses(data)
    own = {"settings": settings.ctypes.data, "trace": trace.ctypes.data}
    pointer_table = PointerTable(*physics.pointer_table.tolist())._replace(model=model, data=live_data, **own)
    tables = np.array(rows, np.int64).reshape(-1, 4), np.array(live, np.int64)
    return Lane(*tables, cache_aligned_copy(np.array(pointer_table, np.int64)), settings, trace)


@internal
def load_fields(row: int, lane: Lane) -> None:
    """Give the lane's model what a row has of it."""
    for field in range(len(lane.fields)):
        target, first, stride, size = lane.fields[field]
        copy_bytes(target, first + row * stride, size)


@internal
def load(rows: Rows, row: int, lane: Lane) -> None:
    """Make the lane's simulation the one of a row."""
    load_fields(row, lane)
    lane.pointer_table[_MEMORY] = rows.memory.ctypes.data + row * rows.memory.strides[0]
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
        _set_const(lane.pointer_table[0], lane.pointer_table[1])
        for field in derived:
            source, first, stride, size = lane.fields[field]
            copy_bytes(first + row * stride, source, size)
