"""Registration of the MuJoCo actuator plugin, a single one for all motors, at package import.

MuJoCo knows a plugin as a structure of function addresses. `.mjb` files and pickles store the slot
of its registration, so exactly one plugin is registered, at a time that depends on nothing else.
Importing numba and compiling would make `import codrl_mj` slow; the functions registered here are
therefore two Python functions. When the first model calls them, the other functions are compiled
(`codrl_mj.engine.plugin`) and their addresses written into the structure.
"""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import mujoco

NAME = "codrl_mj.actuator"
"""Name of the plugin in models."""
FAMILY = "family"
"""Name of its only configuration attribute: the actuator's family, as `module:Class`."""

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
_PID_FUNCTIONS = {"nstate", "init", "destroy", "reset", "compute", "advance", "actuator_act_dot"}
"""Functions that MuJoCo's own plugin `mujoco.pid` defines."""
_ACTUATOR = 1
"""mjPLUGIN_ACTUATOR of mjplugin.h, which the Python bindings do not have."""


class LayoutError(RuntimeError):
    """MuJoCo's memory layout differs from its own description, or from the known one.

    No compiled function of this package may access such memory.
    """


class Plugin(ctypes.Structure):
    """`mjpPlugin` of mjplugin.h, which MuJoCo's introspection does not describe."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("nattribute", ctypes.c_int),
        ("attributes", ctypes.POINTER(ctypes.c_char_p)),
        ("capabilityflags", ctypes.c_int),
        ("needstage", ctypes.c_int),
        *((function, ctypes.c_void_p) for function in _FUNCTIONS),
        # Registration copies the structure; a later MuJoCo's may be longer, and must not read
        # beyond the end.
        ("later", ctypes.c_byte * 256),
    )


def library() -> ctypes.CDLL:
    """Return MuJoCo's shared library, which the bindings have loaded."""
    for pattern in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll"):
        for path in Path(mujoco.__file__).parent.glob(pattern):
            return ctypes.CDLL(str(path))
    raise LayoutError(
        f"MuJoCo {mujoco.__version__}: found no libmujoco in {Path(mujoco.__file__).parent}"
    )


def registered_plugins() -> dict[str, tuple[int, Plugin]]:
    """Return name -> (slot, structure) of every plugin that MuJoCo knows."""
    mujoco_library = library()
    plugin_at_slot = mujoco_library.mjp_getPluginAtSlot
    plugin_at_slot.argtypes, plugin_at_slot.restype = (ctypes.c_int,), ctypes.POINTER(Plugin)
    plugins = (
        (slot, plugin_at_slot(slot).contents) for slot in range(mujoco_library.mjp_pluginCount())
    )
    return {plugin.name.decode(): (slot, plugin) for slot, plugin in plugins}


def check_structure(plugins: dict[str, tuple[int, Plugin]]) -> None:
    """Raise if `Plugin` does not describe the structure that MuJoCo filled for `mujoco.pid`."""
    pid = plugins["mujoco.pid"][1] if "mujoco.pid" in plugins else Plugin()
    attributes = (
        {pid.attributes[index] for index in range(pid.nattribute)}
        if 0 < pid.nattribute < 20
        else set()
    )
    defined_functions = {function for function in _FUNCTIONS if getattr(pid, function)}
    if (
        not {b"kp", b"ki", b"kd"} <= attributes
        or pid.capabilityflags != _ACTUATOR
        or defined_functions != _PID_FUNCTIONS
    ):
        raise LayoutError(
            f"MuJoCo {mujoco.__version__}: its plugin mujoco.pid is not as expected (functions"
            f" {', '.join(sorted(defined_functions))}). Install a MuJoCo that this version of"
            " codrl_mj was tested with (see pyproject.toml)"
        )


class Backend(Protocol):
    """The module with the compiled functions, `codrl_mj.engine.plugin`.

    Its functions get the addresses of `mjModel` and `mjData`.
    """

    def num_states(self, model: int, instance: int) -> int:
        """Return `nstate`, the number of states of an instance."""

    def start(self, model: int, data: int, instance: int) -> int:
        """Replace the functions of the plugin, and run `init`."""


_BACKEND: list[Callable[[], Backend]] = []
"""Function that returns the module with the compiled functions, once the plugin is registered."""
_REFERENCES: list[object] = []
"""Objects to whose memory MuJoCo has pointers; they must never be freed."""


def register(load_backend: Callable[[], Backend]) -> None:
    """Register the plugin; a no-op if this module has done so before.

    Args:
        load_backend: function that returns the module with the compiled functions,
            `codrl_mj.engine.plugin`; it is called when the first model with motors is compiled.

    Raises:
        LayoutError: MuJoCo's structure is not the known one.
        RuntimeError: another copy of this package has registered a plugin with this name.
    """
    if _REFERENCES:
        return
    _BACKEND.append(load_backend)
    plugins = registered_plugins()
    check_structure(plugins)
    # MuJoCo itself would end the process.
    if NAME in plugins:
        raise RuntimeError(
            f"MuJoCo has a plugin {NAME} already: another copy of codrl_mj was imported in this"
            " process, which can have only one"
        )
    states = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(_count_states)
    start = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)(_start)
    # MuJoCo requires the function; it is replaced before the first step.
    placeholder = ctypes.CFUNCTYPE(None)(lambda: None)
    attributes = (ctypes.c_char_p * 1)(FAMILY.encode())
    plugin = Plugin(NAME.encode(), 1, attributes, _ACTUATOR)
    functions = {"nstate": states, "init": start, "reset": placeholder, "compute": placeholder}
    for name, function in functions.items():
        setattr(plugin, name, ctypes.cast(function, ctypes.c_void_p).value)
    _REFERENCES.extend((attributes, *functions.values()))
    library().mjp_registerPlugin(ctypes.byref(plugin))


def log_warning(text: str) -> None:
    """Report by MuJoCo's warning why a model is refused; a plugin can only return a failure."""
    library().mju_warning(f"{NAME}: {text}".replace("%", "%%").encode())


def _count_states(model: int, instance: int) -> int:
    """Number of states, `nstate`: MuJoCo's compiler calls it once, and `init` next."""
    try:
        return _BACKEND[0]().num_states(model, instance)
    except Exception:
        # `init` is called next, fails too, and reports the error.
        return 0


def _start(model: int, data: int, instance: int) -> int:
    """Compile the plugin's functions, and run the compiled `init` in place of this one."""
    try:
        return _BACKEND[0]().start(model, data, instance)
    # An exception cannot pass through MuJoCo's C code.
    except Exception as error:
        log_warning(f"{type(error).__name__}: {error}")
        return -1
