"""The current loop's parameters: what is refused, and that every representation holds the same actuator."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given

from codrl_mj.actuators import Actuator, CurrentLoop, Motor, Supply, actuator_from_mapping, parameters_type
from tests.actuators.strategies import every_actuator

PARAMETERS = parameters_type(Actuator)
POSITIVE = [(Motor, name) for name in ("resistance", "inductance", "torque_constant", "arm_radius")]
NOT_NEGATIVE = [
    (Motor, "back_emf_constant"),
    *((CurrentLoop, name) for name in ("kp", "ki", "kd", "kff", "integral_leak", "derivative_time_constant")),
    (CurrentLoop, "current_noise"),
    (Supply, "resistance"),
]
NOT_NUMBERS = [True, False, "1", None, [1.0], np.True_, np.array([1.0, 2.0]), 1j]


def _refusal(kind, field, value):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the message is examined
        kind(**{field: value})
    return str(refused.value)


@pytest.mark.parametrize(("kind", "field"), POSITIVE)
@pytest.mark.parametrize("value", [0.0, -0.0, -1.5, math.nan, math.inf, -math.inf, *NOT_NUMBERS], ids=repr)
def test_a_quantity_that_must_be_positive_is_refused_with_field_value_and_bound(kind, field, value):
    message = _refusal(kind, field, value)
    assert message.startswith(f"{kind.__name__}.{field} = {value!r}: must be ")
    assert message.endswith("> 0")


@pytest.mark.parametrize(("kind", "field"), NOT_NEGATIVE)
@pytest.mark.parametrize("value", [-1e-9, -1.5, math.nan, math.inf, -math.inf, *NOT_NUMBERS], ids=repr)
def test_a_quantity_that_must_not_be_negative_is_refused_with_field_value_and_bound(kind, field, value):
    message = _refusal(kind, field, value)
    assert message.startswith(f"{kind.__name__}.{field} = {value!r}: must be ")
    assert message.endswith(">= 0")


VOLTAGES = [(CurrentLoop, "max_voltage"), (Supply, "voltage")]


@pytest.mark.parametrize(("kind", "field"), VOLTAGES)
@pytest.mark.parametrize("value", [0.0, -24.0, math.nan, -math.inf, *NOT_NUMBERS], ids=repr)
def test_a_voltage_is_refused_unless_positive(kind, field, value):
    message = _refusal(kind, field, value)
    assert message.startswith(f"{kind.__name__}.{field} = {value!r}: must be ")
    assert message.endswith("> 0")


@pytest.mark.parametrize(("kind", "field"), VOLTAGES)
@pytest.mark.parametrize("value", [math.inf, np.float32(np.inf), np.float64(np.inf)], ids=repr)
def test_a_voltage_may_be_infinite(kind, field, value):
    assert getattr(kind(**{field: value}), field) == math.inf


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, *NOT_NUMBERS], ids=repr)
def test_the_sensors_bias_may_be_any_finite_number(value):
    assert CurrentLoop(current_bias=-1.5).current_bias == -1.5
    assert _refusal(CurrentLoop, "current_bias", value).startswith(f"CurrentLoop.current_bias = {value!r}: must be ")


@pytest.mark.parametrize("value", [0, -1, 1.0, 1.5, True, "2", None, math.nan], ids=repr)
def test_substeps_must_be_an_integer_of_at_least_one(value):
    assert _refusal(CurrentLoop, "substeps", value) == f"CurrentLoop.substeps = {value!r}: must be an integer >= 1"


def test_substeps_may_be_any_kind_of_integer_and_are_stored_as_an_int():
    assert type(CurrentLoop(substeps=np.int64(3)).substeps) is int
    assert CurrentLoop(substeps=np.int64(3)) == CurrentLoop(substeps=3)


@pytest.mark.parametrize("value", [0, 1, 1.0, "yes", None], ids=repr)
def test_bemf_compensation_must_be_a_bool(value):
    message = _refusal(CurrentLoop, "bemf_compensation", value)
    assert message == f"CurrentLoop.bemf_compensation = {value!r}: must be true or false"


@pytest.mark.parametrize(("kind", "field"), NOT_NEGATIVE)
def test_zero_is_fine_where_the_bound_includes_it(kind, field):
    assert getattr(kind(**{field: 0}), field) == 0.0


@pytest.mark.parametrize("value", [2, np.float32(2), np.float64(2), np.int64(2)], ids=repr)
def test_every_kind_of_real_number_is_stored_as_a_float(value):
    stored = Motor(resistance=value).resistance
    assert type(stored) is float
    assert stored == 2.0


def test_defaults_are_the_papers_motor_under_a_plain_proportional_loop():
    assert Motor() == Motor(1.0, 0.1, 1.0, 1.0, 1.0)
    loop = CurrentLoop()
    assert (loop.ki, loop.kd, loop.kff, loop.integral_leak, loop.derivative_time_constant) == (0, 0, 0, 0, 0)
    assert (loop.current_bias, loop.current_noise) == (0, 0)
    assert Actuator().supply is None
    assert loop.bemf_compensation
    assert loop.substeps == 1


@pytest.mark.parametrize("value", [Motor(), CurrentLoop(), Supply(), Actuator()])
def test_actuators_are_frozen(value):
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, dataclasses.fields(value)[0].name, 2.0)


@pytest.mark.parametrize(("field", "kind"), [("motor", "Motor"), ("controller", "CurrentLoop"), ("supply", "Supply")])
def test_a_mapping_in_place_of_a_part_is_refused_with_the_remedy(field, kind):
    with pytest.raises(ValueError, match=rf"Actuator\.{field} = .*must be a {kind}.*from_mapping"):
        Actuator(**{field: {}})


@pytest.mark.parametrize(
    ("mapping", "wrong", "suggested"),
    [
        ({"motr": {}}, "motr", "motor"),
        ({"controllr": {}}, "controllr", "controller"),
        ({"motor": {"inductanse": 0.1}}, "motor.inductanse", "motor.inductance"),
        ({"motor": {"arm_radus": 0.1}, "controller": {}}, "motor.arm_radus", "motor.arm_radius"),
        ({"controller": {"max_volts": 5.0}}, "controller.max_volts", "controller.max_voltage"),
        ({"controller": {"kf": 5.0}}, "controller.kf", "controller.kff"),
        ({"supply": {"resistence": 5.0}}, "supply.resistence", "supply.resistance"),
    ],
)
def test_an_unknown_field_of_a_mapping_is_named_and_the_nearest_suggested(mapping, wrong, suggested):
    with pytest.raises(ValueError, match=f"unknown actuator field {wrong}; did you mean {suggested}") as refused:
        Actuator.from_mapping(mapping)
    assert str(refused.value).endswith("?")


def test_an_unknown_field_like_none_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown actuator field motor\.zzz; known: resistance, inductance,"):
        Actuator.from_mapping({"motor": {"zzz": 1.0}})


def test_a_value_where_a_mapping_belongs_is_refused():
    with pytest.raises(ValueError, match=r"'motor' = 3\.0: must be a mapping of Motor's fields"):
        Actuator.from_mapping({"motor": 3.0})


def test_a_bad_value_inside_a_mapping_is_refused_as_in_the_constructor():
    with pytest.raises(ValueError, match=r"CurrentLoop\.ki = -2\.0: must be a finite number >= 0"):
        Actuator.from_mapping({"controller": {"ki": -2.0}})


def test_absent_fields_of_a_mapping_take_the_defaults():
    assert Actuator.from_mapping({}) == Actuator()
    assert Actuator.from_mapping({"motor": {"resistance": 3}}) == Actuator(Motor(resistance=3.0))


@given(every_actuator)
def test_mapping_round_trip(actuator):
    assert Actuator.from_mapping(actuator.as_mapping()) == actuator
    assert actuator_from_mapping(actuator.as_mapping()) == actuator


@given(every_actuator)
def test_json_round_trip(actuator):
    assert Actuator.from_mapping(json.loads(json.dumps(actuator.as_mapping()))) == actuator


@given(every_actuator)
def test_every_number_is_where_its_name_says(actuator):
    assert len(actuator.numbers) == len(PARAMETERS._fields)
    supply = actuator.supply or Supply()
    for name, value in zip(PARAMETERS._fields, actuator.numbers, strict=True):
        owner = actuator.motor if hasattr(actuator.motor, name) else actuator.controller
        if name.startswith("supply_"):
            owner, name = supply, name.removeprefix("supply_")
        assert value == float(getattr(owner, name))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("substeps", 1.5),
        ("substeps", 0.0),
        ("substeps", math.nan),
        ("substeps", math.inf),
        ("bemf_compensation", 0.5),
        ("bemf_compensation", 2.0),
        ("bemf_compensation", math.nan),
        ("resistance", -1.0),
        ("inductance", 0.0),
        ("kp", math.nan),
        ("max_voltage", 0.0),
        ("current_noise", -1.0),
    ],
)
def test_a_number_out_of_bounds_is_refused_by_name(name, value):
    numbers = PARAMETERS(*Actuator().numbers)._replace(**{name: value})
    with pytest.raises(ValueError, match=rf"\.{name} = {value:g}"):
        Actuator.from_numbers(numbers, 1.0)


def test_a_bad_number_of_the_supply_is_refused_by_name():
    numbers = PARAMETERS(*Actuator().numbers)._replace(supply_resistance=-1.0)
    with pytest.raises(ValueError, match=r"Supply\.resistance = -1\.0: must be a finite number >= 0"):
        Actuator.from_numbers(numbers, 1.0)


def test_numbers_with_a_bad_arm_are_refused():
    with pytest.raises(ValueError, match=r"Motor\.arm_radius = 0\.0: must be a finite number > 0"):
        Actuator.from_numbers(Actuator().numbers, 0.0)
