"""Reinforcement learning with realistic actuators: classic control in MuJoCo with DC motors.

    >>> import gymnasium as gym
    >>> import codrl_mj
    >>> env = gym.make("codrl_mj/CartPole-v0", actuator="weaker")

Importing the package registers its environments; since version 1.0, Gymnasium does not import it by
itself. Every public name is imported on first use, so that `import codrl_mj` is fast.

Where a package is missing that simulation needs, as beside a simulator that pins an older MuJoCo,
nothing is registered. `codrl_mj.actuators`, `.catalogue` and `.arrays` work all the same.
"""

import importlib
import os
import signal
import sys

from codrl_mj.requirements import missing_module_message, refuse_simulation, simulation_problem

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
    "EnvSource": "codrl_mj.envs.config",
    "ExternalEnvSource": "codrl_mj.external_envs.sources",
    "register": "codrl_mj.envs.registration",
    "TrainConfig": "codrl_mj.training",
    "train": "codrl_mj.training",
    "load_policy": "codrl_mj.runs.policies",
    "evaluate": "codrl_mj.evaluation",
    "validate": "codrl_mj.validation",
}
"""Main public names -> their modules; others are in `codrl_mj.actuators`, `.engine` and so on."""

__all__ = ["__version__", *_PUBLIC]


def _exit_on_interrupt(*_: object) -> None:
    """End the program at Ctrl-C during its imports; `cli.main` restores the usual handler."""
    os.write(2, b"codrl-mj: stopped before it started\n")
    os._exit(130)


def _is_command_line() -> bool:
    """Return True if this process is the `codrl-mj` command and Ctrl-C has Python's handler."""
    # `pathlib` would have to be imported first, which takes time.
    program = os.path.basename((getattr(sys, "argv", None) or [""])[0])  # noqa: PTH119
    is_command = program == "codrl-mj" or (program == "-m" and "codrl_mj" in sys.orig_argv)
    return is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def _choose_headless_backend() -> None:
    """Let MuJoCo render through EGL on Linux without a display."""
    # MuJoCo reads the variable once, when it is first imported.
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not has_display and "mujoco" not in sys.modules:
        os.environ.setdefault("MUJOCO_GL", "egl")


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name in _PUBLIC:
        try:
            return getattr(importlib.import_module(_PUBLIC[name]), name)
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(missing_module_message(error), name=error.name) from error
    raise AttributeError(f"module 'codrl_mj' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted({*globals(), *__all__})


if _is_command_line():
    signal.signal(signal.SIGINT, _exit_on_interrupt)
if simulation_problem():
    refuse_simulation()
else:
    # This comes before the plugin's module, which imports mujoco: mujoco then reads MUJOCO_GL.
    _choose_headless_backend()
    importlib.import_module("codrl_mj.plugin").register(
        # The module imports numba, so it is loaded when the first model with motors is compiled.
        lambda: importlib.import_module("codrl_mj.engine.plugin")
    )
    # Importing the kinds of env sources registers them, and the tasks with Gymnasium.
    importlib.import_module("codrl_mj.envs.task_source")
    importlib.import_module("codrl_mj.external_envs.sources")
