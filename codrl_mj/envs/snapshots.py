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


def elapsed_steps(env: "gymnasium.Env[Any, Any]") -> np.ndarray:
    """The steps that the `time_limits` have counted, int64; -1 before the first reset."""
    counted = [limit._elapsed_steps for limit in time_limits(env)]
    return np.array([-1 if steps is None else steps for steps in counted], dtype=np.int64)


def set_elapsed_steps(env: "gymnasium.Env[Any, Any]", elapsed: np.ndarray) -> None:
    """Let the `time_limits` have counted what `elapsed_steps` returned."""
    for limit, steps in zip(time_limits(env), elapsed.tolist(), strict=True):
        limit._elapsed_steps = None if steps < 0 else steps


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
