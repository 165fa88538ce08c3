"""Rows of states, which threads load one after another into their own simulations.

Everything that differs between two simulations of a task is in a row of arrays: the engine's state,
fields of the model, the arms and the disturbances' memory. A thread has one simulation (`Lane`). It
loads a row, steps or observes the simulation, and stores the row again.
"""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.compile_cache import njit
from codrl_mj.engine.layout import addresses, engine_function, field_address
from codrl_mj.engine.memory import copy_bytes, f64, internal
from codrl_mj.physics.base import NumbaTuple
from codrl_mj.physics.mujoco_single import ARM_COLUMN, MujocoPhysics
from codrl_mj.physics.sharing import cache_aligned_copy
from codrl_mj.physics.stepping import PointerTable

STATE = mujoco.mjtState
INTEGRATION = int(STATE.mjSTATE_INTEGRATION)
_STATE_PARTS = {
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
"""Parts of MuJoCo's state that an environment step changes; the other parts are constant."""
_MEMORY = PointerTable._fields.index("memory")


class BatchRows(NamedTuple):
    """Arrays with a row for each simulation of a batch."""

    states: np.ndarray
    """States of the engine, shape (N, k), entries as in mjSTATE_INTEGRATION."""
    arms: np.ndarray
    """Arms [m], shape (N, motors)."""
    memory: np.ndarray
    """Memory of the disturbances, shape (N, motors, l)."""


class Lane(NamedTuple):
    """Simulation of one thread, and the addresses to which the parts of a row are copied."""

    fields: np.ndarray
    """For each model field in the rows: its address in the lane's model, the address of its first
    row, the stride between rows [bytes] and the size of a row [bytes]; shape (f, 4).
    """
    parts: np.ndarray
    """For each part of the state: its address in the data, its first entry in a row, its length;
    shape (p, 3).
    """
    pointer_table: np.ndarray
    """Pointers of the simulation, see `codrl_mj.physics.stepping`."""
    settings: np.ndarray
    """Copy of the actuators' settings for this lane."""
    trace: np.ndarray
    """Trace of this lane's last environment step."""


def state_slice(model: mujoco.MjModel, name: str) -> slice:
    """Return the slice of a state row that holds a named part of the engine's state."""
    # MuJoCo stores the parts of a state in the order of their flags, so the sizes of all lower
    # flags add up to the first index.
    flag = int(_STATE_PARTS[name])
    first = mujoco.mj_stateSize(model, INTEGRATION & (flag - 1))
    return slice(first, first + mujoco.mj_stateSize(model, flag))


def make_lane(
    physics: MujocoPhysics, data: mujoco.MjData, fields: Mapping[str, np.ndarray]
) -> Lane:
    """Return a lane for the data of a thread; `fields` are the model fields in the rows."""
    rows = [
        (field_address(data.model, name), values.ctypes.data, values.strides[0], values[0].nbytes)
        for name, values in fields.items()
    ]
    parts = [(name, state_slice(data.model, name)) for name in _STATE_PARTS]
    state_addresses = [
        (field_address(data, name), part.start, part.stop - part.start) for name, part in parts
    ]
    settings, trace = cache_aligned_copy(physics.settings), cache_aligned_copy(physics.trace)
    model, data_address = addresses(data)
    addresses_of_copies = {"settings": settings.ctypes.data, "trace": trace.ctypes.data}
    pointer_table = PointerTable(*physics.pointer_table.tolist())._replace(
        model=model, data=data_address, **addresses_of_copies
    )
    tables = np.array(rows, np.int64).reshape(-1, 4), np.array(state_addresses, np.int64)
    return Lane(*tables, cache_aligned_copy(np.array(pointer_table, np.int64)), settings, trace)


@internal
def load_fields(row: int, lane: Lane) -> None:
    """Copy a row's model fields into the lane's model."""
    for field in range(len(lane.fields)):
        target, first, stride, size = lane.fields[field]
        copy_bytes(target, first + row * stride, size)


@internal
def load(rows: BatchRows, row: int, lane: Lane) -> None:
    """Load a row into the lane's simulation."""
    load_fields(row, lane)
    lane.pointer_table[_MEMORY] = rows.memory.ctypes.data + row * rows.memory.strides[0]
    state = rows.states.ctypes.data + row * rows.states.strides[0]
    for part_index in range(len(lane.parts)):
        live, stored = f64(lane.parts[part_index, 0]), f64(state + 8 * lane.parts[part_index, 1])
        for entry in range(lane.parts[part_index, 2]):
            live[entry] = stored[entry]
    for motor in range(len(lane.settings)):
        lane.settings[motor, ARM_COLUMN] = rows.arms[row, motor]


@internal
def store(rows: BatchRows, row: int, lane: Lane) -> None:
    """Copy the state of the lane's simulation into a row."""
    state = rows.states.ctypes.data + row * rows.states.strides[0]
    for part_index in range(len(lane.parts)):
        live, stored = f64(lane.parts[part_index, 0]), f64(state + 8 * lane.parts[part_index, 1])
        for entry in range(lane.parts[part_index, 2]):
            stored[entry] = live[entry]


_set_const = engine_function("mj_setConst")


@njit(nogil=True, error_model="numpy")
def derive_fields(rows: np.ndarray, lane: NumbaTuple, derived: np.ndarray) -> None:
    """Let MuJoCo derive model fields of rows (m,); `derived` are their indices in `Lane.fields`."""
    lane = Lane(*lane)
    for row in rows:
        load_fields(row, lane)
        _set_const(lane.pointer_table[0], lane.pointer_table[1])
        for field in derived:
            source, first, stride, size = lane.fields[field]
            copy_bytes(first + row * stride, source, size)
