"""Planted faults in the back ends and the reader are caught by the comparisons with Python."""

import operator

import numpy as np
import pytest

from codrl_mj.arrays import array_code, c_code, functions
from codrl_mj.arrays.array_code import ArrayCode
from codrl_mj.arrays.c_code import CCode
from tests.arrays.cases import case, errors
from tests.arrays.runs import COMPILER, run_arrays, run_c


def drop_else(self, condition, then, otherwise, kinds):
    return then()


def swap_min_and_max(self, name, kind, *operands, original=CCode._text):
    return original(self, {"min": "max", "max": "min"}.get(name, name), kind, *operands)


def forget_a_variable(self, loop, original=CCode.loop):
    """Write a loop whose first variable never changes."""
    changed = loop._replace(body=lambda values: [values[0], *loop.body(values)[1:]])
    return original(self, changed)


def make_infinity_finite(self, value, kind, original=CCode.constant):
    return original(self, min(value, 1e9), kind) if kind == "float" else original(self, value, kind)


def run_no_iteration(self, loop):
    return [self.full(value) for value in loop.initial]


def round_up(self, value, rounding="trunc", original=functions.Arithmetic.to_int):
    return original(self, value, {"trunc": "ceil"}.get(rounding, rounding))


C_FAULTS = {
    "a minus becomes a plus": (c_code._INFIX, "sub", "+"),
    "a comparison is turned round": (c_code._INFIX, "gt", "<="),
    "else is dropped": (CCode, "branch", drop_else),
    "min and max are swapped": (CCode, "_text", swap_min_and_max),
    "a loop forgets a variable": (CCode, "loop", forget_a_variable),
    "infinity is finite": (CCode, "constant", make_infinity_finite),
}
ARRAY_FAULTS = {
    "a minus becomes a plus": (array_code._OPERATORS, "sub", operator.add),
    "else is dropped": (ArrayCode, "branch", drop_else),
    "a loop does not run": (ArrayCode, "loop", run_no_iteration),
    "integers are rounded up": (functions.Arithmetic, "to_int", round_up),
}


def plant(monkeypatch, owner, name, fault):
    if isinstance(owner, dict):
        monkeypatch.setitem(owner, name, fault)
    else:
        monkeypatch.setattr(owner, name, fault)


def largest_error(run, names):
    largest = 0.0
    for name in names:
        largest = max(largest, errors(name, 200, run(case(name, 200))).max())
    return largest


@pytest.mark.skipif(COMPILER is None, reason="NOT RUN: no C compiler: apt-get install gcc")
@pytest.mark.parametrize("fault", C_FAULTS)
def test_a_fault_in_c_is_caught(fault, monkeypatch, tmp_path):
    plant(monkeypatch, *C_FAULTS[fault])
    assert largest_error(lambda actuators: run_c(actuators, tmp_path), ["current_loop"]) > 1e-3


@pytest.mark.parametrize("fault", ARRAY_FAULTS)
def test_a_fault_in_array_code_is_caught(fault, monkeypatch):
    plant(monkeypatch, *ARRAY_FAULTS[fault])
    assert (
        largest_error(lambda actuators: run_arrays(actuators, np), ["lag", "current_loop"]) > 1e-3
    )
