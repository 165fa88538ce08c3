"""The plugin backend: functions of our MuJoCo actuator plugin, for any model.

numba compiles them to C functions. The model's actuator keeps its gear, gain, bias, dynamics and
ranges: the force that the engine would have computed from them is the desired force. Several
actuators of one joint may share an instance of the plugin. The sum of their forces is then the
motor's command. The actuator with the motor's parameters delivers the motor's force; the others
deliver none. As in the callback backend, all parameters are in the model and all state is in the
data, here in `plugin_state`. `codrl_mj.plugin` registers the plugin and calls `start`, which
installs these functions.
"""

import ctypes
import functools
import math
from collections.abc import Callable

import mujoco
from numba import types

from codrl_mj.actuators import BUILT_IN, Family, Ideal, family_id, import_path
from codrl_mj.compile_cache import CompiledCallback, cfunc, external_function, njit
from codrl_mj.engine.families import (
    INERTIA,
    MOTION,
    PARAMETERS,
    SIGNATURE,
    SLOT_HEADER_SIZE,
    SLOT_SIZE,
    USER_HEADER_SIZE,
    advance_slot,
    commit_slot,
    family_size,
    has_import_path,
    is_compiled,
    load_family,
    loaded_families,
    slot_size,
)
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import entry_address, f64, internal, named_address, stack_floats
from codrl_mj.engine.model_access import clip, command, is_disabled, output_inertia, user_address
from codrl_mj.engine.supplies import (
    ROW_SIZE,
    advance_supply,
    shares_supply,
    supply_number,
    write_row,
)
from codrl_mj.plugin import FAMILY, NAME, library, log_warning, registered_plugins

PLUGIN_HEADER_SIZE = USER_HEADER_SIZE + 1
"""Length of the header of `user` data in this backend: `user_header`, and the arm [m]."""
EXTRA_STATES = 2
"""Number of states after the actuator's slot.

They are the desired force [N], on the joint's side of the arm, and a flag that is 1 from a step's
first call to its end: calls in between are the later stages of RK4.
"""

REASONS = (
    "",
    "its actuator's user data do not begin with codrl_mj's signature, family and arm",
    "the family of its actuator's user data is not loaded",
    "its configuration and its actuator's user data name different families",
    "its actuator's user data have fewer numbers than the family has parameters; if an earlier"
    " version saved the model, add the motors again",
    "it was compiled when the family had another number of states or signals",
    "several of its actuators have a motor's user data, but only one may have them",
)
"""Reasons why an instance of the plugin is refused, by the index that `_find_fault` returns."""


_GAINS, _BIASES, _DYNAMICS = mujoco.mjNGAIN, mujoco.mjNBIAS, mujoco.mjNDYN
_AFFINE_GAIN, _AFFINE_BIAS = int(mujoco.mjtGain.mjGAIN_AFFINE), int(mujoco.mjtBias.mjBIAS_AFFINE)
_EXACT_FILTER, _MIN_VALUE = int(mujoco.mjtDyn.mjDYN_FILTEREXACT), mujoco.mjMINVAL
_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_IDEAL = family_id(Ideal)
_FIRST, _SECOND = SIGNATURE


@internal(inline="always")
def _slot_of(model: int, data: int, instance: int) -> int:
    return entry_address(DATA.plugin_state(data), MODEL.plugin_stateadr(model)[instance])


@internal(inline="always")
def _activation(model: int, data: int, actuator: int) -> float:
    """Return the activation that sets the force: the present or, if `actearly`, the next one."""
    index = MODEL.actuator_actadr(model)[actuator] + MODEL.actuator_actnum(model)[actuator] - 1
    value = DATA.act(data)[index]
    if not MODEL.actuator_actearly(model)[actuator]:
        return value
    rate, timestep = DATA.act_dot(data)[index], MODEL.opt.timestep(model)
    if MODEL.actuator_dyntype(model)[actuator] == _EXACT_FILTER:
        tau = max(_MIN_VALUE, MODEL.actuator_dynprm(model)[_DYNAMICS * actuator])
        value = value + rate * tau * (1.0 - math.exp(-timestep / tau))
    else:
        value = value + rate * timestep
    if MODEL.actuator_actlimited(model)[actuator]:
        limits = MODEL.actuator_actrange(model)
        value = clip(value, limits[2 * actuator], limits[2 * actuator + 1])
    return value


