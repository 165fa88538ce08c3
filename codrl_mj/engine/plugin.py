"""What MuJoCo's actuator plugin of ours runs, compiled to C functions by numba: the door for models of anybody's.

The actuator keeps whatever it has (gear, gain, bias, dynamics, ranges): the force that the engine
would have produced by them is the desired one. Several actuators of one joint may share an instance
of the plugin: the motor is asked for the sum of their forces, the actuator with its parameters
delivers it, and the others deliver none. As at the other door all parameters are the model's and
all state is the data's, here in `plugin_state`. The plugin is registered, and these functions get
into it, by `codrl_mj.plugin`.
"""

import ctypes
import functools
import math
from typing import Any

import mujoco
from numba import types

from codrl_mj.actuators import BUILT_IN, Ideal, family_id, import_path
from codrl_mj.compile_cache import cfunc, external, njit
from codrl_mj.engine.doors import clip, command, inertia_at, is_disabled, user_of
from codrl_mj.engine.families import (
    HEAD,
    INERTIA,
    MOTION,
    PARAMETERS,
    SIGNATURE,
    WHOLE,
    advance_slot,
    commit_slot,
    is_called,
    is_compiled,
    load_family,
    loaded_families,
    size_of,
    slot_size,
)
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import at, f64, internal, symbol
from codrl_mj.plugin import FAMILY, NAME, complain, library, registered

PLUGIN_HEAD = HEAD + 1
"""The `user` data begin with `user_head` and the actuator's arm [m]."""
EXTRA_STATES = 2
"""After the actuator's slot: the desired force [N], at the joint's side of the arm; and 1 between a
step's first call and its end, where further calls within it are stages of RK4.
"""

REASONS = (
    "",
    "its actuator's user data do not begin with codrl_mj's signature, family and arm",
    "the family of its actuator's user data is not loaded",
    "its configuration and its actuator's user data name different families",
    "its actuator's user data have fewer numbers than the family has parameters",
    "it was compiled when the family had another number of states or signals",
    "several of its actuators have a motor's user data, and one only can",
)


