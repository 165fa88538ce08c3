"""Types of the public names, which `__init__.py` imports on first use."""

from codrl_mj.engine.control import CallbackInUseError as CallbackInUseError
from codrl_mj.engine.control import install as install
from codrl_mj.engine.control import installed as installed
from codrl_mj.engine.control import uninstall as uninstall
from codrl_mj.engine.families import load_family as load_family
from codrl_mj.engine.hill import HILL_NAMES as HILL_NAMES
from codrl_mj.engine.joint_dynamics import MotorWarning as MotorWarning
from codrl_mj.engine.layout import LayoutError as LayoutError
from codrl_mj.engine.reading import Readout as Readout
from codrl_mj.engine.reading import clear_motors as clear_motors
from codrl_mj.engine.reading import motors as motors
from codrl_mj.engine.reading import signals as signals
