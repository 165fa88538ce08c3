"""Distributions as text: what is written is read exactly, and what is none is refused with a reason."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.envs.distributions import Choice, LogUniform, Uniform, parse

bounds = st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 2).map(sorted)
positive = st.tuples(*[st.floats(min_value=0.0, exclude_min=True, allow_infinity=False)] * 2).map(
    sorted
)
values = st.lists(
    st.one_of(st.booleans(), st.integers(), st.floats(allow_nan=False)), min_size=1, max_size=5
)


def _kinds(distribution):
    return [type(value) for value in distribution.extremes]


@given(
    st.one_of(
        bounds.map(lambda pair: Uniform(*pair)),
        positive.map(lambda pair: LogUniform(*pair)),
        values.map(Choice),
    )
)
def test_what_is_written_is_read_exactly(distribution):
    read = parse(str(distribution))
    assert type(read) is type(distribution)
    assert read == distribution
    assert repr(read) == repr(distribution)  # tells True from 1, 1 from 1.0 and 0.0 from -0.0
    assert str(read) == str(distribution)


@pytest.mark.parametrize(
    ("text", "distribution"),
    [
        ("uniform(0.05, 0.2)", Uniform(0.05, 0.2)),
        ("uniform(-1,1e-3)", Uniform(-1.0, 0.001)),
        (" loguniform( .1 , 10 ) ", LogUniform(0.1, 10.0)),
        ("choice(1, 2)", Choice([1, 2])),
        ("choice(+3)", Choice([3])),
        ("choice(3.0, 12.0, inf)", Choice([3.0, 12.0, math.inf])),
        ("choice(True, False)", Choice([True, False])),
    ],
)
def test_a_reader_writes_it_by_hand(text, distribution):
    read = parse(text)
    assert read == distribution
    assert _kinds(read) == _kinds(distribution)


def test_numpys_numbers_are_written_as_pythons():
    assert str(Uniform(np.float32(0.5), np.int64(2))) == "uniform(0.5, 2.0)"
    assert str(Choice(np.array([1, 2]))) == "choice(1, 2)"
    assert str(Choice([np.True_, np.float64(0.1)])) == "choice(True, 0.1)"


EXPECTED = "must be uniform(LOW, HIGH), loguniform(LOW, HIGH) or choice(VALUE, ...)"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gauss(0, 1)", f"'gauss(0, 1)' is no distribution: it {EXPECTED}"),
        (
            "unifrom(0, 1)",
            f"'unifrom(0, 1)' is no distribution: did you mean 'uniform'? it {EXPECTED}",
        ),
        (
            "Uniform(low=0.0, high=1.0)",
            "'Uniform(low=0.0, high=1.0)' is no distribution: did you mean 'uniform'? it ",
        ),
        ("", f"'' is no distribution: {EXPECTED}"),
        ("0.3", f"'0.3' is no distribution: {EXPECTED}"),
        ("uniform(0, 1", f"'uniform(0, 1' is no distribution: {EXPECTED}"),
        ("uniform(0, (1))", f"'uniform(0, (1))' is no distribution: {EXPECTED}"),
        ("uniform(0, 1) + 1", f"'uniform(0, 1) + 1' is no distribution: {EXPECTED}"),
        (0.3, f"0.3 is no distribution: {EXPECTED}"),
        (None, f"None is no distribution: {EXPECTED}"),
        ("uniform(0.3)", "'uniform(0.3)' has 1 values: must be uniform(LOW, HIGH)"),
        ("uniform()", "'uniform()' has 0 values: must be uniform(LOW, HIGH)"),
        (
            "loguniform(1, 2, 3)",
            "'loguniform(1, 2, 3)' has 3 values: must be loguniform(LOW, HIGH)",
        ),
        ("uniform(1,)", "'uniform(1,)': '' must be a number"),
        ("uniform(a, 2)", "'uniform(a, 2)': 'a' must be a number"),
        ("choice(1, 1+1)", "'choice(1, 1+1)': '1+1' must be a number"),
        ("choice()", "'choice()': Choice.values = []: must be a sequence of one or more numbers"),
        ("choice(nan)", "'choice(nan)': Choice.values = [nan]: nan must be a number"),
        ("uniform(2, 1)", "'uniform(2, 1)': Uniform.high = 1: must be >= low = 2"),
        ("uniform(0, inf)", "'uniform(0, inf)': Uniform.high = inf: must be a finite number"),
        ("uniform(True, 2)", "'uniform(True, 2)': Uniform.low = True: must be a finite number"),
        ("loguniform(0, 1)", "'loguniform(0, 1)': LogUniform.low = 0: must be a finite number > 0"),
    ],
)
def test_what_is_no_distribution_is_refused_with_a_reason(text, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        parse(text)
