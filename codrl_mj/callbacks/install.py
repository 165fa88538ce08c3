"""Installing our callbacks into MuJoCo, and taking them out, without trampling on anybody else's."""

from typing import Any

import mujoco

from codrl_mj.callbacks.kernels import compiled

_NAMES = ("control", "act_bias")


class CallbackInUseError(RuntimeError):
    """Another library's MuJoCo callback is installed where ours has to go."""


def _present(name: str) -> Any:
    return getattr(mujoco, f"get_mjcb_{name}")()


def _is_ours(name: str) -> bool:
    return bool(compiled.cache_info().currsize) and _present(name) is getattr(compiled(), name)


def installed() -> bool:
    """Whether MuJoCo runs our callbacks at present."""
    return all(_is_ours(name) for name in _NAMES)


def install() -> None:
    """Install the callbacks that run our motors; harmless when they are installed already.

    The callbacks are process-wide, as all of MuJoCo's are. They act on actuators that carry our signature in their user
    data and on nothing else: other models, and foreign actuators of the same model, behave as without them.

    Raises:
        CallbackInUseError: `mjcb_control` or `mjcb_act_bias` is somebody else's; nothing was changed.
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    for name in _NAMES:
        if _present(name) is not None and not _is_ours(name):
            raise CallbackInUseError(
                f"mujoco.mjcb_{name} is already set, to {_present(name)!r}: refusing to replace it. Remove it with "
                f"mujoco.set_mjcb_{name}(None) first, or build the environment with actuator='ideal' or "
                "physics='analytic', which need no callback"
            )
    for name in _NAMES:
        getattr(mujoco, f"set_mjcb_{name}")(getattr(compiled(), name))


def uninstall() -> None:
    """Remove our callbacks; anybody else's stay where they are."""
    for name in _NAMES:
        if _is_ours(name):
            getattr(mujoco, f"set_mjcb_{name}")(None)
