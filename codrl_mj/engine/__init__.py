"""Our actuators inside MuJoCo: memory layouts, compiled families, backends and readout."""

from codrl_mj.engine.control import CallbackInUseError, install, installed, uninstall
from codrl_mj.engine.families import load_family
from codrl_mj.engine.hill import HILL_NAMES
from codrl_mj.engine.layout import LayoutError
from codrl_mj.engine.reading import Readout, clear_motors, motors, signals
from codrl_mj.engine.specs import MotorWarning

__all__ = [
    "motors",
    "signals",
    "Readout",
    "clear_motors",
    "load_family",
    "HILL_NAMES",
    "CallbackInUseError",
    "LayoutError",
    "MotorWarning",
    "install",
    "installed",
    "uninstall",
]
