"""The engine for functions that numba compiles: its step and reset, and where a simulation keeps what they need.

Compiled code knows a simulation by two integers, the `addresses` of its `mjModel` and `mjData`, which must outlive the
call. A fault that the engine itself finds (an unknown integrator, memory run
out) ends the process there, where `mujoco.mj_step` would raise `mujoco.FatalError`; our models cause none.
"""

import ctypes
import functools
from typing import Any, NamedTuple

import mujoco

from codrl_mj.engine.layout import check_layout, offset
from codrl_mj.engine.memory import array, f64, internal
from codrl_mj.plugin import library

MODEL_FIELDS = ("opt.timestep",)
DATA_FIELDS = ("time", "qpos", "qvel", "ctrl", "act", "qfrc_applied")


def addresses(data: mujoco.MjData) -> tuple[int, int]:
    """The addresses of an `MjData`'s model and of itself, by which compiled code knows them."""
    return data.model._address, data._address


class Engine(NamedTuple):
    """Functions for compiled code."""

    step: Any
    """(model, data): MuJoCo's `mj_step`."""
    reset: Any
    """(model, data): MuJoCo's `mj_resetData`."""
    set_const: Any
    """(model, data): MuJoCo's `mj_setConst`."""
    timestep: Any
    """(model) -> integration step [s]."""
    time: Any
    """(data) -> time [s]."""
    qpos: Any
    """(data) -> pointer to the positions; so are the others, to what they are called after."""
    qvel: Any
    ctrl: Any
    act: Any
    qfrc_applied: Any


@functools.cache
def engine() -> Engine:
    """The functions, made on first use.

    Raises:
        LayoutError: the installed MuJoCo has no library where its package should have it, or its memory is not laid out
            as its introspection says.
    """
    check_layout(MODEL_FIELDS, DATA_FIELDS)
    timestep_at, time_at = offset("mjModel", "opt.timestep"), offset("mjData", "time")

    @internal
    def timestep(model: int) -> float:
        return f64(model + timestep_at)[0]

    @internal
    def time(data: int) -> float:
        return f64(data + time_at)[0]

    mujoco_library = library()
    functions = mujoco_library.mj_step, mujoco_library.mj_resetData, mujoco_library.mj_setConst
    for function in functions:
        function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_void_p), None
    arrays = (_array_of(name) for name in ("qpos", "qvel", "ctrl", "act", "qfrc_applied"))
    return Engine(*functions, timestep, time, *arrays)


def _array_of(name: str) -> Any:
    at = offset("mjData", name)

    @internal
    def pointer(data: int) -> Any:
        return f64(array(data, at))

    return pointer


def address_of(owner: Any, name: str) -> int:
    """Of a field of an `MjModel` or `MjData` that is a single number, such as `opt.timestep`."""
    return int(owner._address) + offset("mjModel" if isinstance(owner, mujoco.MjModel) else "mjData", name)
