"""A family that the reader does not take is refused with file, line, construct and remedy."""

import dataclasses
import functools
import math
import random
import re
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import pytest

from codrl_mj.actuators import BUILT_IN, ActuatorModel
from codrl_mj.arrays import UnsupportedError, check_family
from codrl_mj.fields import real
from tests.arrays.gearbox import Gearbox

GAINS = [1.0, 2.0]


class State(NamedTuple):
    a: float


class Signals(NamedTuple):
    b: float


def family_of(function):
    """Return a family with this `advance`."""

    @dataclasses.dataclass(frozen=True)
    class Custom(ActuatorModel):
        State: ClassVar[type] = globals()["State"]
        Signals: ClassVar[type] = globals()["Signals"]
        advance: ClassVar = staticmethod(function)
        gain: float = real(1.0)

    return Custom


def a_list(parameters, timestep, state, inputs):
    values = [state.a, inputs.speed]
    return state, values[0], Signals(0.0)


def a_comprehension(parameters, timestep, state, inputs):
    return State(*[value * 2.0 for value in state]), 0.0, Signals(0.0)


def a_generator(parameters, timestep, state, inputs):
    return State(*(value * 2.0 for value in state)), 0.0, Signals(0.0)


def a_lambda(parameters, timestep, state, inputs):
    double = lambda value: value * 2.0  # noqa: E731
    return state, double(state.a), Signals(0.0)


twice = lambda value: value * 2.0  # noqa: E731


def a_lambda_of_the_module(parameters, timestep, state, inputs):
    return state, twice(state.a), Signals(0.0)


def an_inner_function(parameters, timestep, state, inputs):
    def double(value):
        return value * 2.0

    return state, double(state.a), Signals(0.0)


def an_error(parameters, timestep, state, inputs):
    if state.a > 1e6:
        raise ValueError("too large")
    return state, 0.0, Signals(0.0)


def an_assertion(parameters, timestep, state, inputs):
    assert state.a < 1e6
    return state, 0.0, Signals(0.0)


def a_try(parameters, timestep, state, inputs):
    try:
        torque = 1.0 / (1.0 + state.a)
    except ZeroDivisionError:
        torque = 0.0
    return state, torque, Signals(0.0)


def an_interpolation(parameters, timestep, state, inputs):
    return state, np.interp(inputs.speed, (0.0, 1.0), (0.0, 2.0)), Signals(0.0)


def an_array(parameters, timestep, state, inputs):
    values = np.zeros(3)
    values[0] = state.a
    return state, values[0], Signals(0.0)


def an_element_of_a_list(parameters, timestep, state, inputs):
    return state, GAINS[int(abs(inputs.speed) > 1.0)], Signals(0.0)


def an_attribute_that_is_set(parameters, timestep, state, inputs):
    if state.a > 1e6:
        state.a = 0.0
    return state, 0.0, Signals(0.0)


def a_recursion(parameters, timestep, state, inputs):
    return state, factorial(inputs.speed), Signals(0.0)


def factorial(n):
    return 1.0 if n < 1.0 else n * factorial(n - 1.0)


def a_random_number(parameters, timestep, state, inputs):
    return state, random.gauss(0.0, 1.0), Signals(0.0)


def a_random_array(parameters, timestep, state, inputs):
    return state, np.random.normal(), Signals(0.0)


def unlike_sides(parameters, timestep, state, inputs):
    pair = (1.0, 2.0) if state.a > 0.0 else 3.0
    return state, 1.0 if pair else 0.0, Signals(0.0)


def a_loop_that_changes_structure(parameters, timestep, state, inputs):
    value = 1.0
    for _ in range(2):
        value = (1.0, 2.0)
    return state, 1.0 if value else 0.0, Signals(0.0)


def a_variable_after_its_loop(parameters, timestep, state, inputs):
    total = 0.0
    for k in range(3):
        total += k
    return state, total * k, Signals(0.0)


def an_unknown_step(parameters, timestep, state, inputs):
    total = 0.0
    for k in range(0, 10, int(abs(inputs.speed)) + 1):
        total += k
    return state, total, Signals(0.0)


def a_loop_with_else(parameters, timestep, state, inputs):
    for _ in range(3):
        torque = 1.0
    else:
        torque = 2.0
    return state, torque, Signals(0.0)


def a_path_without_a_result(parameters, timestep, state, inputs):
    return state, half(state.a), Signals(0.0)


def half(value):  # noqa: RET503
    if value > -1.0:
        return 0.5 * value


def an_assignment_in_a_condition(parameters, timestep, state, inputs):
    torque = 2.0 * x if state.a > 1.0 and (x := inputs.speed) > 0.0 else 0.0
    return state, torque, Signals(0.0)


@functools.cache
def cached(value):
    return value


def a_cached_function(parameters, timestep, state, inputs):
    return state, cached(state.a), Signals(0.0)


def doubling(function):
    @functools.wraps(function)
    def wrapper(value):
        return 2.0 * function(value)

    return wrapper


@doubling
def decorated(value):
    return value


def a_decorated_function(parameters, timestep, state, inputs):
    return state, decorated(state.a), Signals(0.0)