@internal(inline="always")
def _engine_force(model: int, data: int, actuator: int, length: float, velocity: float) -> float:
    """Return the actuator's force as `mj_fwdActuation` computes it."""
    # The order of the operations is the engine's, so that an ideal motor gives the same bits.
    prm, first = MODEL.actuator_gainprm(model), _GAINS * actuator
    gain = prm[first]
    if MODEL.actuator_gaintype(model)[actuator] == _AFFINE_GAIN:
        gain = prm[first] + prm[first + 1] * length + prm[first + 2] * velocity
    if MODEL.actuator_actnum(model)[actuator] == 0:
        force = gain * command(model, data, actuator)
    else:
        force = gain * _activation(model, data, actuator)
    bias = 0.0
    if MODEL.actuator_biastype(model)[actuator] == _AFFINE_BIAS:
        prm, first = MODEL.actuator_biasprm(model), _BIASES * actuator
        bias = prm[first] + prm[first + 1] * length + prm[first + 2] * velocity
    force += bias
    if MODEL.actuator_forcelimited(model)[actuator]:
        limits = MODEL.actuator_forcerange(model)
        force = clip(force, limits[2 * actuator], limits[2 * actuator + 1])
    return force


@internal(inline="always")
def _desired_force(model: int, data: int, motor: int, length: float, velocity: float) -> float:
    """Return the summed force of all actuators that share a motor, and thus its shaft and gear."""
    force = _engine_force(model, data, motor, length, velocity)
    for partner in range(MODEL.nactuator(model)):
        if (
            partner != motor
            and MODEL.actuator_plugin(model)[partner] == MODEL.actuator_plugin(model)[motor]
        ):
            force += _engine_force(model, data, partner, length, velocity)
    return force


_ATTRIBUTE = ctypes.create_string_buffer(FAMILY.encode())
_attribute_pointer = named_address("codrl_mj_attribute", ctypes.addressof(_ATTRIBUTE))
_get_config = library().mj_getPluginConfig
"""MuJoCo's function (model, instance, address of an attribute's name) -> address of its value."""
_get_config.argtypes = ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p
_get_config.restype = ctypes.c_void_p


_get_config_compiled = external_function(
    "mj_plugin_configuration", _get_config, types.uintp(types.uintp, types.int32, types.uintp)
)
"""`_get_config` for compiled code."""


@internal(inline="always")
def _is_motor(model: int, actuator: int, instance: int) -> bool:
    """Return True if an actuator of an instance has the motor's parameters."""
    if (
        MODEL.actuator_plugin(model)[actuator] != instance
        or MODEL.nuser_actuator(model) < PLUGIN_HEADER_SIZE
    ):
        return False
    user = f64(user_address(model, actuator))
    return user[0] == _FIRST and user[1] == _SECOND


@njit(nogil=True, error_model="numpy")
def _find_fault(model: int, instance: int) -> int:
    """Return the index into `REASONS` of an instance's fault; 0 if it has none."""
    num_motors = 0
    for actuator in range(MODEL.nactuator(model)):
        if not _is_motor(model, actuator, instance):
            continue
        num_motors += 1
        width, user = MODEL.nuser_actuator(model), f64(user_address(model, actuator))
        if not user[USER_HEADER_SIZE] > 0.0:
            return 1
        if not is_compiled(user[2]):
            return 2
        family_number = int(user[2])
        if not has_import_path(
            family_number, _get_config_compiled(model, instance, _attribute_pointer())
        ):
            return 3
        if width < PLUGIN_HEADER_SIZE + family_size(family_number, PARAMETERS):
            return 4
        if (
            MODEL.plugin_statenum(model)[instance]
            != family_size(family_number, SLOT_SIZE) + EXTRA_STATES
        ):
            return 5
    return 1 if num_motors == 0 else 0 if num_motors == 1 else 6