_GAINS, _BIASES, _DYNAMICS = mujoco.mjNGAIN, mujoco.mjNBIAS, mujoco.mjNDYN
_AFFINE_GAIN, _AFFINE_BIAS = int(mujoco.mjtGain.mjGAIN_AFFINE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_EXACT_FILTER, _LEAST = int(mujoco.mjtDyn.mjDYN_FILTEREXACT), mujoco.mjMINVAL
_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_IDEAL = family_id(Ideal)
_FIRST, _SECOND = SIGNATURE


@internal(inline="always")
def _slot_of(model: int, data: int, instance: int) -> int:
    return at(DATA.plugin_state(data), MODEL.plugin_stateadr(model)[instance])


@internal(inline="always")
def _activation(model: int, data: int, actuator: int) -> float:
    """The activation that the force is made of: the present one, or the next (`mj_nextActivation`)."""
    place = MODEL.actuator_actadr(model)[actuator] + MODEL.actuator_actnum(model)[actuator] - 1
    value = DATA.act(data)[place]
    if not MODEL.actuator_actearly(model)[actuator]:
        return value
    rate, timestep = DATA.act_dot(data)[place], MODEL.opt.timestep(model)
    if MODEL.actuator_dyntype(model)[actuator] == _EXACT_FILTER:
        tau = max(_LEAST, MODEL.actuator_dynprm(model)[_DYNAMICS * actuator])
        value = value + rate * tau * (1.0 - math.exp(-timestep / tau))
    else:
        value = value + rate * timestep
    if MODEL.actuator_actlimited(model)[actuator]:
        limits = MODEL.actuator_actrange(model)
        value = clip(value, limits[2 * actuator], limits[2 * actuator + 1])
    return value


@internal(inline="always")
def _engine_force(model: int, data: int, actuator: int, length: float, velocity: float) -> float:
    """What the engine makes of the actuator in `mj_fwdActuation`, in its order."""
    prm, own = MODEL.actuator_gainprm(model), _GAINS * actuator
    gain = prm[own]
    if MODEL.actuator_gaintype(model)[actuator] == _AFFINE_GAIN:
        gain = prm[own] + prm[own + 1] * length + prm[own + 2] * velocity
    if MODEL.actuator_actnum(model)[actuator] == 0:
        force = gain * command(model, data, actuator)
    else:
        force = gain * _activation(model, data, actuator)
    bias = 0.0
    if MODEL.actuator_biastype(model)[actuator] == _AFFINE_BIAS:
        prm, own = MODEL.actuator_biasprm(model), _BIASES * actuator
        bias = prm[own] + prm[own + 1] * length + prm[own + 2] * velocity
    force += bias
    if MODEL.actuator_forcelimited(model)[actuator]:
        limits = MODEL.actuator_forcerange(model)
        force = clip(force, limits[2 * actuator], limits[2 * actuator + 1])
    return force


@internal(inline="always")
def _asked_force(model: int, data: int, motor: int, length: float, velocity: float) -> float:
    """Return the sum of the forces of all actuators that share a motor: they have one shaft and one gear."""
    force = _engine_force(model, data, motor, length, velocity)
    for other in range(MODEL.nactuator(model)):
        if (
            other != motor
            and MODEL.actuator_plugin(model)[other] == MODEL.actuator_plugin(model)[motor]
        ):
            force += _engine_force(model, data, other, length, velocity)
    return force


_ATTRIBUTE = ctypes.create_string_buffer(FAMILY.encode())
_attribute_at = symbol("codrl_mj_attribute", ctypes.addressof(_ATTRIBUTE))
_configuration_of = library().mj_getPluginConfig
"""(model, instance, address of an attribute's name) -> address of its value."""
_configuration_of.argtypes = ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p
_configuration_of.restype = ctypes.c_void_p


_configured = external(
    "mj_plugin_configuration", _configuration_of, types.uintp(types.uintp, types.int32, types.uintp)
)
"""The same for compiled code."""


@internal(inline="always")
def _is_motor(model: int, actuator: int, instance: int) -> bool:
    """Return True if an actuator of an instance has the motor's parameters."""
    if (
        MODEL.actuator_plugin(model)[actuator] != instance
        or MODEL.nuser_actuator(model) < PLUGIN_HEAD
    ):
        return False
    user = f64(user_of(model, actuator))
    return user[0] == _FIRST and user[1] == _SECOND


@njit(nogil=True, error_model="numpy")
def _verdict(model: int, instance: int) -> int:
    """Index into `REASONS`: what is wrong with an instance."""
    count = 0
    for actuator in range(MODEL.nactuator(model)):
        if not _is_motor(model, actuator, instance):
            continue
        count += 1
        width, user = MODEL.nuser_actuator(model), f64(user_of(model, actuator))
        if not user[HEAD] > 0.0:
            return 1
        if not is_compiled(user[2]):
            return 2
        number = int(user[2])
        if not is_called(number, _configured(model, instance, _attribute_at())):
            return 3
        if width < PLUGIN_HEAD + size_of(number, PARAMETERS):
            return 4
        if MODEL.plugin_statenum(model)[instance] != size_of(number, WHOLE) + EXTRA_STATES:
            return 5
    return 1 if count == 0 else 0 if count == 1 else 6


@functools.cache
def compiled_entries() -> dict[str, Any]:
    """The functions by their names in `mjpPlugin`, compiled on first use and kept for the life of the process."""

    @cfunc(
        types.void(types.uintp, types.uintp, types.int32, types.int32),
        nogil=True,
        error_model="numpy",
    )
    def compute(model: int, data: int, instance: int, capability: int) -> None:  # noqa: ARG001
        time, timestep = DATA.time(data), MODEL.opt.timestep(model)
        slot = _slot_of(model, data, instance)
        own = f64(slot)
        for actuator in range(MODEL.nactuator(model)):
            if not _is_motor(model, actuator, instance) or is_disabled(model, actuator):
                continue
            user, out = user_of(model, actuator), MODEL.actuator_outadr(model)[actuator]
            number, arm = int(f64(user)[2]), f64(user)[HEAD]
            whole = size_of(number, WHOLE)
            gear = 1.0 / arm  # as at the other door, which multiplies by it
            # stages 2 to 4 of RK4: a drive is sampled once a step, and its torque held
            within = own[0] < time <= own[0] + timestep and own[whole + 1] != 0.0
            held = within and MODEL.opt.integrator(model) == _RK4 and number != _IDEAL
            if not held:
                length = DATA.actuator_length(data)[out]
                velocity = DATA.actuator_velocity(data)[out]
                own[0] = time  # of the committed state, also after somebody set the time
                motion, force = size_of(number, MOTION) != 0, 0.0
                if motion:
                    asked = command(model, data, actuator) * gear
                else:
                    force = _asked_force(model, data, actuator, length, velocity)
                    asked = force * arm
                load = inertia_at(model, data, out, gear) if size_of(number, INERTIA) else math.inf
                advance_slot(
                    *(number, user + 8 * PLUGIN_HEAD, timestep, slot, asked),
                    *(length * gear, velocity * gear, time, load),
                )
                own[whole], own[whole + 1] = own[2] * gear if motion else force, 1.0
            DATA.actuator_force(data)[out] = own[2] * gear

    @cfunc(types.void(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def advance(model: int, data: int, instance: int) -> None:
        for actuator in range(MODEL.nactuator(model)):
            if _is_motor(model, actuator, instance):
                number, slot = (
                    int(f64(user_of(model, actuator))[2]),
                    _slot_of(model, data, instance),
                )
                commit_slot(number, slot, DATA.time(data))
                f64(slot)[size_of(number, WHOLE) + 1] = 0.0

    @cfunc(
        types.void(types.uintp, types.uintp, types.uintp, types.int32),
        nogil=True,
        error_model="numpy",
    )
    def reset(model: int, state: int, data: int, instance: int) -> None:  # noqa: ARG001
        for entry in range(MODEL.plugin_statenum(model)[instance]):
            f64(state)[entry] = 0.0

    complaint = external("codrl_mj_judge", _JUDGE, types.int32(types.uintp, types.int32))

    @cfunc(types.int32(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def init(model: int, data: int, instance: int) -> int:  # noqa: ARG001
        if _verdict(model, instance) == 0:
            return 0
        return complaint(model, instance)

    return {"init": init, "reset": reset, "compute": compute, "advance": advance}


def start(model: int, data: int, instance: int) -> int:
    """The plugin's first `init`, with addresses of mjModel and mjData: from here on MuJoCo calls what is compiled."""
    del data
    structure = registered()[NAME][1]
    for name, function in compiled_entries().items():
        setattr(structure, name, function.address)
    return _judge(model, instance)


def states_of(model: int, instance: int) -> int:
    """The plugin's `nstate`: how many numbers of state an instance's actuator has."""
    return slot_size(_family(model, instance)) + EXTRA_STATES


def _family(model: int, instance: int) -> Any:
    """The family that a model names. No model has code imported: it is ours, or the user has loaded it."""
    text = _configuration_of(model, instance, ctypes.addressof(_ATTRIBUTE))
    name = ctypes.string_at(text).decode() if text else ""
    for family in (*loaded_families(), *BUILT_IN):
        if import_path(family) == name:
            return family
    raise ValueError(
        f"its family {name!r} is not loaded, and is not imported because a model says so: import"
        " its module and call codrl_mj.engine.load_family with it before the model is loaded"
    )


def _judge(model: int, instance: int) -> int:
    """`init` of an instance whose family has yet to be compiled, or that is wrong: 0, or -1 and a warning."""
    try:
        load_family(_family(model, instance))
        verdict = _verdict(model, instance)
        if verdict:
            raise ValueError(REASONS[verdict])
    except Exception as error:  # there is nobody to raise it to
        complain(f"plugin instance {instance}: {error}")
        return -1
    return 0


_JUDGE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(_judge)
"""As C calls it."""
