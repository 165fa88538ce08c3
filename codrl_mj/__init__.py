"""Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a DC motor.

    >>> import gymnasium as gym
    >>> import codrl_mj
    >>> env = gym.make("codrl_mj/CartPole-v0", actuator="weaker")

Importing the package registers its environments with Gymnasium (which loads no plugins since its version 1.0).
Everything named here is imported on first use, so that `import codrl_mj` costs little.
"""

import importlib
import os
import sys
from typing import Any

from codrl_mj.envs.registration import register_envs

__version__ = "0.1.0"

_PUBLIC = {
    "Actuator": "codrl_mj.motor",
    "CurrentLoop": "codrl_mj.motor",
    "Disturbances": "codrl_mj.disturbances",
    "Motor": "codrl_mj.motor",
    "spectral_radius": "codrl_mj.motor",
    "named_actuator": "codrl_mj.motor",
    "TASKS": "codrl_mj.tasks",
    "Uniform": "codrl_mj.envs.distributions",
    "LogUniform": "codrl_mj.envs.distributions",
    "Choice": "codrl_mj.envs.distributions",
    "make_sb3_vec_env": "codrl_mj.envs.sb3",
    "motors": "codrl_mj.physics",
    "set_actuator": "codrl_mj.physics",
    "install_callbacks": "codrl_mj.physics",
}

__all__ = ["__version__", *_PUBLIC]


def _choose_headless_backend() -> None:
    """On Linux without a display let MuJoCo render through EGL; it reads the variable when it is first imported."""
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not has_display and "mujoco" not in sys.modules:
        os.environ.setdefault("MUJOCO_GL", "egl")


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'codrl_mj' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names."""
    return sorted({*globals(), *__all__})


_choose_headless_backend()
register_envs()
