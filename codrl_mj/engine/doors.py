"""What both doors read of a model, compiled: an actuator's numbers, its control, and what it moves.

The inertia at an actuator's shaft comes from the engine's own factorisation of the inertia matrix.
"""

import functools
import math
from typing import Any

import mujoco
import numpy as np
from numba import types

from codrl_mj.compile_cache import cfunc
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import at, call, internal, on_stack, symbol, u64

_NO_CLAMP, _GROUPS, _LARGEST = (
    int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL),
    mujoco.mjNGROUP,
    mujoco.mjMAXVAL,
)
MOST_ON_STACK = 1024
"""Degrees of freedom up to which the work is done on the stack, which is quicker."""
_ADDRESS = np.zeros(1, dtype=np.uintp)
_address_at = symbol("codrl_mj_inertia", _ADDRESS.ctypes.data)


@internal(inline="always")
def user_of(model: int, actuator: int) -> int:
    """Address of an actuator's `user` data."""
    return at(MODEL.actuator_user(model), actuator * MODEL.nuser_actuator(model))


@internal(inline="always")
def clip(value: float, low: float, high: float) -> float:
    """MuJoCo's `mju_clip`, which keeps what is no number."""
    return low if value < low else high if value > high else value


@internal(inline="always")
def _clamped(model: int, data: int, control: int) -> float:
    value = DATA.ctrl(data)[control]
    if MODEL.actuator_ctrllimited(model)[control] and not MODEL.opt.disableflags(model) & _NO_CLAMP:
        limits = MODEL.actuator_ctrlrange(model)
        return clip(value, limits[2 * control], limits[2 * control + 1])
    return value


@internal(inline="always")
def command(model: int, data: int, actuator: int) -> float:
    """The control that an actuator acts on: clamped where it is limited; zero if any control is bad."""
    for control in range(MODEL.nu(model)):
        if not abs(_clamped(model, data, control)) <= _LARGEST:
            return 0.0
    return _clamped(model, data, MODEL.actuator_ctrladr(model)[actuator])


@internal(inline="always")
def is_disabled(model: int, actuator: int) -> bool:
    """Whether an actuator's group is switched off."""
    group = MODEL.actuator_group(model)[actuator]
    return 0 <= group < _GROUPS and (MODEL.opt.disableactuator(model) >> group) & 1 == 1


@internal
def inertia_at(model: int, data: int, output: int, gear: float) -> float:
    """The inertia [kg*m^2] at an actuator's output, through a gear; `load_inertia` must have been called.

    To be compiled takes a second, which only families that ask for it are to pay.
    """
    return call(u64(_address_at())[0], model, data, output, gear)


@internal(inline="always")
def _eliminated(model: int, data: int, output: int, gear: float, turned: Any) -> float:
    """The inertia; `turned` becomes L^-T*m; there it has room for a number for each degree of freedom."""
    start, last = DATA.moment_rowadr(data)[output], 0
    entries = range(start, start + DATA.moment_rownnz(data)[output])
    for entry in entries:
        last = max(last, DATA.moment_colind(data)[entry])
    for row in range(last + 1):
        turned[row] = 0.0
    for entry in entries:
        turned[DATA.moment_colind(data)[entry]] = gear * DATA.actuator_moment(data)[entry]
    total = 0.0
    for row in range(last, -1, -1):
        if turned[row] == 0.0:
            continue
        total += turned[row] * turned[row] * DATA.qLDiagInv(data)[row]
        start = MODEL.M_rowadr(model)[row]
        for entry in range(
            start, start + MODEL.M_rownnz(model)[row] - 1
        ):  # its ancestors; then itself
            turned[MODEL.M_colind(model)[entry]] -= DATA.qLD(data)[entry] * turned[row]
    return 1.0 / total if total > 0.0 else math.inf


@functools.cache
def load_inertia() -> Any:
    """Compile what `inertia_at` calls, once a process; returns what owns the machine code.

    With its moment m, the gear times a row of `actuator_moment`, and the inertia matrix M = L^T*D*L
    that `mj_fwdPosition` has factorised, it is 1/(m*M^-1*m): how hard it is to turn with all other
    joints free. Infinite where nothing moves.
    """

    @cfunc(
        types.float64(types.uintp, types.uintp, types.int32, types.float64),
        nogil=True,
        error_model="numpy",
    )
    def through_gear(model: int, data: int, output: int, gear: float) -> float:
        count = MODEL.nv(model)
        if count > MOST_ON_STACK:
            return _eliminated(model, data, output, gear, np.empty(count))
        return _eliminated(model, data, output, gear, on_stack(count))

    _ADDRESS[0] = through_gear.address
    return through_gear


def shaft_inertia(model: mujoco.MjModel, data: mujoco.MjData, output: int, gear: float) -> float:
    """What `inertia_at` finds of a simulation whose `mj_fwdPosition` has run."""
    return float(load_inertia().ctypes(model._address, data._address, output, gear))
