"""Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a DC motor.

    >>> import gymnasium as gym
    >>> import codrl_mj
    >>> env = gym.make("codrl_mj/CartPole-v0", actuator="weaker")

Importing the package registers its environments with Gymnasium (which loads no plugins since its
version 1.0). Everything named here is imported on first use, so that `import codrl_mj` costs
little.
"""

import importlib
import os
import signal
import sys
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "make": "codrl_mj.factory",
    "make_vec": "codrl_mj.factory",
    "EnvConfig": "codrl_mj.envs.config",
    "Uniform": "codrl_mj.envs.distributions",
    "LogUniform": "codrl_mj.envs.distributions",
    "Choice": "codrl_mj.envs.distributions",
    "Disturbances": "codrl_mj.disturbances",
    "Joint": "codrl_mj.disturbances",
    "make_sb3_vec_env": "codrl_mj.envs.sb3",
    "make_dm_control": "codrl_mj.external_envs.dm_control",
    "add_motors": "codrl_mj.engine.specs",
    "motors_added": "codrl_mj.external_envs.building",
    "signals": "codrl_mj.engine.reading",
    "Task": "codrl_mj.tasks",
    "EnvSource": "codrl_mj.envs.worlds",
    "register": "codrl_mj.tasks",
    "TrainConfig": "codrl_mj.training",
    "train": "codrl_mj.training",
    "load_policy": "codrl_mj.runs.policies",
    "evaluate": "codrl_mj.evaluation",
    "validate": "codrl_mj.validation",
}
"""What one begins with; what experts need is in the rooms: `codrl_mj.actuators`, `.engine`, `.identify` and so on."""

__all__ = ["__version__", *_PUBLIC]


def _stopped_early(*_: object) -> None:
    """End the program at Ctrl-C while it imports what it needs; `cli.main` puts the usual handler back."""
    os.write(2, b"codrl-mj: stopped before anything was begun\n")
    os._exit(130)


def _is_program() -> bool:
    """Whether this is the process of `codrl-mj` or `python -m codrl_mj`, with nobody else's handler of Ctrl-C."""
    called = os.path.basename((getattr(sys, "argv", None) or [""])[0])  # noqa: PTH119 - without importing more
    named = called == "codrl-mj" or (called == "-m" and "codrl_mj" in sys.orig_argv)
    return named and signal.getsignal(signal.SIGINT) is signal.default_int_handler


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


if _is_program():
    signal.signal(signal.SIGINT, _stopped_early)
_choose_headless_backend()
importlib.import_module("codrl_mj.plugin").register()  # imports mujoco, which reads the variable
importlib.import_module("codrl_mj.tasks")  # registers them with Gymnasium
