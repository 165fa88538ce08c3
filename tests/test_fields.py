"""Validated fields: accepted values, and errors with field, value and bound."""

import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from codrl_mj.fields import (
    Checked,
    build,
    check_names,
    choice,
    did_you_mean,
    flag,
    integer,
    nested_types,
    optional_nested,
    positive_integers,
    positive_reals,
    real,
    reals,
)

BOUNDS = {
    "above": (lambda value, limit: value > limit, ">"),
    "minimum": (lambda value, limit: value >= limit, ">="),
    "below": (lambda value, limit: value < limit, "<"),
    "maximum": (lambda value, limit: value <= limit, "<="),
}
WORDS = st.text("a1.e- é", max_size=3)
NOT_REAL = st.sampled_from([True, False, np.True_, "1", None, [1.0], (1.0,), 1j, {}]) | WORDS


def _settings(field):
    """Return a validated class with one field."""
    return dataclasses.make_dataclass(
        "Settings", [("field", object, field)], frozen=True, bases=(Checked,)
    )


def _refusal(kind, value):
    with pytest.raises(
        ValueError, match=rf"^Settings\.field = {re.escape(repr(value))}: must be "
    ) as refused:
        kind(field=value)
    return str(refused.value).partition(": must be ")[2]


@pytest.mark.parametrize("bound", BOUNDS)
@given(value=st.floats(), limit=st.integers(-99, 99))
def test_a_number_is_accepted_exactly_within_its_bound(bound, value, limit):
    holds, sign = BOUNDS[bound]
    kind = _settings(real(limit, **{bound: limit}))
    if math.isfinite(value) and holds(value, limit):
        assert kind(field=value).field == value
    else:
        assert _refusal(kind, value) == f"a finite number {sign} {limit}"


@given(value=st.floats() | st.integers(-5, 5).map(float))
def test_two_bounds_apply_together(value):
    kind = _settings(real(0.0, above=-2, maximum=3))
    if -2 < value <= 3:
        assert kind(field=value).field == value
    else:
        assert _refusal(kind, value) == "a finite number > -2 and <= 3"


@given(value=st.floats())
def test_infinity_is_accepted_if_allowed(value):
    kind = _settings(real(1.0, above=0.0, infinite=True))
    if value > 0.0:
        assert kind(field=value).field == value
    else:
        assert _refusal(kind, value) == "a number > 0"


@given(value=st.integers(-50, 50), minimum=st.integers(-9, 9))
def test_an_integer_is_accepted_exactly_within_its_bound(value, minimum):
    kind = _settings(integer(minimum, minimum=minimum))
    for of_kind in (int, np.int32, np.int64):
        if value >= minimum:
            stored = kind(field=of_kind(value)).field
            assert type(stored) is int
            assert stored == value
        else:
            assert _refusal(kind, of_kind(value)) == f"an integer >= {minimum}"


@given(value=st.floats() | NOT_REAL)
def test_raises_if_a_value_is_not_an_integer(value):
    assume(value is not None)
    assert _refusal(_settings(integer(1, minimum=1)), value) == "an integer >= 1"


@given(value=NOT_REAL)
def test_raises_if_a_value_is_not_a_number(value):
    assert _refusal(_settings(real(1.0)), value) == "a finite number"


@pytest.mark.parametrize("of_kind", [int, float, np.float32, np.float64, np.int16])
def test_all_types_of_numbers_are_stored_as_python_numbers(of_kind):
    stored = _settings(real(1.0))(field=of_kind(2)).field
    assert type(stored) is float
    assert stored == 2.0


@pytest.mark.parametrize("field", [real(None), real(1.0, optional=True), integer(None, minimum=1)])
def test_none_is_accepted_if_allowed_and_mentioned_in_the_error(field):
    kind = _settings(field)
    assert kind(field=None).field is None
    assert _refusal(kind, "x").endswith(" or none")


@given(value=NOT_REAL | st.floats() | st.integers())
def test_a_flag_is_true_or_false(value):
    kind = _settings(flag(True))
    if isinstance(value, bool):
        assert kind(field=value).field is value
    else:
        assert _refusal(kind, value) == "true or false"


def test_a_choice_accepts_its_words_only():
    kind = _settings(choice("one", "one", "two"))
    assert kind(field="two").field == "two"
    for wrong in ("three", "", 1, None):
        assert _refusal(kind, wrong) == "one of one, two"


@pytest.mark.parametrize(
    ("field", "good", "bad", "bound"),
    [
        (
            positive_integers((64,)),
            [(1,), (), (2, 3)],
            [(0,), (1.5,), [64], (True,), 64],
            "a tuple of integers >= 1",
        ),
        (
            positive_reals(),
            [(1.0, 2), None],
            [(0.0,), (-1,), [1.0], (math.inf,), (math.nan,)],
            "a tuple of finite numbers > 0 or none",
        ),
        (
            reals(),
            [(-1.0, 2), (), None],
            [(math.nan,), [1.0], (math.inf,), ("1",)],
            "a tuple of finite numbers or none",
        ),
    ],
)
def test_tuples_are_validated(field, good, bad, bound):
    kind = _settings(field)
    for value in good:
        assert kind(field=value).field == value
    for value in bad:
        assert _refusal(kind, value) == bound


