"""The worst of many comparisons."""

from collections.abc import Iterable


def worst_of(found: Iterable[tuple[float, str]]) -> tuple[float, str]:
    """The largest of (difference, where it was found), the first of equals; a NaN is larger than anything.

    Args:
        found: at least one comparison.
    """
    return max(found, key=lambda pair: (pair[0] != pair[0], pair[0]))
