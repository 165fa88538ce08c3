"""The engine for functions that numba compiles: its step and reset.

Compiled code knows a simulation by two integers, the `addresses` of its `mjModel` and `mjData`, which must outlive the
call. A fault that the engine itself finds (an unknown integrator, memory run
out) ends the process there, where `mujoco.mj_step` would raise `mujoco.FatalError`; our models cause none.
"""

import functools
from typing import Any, NamedTuple

import mujoco
from numba import types

from codrl_mj.engine.layout import offset
from codrl_mj.kept import external
from codrl_mj.plugin import library


def addresses(data: mujoco.MjData) -> tuple[int, int]:
    """The addresses of an `MjData`'s model and of itself, by which compiled code knows them."""
    return data.model._address, data._address


def address_of(owner: Any, name: str) -> int:
    """Of a field of an `MjModel` or `MjData` that is a single number, such as `opt.timestep`."""
    return int(owner._address) + offset("mjModel" if isinstance(owner, mujoco.MjModel) else "mjData", name)


class Engine(NamedTuple):
    """MuJoCo's own functions of (model, data), by their addresses, for compiled code."""

    step: Any
    """`mj_step`."""
    reset: Any
    """`mj_resetData`."""
    set_const: Any
    """`mj_setConst`."""


@functools.cache
def engine() -> Engine:
    """The functions, found on first use."""
    mujoco_library = library()
    functions = mujoco_library.mj_step, mujoco_library.mj_resetData, mujoco_library.mj_setConst
    signature = types.void(types.uintp, types.uintp)
    return Engine(*(external(f"mj_function_{at}", one, signature) for at, one in enumerate(functions)))
