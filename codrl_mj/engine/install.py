"""Installing our callbacks into MuJoCo, and taking them out, without trampling on anybody else's."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco

from codrl_mj.engine.control import compiled
from codrl_mj.engine.hill import compiled_hill


class _CallbackGroup(NamedTuple):
    """Callbacks that are installed together."""

    names: tuple[str, ...]
    """MuJoCo's names, as in `mujoco.set_mjcb_...`; also the fields of what `compile` returns."""
    compile: Callable[[], Any]
    remedy: str
    """What else a user could do than to install them."""


_PARTS = {
    "motor": _CallbackGroup(("control", "act_bias"), compiled, "actuator='ideal' or physics='analytic'"),
    "hill": _CallbackGroup(("passive",), compiled_hill, "physics='analytic'"),
}


class CallbackInUseError(RuntimeError):
    """Another library's MuJoCo callback is installed where ours has to go."""


def _present(name: str) -> Any:
    return getattr(mujoco, f"get_mjcb_{name}")()


def _is_ours(name: str) -> bool:
    """Whether the callback of that name is ours; nothing is compiled to find out."""
    present = _present(name)
    return present is not None and present is _INSTALLED.get(name)


_INSTALLED: dict[str, Any] = {}
"""What each of MuJoCo's callbacks was last set to."""


def installed(*parts: str) -> bool:
    """Whether MuJoCo runs our callbacks at present.

    Args:
        *parts: as for `install`.
    """
    return all(_is_ours(name) for part in _chosen(parts) for name in _PARTS[part].names)


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
    chosen = _chosen(parts)
    for part in chosen:
        for name in _PARTS[part].names:
            if _present(name) is not None and not _is_ours(name):
                raise CallbackInUseError(
                    f"mujoco.mjcb_{name} is already set, to {_present(name)!r}: refusing to replace it. Remove it with "
                    f"mujoco.set_mjcb_{name}(None) first, or build the environment with {_PARTS[part].remedy}, which "
                    "needs no such callback"
                )
    missing = [(part, name) for part in chosen for name in _PARTS[part].names if not _is_ours(name)]
    pointers = [(name, getattr(_PARTS[part].compile(), name)) for part, name in missing]
    for name, pointer in pointers:
        getattr(mujoco, f"set_mjcb_{name}")(pointer)
        _INSTALLED[name] = pointer


def uninstall() -> None:
    """Remove all our callbacks; anybody else's stay where they are."""
    for name in {name for part in _PARTS.values() for name in part.names}:
        if _is_ours(name):
            getattr(mujoco, f"set_mjcb_{name}")(None)


def _chosen(names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if name not in _PARTS:
            raise ValueError(f"callbacks {name!r}: must be one of {', '.join(_PARTS)}")
    return names or ("motor",)