@internal(inline="always")
def _is_held(model: int, data: int, family_number: int, slot: int) -> bool:
    """Return True in stages 2 to 4 of RK4.

    There the torque is held, because a drive is sampled once per step.
    """
    states, time = f64(slot), DATA.time(data)
    flag = states[family_size(family_number, SLOT_SIZE) + 1]
    is_in_step = states[0] < time <= states[0] + MODEL.opt.timestep(model) and flag != 0.0
    return is_in_step and MODEL.opt.integrator(model) == _RK4 and family_number != _IDEAL


@internal(inline="always")
def _begin(model: int, data: int, actuator: int, slot: int) -> tuple[float, float]:
    """Begin a motor's step: return desired torque [N*m] and inertia [kg*m^2] at the shaft."""
    user, out = user_address(model, actuator), MODEL.actuator_outadr(model)[actuator]
    family_number, arm = int(f64(user)[2]), f64(user)[USER_HEADER_SIZE]
    # The callback backend multiplies by the gear 1/arm. A division by the arm would differ from it
    # in the last bits.
    gear, states = 1.0 / arm, f64(slot)
    slot_end, force = family_size(family_number, SLOT_SIZE), 0.0
    # The user may have changed the time since the state was committed.
    states[0] = DATA.time(data)
    if family_size(family_number, MOTION):
        desired = command(model, data, actuator) * gear
    else:
        length, velocity = DATA.actuator_length(data)[out], DATA.actuator_velocity(data)[out]
        force = _desired_force(model, data, actuator, length, velocity)
        desired = force * arm
    states[slot_end], states[slot_end + 1] = force, 1.0
    if family_size(family_number, INERTIA):
        return desired, output_inertia(model, data, out, gear)
    return desired, math.inf


@internal(inline="always")
def _is_on_supply(model: int, actuator: int, number: float) -> bool:
    """Return True if an enabled motor of ours is on the supply of a number."""
    instance = MODEL.actuator_plugin(model)[actuator]
    if instance < 0 or not _is_motor(model, actuator, instance) or is_disabled(model, actuator):
        return False
    user = user_address(model, actuator)
    return (
        shares_supply(int(f64(user)[2])) and supply_number(user + 8 * PLUGIN_HEADER_SIZE) == number
    )


@internal
def _advance_supply_of(model: int, data: int, motor: int) -> None:
    """Advance all motors of a supply if `motor` is the one whose instance MuJoCo computes first."""
    number = supply_number(user_address(model, motor) + 8 * PLUGIN_HEADER_SIZE)
    instances, count = MODEL.actuator_plugin(model), 0
    slot = _slot_of(model, data, instances[motor])
    for actuator in range(MODEL.nactuator(model)):
        if _is_on_supply(model, actuator, number):
            if instances[actuator] < instances[motor]:
                return
            count += 1
    if _is_held(model, data, int(f64(user_address(model, motor))[2]), slot):
        return
    rows = entry_address(stack_floats(ROW_SIZE * count), 0)
    row = rows
    # The order is that of the actuators, as in the callback backend.
    for actuator in range(MODEL.nactuator(model)):
        if not _is_on_supply(model, actuator, number):
            continue
        user, out = user_address(model, actuator), MODEL.actuator_outadr(model)[actuator]
        slot, gear = _slot_of(model, data, instances[actuator]), 1.0 / f64(user)[USER_HEADER_SIZE]
        desired, inertia = _begin(model, data, actuator, slot)
        write_row(
            row,
            int(f64(user)[2]),
            user + 8 * PLUGIN_HEADER_SIZE,
            slot,
            slot + 8 * SLOT_HEADER_SIZE,
            desired,
            DATA.actuator_length(data)[out] * gear,
            DATA.actuator_velocity(data)[out] * gear,
            DATA.time(data),
            inertia,
        )
        row += 8 * ROW_SIZE
    advance_supply(rows, count, MODEL.opt.timestep(model))


