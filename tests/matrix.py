"""Marks for large products of parameters: `make test` runs some rows, `make check` all."""

import pytest


def matrix_params(default, values):
    """Return the values as parameters; those that are not in `default` are marked as matrix."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    assert {value if isinstance(value, tuple) else (value,) for value in default} <= set(rows)
    return [
        pytest.param(*row, marks=() if row in default or row[0] in default else pytest.mark.matrix)
        for row in rows
    ]
