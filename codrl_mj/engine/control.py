"""MuJoCo's control and bias callbacks for our actuators, compiled to C functions by numba: the door of tasks.

They are pure functions of (mjModel, mjData): which actuators are ours, and their parameters, is
read from the model; all state is in `data.act`. The structures' offsets are compiled in: code kept
on disk has them in its key.
"""

import ctypes
import functools
import math
from collections.abc import Callable
from typing import Any

import mujoco
from numba import types

from codrl_mj.compile_cache import cfunc
from codrl_mj.engine.doors import command, inertia_at, is_disabled, user_of
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
from codrl_mj.engine.hill import compiled_hill
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import at, callback, f64, internal

_USER_DYNAMICS, _USER_BIAS = int(mujoco.mjtDyn.mjDYN_USER), int(mujoco.mjtBias.mjBIAS_USER)
_FIRST, _SECOND = SIGNATURE


@internal(inline="always")
def _slot_of(model: int, data: int, actuator: int) -> int:
    return at(DATA.act(data), MODEL.actuator_actadr(model)[actuator])


@internal(inline="always")
def _is_ours(model: int, actuator: int) -> bool:
    if (
        MODEL.actuator_dyntype(model)[actuator] != _USER_DYNAMICS
        or MODEL.nuser_actuator(model) < HEAD
    ):
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
def compiled_motors() -> dict[str, Any]:
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
                inertia_at(model, data, out, 1.0) if size_of(number, INERTIA) else math.inf,
            )

    @cfunc(types.float64(types.uintp, types.uintp, types.int32), nogil=True, error_model="numpy")
    def act_bias(model: int, data: int, actuator: int) -> float:
        if not _is_ours(model, actuator):
            return 0.0  # as the engine does when there is no callback
        return f64(_slot_of(model, data, actuator))[2]

    return {
        "control": callback(control),
        "act_bias": callback(act_bias, ctypes.c_double, ctypes.c_int),
    }


# -- installing them, and that of hills, without trampling on anybody else's -----------------------------------

_PARTS: dict[str, tuple[tuple[str, ...], Callable[[], dict[str, Any]], str]] = {
    "motor": (("control", "act_bias"), compiled_motors, "actuator='ideal' or physics='analytic'"),
    "hill": (("passive",), compiled_hill, "physics='analytic'"),
}
"""Callbacks that are installed together: MuJoCo's names, as in `mujoco.set_mjcb_...`; what compiles
them, by these names; and what else a user could do than to install them.
"""


class CallbackInUseError(RuntimeError):
    """Another library's MuJoCo callback is installed where ours has to go."""


_INSTALLED: dict[str, Any] = {}
"""What each of MuJoCo's callbacks was last set to."""


def _whose(name: str) -> tuple[bool, Any]:
    """Whether the callback of that name is ours, and what it is, if any; nothing is compiled to find out."""
    present = getattr(mujoco, f"get_mjcb_{name}")()
    return present is not None and present is _INSTALLED.get(name), present


def installed(*parts: str) -> bool:
    """Whether MuJoCo runs our callbacks at present.

    Args:
        *parts: as for `install`.
    """
    return all(_whose(name)[0] for _, name in _callbacks(parts))


def install(*parts: str) -> None:
    """Install the callbacks that run our motors, or our hills; harmless when they are installed already.

    The callbacks are process-wide, as all of MuJoCo's are. They act on actuators and joints that
    carry our signature in their user data and on nothing else: other models, and foreign actuators
    and joints of the same model, behave as without them. A process in which no model has a hill
    need not pay for the hill's callback.

    Args:
        *parts: `motor` (`mjcb_control` and `mjcb_act_bias`), `hill` (`mjcb_passive`), or both; none
            means `motor`.

    Raises:
        ValueError: no such part.
        CallbackInUseError: one of the callbacks is somebody else's; nothing was changed.
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    missing = []
    for part, name in _callbacks(parts):
        ours, present = _whose(name)
        if present is not None and not ours:
            raise CallbackInUseError(
                f"mujoco.mjcb_{name} is already set, to {present!r}: refusing to replace it. Remove"
                f" it with mujoco.set_mjcb_{name}(None) first, or build the environment with"
                f" {_PARTS[part][2]}, which needs no such callback"
            )
        if not ours:
            missing.append((part, name))
    pointers = [(name, _PARTS[part][1]()[name]) for part, name in missing]
    for name, pointer in pointers:
        getattr(mujoco, f"set_mjcb_{name}")(pointer)
        _INSTALLED[name] = pointer


def uninstall() -> None:
    """Remove all our callbacks; anybody else's stay where they are."""
    for _, name in _callbacks(tuple(_PARTS)):
        if _whose(name)[0]:
            getattr(mujoco, f"set_mjcb_{name}")(None)


def _callbacks(parts: tuple[str, ...]) -> list[tuple[str, str]]:
    """Part and name of each of MuJoCo's callbacks that are of some parts, those of motors if none is named."""
    for part in parts:
        if part not in _PARTS:
            raise ValueError(f"callbacks {part!r}: must be one of {', '.join(_PARTS)}")
    return [(part, name) for part in parts or ("motor",) for name in _PARTS[part][0]]
