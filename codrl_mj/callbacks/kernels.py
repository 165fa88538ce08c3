"""MuJoCo's control and bias callbacks for our motors, compiled to C functions by numba.

They are pure functions of (mjModel, mjData): which actuators are ours, and their parameters, is read from the model;
all state is in `data.act`. Nothing is cached on disk: the structure offsets are compiled in as constants.
"""

import ctypes
import functools
from typing import Any, NamedTuple

import mujoco
import numba
from numba import types
from numba.extending import register_jitable

from codrl_mj.callbacks.layout import check_layout, offset
from codrl_mj.callbacks.memory import array, f64, i32, i64, u8
from codrl_mj.motor import noise
from codrl_mj.motor.current_loop import advance, advance_imperfect, electrical_step
from codrl_mj.motor.parameters import (
    CURRENT_BIAS,
    CURRENT_NOISE,
    IMPERFECTION_NAMES,
    PARAMETER_NAMES,
    SIGNATURE,
    SUPPLY_RESISTANCE,
    TORQUE_CONSTANT,
)

ACT_NAMES = (
    "tick",
    "committed_current",
    "committed_integral",
    "committed_error",
    "current",
    "integral",
    "error",
    "voltage",
)
"""What the `act` entries of one of our actuators hold, in order: the time of the tick [s], the state at the tick, the
state one step later (the candidate), and the voltage between them."""
TICK, COMMITTED_CURRENT, COMMITTED_INTEGRAL, COMMITTED_ERROR, CURRENT, INTEGRAL, ERROR, VOLTAGE = range(len(ACT_NAMES))

IMPERFECT_ACT_NAMES = (*ACT_NAMES, "available_voltage", "noise_key")
"""The same for an actuator whose sensor or supply is imperfect: also the voltage that was available, and the key of the
sensor's noise, written at a reset and only read here. Its number of entries is what such an actuator is known by. The
last one must be finite: the engine multiplies it by the actuator's gain, 0."""
AVAILABLE_VOLTAGE, NOISE_KEY = len(ACT_NAMES), len(ACT_NAMES) + 1

for _function in (noise.philox, noise.unit, noise.standard_normal, electrical_step):
    register_jitable(_function)  # compiled code may call them; they stay what they are

MODEL_FIELDS = (
    "nu",
    "nactuator",
    "nuser_actuator",
    "opt.timestep",
    "opt.disableflags",
    "opt.disableactuator",
    "actuator_dyntype",
    "actuator_biastype",
    "actuator_actnum",
    "actuator_actadr",
    "actuator_ctrladr",
    "actuator_outadr",
    "actuator_group",
    "actuator_user",
    "actuator_ctrllimited",
    "actuator_ctrlrange",
)
DATA_FIELDS = ("time", "act", "ctrl", "actuator_velocity")
PBASE_NEIGHBOURS = ("narena", "nbuffer", "pstack", "maxuse_stack")
"""Fields of mjData around `pbase`, which the bindings do not show."""


class Callbacks(NamedTuple):
    """The compiled callbacks."""

    control: Any
    """ctypes pointer for `mjcb_control`: advances the current loops."""
    act_bias: Any
    """ctypes pointer for `mjcb_act_bias`: the motors' torque kT*i."""
    owners: tuple[Any, ...]
    """The numba objects that own the machine code: they must live as long as the pointers."""


def _nothing(*arguments: Any) -> tuple[float, float, float, float, float]:  # noqa: ARG001 - in the place of another
    return 0.0, 0.0, 0.0, 0.0, 0.0


