"""The only code that touches raw mjModel and mjData memory: structure layout, callbacks, installation."""

from codrl_mj.callbacks.hill import HILL_NAMES
from codrl_mj.callbacks.install import CallbackInUseError, install, installed, uninstall
from codrl_mj.callbacks.kernels import ACT_NAMES, IMPERFECT_ACT_NAMES
from codrl_mj.callbacks.layout import LayoutError

__all__ = [
    "ACT_NAMES",
    "HILL_NAMES",
    "IMPERFECT_ACT_NAMES",
    "CallbackInUseError",
    "LayoutError",
    "install",
    "installed",
    "uninstall",
]
