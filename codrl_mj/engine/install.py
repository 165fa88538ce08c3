"""Installing our callbacks into MuJoCo, and taking them out, without trampling on anybody else's."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco

from codrl_mj.engine.control import compiled
from codrl_mj.engine.hill import compiled_hill


class _CallbackGroup(NamedTuple):
    """Callbacks that are installed together."""

    names: tuple[str, ...]
    """MuJoCo's names, as in `mujoco.set_mjcb_...`."""
    compile: Callable[[], dict[str, Any]]
    """() -> the callbacks by these names."""
    remedy: str
    """What else a user could do than to install them."""


_PARTS = {
    "motor": _CallbackGroup(("control", "act_bias"), compiled, "actuator='ideal' or physics='analytic'"),
    "hill": _CallbackGroup(("passive",), compiled_hill, "physics='analytic'"),
}


class CallbackInUseError(RuntimeError):
    """Another library's MuJoCo callback is installed where ours has to go."""


_INSTALLED: dict[str, Any] = {}
"""What each of MuJoCo's callbacks was last set to."""


def _whose(name: str) -> tuple[bool, Any]:
    """Whether the callback of that name is ours, and what it is, if any; nothing is compiled to find out."""
    present = getattr(mujoco, f"get_mjcb_{name}")()
    return present is not None and present is _INSTALLED.get(name), present


def installed(*parts: str) -> bool:
    """Whether MuJoCo runs our callbacks at present.

    Args:
        *parts: as for `install`.
    """
    return all(_whose(name)[0] for _, name in _callbacks(parts))


def install(*parts: str) -> None:
    """Install the callbacks that run our motors, or our hills; harmless when they are installed already.

    The callbacks are process-wide, as all of MuJoCo's are. They act on actuators and joints that carry our signature in
    their user data and on nothing else: other models, and foreign actuators and joints of the same model, behave as
    without them. A process in which no model has a hill need not pay for the hill's callback.

    Args:
        *parts: `motor` (`mjcb_control` and `mjcb_act_bias`), `hill` (`mjcb_passive`), or both; none means `motor`.

    Raises:
        ValueError: no such part.
        CallbackInUseError: one of the callbacks is somebody else's; nothing was changed.
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    missing = []
    for part, name in _callbacks(parts):
        ours, present = _whose(name)
        if present is not None and not ours:
            raise CallbackInUseError(
                f"mujoco.mjcb_{name} is already set, to {present!r}: refusing to replace it. Remove it with "
                f"mujoco.set_mjcb_{name}(None) first, or build the environment with {_PARTS[part].remedy}, which "
                "needs no such callback"
            )
        if not ours:
            missing.append((part, name))
    pointers = [(name, _PARTS[part].compile()[name]) for part, name in missing]
    for name, pointer in pointers:
        getattr(mujoco, f"set_mjcb_{name}")(pointer)
        _INSTALLED[name] = pointer


def uninstall() -> None:
    """Remove all our callbacks; anybody else's stay where they are."""
    for _, name in _callbacks(tuple(_PARTS)):
        if _whose(name)[0]:
            getattr(mujoco, f"set_mjcb_{name}")(None)


def _callbacks(parts: tuple[str, ...]) -> list[tuple[str, str]]:
    """Part and name of each of MuJoCo's callbacks that are of some parts, those of motors if none is named."""
    for part in parts:
        if part not in _PARTS:
            raise ValueError(f"callbacks {part!r}: must be one of {', '.join(_PARTS)}")
    return [(part, name) for part in parts or ("motor",) for name in _PARTS[part].names]
