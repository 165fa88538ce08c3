"""Our actuators inside MuJoCo: memory layouts, compiled families, backends and readout.

Every public name is imported on first use, because some modules need no numba and others do.
"""

import importlib

_PUBLIC = {
    "motors": "codrl_mj.engine.reading",
    "signals": "codrl_mj.engine.reading",
    "Readout": "codrl_mj.engine.reading",
    "clear_motors": "codrl_mj.engine.reading",
    "load_family": "codrl_mj.engine.families",
    "HILL_NAMES": "codrl_mj.engine.hill",
    "CallbackInUseError": "codrl_mj.engine.control",
    "LayoutError": "codrl_mj.engine.layout",
    "MotorWarning": "codrl_mj.engine.joint_dynamics",
    "install": "codrl_mj.engine.control",
    "installed": "codrl_mj.engine.control",
    "uninstall": "codrl_mj.engine.control",
}
"""Public names -> their modules."""

__all__ = [*_PUBLIC]


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'codrl_mj.engine' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted({*globals(), *__all__})
