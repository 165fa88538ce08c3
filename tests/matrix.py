"""Which of many combinations `make test` runs; the others are `make check`'s."""

import pytest


def but(kept, values):
    """The values as parameters, all but those that are `kept` marked as parts of the full matrix."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    assert {one if isinstance(one, tuple) else (one,) for one in kept} <= set(rows)
    return [
        pytest.param(*row, marks=() if row in kept or row[0] in kept else pytest.mark.matrix)
        for row in rows
    ]