@functools.cache
def compiled() -> Callbacks:
    """The callbacks for motors with perfect sensors and supplies; others are left alone, as foreign ones are.

    Compiled on first use (about a second) and kept for the life of the process.

    Raises:
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    return _compile(False)


@functools.cache
def compiled_imperfect() -> Callbacks:
    """The callbacks for every motor of ours, those with imperfect sensors or supplies included.

    Raises:
        LayoutError: as for `compiled`.
    """
    return _compile(True)


def _compile(imperfect: bool) -> Callbacks:
    """Compile the callbacks. Leaving out what few models need saves as much time as the rest takes.

    Args:
        imperfect: for imperfect sensors and supplies too.

    Raises:
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    check_layout(MODEL_FIELDS, (*DATA_FIELDS, *PBASE_NEIGHBOURS))
    model_at = {field: offset("mjModel", field) for field in MODEL_FIELDS}
    data_at = {field: offset("mjData", field) for field in (*DATA_FIELDS, "pbase")}
    nu_at, nactuator_at, nuser_at = model_at["nu"], model_at["nactuator"], model_at["nuser_actuator"]
    timestep_at = model_at["opt.timestep"]
    disableflags_at, disableactuator_at = model_at["opt.disableflags"], model_at["opt.disableactuator"]
    dyntype_at, biastype_at = model_at["actuator_dyntype"], model_at["actuator_biastype"]
    actnum_at, actadr_at = model_at["actuator_actnum"], model_at["actuator_actadr"]
    ctrladr_at, outadr_at = model_at["actuator_ctrladr"], model_at["actuator_outadr"]
    group_at, user_at = model_at["actuator_group"], model_at["actuator_user"]
    ctrllimited_at, ctrlrange_at = model_at["actuator_ctrllimited"], model_at["actuator_ctrlrange"]
    time_at, pbase_at = data_at["time"], data_at["pbase"]
    act_at, ctrl_at, velocity_at = data_at["act"], data_at["ctrl"], data_at["actuator_velocity"]
    user_dynamics, user_bias = int(mujoco.mjtDyn.mjDYN_USER), int(mujoco.mjtBias.mjBIAS_USER)
    no_clamp, groups, largest = int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL), mujoco.mjNGROUP, mujoco.mjMAXVAL
    act_size, user_size = len(ACT_NAMES), len(PARAMETER_NAMES)
    imperfect_act_size, imperfect_user_size = len(IMPERFECT_ACT_NAMES), user_size + len(IMPERFECTION_NAMES)
    loop = numba.njit(inline="always")(advance)
    imperfect_loop = numba.njit(advance_imperfect if imperfect else _nothing)

    @numba.njit(inline="always")
    def is_imperfect(model: int, actuator: int) -> bool:
        return (
            imperfect
            and i32(array(model, actnum_at))[actuator] == imperfect_act_size
            and i64(model + nuser_at)[0] >= imperfect_user_size
        )

    @numba.njit(inline="always")
    def is_ours(model: int, actuator: int) -> bool:
        return (
            i32(array(model, dyntype_at))[actuator] == user_dynamics
            and i64(model + nuser_at)[0] >= user_size
            and f64(array(model, user_at))[actuator * i64(model + nuser_at)[0]] == SIGNATURE
            and i32(array(model, biastype_at))[actuator] == user_bias
            and (i32(array(model, actnum_at))[actuator] == act_size or is_imperfect(model, actuator))
        )

    @numba.njit(inline="always")
    def is_disabled(model: int, actuator: int) -> bool:
        group = i32(array(model, group_at))[actuator]
        return 0 <= group < groups and (i32(model + disableactuator_at)[0] >> group) & 1 == 1

    @numba.njit(inline="always")
    def command(model: int, data: int, actuator: int) -> float:
        """The control as the engine would use it: zero if any is not a number, clamped where it is limited."""
        controls = f64(array(data, ctrl_at))
        for other in range(i64(model + nu_at)[0]):
            if not abs(controls[other]) <= largest:
                return 0.0
        control = i32(array(model, ctrladr_at))[actuator]
        value = controls[control]
        if u8(array(model, ctrllimited_at))[control] and not i32(model + disableflags_at)[0] & no_clamp:
            limits = f64(array(model, ctrlrange_at))
            value = min(max(value, limits[2 * control]), limits[2 * control + 1])
        return value

    @numba.cfunc(types.void(types.uintp, types.uintp), nogil=True, error_model="numpy")
    def control(model: int, data: int) -> None:
        if i64(model + nuser_at)[0] < user_size:
            return  # no actuator of this model can be ours
        if i64(data + pbase_at)[0] != 0:
            return  # stages 2 to 4 of RK4: the force is held over the step
        for actuator in range(i64(model + nactuator_at)[0]):
            if not is_ours(model, actuator) or is_disabled(model, actuator):
                continue
            act = f64(array(data, act_at) + 8 * i32(array(model, actadr_at))[actuator])
            time = f64(data + time_at)[0]
            if time != act[TICK]:  # a step was taken: what was the candidate has happened
                act[TICK] = time
                act[COMMITTED_CURRENT] = act[CURRENT]
                act[COMMITTED_INTEGRAL] = act[INTEGRAL]
                act[COMMITTED_ERROR] = act[ERROR]
            user = f64(array(model, user_at) + 8 * actuator * i64(model + nuser_at)[0])
            timestep = f64(model + timestep_at)[0]
            torque = command(model, data, actuator)
            speed = f64(array(data, velocity_at))[i32(array(model, outadr_at))[actuator]]
            i, total, last = act[COMMITTED_CURRENT], act[COMMITTED_INTEGRAL], act[COMMITTED_ERROR]
            if is_imperfect(model, actuator):
                current, integral, error, voltage, available = imperfect_loop(
                    user,
                    timestep,
                    i,
                    total,
                    last,
                    torque,
                    speed,
                    user[CURRENT_BIAS],
                    user[CURRENT_NOISE],
                    user[SUPPLY_RESISTANCE],
                    act[NOISE_KEY],
                    time,
                )
                act[AVAILABLE_VOLTAGE] = available
            else:
                current, integral, error, voltage = loop(user, timestep, i, total, last, torque, speed)
            act[CURRENT] = current
            act[INTEGRAL] = integral
            act[ERROR] = error
            act[VOLTAGE] = voltage

    @numba.cfunc(types.float64(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def act_bias(model: int, data: int, actuator: int) -> float:
        if not is_ours(model, actuator):
            return 0.0  # as the engine does when there is no callback
        user = f64(array(model, user_at) + 8 * actuator * i64(model + nuser_at)[0])
        act = f64(array(data, act_at) + 8 * i32(array(model, actadr_at))[actuator])
        return user[TORQUE_CONSTANT] * act[CURRENT]

    generic = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
    bias = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)
    return Callbacks(generic(control.address), bias(act_bias.address), (control, act_bias))
