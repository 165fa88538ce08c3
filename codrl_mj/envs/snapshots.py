"""What snapshots of environments have in common: whether one fits, and the time limits that they have to remember."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np


def time_limits(env: "gymnasium.Env[Any, Any]") -> list[Any]:
    """The time limits among an environment's wrappers, from the outermost to what has snapshots of its own."""
    limits = []
    while isinstance(env, gymnasium.Wrapper) and not hasattr(type(env), "snapshot"):
        if "_elapsed_steps" in vars(env):  # TimeLimit, or what rl-zoo3 puts in its place
            limits.append(env)
        env = env.env
    return limits


def check_snapshot(snapshot: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray]) -> None:
    """Refuse a snapshot of other entries, shapes or types than those of the environment's own.

    Args:
        snapshot: what is to be restored.
        expected: what the environment's `snapshot` returns now.

    Raises:
        ValueError: an entry is missing, unknown, or of another shape or type.
    """
    for name in [*expected, *(name for name in snapshot if name not in expected)]:
        found, wanted = (_description(arrays.get(name)) for arrays in (snapshot, expected))
        if found != wanted:
            raise ValueError(
                f"snapshot[{name!r}] is {found}: must be {wanted}; it is of another task, other arguments or another "
                "number of environments"
            )


def _description(array: np.ndarray | None) -> str:
    return "missing" if array is None else f"of shape {array.shape} and type {array.dtype}"
