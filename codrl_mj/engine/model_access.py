"""Compiled functions by which both backends read a simulation: user data, control and inertia.

The inertia at an actuator's shaft comes from the engine's own factorization of the inertia matrix.
"""

import functools
import math

import mujoco
import numpy as np
from numba import types

from codrl_mj.compile_cache import CompiledCallback, cfunc
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import (
    Pointer,
    call,
    entry_address,
    internal,
    named_address,
    stack_floats,
    u64,
)

_NO_CLAMP, _NUM_GROUPS, _MAX_VALUE = (
    int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL),
    mujoco.mjNGROUP,
    mujoco.mjMAXVAL,
)
MAX_STACK_DOFS = 1024
"""Largest number of degrees of freedom whose work array is on the stack, which is faster."""
_FUNCTION_ADDRESS = np.zeros(1, dtype=np.uintp)
_function_pointer = named_address("codrl_mj_inertia", _FUNCTION_ADDRESS.ctypes.data)


@internal(inline="always")
def user_address(model: int, actuator: int) -> int:
    """Return the address of an actuator's `user` data."""
    return entry_address(MODEL.actuator_user(model), actuator * MODEL.nuser_actuator(model))


@internal(inline="always")
def clip(value: float, low: float, high: float) -> float:
    """Clip a value as MuJoCo's `mju_clip` does: NaN stays NaN."""
    # max(low, min(value, high)) would turn NaN into a limit.
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
    """Return an actuator's control, clamped to its range; 0 if any control of the model is bad."""
    # As in mj_fwdActuation, where a single bad control (NaN or beyond mjMAXVAL) clears all of them.
    for control in range(MODEL.nu(model)):
        if not abs(_clamped(model, data, control)) <= _MAX_VALUE:
            return 0.0
    return _clamped(model, data, MODEL.actuator_ctrladr(model)[actuator])


@internal(inline="always")
def is_disabled(model: int, actuator: int) -> bool:
    """Return True if an actuator's group is disabled."""
    group = MODEL.actuator_group(model)[actuator]
    return 0 <= group < _NUM_GROUPS and (MODEL.opt.disableactuator(model) >> group) & 1 == 1


@internal
def output_inertia(model: int, data: int, output: int, gear: float) -> float:
    """Return the inertia [kg*m^2] at an output through a gear; `load_inertia` must run first.

    The computation is called through its address. It takes a second to compile, and this way it is
    compiled only for families that need the inertia.
    """
    return call(u64(_function_pointer())[0], model, data, output, gear)


@internal(inline="always")
def _solve_inertia(
    model: int, data: int, output: int, gear: float, work: np.ndarray | Pointer[float]
) -> float:
    """Return 1/(m*M^-1*m) for the moment m of an output; `work` (nv numbers) becomes L^-T*m."""
    # M = L^T*D*L, hence m*M^-1*m is the sum of (L^-T*m)^2/D. The back substitution runs only over
    # the degrees of freedom that the moment reaches, and their ancestors in the kinematic tree,
    # because all other entries stay zero.
    start, last = DATA.moment_rowadr(data)[output], 0
    entries = range(start, start + DATA.moment_rownnz(data)[output])
    for entry in entries:
        last = max(last, DATA.moment_colind(data)[entry])
    for row in range(last + 1):
        work[row] = 0.0
    for entry in entries:
        work[DATA.moment_colind(data)[entry]] = gear * DATA.actuator_moment(data)[entry]
    total = 0.0
    for row in range(last, -1, -1):
        if work[row] == 0.0:
            continue
        total += work[row] * work[row] * DATA.qLDiagInv(data)[row]
        start = MODEL.M_rowadr(model)[row]
        # A row's last entry is its diagonal; the entries before it are the row's ancestors.
        for entry in range(start, start + MODEL.M_rownnz(model)[row] - 1):
            work[MODEL.M_colind(model)[entry]] -= DATA.qLD(data)[entry] * work[row]
    return 1.0 / total if total > 0.0 else math.inf


@functools.cache
def load_inertia() -> CompiledCallback[[int, int, int, float], float]:
    """Compile the function behind `output_inertia`, once per process, and return it.

    The inertia is 1/(m*M^-1*m). Here m is the gear times a row of `actuator_moment`, and M =
    L^T*D*L is the inertia matrix that `mj_fwdPosition` has factorized. It is the inertia at the
    actuator with all other joints free, and infinite if the actuator moves nothing.
    """

    @cfunc(
        types.float64(types.uintp, types.uintp, types.int32, types.float64),
        nogil=True,
        error_model="numpy",
    )
    def through_gear(model: int, data: int, output: int, gear: float) -> float:
        num_dofs = MODEL.nv(model)
        if num_dofs > MAX_STACK_DOFS:
            return _solve_inertia(model, data, output, gear, np.empty(num_dofs))
        return _solve_inertia(model, data, output, gear, stack_floats(num_dofs))

    _FUNCTION_ADDRESS[0] = through_gear.address
    return through_gear


def shaft_inertia(model: mujoco.MjModel, data: mujoco.MjData, output: int, gear: float) -> float:
    """Return `output_inertia` of a simulation for which `mj_fwdPosition` has run."""
    return float(load_inertia().ctypes(model._address, data._address, output, gear))