def a_special_function(parameters, timestep, state, inputs):
    return state, math.gamma(1.0 + abs(state.a)), Signals(0.0)


def a_text(parameters, timestep, state, inputs):
    name = f"{state.a}"
    return state, float(name), Signals(0.0)


class Polar(NamedTuple):
    radius: float

    @property
    def size(self):
        return self.radius if self.radius > 0.0 else 0.0


def a_property_with_a_condition(parameters, timestep, state, inputs):
    return state, Polar(state.a).size, Signals(0.0)


REFUSED = {
    a_list: (1, "a list: use a tuple"),
    a_comprehension: (1, "a list comprehension: use a loop, or write a tuple"),
    a_generator: (1, "a generator: use a loop, or write a tuple"),
    a_lambda: (1, "a lambda: define a function with def outside of this function"),
    a_lambda_of_the_module: (1, "<lambda> is a lambda: define the function with `def`"),
    an_inner_function: (1, "a function in a function: define it outside of this function"),
    an_error: (2, "raise: check fields in the dataclass, and limit values with min and max"),
    an_assertion: (1, "assert: check fields in the dataclass, and limit values with min and max"),
    a_try: (1, "try: avoid the error with a condition"),
    an_interpolation: (
        1,
        "interp is not supported: use arithmetic, functions of math, and your own functions made"
        " of these",
    ),
    an_array: (
        1,
        "zeros is not supported: use arithmetic, functions of math, and your own functions made of"
        " these",
    ),
    an_element_of_a_list: (1, "an element of [1.0, 2.0]: make it a tuple"),
    an_attribute_that_is_set: (2, "an attribute is assigned: make a new tuple with _replace"),
    a_recursion: (1, "factorial calls itself: use a loop", factorial),
    a_random_number: (
        1,
        "gauss draws random numbers: use codrl_mj.actuators.noise.standard_normal",
    ),
    a_random_array: (
        1,
        "normal draws random numbers: use codrl_mj.actuators.noise.standard_normal",
    ),
    unlike_sides: (
        1,
        "the two sides of a condition are a tuple of 2 and a number: make them alike",
    ),
    a_loop_that_changes_structure: (
        2,
        "value is a number before the loop and a tuple of 2 after an iteration: make them alike",
    ),
    a_variable_after_its_loop: (
        4,
        "k is used after its loop: assign it to another name within",
    ),
    an_unknown_step: (2, "a range with an unknown step: use a while loop"),
    a_loop_with_else: (1, "else of a loop: use a flag"),
    a_path_without_a_result: (
        1,
        "a function returns in some cases only: return in all cases",
        half,
    ),
    an_assignment_in_a_condition: (
        1,
        ":= in a condition that may not run: assign in a statement before it",
    ),
    a_cached_function: (
        1,
        "cached is not supported: use arithmetic, functions of math, and your own functions made"
        " of these",
    ),
    a_decorated_function: (1, "decorated has a decorator: call a plain function"),
    a_special_function: (
        1,
        "gamma is not supported: use arithmetic, functions of math, and your own functions made of"
        " these",
    ),
    a_text: (1, "a formatted string: advance computes with numbers only"),
    a_property_with_a_condition: (
        1,
        "a number is used in Python code that is not read: use plain functions",
    ),
}
"""Functions -> line after `def` that is refused, the message, and the function if it is another."""


@pytest.mark.parametrize("function", REFUSED)
def test_a_construct_is_refused_with_its_line_and_a_remedy(function):
    offset, text, *others = REFUSED[function]
    owner = (others or [function])[0]
    line = owner.__code__.co_firstlineno + offset
    with pytest.raises(UnsupportedError) as error:
        check_family(family_of(function))
    assert str(error.value) == f"{Path(__file__).name}:{line}, in {owner.__name__}: {text}"


def test_a_function_without_a_source_is_refused():
    namespace = {"Signals": Signals}
    text = "def advance(parameters, timestep, state, inputs):\n return state, 1.0, Signals(0.0)"
    exec(text, namespace)
    expected = "<string>:1, in advance: advance has no source: define it in a file, with `def`"
    with pytest.raises(UnsupportedError, match=re.escape(expected)):
        check_family(family_of(namespace["advance"]))


def a_missing_field(parameters, timestep, state, inputs):
    if state.a > 1e6:
        return state, parameters.gian, Signals(0.0)
    return state, 0.0, Signals(0.0)


def test_a_mistake_that_python_does_not_reach_is_found():
    line = a_missing_field.__code__.co_firstlineno + 2
    with pytest.raises(UnsupportedError, match=f"py:{line}, in a_missing_field: AttributeError"):
        check_family(family_of(a_missing_field))


def two_signals(parameters, timestep, state, inputs):
    if state.a > 1e6:
        return state, 0.0, (1.0, 2.0)
    return state, 0.0, Signals(0.0)


def test_paths_with_different_results_are_refused():
    with pytest.raises(UnsupportedError, match="two sides of a condition are a tuple of 3 and a"):
        check_family(family_of(two_signals))


@pytest.mark.parametrize("family", [*BUILT_IN, Gearbox])
def test_built_in_families_and_a_custom_one_are_accepted(family):
    check_family(family)
