"""MuJoCo's control and bias callbacks for our actuators, compiled to C functions by numba: the five tasks' door.

They are pure functions of (mjModel, mjData): which actuators are ours, and their parameters, is read from the model;
all state is in `data.act`. Nothing is cached on disk: the structure offsets are compiled in as constants.
"""

import ctypes
import functools
import math
from typing import Any, NamedTuple

import mujoco
import numba
from numba import types

from codrl_mj.engine.commands import COMMAND_DATA_FIELDS, COMMAND_MODEL_FIELDS, commands
from codrl_mj.engine.families import (
    HEAD,
    SIGNATURE,
    advance_slot,
    asks_inertia,
    commit_slot,
    is_compiled,
    parameter_count,
    size_of,
)
from codrl_mj.engine.inertia import seen_from
from codrl_mj.engine.layout import check_layout, offset
from codrl_mj.engine.memory import array, f64, i32, i64, internal

MODEL_FIELDS = (
    *COMMAND_MODEL_FIELDS,
    "nactuator",
    "nuser_actuator",
    "opt.timestep",
    "actuator_dyntype",
    "actuator_biastype",
    "actuator_actnum",
    "actuator_actadr",
    "actuator_outadr",
    "actuator_user",
)
DATA_FIELDS = (*COMMAND_DATA_FIELDS, "time", "act", "actuator_length", "actuator_velocity")
PBASE_NEIGHBOURS = ("narena", "nbuffer", "pstack", "maxuse_stack")
"""Fields of mjData around `pbase`, which the bindings do not show."""


class Callbacks(NamedTuple):
    """The compiled callbacks."""

    control: Any
    """ctypes pointer for `mjcb_control`: advances the actuators."""
    act_bias: Any
    """ctypes pointer for `mjcb_act_bias`: the torque that they deliver."""
    owners: tuple[Any, ...]
    """The numba objects that own the machine code: they must live as long as the pointers."""


@functools.cache
def compiled() -> Callbacks:
    """Compile the callbacks on first use and keep them for the life of the process.

    Raises:
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    check_layout(MODEL_FIELDS, (*DATA_FIELDS, *PBASE_NEIGHBOURS))
    model_at = {field: offset("mjModel", field) for field in MODEL_FIELDS}
    data_at = {field: offset("mjData", field) for field in (*DATA_FIELDS, "pbase")}
    nactuator_at, nuser_at = model_at["nactuator"], model_at["nuser_actuator"]
    timestep_at = model_at["opt.timestep"]
    dyntype_at, biastype_at = model_at["actuator_dyntype"], model_at["actuator_biastype"]
    actnum_at, actadr_at = model_at["actuator_actnum"], model_at["actuator_actadr"]
    outadr_at, user_at = model_at["actuator_outadr"], model_at["actuator_user"]
    time_at, pbase_at = data_at["time"], data_at["pbase"]
    act_at = data_at["act"]
    length_at, velocity_at = data_at["actuator_length"], data_at["actuator_velocity"]
    user_dynamics, user_bias = int(mujoco.mjtDyn.mjDYN_USER), int(mujoco.mjtBias.mjBIAS_USER)
    command, is_disabled = commands()
    first, second = SIGNATURE

    @internal(inline="always")
    def user_of(model: int, actuator: int) -> int:
        return array(model, user_at) + 8 * actuator * i64(model + nuser_at)[0]

    @internal(inline="always")
    def slot_of(model: int, data: int, actuator: int) -> int:
        return array(data, act_at) + 8 * i32(array(model, actadr_at))[actuator]

    @internal(inline="always")
    def is_ours(model: int, actuator: int) -> bool:
        if i32(array(model, dyntype_at))[actuator] != user_dynamics or i64(model + nuser_at)[0] < HEAD:
            return False
        user = f64(user_of(model, actuator))
        return (
            user[0] == first
            and user[1] == second
            and is_compiled(user[2])
            and i64(model + nuser_at)[0] >= HEAD + parameter_count(int(user[2]))
            and i32(array(model, biastype_at))[actuator] == user_bias
            and i32(array(model, actnum_at))[actuator] == size_of(int(user[2]))
        )

    @numba.cfunc(types.void(types.uintp, types.uintp), nogil=True, error_model="numpy")
    def control(model: int, data: int) -> None:
        if i64(model + nuser_at)[0] < HEAD:
            return  # no actuator of this model can be ours
        if i64(data + pbase_at)[0] != 0:
            return  # stages 2 to 4 of RK4: the force is held over the step
        time, timestep = f64(data + time_at)[0], f64(model + timestep_at)[0]
        for actuator in range(i64(model + nactuator_at)[0]):
            if not is_ours(model, actuator) or is_disabled(model, actuator):
                continue
            user, slot = user_of(model, actuator), slot_of(model, data, actuator)
            number = int(f64(user)[2])
            if time != f64(slot)[0]:
                commit_slot(number, slot, time)
            out = i32(array(model, outadr_at))[actuator]
            advance_slot(
                number,
                user + 8 * HEAD,
                timestep,
                slot,
                command(model, data, actuator),
                f64(array(data, length_at))[out],
                f64(array(data, velocity_at))[out],
                time,
                seen_from(model, data, out, 1.0) if asks_inertia(number) else math.inf,
            )

    @numba.cfunc(types.float64(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def act_bias(model: int, data: int, actuator: int) -> float:
        if not is_ours(model, actuator):
            return 0.0  # as the engine does when there is no callback
        return f64(slot_of(model, data, actuator))[2]

    generic = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
    bias = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)
    return Callbacks(generic(control.address), bias(act_bias.address), (control, act_bias))