@functools.cache
def compiled_entries() -> dict[str, CompiledCallback[..., int | None]]:
    """Return the plugin's functions by their names in `mjpPlugin`, compiled on first use.

    The cache keeps them alive for as long as the process runs, because MuJoCo holds only their
    addresses.
    """

    @cfunc(
        types.void(types.uintp, types.uintp, types.int32, types.int32),
        nogil=True,
        error_model="numpy",
    )
    def compute(model: int, data: int, instance: int, capability: int) -> None:  # noqa: ARG001
        time, timestep = DATA.time(data), MODEL.opt.timestep(model)
        slot = _slot_of(model, data, instance)
        states = f64(slot)
        for actuator in range(MODEL.nactuator(model)):
            if not _is_motor(model, actuator, instance) or is_disabled(model, actuator):
                continue
            user, out = user_address(model, actuator), MODEL.actuator_outadr(model)[actuator]
            family_number = int(f64(user)[2])
            gear = 1.0 / f64(user)[USER_HEADER_SIZE]
            if shares_supply(family_number):
                _advance_supply_of(model, data, actuator)
            elif not _is_held(model, data, family_number, slot):
                desired, inertia = _begin(model, data, actuator, slot)
                length = DATA.actuator_length(data)[out]
                velocity = DATA.actuator_velocity(data)[out]
                advance_slot(
                    *(family_number, user + 8 * PLUGIN_HEADER_SIZE, timestep, slot, desired),
                    *(length * gear, velocity * gear, time, inertia),
                )
                if family_size(family_number, MOTION):
                    states[family_size(family_number, SLOT_SIZE)] = states[2] * gear
            DATA.actuator_force(data)[out] = states[2] * gear

    @cfunc(types.void(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def advance(model: int, data: int, instance: int) -> None:
        for actuator in range(MODEL.nactuator(model)):
            if _is_motor(model, actuator, instance):
                family_number, slot = (
                    int(f64(user_address(model, actuator))[2]),
                    _slot_of(model, data, instance),
                )
                commit_slot(family_number, slot, DATA.time(data))
                f64(slot)[family_size(family_number, SLOT_SIZE) + 1] = 0.0

    @cfunc(
        types.void(types.uintp, types.uintp, types.uintp, types.int32),
        nogil=True,
        error_model="numpy",
    )
    def reset(model: int, state: int, data: int, instance: int) -> None:  # noqa: ARG001
        for entry in range(MODEL.plugin_statenum(model)[instance]):
            f64(state)[entry] = 0.0

    init_instance: Callable[[int, int], int] = external_function(
        "codrl_mj_init_instance", _INIT_INSTANCE, types.int32(types.uintp, types.int32)
    )

    @cfunc(types.int32(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def init(model: int, data: int, instance: int) -> int:  # noqa: ARG001
        if _find_fault(model, instance) == 0:
            return 0
        return init_instance(model, instance)

    return {"init": init, "reset": reset, "compute": compute, "advance": advance}


def start(model: int, data: int, instance: int) -> int:
    """Run the plugin's first `init`, with addresses of mjModel and mjData.

    From then on MuJoCo calls the compiled functions instead of the plugin's Python functions.
    """
    del data
    structure = registered_plugins()[NAME][1]
    for name, function in compiled_entries().items():
        setattr(structure, name, function.address)
    return _init_instance(model, instance)


def num_states(model: int, instance: int) -> int:
    """Return the plugin's `nstate`, the number of states of an instance."""
    return slot_size(_family(model, instance)) + EXTRA_STATES


def _family(model: int, instance: int) -> Family:
    """Return the family that an instance names in its configuration.

    Only built-in families and those that the user has loaded are accepted, because a model file
    must not cause an import of code.
    """
    text = _get_config(model, instance, ctypes.addressof(_ATTRIBUTE))
    name = ctypes.string_at(text).decode() if text else ""
    for family in (*loaded_families(), *BUILT_IN):
        if import_path(family) == name:
            return family
    raise ValueError(
        f"its family {name!r} is not loaded, and a model must not import code: import its"
        " module and call codrl_mj.engine.load_family with it before you load the model"
    )


def _init_instance(model: int, instance: int) -> int:
    """Compile an instance's family and check the instance; return 0, or warn and return -1."""
    try:
        load_family(_family(model, instance))
        fault = _find_fault(model, instance)
        if fault:
            raise ValueError(REASONS[fault])
    except Exception as error:
        # MuJoCo calls this from C, where an exception cannot be raised.
        log_warning(f"plugin instance {instance}: {error}")
        return -1
    return 0


_INIT_INSTANCE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(_init_instance)
"""`_init_instance` as a C function."""
