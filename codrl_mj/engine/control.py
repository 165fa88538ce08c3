"""MuJoCo's control and bias callbacks for our actuators, compiled to C functions by numba: the five tasks' door.

They are pure functions of (mjModel, mjData): which actuators are ours, and their parameters, is read from the model;
all state is in `data.act`. Nothing is cached on disk: the structure offsets are compiled in as constants.
"""

import ctypes
import functools
import math
from typing import Any

import mujoco
from numba import types

from codrl_mj.engine.doors import command, is_disabled, seen_from, user_of
from codrl_mj.engine.families import (
    HEAD,
    INERTIA,
    PARAMETERS,
    SIGNATURE,
    WHOLE,
    advance_slot,
    commit_slot,
    is_compiled,
    size_of,
)
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import at, f64, internal
from codrl_mj.kept import cfunc

_USER_DYNAMICS, _USER_BIAS = int(mujoco.mjtDyn.mjDYN_USER), int(mujoco.mjtBias.mjBIAS_USER)
_FIRST, _SECOND = SIGNATURE


@internal(inline="always")
def _slot_of(model: int, data: int, actuator: int) -> int:
    return at(DATA.act(data), MODEL.actuator_actadr(model)[actuator])


@internal(inline="always")
def _is_ours(model: int, actuator: int) -> bool:
    if MODEL.actuator_dyntype(model)[actuator] != _USER_DYNAMICS or MODEL.nuser_actuator(model) < HEAD:
        return False
    user = f64(user_of(model, actuator))
    return (
        user[0] == _FIRST
        and user[1] == _SECOND
        and is_compiled(user[2])
        and MODEL.nuser_actuator(model) >= HEAD + size_of(int(user[2]), PARAMETERS)
        and MODEL.actuator_biastype(model)[actuator] == _USER_BIAS
        and MODEL.actuator_actnum(model)[actuator] == size_of(int(user[2]), WHOLE)
    )


@functools.cache
def compiled() -> dict[str, Any]:
    """MuJoCo's names of the callbacks -> what its setters take; compiled on first use, kept for the process's life.

    `control` advances the actuators, `act_bias` is the torque that they deliver.
    """

    @cfunc(types.void(types.uintp, types.uintp), nogil=True, error_model="numpy")
    def control(model: int, data: int) -> None:
        if MODEL.nuser_actuator(model) < HEAD:
            return  # no actuator of this model can be ours
        if DATA.pbase(data) != 0:
            return  # stages 2 to 4 of RK4: the force is held over the step
        time, timestep = DATA.time(data), MODEL.opt.timestep(model)
        for actuator in range(MODEL.nactuator(model)):
            if not _is_ours(model, actuator) or is_disabled(model, actuator):
                continue
            user, slot = user_of(model, actuator), _slot_of(model, data, actuator)
            number = int(f64(user)[2])
            if time != f64(slot)[0]:
                commit_slot(number, slot, time)
            out = MODEL.actuator_outadr(model)[actuator]
            advance_slot(
                number,
                user + 8 * HEAD,
                timestep,
                slot,
                command(model, data, actuator),
                DATA.actuator_length(data)[out],
                DATA.actuator_velocity(data)[out],
                time,
                seen_from(model, data, out, 1.0) if size_of(number, INERTIA) else math.inf,
            )

    @cfunc(types.float64(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def act_bias(model: int, data: int, actuator: int) -> float:
        if not _is_ours(model, actuator):
            return 0.0  # as the engine does when there is no callback
        return f64(_slot_of(model, data, actuator))[2]

    return {"control": callback(control), "act_bias": callback(act_bias, ctypes.c_double, ctypes.c_int)}


def callback(function: Any, returned: Any = None, *more: Any) -> Any:
    """What MuJoCo's setters take for a compiled function of (mjModel, mjData) and `more`; it keeps that alive."""
    made: Any = ctypes.CFUNCTYPE(returned, ctypes.c_void_p, ctypes.c_void_p, *more)(function.address)
    made.owner = function
    return made
