"""What MuJoCo's actuator plugin of ours runs, compiled to C functions by numba: the door for models of anybody's.

The actuator keeps whatever it has (gear, gain, bias, dynamics, ranges): the force that the engine would have produced
by them is the desired one. As at the other door all parameters are the model's and all state is the data's, here in
`plugin_state`. The plugin is registered, and these functions get into it, by `codrl_mj.plugin`.
"""

import ctypes
import functools
import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import mujoco
import numba
from numba import types

from codrl_mj.actuators import BUILT_IN, Ideal, family_number, reference
from codrl_mj.engine.commands import COMMAND_DATA_FIELDS, COMMAND_MODEL_FIELDS, clip, commands
from codrl_mj.engine.families import (
    HEAD,
    SIGNATURE,
    advance_slot,
    asked_motion,
    asks_inertia,
    commit_slot,
    is_called,
    is_compiled,
    load_family,
    loaded_families,
    parameter_count,
    size_of,
    slot_size,
)
from codrl_mj.engine.inertia import seen_from
from codrl_mj.engine.layout import check_layout, offset
from codrl_mj.engine.memory import array, f64, i32, i64, internal, u8
from codrl_mj.plugin import FAMILY, NAME, complain, library, registered

PLUGIN_HEAD = HEAD + 1
"""The `user` data begin with `Head` and the actuator's arm [m]."""
EXTRA_STATES = 2
"""After the actuator's slot: the desired force [N], at the joint's side of the arm; and 1 between a step's first call
and its end, where further calls within it are stages of RK4."""

MODEL_FIELDS = (
    *COMMAND_MODEL_FIELDS,
    *("nactuator", "nuser_actuator", "opt.timestep", "opt.integrator", "plugin_stateadr", "plugin_statenum"),
    *("actuator_plugin", "actuator_user", "actuator_outadr", "actuator_actadr", "actuator_actnum", "actuator_actearly"),
    *("actuator_actlimited", "actuator_actrange", "actuator_dyntype", "actuator_dynprm", "actuator_gaintype"),
    *("actuator_gainprm", "actuator_biastype", "actuator_biasprm", "actuator_forcelimited", "actuator_forcerange"),
)
DATA_FIELDS = (
    *COMMAND_DATA_FIELDS,
    *("time", "act", "act_dot", "actuator_length", "actuator_velocity", "actuator_force"),
)
STATE_NEIGHBOURS = ("qacc_warmstart", "ctrl")
"""Fields of mjData around `plugin_state`, which is empty in models without a plugin that has states."""

REASONS = (
    "",
    "its actuator's user data do not begin with codrl_mj's signature, family and arm",
    "the family of its actuator's user data is not loaded",
    "its configuration and its actuator's user data name different families",
    "its actuator's user data have fewer numbers than the family has parameters",
    "it was compiled when the family had another number of states or signals",
)


class Functions(NamedTuple):
    """The compiled functions."""

    plugin: dict[str, Any]
    """Those of the plugin, by their names in `mjpPlugin`."""
    verdict: Any
    """(model, instance) -> index into `REASONS`: what is wrong with an instance."""
    owners: tuple[Any, ...]
    """What they hold addresses of."""


