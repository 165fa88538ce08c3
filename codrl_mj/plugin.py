"""Registers our MuJoCo actuator plugin, one for all motors, when the package is imported; and MuJoCo's own library.

MuJoCo knows a plugin by a structure of addresses of functions. `.mjb` files and pickles store the
slot that it was registered in, so there is exactly one of ours, registered at a time that depends
on nothing else. Importing numba and compiling would make `import codrl_mj` slow: what is registered
here are two Python functions. When a first model reaches them, the others are compiled
(`codrl_mj.engine.plugin`) and their addresses written into the structure.
"""

import ctypes
import importlib
from pathlib import Path
from typing import Any

import mujoco

NAME = "codrl_mj.actuator"
"""The plugin's name in models."""
FAMILY = "family"
"""Its only configuration attribute: the family of the actuator, as `module:Class`."""

_FUNCTIONS = (
    *(
        "nstate",
        "nsensordata",
        "init",
        "destroy",
        "copy",
        "reset",
        "compute",
        "advance",
        "visualize",
    ),
    *(
        "actuator_act_dot",
        "sdf_distance",
        "sdf_gradient",
        "sdf_staticdistance",
        "sdf_attribute",
        "sdf_aabb",
    ),
)
_OF_PID = {"nstate", "init", "destroy", "reset", "compute", "advance", "actuator_act_dot"}
"""The functions that MuJoCo's own plugin `mujoco.pid` has."""
_ACTUATOR = 1
"""mjPLUGIN_ACTUATOR of mjplugin.h, which the bindings do not show."""


class LayoutError(RuntimeError):
    """MuJoCo's memory is not laid out as it says, or as we know it: nothing of ours must run in it."""


class Plugin(ctypes.Structure):
    """`mjpPlugin` of mjplugin.h, which MuJoCo's introspection does not describe."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("nattribute", ctypes.c_int),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", ctypes.c_int),
        ("needstage", ctypes.c_int),
        *((function, ctypes.c_void_p) for function in _FUNCTIONS),
        ("later", ctypes.c_byte * 256),  # registering copies a structure that may have grown
    )


def library() -> ctypes.CDLL:
    """MuJoCo's shared library, which the bindings have loaded."""
    for pattern in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll"):
        for path in Path(mujoco.__file__).parent.glob(pattern):
            return ctypes.CDLL(str(path))
    raise LayoutError(
        f"MuJoCo {mujoco.__version__}: found no libmujoco in {Path(mujoco.__file__).parent}"
    )


def registered() -> dict[str, tuple[int, Any]]:
    """Name -> (slot, structure) of every plugin that MuJoCo knows."""
    mujoco_library = library()
    at_slot = mujoco_library.mjp_getPluginAtSlot
    at_slot.argtypes, at_slot.restype = (ctypes.c_int,), ctypes.POINTER(Plugin)
    found = ((slot, at_slot(slot).contents) for slot in range(mujoco_library.mjp_pluginCount()))
    return {plugin.name.decode(): (slot, plugin) for slot, plugin in found}


def check_structure(known: dict[str, tuple[int, Any]]) -> None:
    """Compare `Plugin` with the one that MuJoCo itself filled for `mujoco.pid`."""
    pid = known["mujoco.pid"][1] if "mujoco.pid" in known else Plugin()
    attributes = (
        {pid.attributes[index] for index in range(pid.nattribute)}
        if 0 < pid.nattribute < 20
        else set()
    )
    filled = {function for function in _FUNCTIONS if getattr(pid, function)}
    if (
        not {b"kp", b"ki", b"kd"} <= attributes
        or pid.capabilityflags != _ACTUATOR
        or filled != _OF_PID
    ):
        raise LayoutError(
            f"MuJoCo {mujoco.__version__}: its plugin mujoco.pid is not as expected (functions"
            f" {', '.join(sorted(filled))}). Install a MuJoCo that this version of codrl_mj was"
            " tested with (see pyproject.toml)"
        )


_KEPT: list[Any] = []
"""What MuJoCo holds addresses of."""


def register() -> None:
    """Register the plugin; harmless when this module has done it.

    Raises:
        LayoutError: MuJoCo's structure is not the one that we know.
        RuntimeError: another copy of this package has registered a plugin of the name.
    """
    if _KEPT:
        return
    known = registered()
    check_structure(known)
    if NAME in known:  # MuJoCo would end the process
        raise RuntimeError(
            f"MuJoCo has a plugin {NAME} already: another copy of codrl_mj was imported in this"
            " process, which can have one only"
        )
    states = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(_states)
    start = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)(_start)
    unreached = ctypes.CFUNCTYPE(None)(lambda: None)  # has to be there; replaced before any step
    attributes = (ctypes.c_char_p * 1)(FAMILY.encode())
    plugin = Plugin(NAME.encode(), 1, attributes, _ACTUATOR)
    functions = {"nstate": states, "init": start, "reset": unreached, "compute": unreached}
    for name, function in functions.items():
        setattr(plugin, name, ctypes.cast(function, ctypes.c_void_p).value)
    _KEPT.extend((attributes, *functions.values()))
    library().mjp_registerPlugin(ctypes.byref(plugin))


def complain(text: str) -> None:
    """Say why a model is refused, where MuJoCo says such things: all that a plugin can tell it is that it failed."""
    library().mju_warning(f"{NAME}: {text}".replace("%", "%%").encode())


def _door() -> Any:
    """The compiled side; by its name, because it stands above this module."""
    return importlib.import_module("codrl_mj.engine.plugin")


def _states(model: int, instance: int) -> int:
    """`nstate`: asked once by the compiler of a model, which asks `init` next."""
    try:
        return _door().num_states(model, instance)
    except Exception:
        return 0  # `init` will say why


def _start(model: int, data: int, instance: int) -> int:
    """`init`, until it is replaced: compile, then be what was compiled."""
    try:
        return _door().start(model, data, instance)
    except Exception as error:  # there is nobody to raise it to
        complain(f"{type(error).__name__}: {error}")
        return -1
