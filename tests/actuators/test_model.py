"""What a family says of itself, and what is made of it: numbers, paths, names."""

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.actuators import (
    FAMILIES,
    IDEAL,
    ActuatorModel,
    CurrentLoop,
    DCMotorActuator,
    Drive,
    Inputs,
    Lag,
    Motor,
    Supply,
    family_name,
    family_id,
    field_paths,
    parameter_paths,
    parameters_type,
    import_path,
)
from codrl_mj.fields import flag, integer, part, real
from tests.actuators.strategies import of_every_family


@dataclasses.dataclass(frozen=True)
class Inner:
    """A part of a family."""

    gain: float = real(1.0, minimum=0.0)
    count: int = integer(2, minimum=1)


@dataclasses.dataclass(frozen=True)
class Nested(ActuatorModel):
    """A family with parts, one of which may be absent, and an arm."""

    arm_radius: float = real(0.5, above=0.0)
    on: bool = flag(True)
    always: Inner = Inner(gain=3.0)
    maybe: Inner | None = part(Inner(gain=4.0))


@dataclasses.dataclass(frozen=True)
class Finer(Inner):
    """A kind of such a part."""


@dataclasses.dataclass(frozen=True)
class Open(Nested):
    """A family that declares less of its parts than it has by default."""

    always: Inner = Finer(gain=3.0)
    maybe: Any = part(Inner(gain=4.0))


def test_parts_are_what_a_family_declares_and_not_what_it_has_by_default():
    assert Open(always=Inner(), maybe=Supply(12.0)).maybe.voltage == 12.0
    assert Nested(always=Finer(), maybe=None).maybe is None


@given(of_every_family)
def test_numbers_make_the_actuator_again(actuator):
    family = type(actuator)
    found = family.from_parameter_values(actuator.parameter_values, actuator.arm_radius)
    assert found.parameter_values == actuator.parameter_values
    assert len(actuator.parameter_values) == len(parameters_type(family)._fields)
    assert family.from_parameter_values(np.array(actuator.parameter_values), actuator.arm_radius) == found
    if family is Drive:  # the gear's ratio goes into the arm and out again
        assert found.motor.arm_radius == pytest.approx(actuator.motor.arm_radius, rel=1e-15)
        found = found.replaced({"motor.arm_radius": actuator.motor.arm_radius})
    if family in (DCMotorActuator, Drive):  # a supply that says what None does
        actuator = dataclasses.replace(actuator, supply=found.supply)
    assert found == actuator


@given(of_every_family, st.sampled_from([1e-3, 0.002, 0.00123, 0.01, 0.05]))
def test_what_is_refused_is_what_counts_as_unstable(actuator, timestep):
    (radius,) = type(actuator).instability(np.array([actuator.parameter_values]), timestep)
    try:
        actuator.check(timestep)
    except ValueError:
        assert not radius < 1.0
    else:
        assert radius < 1.0


def test_an_absent_part_and_one_of_its_numbers_are_one_actuator():
    assert DCMotorActuator.from_parameter_values(DCMotorActuator(supply=Supply()).parameter_values).supply is None
    assert Nested().parameter_values == Nested(maybe=Inner(gain=4.0)).parameter_values
    assert Nested.from_parameter_values(Nested(maybe=Inner(5.0)).parameter_values, 0.5) == Nested(maybe=Inner(5.0))
    found = Nested.from_parameter_values((0.0, 2.0, 7.0, 4.0, 2.0), 0.25)
    assert found == Nested(0.25, False, Inner(2.0, 7))
    assert (type(found.always.count), found.on) == (
        int,
        False,
    )  # whole numbers and flags come back as such


def test_paths_are_those_of_all_fields_and_parameters_all_but_the_arm():
    assert field_paths(Nested) == (
        "arm_radius",
        "on",
        "always.gain",
        "always.count",
        "maybe.gain",
        "maybe.count",
    )
    assert dict(parameter_paths(Nested)) == {
        "on": "on",
        "gain": "always.gain",
        "count": "always.count",
        "maybe_gain": "maybe.gain",
        "maybe_count": "maybe.count",
    }
    assert Nested(on=False, always=Inner(2.0, 7)).parameter_values == (0.0, 2.0, 7.0, 4.0, 2.0)
    assert parameters_type(DCMotorActuator)._fields[:2] == ("resistance", "inductance")
    assert field_paths(type(IDEAL)) == ()
    assert parameters_type(type(IDEAL))._fields == ()


