"""The callback backend: MuJoCo's control and bias callbacks that run our actuators in our tasks.

numba compiles them to C functions. They have no state of their own: they recognize our actuators
and read their parameters in the model's user data, and keep all state in `data.act`. The offsets of
the structures' fields are constants in the code, so they are part of its key in the cache on disk.
"""

import ctypes
import functools
import math
from collections.abc import Callable

import mujoco
from numba import types

from codrl_mj.compile_cache import cfunc
from codrl_mj.engine.families import (
    INERTIA,
    PARAMETERS,
    SIGNATURE,
    SLOT_HEADER_SIZE,
    SLOT_SIZE,
    USER_HEADER_SIZE,
    advance_slot,
    commit_slot,
    family_size,
    is_compiled,
)
from codrl_mj.engine.hill import hill_callbacks
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import (
    CFunction,
    callback,
    entry_address,
    f64,
    internal,
    stack_floats,
)
from codrl_mj.engine.model_access import command, is_disabled, output_inertia, user_address
from codrl_mj.engine.supplies import (
    ROW_SIZE,
    advance_supply,
    shares_supply,
    supply_number,
    write_row,
)

_USER_DYNAMICS, _USER_BIAS = int(mujoco.mjtDyn.mjDYN_USER), int(mujoco.mjtBias.mjBIAS_USER)
_FIRST, _SECOND = SIGNATURE


@internal(inline="always")
def _slot_of(model: int, data: int, actuator: int) -> int:
    return entry_address(DATA.act(data), MODEL.actuator_actadr(model)[actuator])


@internal(inline="always")
def _is_ours(model: int, actuator: int) -> bool:
    if (
        MODEL.actuator_dyntype(model)[actuator] != _USER_DYNAMICS
        or MODEL.nuser_actuator(model) < USER_HEADER_SIZE
    ):
        return False
    user = f64(user_address(model, actuator))
    return (
        user[0] == _FIRST
        and user[1] == _SECOND
        and is_compiled(user[2])
        and MODEL.nuser_actuator(model) >= USER_HEADER_SIZE + family_size(int(user[2]), PARAMETERS)
        and MODEL.actuator_biastype(model)[actuator] == _USER_BIAS
        and MODEL.actuator_actnum(model)[actuator] == family_size(int(user[2]), SLOT_SIZE)
    )


@internal(inline="always")
def _is_on_supply(model: int, actuator: int, number: float) -> bool:
    """Return True if an enabled actuator of ours is on the supply of a number."""
    if not _is_ours(model, actuator) or is_disabled(model, actuator):
        return False
    user = user_address(model, actuator)
    return shares_supply(int(f64(user)[2])) and supply_number(user + 8 * USER_HEADER_SIZE) == number


@internal
def _advance_supply_of(model: int, data: int, first: int) -> None:
    """Advance all actuators of a supply, unless an actuator before `first` has done so."""
    time, count = DATA.time(data), 0
    number = supply_number(user_address(model, first) + 8 * USER_HEADER_SIZE)
    for actuator in range(first):
        if _is_on_supply(model, actuator, number):
            return
    for actuator in range(first, MODEL.nactuator(model)):
        count += _is_on_supply(model, actuator, number)
    rows = entry_address(stack_floats(ROW_SIZE * count), 0)
    row = rows
    for actuator in range(first, MODEL.nactuator(model)):
        if not _is_on_supply(model, actuator, number):
            continue
        user, slot = user_address(model, actuator), _slot_of(model, data, actuator)
        family_number, out = int(f64(user)[2]), MODEL.actuator_outadr(model)[actuator]
        if f64(slot)[0] != time:
            commit_slot(family_number, slot, time)
        write_row(
            row,
            family_number,
            user + 8 * USER_HEADER_SIZE,
            slot,
            slot + 8 * SLOT_HEADER_SIZE,
            command(model, data, actuator),
            DATA.actuator_length(data)[out],
            DATA.actuator_velocity(data)[out],
            time,
            output_inertia(model, data, out, 1.0),
        )
        row += 8 * ROW_SIZE
    advance_supply(rows, count, MODEL.opt.timestep(model))