# -- names and nested mappings ---------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Inner(Checked):
    """Part of a class."""

    gain: float = real(1.0, minimum=0.0)
    limit: float = real(2.0, above=0.0)


@dataclasses.dataclass(frozen=True)
class Outer(Checked):
    """Class with a required and an optional part."""

    size: int = integer(1, minimum=1)
    always: Inner = Inner()
    maybe: Inner | None = optional_nested(Inner())


@given(st.floats(0, 10), st.integers(1, 9), st.none() | st.floats(0, 10))
def test_nested_mappings_build_dataclasses(gain, size, maybe_gain):
    mapping = {
        "size": size,
        "always": {"gain": gain},
        "maybe": None if maybe_gain is None else {"gain": maybe_gain},
    }
    expected = Outer(size, Inner(gain), None if maybe_gain is None else Inner(maybe_gain))
    assert build(Outer, mapping, "field") == expected
    assert build(Outer, dataclasses.asdict(expected), "field") == expected
    assert build(Outer, {}, "field") == Outer()


def test_parts_are_the_fields_with_dataclasses():
    assert nested_types(Outer) == {"always": Inner, "maybe": Inner}
    assert nested_types(Inner) == {}


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"siez": 2}, r"unknown field siez; did you mean size\?"),
        ({"always": {"gian": 2}}, r"unknown field always\.gian; did you mean always\.gain\?"),
        ({"maybe": {"zzz": 2}}, r"unknown field maybe\.zzz; known: gain, limit"),
        ({3: 2}, r"unknown field 3; known: size, always, maybe"),
        ({"always": 2.0}, r"field 'always' = 2\.0: must be a mapping of Inner's fields"),
        ({"maybe": [1]}, r"field 'maybe' = \[1\]: must be a mapping of Inner's fields"),
        (None, r"field '' = None: must be a mapping of Outer's fields"),
        ({"always": {"gain": -1.0}}, r"Inner\.gain = -1\.0: must be a finite number >= 0"),
        ({"size": 1.0}, r"Outer\.size = 1\.0: must be an integer >= 1"),
    ],
)
def test_raises_if_a_mapping_does_not_describe_the_fields(mapping, message):
    with pytest.raises(ValueError, match=message):
        build(Outer, mapping, "field")


def test_the_nearest_name_is_suggested_unless_it_is_distant():
    assert did_you_mean("pendulm", iter(["cartpole", "pendulum"])) == "did you mean 'pendulum'? "
    assert did_you_mean(3, ["33", "cartpole"]) == "did you mean '33'? "
    assert did_you_mean("x", ["cartpole", "pendulum"]) == did_you_mean("x", []) == ""


@given(st.lists(WORDS, max_size=4), st.lists(WORDS, min_size=1, max_size=4))
def test_raises_exactly_for_unknown_names(names, known):
    wrong = [name for name in names if name not in known]
    if not wrong:
        check_names(names, known, "thing")
        return
    with pytest.raises(ValueError, match=re.escape(f"unknown thing in.{wrong[0]}; ")):
        check_names(names, known, "thing", "in.")


FLAGS = [
    *(
        "--actuators",
        "--env.levels",
        "--env.timestep",
        "--env.disturbances.command-delay",
        "--actuator.supply.voltage",
    ),
    *(
        f"--actuator.motor.{field}"
        for field in ("resistance", "inductance", "coulomb-friction", "viscous-friction")
    ),
    *(
        "--actuator.motor.arm-radius",
        "--actuator.motor.rotor-inertia",
        "--actuator.controller.max-current",
    ),
]


@pytest.mark.parametrize(
    ("flag", "near"),
    {
        "--actuator.motor.friction": [
            "--actuator.motor.coulomb-friction",
            "--actuator.motor.viscous-friction",
        ],
        "--actuator.motor.inertia": ["--actuator.motor.rotor-inertia"],
        "--actuator.controller.current": ["--actuator.controller.max-current"],
        "--actuator.motor.inductanse": ["--actuator.motor.inductance"],
        "--actuator.motr.inductance": ["--actuator.motor.inductance"],
        "--env.delay": ["--env.disturbances.command-delay"],
        "--env.time-step": ["--env.timestep"],
        **{
            flag: []
            for flag in (
                "--actuator.backlash",
                "--actuator.motor.backlash",
                "--backlash",
                "--env.encoder",
            )
        },
    }.items(),
)
def test_suggestions_have_the_same_meaning_or_are_omitted(flag, near):
    suggestion = did_you_mean(flag, FLAGS)
    assert suggestion == (f"did you mean {' or '.join(map(repr, near))}? " if near else "")