@dataclasses.dataclass(frozen=True)
class Twice(ActuatorModel):
    """A family that has a name twice."""

    gain: float = real(1.0)
    inner: Inner = Inner()


LOOP = parameters_type(DCMotorActuator)(*DCMotorActuator().parameter_values)
LEAST = {  # field: the least that it may be, or what it must be more than
    "Motor": {
        ">": ("resistance", "inductance", "torque_constant", "arm_radius"),
        ">=": ("back_emf_constant",),
    },
    "CurrentLoop": {
        ">": ("max_voltage",),
        ">=": (
            "kp",
            "ki",
            "kd",
            "kff",
            "integral_leak",
            "derivative_time_constant",
            "current_noise",
        ),
    },
    "Supply": {">": ("voltage",), ">=": ("resistance",)},
}
BOUNDS = [
    (kind, field, sign)
    for kind in (Motor, CurrentLoop, Supply)
    for sign, fields in LEAST[kind.__name__].items()
    for field in fields
]


@pytest.mark.parametrize(("kind", "field", "sign"), BOUNDS)
def test_quantities_have_their_bounds(kind, field, sign):
    assert getattr(kind(**{field: 1e-9}), field) == 1e-9
    if sign == ">=":
        assert getattr(kind(**{field: 0}), field) == 0.0
    infinite = field in ("max_voltage", "voltage")
    refused = [-1e-9, -math.inf, math.nan, *[0.0] * (sign == ">"), *[math.inf] * (not infinite)]
    assert not infinite or getattr(kind(**{field: math.inf}), field) == math.inf
    for value in refused:
        said = (
            f"{kind.__name__}.{field} = {value!r}: must be {'a' if infinite else 'a finite'} number"
            f" {sign} 0"
        )
        with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
            kind(**{field: value})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Nested(always=Supply()),
            r"Nested\.always = .*: must be a Inner; .*Nested\.from_mapping",
        ),
        (
            lambda: Nested(maybe=Supply()),
            r"Nested\.maybe = .*: must be a Inner; .*Nested\.from_mapping",
        ),
        (lambda: Nested(always=None), r"Nested\.always = None: must be a Inner"),
        (lambda: DCMotorActuator(motor={}), r"Actuator\.motor = .*must be a Motor.*from_mapping"),
        (
            lambda: parameter_paths(Twice),
            r"Twice: another parameter has the same name as gain: rename one",
        ),
        (
            lambda: CurrentLoop(current_bias=math.inf),
            r"CurrentLoop\.current_bias = inf: must be a finite number$",
        ),
        (lambda: CurrentLoop(substeps=0), r"CurrentLoop\.substeps = 0: must be an integer >= 1"),
        (
            lambda: CurrentLoop(bemf_compensation=1),
            r"CurrentLoop\.bemf_compensation = 1: must be true or false",
        ),
        (lambda: Lag(gain=0.0), r"Lag\.gain = 0\.0: must be a finite number > 0"),
        (lambda: Nested.from_parameter_values((0.0,) * 3), "zip"),
        (lambda: Nested.from_parameter_values((0.0,) * 6), "zip"),
        (
            lambda: Nested.from_parameter_values((0.5, 2.0, 7.0, 4.0, 2.0)),
            r"Nested\.on = 0\.5: must be true or false",
        ),
        (lambda: DCMotorActuator.from_parameter_values(LOOP._replace(substeps=1.5)), r"\.substeps = 1\.5"),
        (
            lambda: DCMotorActuator.from_parameter_values(LOOP._replace(substeps=math.inf)),
            r"\.substeps = inf",
        ),
        (
            lambda: DCMotorActuator.from_parameter_values(LOOP._replace(bemf_compensation=2.0)),
            r"\.bemf_compensation = 2",
        ),
        (
            lambda: DCMotorActuator.from_parameter_values(LOOP._replace(supply_resistance=-1.0)),
            r"Supply\.resistance = -1\.0",
        ),
        (
            lambda: DCMotorActuator.from_parameter_values(LOOP, 0.0),
            r"Motor\.arm_radius = 0\.0: must be a finite number > 0",
        ),
        (
            lambda: DCMotorActuator().replaced({"controller.substeps": 1.5}),
            r"substeps = 1\.5: must be an integer >= 1",
        ),
        (
            lambda: DCMotorActuator().replaced({"motor.inductanc": 1.0}),
            "unknown actuator field motor.inductanc",
        ),
        (
            lambda: DCMotorActuator().replaced({"motr.inductance": 1.0}),
            "unknown actuator field motr.inductance",
        ),
    ],
)
def test_what_is_no_actuator_is_refused_with_field_value_and_bound(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_current_loop_by_default_is_the_papers_motor_under_a_proportional_gain():
    assert Motor() == Motor(1.0, 0.1, 1.0, 1.0, 1.0)
    loop = CurrentLoop()
    assert (loop.ki, loop.kd, loop.kff, loop.integral_leak, loop.derivative_time_constant) == (
        0,
        0,
        0,
        0,
        0,
    )
    assert (loop.current_bias, loop.current_noise, loop.bemf_compensation, loop.substeps) == (
        0,
        0,
        True,
        1,
    )
    assert DCMotorActuator().supply is None
    with pytest.raises(dataclasses.FrozenInstanceError):
        loop.ki = 2.0


def test_fields_are_replaced_by_their_path():
    base = DCMotorActuator(Motor(resistance=2.0), CurrentLoop(kp=3.0))
    changed = base.replaced(
        {"motor.inductance": 0.2, "controller.substeps": 4.0, "controller.bemf_compensation": 0.0}
    )
    loop = CurrentLoop(kp=3.0, substeps=4, bemf_compensation=False)
    assert changed == DCMotorActuator(Motor(resistance=2.0, inductance=0.2), loop)
    assert Lag(0.1).replaced({"delay": 0.2}) == Lag(0.1, 0.2)
    assert DCMotorActuator(supply=Supply()).replaced({"supply.voltage": 12.0}).supply == Supply(
        voltage=12.0
    )
    assert base.replaced({"supply.voltage": 12.0}).supply == Supply(
        voltage=12.0
    )  # over what no supply stands for
    assert base.replaced({}) == base


def test_a_family_of_ours_has_its_name_and_anybody_elses_its_place_whatever_name_it_takes():
    @dataclasses.dataclass(frozen=True)
    class Impostor(ActuatorModel):
        family = "lag"

    assert [family_name(family) for family in FAMILIES.values()] == [*FAMILIES]
    assert family_name(Nested) == import_path(Nested) == f"{__name__}:Nested"
    assert family_name(Impostor) == import_path(Impostor) != "lag"


def test_numbers_of_families_have_six_digits_and_differ():
    numbers = [family_id(family) for family in (*FAMILIES.values(), Nested, Open)]
    assert len({*numbers}) == len(numbers)
    assert all(0 <= number < 10**6 and float(f"{number:.6g}") == number for number in numbers)


def test_the_defaults_are_those_of_an_actuator_without_gear_electrics_and_chance():
    @dataclasses.dataclass(frozen=True)
    class Least(ActuatorModel):
        pass

    least = Least()
    assert least.arm_radius == 1.0
    assert least.additions == (0.0, 0.0, 0.0)
    assert least.winding is None
    assert least.voltage_limit is None
    assert not least.random
    assert least.commands() == {}
    assert least.check(0.01) is None
    np.testing.assert_array_equal(Least.instability(np.empty((3, 0)), 0.01), [0.0, 0.0, 0.0])
    rest = Inputs(0.0, 0.0, 0.0, 0.0, 0.0)
    for function in (Least.advance, Least.observe):
        with pytest.raises(NotImplementedError):
            function((), 0.01, least.State(), rest)