@functools.cache
def compiled() -> Functions:
    """Compile the functions on first use and keep them for the life of the process.

    Raises:
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    # within the compiler of a model, which is not reentrant in its thread
    with ThreadPoolExecutor(1) as thread:
        thread.submit(check_layout, MODEL_FIELDS, (*DATA_FIELDS, *STATE_NEIGHBOURS)).result()
    model_at = {field: offset("mjModel", field) for field in MODEL_FIELDS}
    data_at = {field: offset("mjData", field) for field in (*DATA_FIELDS, "plugin_state")}
    nactuator_at, nuser_at = model_at["nactuator"], model_at["nuser_actuator"]
    timestep_at, integrator_at = model_at["opt.timestep"], model_at["opt.integrator"]
    stateadr_at, statenum_at = model_at["plugin_stateadr"], model_at["plugin_statenum"]
    plugin_at, user_at, outadr_at = (model_at[f"actuator_{name}"] for name in ("plugin", "user", "outadr"))
    actadr_at, actnum_at, actearly_at, actlimited_at, actrange_at = (
        model_at[f"actuator_{name}"] for name in ("actadr", "actnum", "actearly", "actlimited", "actrange")
    )
    dyntype_at, dynprm_at, gaintype_at, gainprm_at = (
        model_at[f"actuator_{name}"] for name in ("dyntype", "dynprm", "gaintype", "gainprm")
    )
    biastype_at, biasprm_at, forcelimited_at, forcerange_at = (
        model_at[f"actuator_{name}"] for name in ("biastype", "biasprm", "forcelimited", "forcerange")
    )
    time_at, act_at, act_dot_at, state_at = (data_at[name] for name in ("time", "act", "act_dot", "plugin_state"))
    length_at, velocity_at, force_at = (data_at[f"actuator_{name}"] for name in ("length", "velocity", "force"))
    gains, biases, dynamics = mujoco.mjNGAIN, mujoco.mjNBIAS, mujoco.mjNDYN
    affine_gain, affine_bias = int(mujoco.mjtGain.mjGAIN_AFFINE), int(mujoco.mjtBias.mjBIAS_AFFINE)
    exact_filter, least = int(mujoco.mjtDyn.mjDYN_FILTEREXACT), mujoco.mjMINVAL
    rk4 = int(mujoco.mjtIntegrator.mjINT_RK4)
    command, is_disabled = commands()
    first, second = SIGNATURE
    ideal = family_number(Ideal)

    @internal(inline="always")
    def user_of(model: int, actuator: int) -> int:
        return array(model, user_at) + 8 * actuator * i64(model + nuser_at)[0]

    @internal(inline="always")
    def slot_of(model: int, data: int, instance: int) -> int:
        return array(data, state_at) + 8 * i32(array(model, stateadr_at))[instance]

    @internal(inline="always")
    def activation(model: int, data: int, actuator: int) -> float:
        """The activation that the force is made of: the present one, or the next (`mj_nextActivation`)."""
        place = i32(array(model, actadr_at))[actuator] + i32(array(model, actnum_at))[actuator] - 1
        value = f64(array(data, act_at))[place]
        if not u8(array(model, actearly_at))[actuator]:
            return value
        rate, timestep = f64(array(data, act_dot_at))[place], f64(model + timestep_at)[0]
        if i32(array(model, dyntype_at))[actuator] == exact_filter:
            tau = max(least, f64(array(model, dynprm_at))[dynamics * actuator])
            value = value + rate * tau * (1.0 - math.exp(-timestep / tau))
        else:
            value = value + rate * timestep
        if u8(array(model, actlimited_at))[actuator]:
            limits = f64(array(model, actrange_at))
            value = clip(value, limits[2 * actuator], limits[2 * actuator + 1])
        return value

    @internal(inline="always")
    def engine_force(model: int, data: int, actuator: int, length: float, velocity: float) -> float:
        """What the engine makes of the actuator in `mj_fwdActuation`, in its order."""
        prm = f64(array(model, gainprm_at) + 8 * gains * actuator)
        gain = prm[0]
        if i32(array(model, gaintype_at))[actuator] == affine_gain:
            gain = prm[0] + prm[1] * length + prm[2] * velocity
        if i32(array(model, actnum_at))[actuator] == 0:
            force = gain * command(model, data, actuator)
        else:
            force = gain * activation(model, data, actuator)
        bias = 0.0
        if i32(array(model, biastype_at))[actuator] == affine_bias:
            prm = f64(array(model, biasprm_at) + 8 * biases * actuator)
            bias = prm[0] + prm[1] * length + prm[2] * velocity
        force += bias
        if u8(array(model, forcelimited_at))[actuator]:
            limits = f64(array(model, forcerange_at))
            force = clip(force, limits[2 * actuator], limits[2 * actuator + 1])
        return force

    @numba.cfunc(types.void(types.uintp, types.uintp, types.int32, types.int32), nogil=True, error_model="numpy")
    def compute(model: int, data: int, instance: int, capability: int) -> None:  # noqa: ARG001
        time, timestep = f64(data + time_at)[0], f64(model + timestep_at)[0]
        slot = slot_of(model, data, instance)
        own = f64(slot)
        for actuator in range(i64(model + nactuator_at)[0]):
            if i32(array(model, plugin_at))[actuator] != instance or is_disabled(model, actuator):
                continue
            user, out = user_of(model, actuator), i32(array(model, outadr_at))[actuator]
            number, arm = int(f64(user)[2]), f64(user)[HEAD]
            gear = 1.0 / arm  # as at the other door, which multiplies by it
            # stages 2 to 4 of RK4: a drive is sampled once a step, and its torque held
            within = own[0] < time <= own[0] + timestep and own[size_of(number) + 1] != 0.0
            held = within and i32(model + integrator_at)[0] == rk4 and number != ideal
            if not held:
                length = f64(array(data, length_at))[out]
                velocity = f64(array(data, velocity_at))[out]
                own[0] = time  # of the committed state, also after somebody set the time
                motion, force = asked_motion(number), 0.0
                if motion:
                    asked = command(model, data, actuator) * gear
                else:
                    force = engine_force(model, data, actuator, length, velocity)
                    asked = force * arm
                load = seen_from(model, data, out, gear) if asks_inertia(number) else math.inf
                advance_slot(
                    *(number, user + 8 * PLUGIN_HEAD, timestep, slot, asked),
                    *(length * gear, velocity * gear, time, load),
                )
                own[size_of(number)], own[size_of(number) + 1] = own[2] * gear if motion else force, 1.0
            f64(array(data, force_at))[out] = own[2] * gear

    @numba.cfunc(types.void(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def advance(model: int, data: int, instance: int) -> None:
        for actuator in range(i64(model + nactuator_at)[0]):
            if i32(array(model, plugin_at))[actuator] == instance:
                number, slot = int(f64(user_of(model, actuator))[2]), slot_of(model, data, instance)
                commit_slot(number, slot, f64(data + time_at)[0])
                f64(slot)[size_of(number) + 1] = 0.0

    @numba.cfunc(types.void(types.uintp, types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def reset(model: int, state: int, data: int, instance: int) -> None:  # noqa: ARG001
        for entry in range(i32(array(model, statenum_at))[instance]):
            f64(state)[entry] = 0.0

    configuration_of = _configuration_function()
    attribute = ctypes.create_string_buffer(FAMILY.encode())
    attribute_at = ctypes.addressof(attribute)

    @numba.njit(nogil=True, error_model="numpy")
    def verdict(model: int, instance: int) -> int:
        for actuator in range(i64(model + nactuator_at)[0]):
            if i32(array(model, plugin_at))[actuator] != instance:
                continue
            width, user = i64(model + nuser_at)[0], f64(user_of(model, actuator))
            if width < PLUGIN_HEAD or user[0] != first or user[1] != second or not user[HEAD] > 0.0:
                return 1
            if not is_compiled(user[2]):
                return 2
            number = int(user[2])
            if not is_called(number, configuration_of(model, instance, attribute_at)):
                return 3
            if width < PLUGIN_HEAD + parameter_count(number):
                return 4
            if i32(array(model, statenum_at))[instance] != size_of(number) + EXTRA_STATES:
                return 5
        return 0

    complaint = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(_judge)

    @numba.cfunc(types.int32(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def init(model: int, data: int, instance: int) -> int:  # noqa: ARG001
        if verdict(model, instance) == 0:
            return 0
        return complaint(model, instance)

    functions = {"init": init, "reset": reset, "compute": compute, "advance": advance}
    return Functions(functions, verdict, (attribute, complaint))


def _configuration_function() -> Any:
    """(model, instance, address of an attribute's name) -> address of its value."""
    function = library().mj_getPluginConfig
    function.argtypes, function.restype = (ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
    return function


def start(model: int, data: int, instance: int) -> int:
    """The plugin's first `init`, with addresses of mjModel and mjData: from here on MuJoCo calls what is compiled."""
    del data
    functions = compiled().plugin
    structure = registered()[NAME][1]
    for name, function in functions.items():
        setattr(structure, name, function.address)
    return _judge(model, instance)


def states_of(model: int, instance: int) -> int:
    """The plugin's `nstate`: how many numbers of state an instance's actuator has.

    Raises:
        ValueError: its family is not known.
    """
    return slot_size(_family(_configuration(model, instance))) + EXTRA_STATES


def _configuration(model: int, instance: int) -> str:
    attribute = ctypes.create_string_buffer(FAMILY.encode())  # held until it has been read
    text = _configuration_function()(model, instance, ctypes.addressof(attribute))
    return ctypes.string_at(text).decode() if text else ""


def _family(name: str) -> Any:
    """The family that a model names. A model must not have code imported: only ours is, and what the user has loaded.

    Raises:
        ValueError: it is somebody else's and was not loaded.
    """
    for family in (*loaded_families(), *BUILT_IN):
        if reference(family) == name:
            return family
    raise ValueError(
        f"its family {name!r} is not loaded, and is not imported because a model says so: import its module and call "
        "codrl_mj.load_family with it before the model is loaded"
    )


def _judge(model: int, instance: int) -> int:
    """`init` of an instance whose family has yet to be compiled, or that is wrong: 0, or -1 and a warning."""
    try:
        load_family(_family(_configuration(model, instance)))
        verdict = compiled().verdict(model, instance)
        if verdict:
            raise ValueError(REASONS[verdict])
    except Exception as error:  # there is nobody to raise it to
        complain(f"plugin instance {instance}: {error}")
        return -1
    return 0