@functools.cache
def motor_callbacks() -> dict[str, CFunction]:
    """Return the motors' callbacks by MuJoCo's names, in the form that its setters accept.

    `control` advances the actuators; `act_bias` returns the torque that they deliver. They are
    compiled on first use. The cache keeps them alive for as long as the process runs, because
    MuJoCo holds only their addresses.
    """

    @cfunc(types.void(types.uintp, types.uintp), nogil=True, error_model="numpy")
    def control(model: int, data: int) -> None:
        if MODEL.nuser_actuator(model) < USER_HEADER_SIZE:
            # Without room for our signature no actuator of this model can be ours.
            return
        if DATA.pbase(data) != 0:
            # The engine calls this with an open stack frame only in stages 2 to 4 of RK4. A drive
            # is sampled once per step, so its force is held in these stages.
            return
        time, timestep = DATA.time(data), MODEL.opt.timestep(model)
        for actuator in range(MODEL.nactuator(model)):
            if not _is_ours(model, actuator) or is_disabled(model, actuator):
                continue
            user, slot = user_address(model, actuator), _slot_of(model, data, actuator)
            family_number = int(f64(user)[2])
            if shares_supply(family_number):
                _advance_supply_of(model, data, actuator)
                continue
            # The engine may call this several times at one time (mj_forward, then mj_step). The
            # candidate state becomes the state only after time has advanced.
            if time != f64(slot)[0]:
                commit_slot(family_number, slot, time)
            out = MODEL.actuator_outadr(model)[actuator]
            advance_slot(
                family_number,
                user + 8 * USER_HEADER_SIZE,
                timestep,
                slot,
                command(model, data, actuator),
                DATA.actuator_length(data)[out],
                DATA.actuator_velocity(data)[out],
                time,
                output_inertia(model, data, out, 1.0)
                if family_size(family_number, INERTIA)
                else math.inf,
            )

    @cfunc(types.float64(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def act_bias(model: int, data: int, actuator: int) -> float:
        if not _is_ours(model, actuator):
            # The engine's own value for a user bias without a callback.
            return 0.0
        return f64(_slot_of(model, data, actuator))[2]

    return {
        "control": callback(control),
        "act_bias": callback(act_bias, ctypes.c_double, ctypes.c_int),
    }


# -- installation of the callbacks, which never replaces those of other libraries --

_GROUPS: dict[str, tuple[tuple[str, ...], Callable[[], dict[str, CFunction]], str]] = {
    "motor": (("control", "act_bias"), motor_callbacks, "actuator='ideal' or physics='analytic'"),
    "hill": (("passive",), hill_callbacks, "physics='analytic'"),
}
"""Group -> names of its callbacks, as in `mujoco.set_mjcb_NAME`; function that returns the compiled
callbacks by name; and settings of an environment that does not need them.
"""


class CallbackInUseError(RuntimeError):
    """Another library has set a MuJoCo callback that the package needs."""


_INSTALLED: dict[str, CFunction] = {}
"""The pointer that `install` last set for each of MuJoCo's callbacks, by name."""


def _read_callback(name: str) -> tuple[bool, object]:
    """Return a pair: True if MuJoCo's present callback is ours; and the callback, or None."""
    # The pointers that `install` set are compared, because asking for our callbacks would compile
    # them.
    present = getattr(mujoco, f"get_mjcb_{name}")()
    return present is not None and present is _INSTALLED.get(name), present


def installed(*groups: str) -> bool:
    """Return True if MuJoCo runs our callbacks at present.

    Args:
        *groups: as for `install`.
    """
    return all(_read_callback(name)[0] for _, name in _callbacks(groups))


def install(*groups: str) -> None:
    """Install the callbacks that run our motors or hills; a repeated call does nothing.

    MuJoCo's callbacks are process-wide. Ours act only on actuators and joints that carry our
    signature in their user data: other models, and other actuators and joints of the same model,
    behave as they do without the callbacks. The hill's callback is a group of its own, so that
    processes without hills do not pay for it.

    Args:
        *groups: `motor` (`mjcb_control` and `mjcb_act_bias`), `hill` (`mjcb_passive`), or both.
            `motor` if none is given.

    Raises:
        ValueError: unknown group.
        CallbackInUseError: another library has set one of the callbacks; nothing was changed.
        LayoutError: the memory of the installed MuJoCo differs from its introspection.
    """
    # All checks come before the first change, so that an error leaves MuJoCo as it was.
    missing = []
    for group, name in _callbacks(groups):
        is_ours, present = _read_callback(name)
        if present is not None and not is_ours:
            raise CallbackInUseError(
                f"mujoco.mjcb_{name} is already set, to {present!r}: refusing to replace it. Remove"
                f" it with mujoco.set_mjcb_{name}(None) first, or build the environment with"
                f" {_GROUPS[group][2]}, which needs no such callback"
            )
        if not is_ours:
            missing.append((group, name))
    pointers = [(name, _GROUPS[group][1]()[name]) for group, name in missing]
    for name, pointer in pointers:
        getattr(mujoco, f"set_mjcb_{name}")(pointer)
        _INSTALLED[name] = pointer


def uninstall() -> None:
    """Remove all our callbacks, and leave those of other libraries."""
    for _, name in _callbacks(tuple(_GROUPS)):
        if _read_callback(name)[0]:
            getattr(mujoco, f"set_mjcb_{name}")(None)


def _callbacks(groups: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return (group, MuJoCo's name) for each callback of the groups; without groups, of `motor`."""
    for group in groups:
        if group not in _GROUPS:
            raise ValueError(f"callbacks {group!r}: must be one of {', '.join(_GROUPS)}")
    return [(group, name) for group in groups or ("motor",) for name in _GROUPS[group][0]]
