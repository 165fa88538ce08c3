"""Whether a snapshot fits the environment that is to continue from it."""

from collections.abc import Mapping

import numpy as np


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
