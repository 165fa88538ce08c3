"""The only code that touches raw mjModel and mjData memory: structure layout, compiled families, doors, reading."""

from codrl_mj.engine.families import load_family
from codrl_mj.engine.hill import HILL_NAMES
from codrl_mj.engine.install import CallbackInUseError, install, installed, uninstall
from codrl_mj.engine.layout import LayoutError

__all__ = ["HILL_NAMES", "CallbackInUseError", "LayoutError", "install", "installed", "load_family", "uninstall"]
