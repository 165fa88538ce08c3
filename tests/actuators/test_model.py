"""Declarations of actuator families, and their parameters, paths and names."""

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
    PwmServo,
    Supply,
    family_id,
    family_name,
    field_paths,
    import_path,
    parameter_paths,
    parameters_type,
)
from codrl_mj.fields import flag, integer, optional_nested, real
from tests.actuators.strategies import of_every_family


@dataclasses.dataclass(frozen=True)
class Inner:
    """Part of a family."""

    gain: float = real(1.0, minimum=0.0)
    count: int = integer(2, minimum=1)


@dataclasses.dataclass(frozen=True)
class Nested(ActuatorModel):
    """Family with parts, one of which is optional, and an arm."""

    arm_radius: float = real(0.5, above=0.0)
    on: bool = flag(True)
    always: Inner = Inner(gain=3.0)
    maybe: Inner | None = optional_nested(Inner(gain=4.0))


@dataclasses.dataclass(frozen=True)
class Finer(Inner):
    """Subclass of such a part."""


@dataclasses.dataclass(frozen=True)
class Open(Nested):
    """Family that declares a more general part than its default."""

    always: Inner = Finer(gain=3.0)
    maybe: Any = optional_nested(Inner(gain=4.0))


def test_parts_have_the_declared_type_not_that_of_the_default():
    assert Open(always=Inner(), maybe=Supply(12.0)).maybe.voltage == 12.0
    assert Nested(always=Finer(), maybe=None).maybe is None


@given(of_every_family)
def test_parameters_round_trip(actuator):
    family = type(actuator)
    copy = family.from_parameter_values(actuator.parameter_values, actuator.arm_radius)
    assert copy.parameter_values == actuator.parameter_values
    assert len(actuator.parameter_values) == len(parameters_type(family)._fields)
    assert (
        family.from_parameter_values(np.array(actuator.parameter_values), actuator.arm_radius)
        == copy
    )
    # The gear ratio is divided into the arm and multiplied out again.
    if family in (Drive, PwmServo):
        assert copy.motor.arm_radius == pytest.approx(actuator.motor.arm_radius, rel=1e-15)
        copy = copy.replaced({"motor.arm_radius": actuator.motor.arm_radius})
    # The parameters of no supply are those of its default.
    if family in (DCMotorActuator, Drive, PwmServo):
        actuator = dataclasses.replace(actuator, supply=copy.supply)
    assert copy == actuator


@given(of_every_family, st.sampled_from([1e-3, 0.002, 0.00123, 0.01, 0.05]))
def test_check_raises_where_instability_is_1_or_more(actuator, timestep):
    (radius,) = type(actuator).instability(np.array([actuator.parameter_values]), timestep)
    try:
        actuator.check(timestep)
    except ValueError:
        assert not radius < 1.0
    else:
        assert radius < 1.0


def test_a_missing_part_equals_its_default():
    assert (
        DCMotorActuator.from_parameter_values(
            DCMotorActuator(supply=Supply()).parameter_values
        ).supply
        is None
    )
    assert Nested().parameter_values == Nested(maybe=Inner(gain=4.0)).parameter_values
    assert Nested.from_parameter_values(Nested(maybe=Inner(5.0)).parameter_values, 0.5) == Nested(
        maybe=Inner(5.0)
    )
    actuator = Nested.from_parameter_values((0.0, 2.0, 7.0, 4.0, 2.0), 0.25)
    assert actuator == Nested(0.25, False, Inner(2.0, 7))
    # Integers and flags are restored.
    assert (type(actuator.always.count), actuator.on) == (
        int,
        False,
    )


def test_paths_cover_all_fields_and_parameters_all_but_the_arm():
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
    """Family with two parameters of the same name."""

    gain: float = real(1.0)
    inner: Inner = Inner()


LOOP = parameters_type(DCMotorActuator)(*DCMotorActuator().parameter_values)
BOUNDS = {  # field: its minimum, or its exclusive lower bound
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
    for sign, fields in BOUNDS[kind.__name__].items()
    for field in fields
]


@pytest.mark.parametrize(("kind", "field", "sign"), BOUNDS)
def test_fields_have_bounds(kind, field, sign):
    assert getattr(kind(**{field: 1e-9}), field) == 1e-9
    if sign == ">=":
        assert getattr(kind(**{field: 0}), field) == 0.0
    infinite = field in ("max_voltage", "voltage")
    refused = [-1e-9, -math.inf, math.nan, *[0.0] * (sign == ">"), *[math.inf] * (not infinite)]
    assert not infinite or getattr(kind(**{field: math.inf}), field) == math.inf
    for value in refused:
        message = (
            f"{kind.__name__}.{field} = {value!r}: must be {'a' if infinite else 'a finite'} number"
            f" {sign} 0"
        )
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
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
        (
            lambda: DCMotorActuator.from_parameter_values(LOOP._replace(substeps=1.5)),
            r"\.substeps = 1\.5",
        ),
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
def test_raises_with_field_value_and_bound(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_default_is_the_papers_motor_with_a_proportional_gain():
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


def test_fields_are_replaced_by_path():
    base = DCMotorActuator(Motor(resistance=2.0), CurrentLoop(kp=3.0))
    changed = base.replaced(
        {"motor.inductance": 0.2, "controller.substeps": 4.0, "controller.bemf_compensation": 0.0}
    )
    loop = CurrentLoop(kp=3.0, substeps=4, bemf_compensation=False)
    assert changed == DCMotorActuator(Motor(resistance=2.0, inductance=0.2), loop)
    assert Lag(0.1).replaced({"delay": 0.2}) == Lag(0.1, 0.2)
    assert DCMotorActuator(supply=Supply()).replaced({"supply.voltage": 12.0}).supply == Supply(
        voltage=12.0
        # The other values are those that no supply stands for.
    )
    assert base.replaced({"supply.voltage": 12.0}).supply == Supply(voltage=12.0)
    assert base.replaced({}) == base


def test_only_built_in_families_are_found_by_their_name():
    @dataclasses.dataclass(frozen=True)
    class Impostor(ActuatorModel):
        family = "lag"

    assert [family_name(family) for family in FAMILIES.values()] == [*FAMILIES]
    assert family_name(Nested) == import_path(Nested) == f"{__name__}:Nested"
    assert family_name(Impostor) == import_path(Impostor) != "lag"


def test_family_ids_have_six_digits_and_differ():
    numbers = [family_id(family) for family in (*FAMILIES.values(), Nested, Open)]
    assert len({*numbers}) == len(numbers)
    assert all(0 <= number < 10**6 and float(f"{number:.6g}") == number for number in numbers)


def test_the_defaults_suit_an_actuator_without_gear_electrics_and_noise():
    @dataclasses.dataclass(frozen=True)
    class Minimal(ActuatorModel):
        pass

    minimal = Minimal()
    assert minimal.arm_radius == 1.0
    assert minimal.additions == (0.0, 0.0, 0.0)
    assert minimal.winding is None
    assert minimal.voltage_limit is None
    assert not minimal.random
    assert minimal.commands() == {}
    assert minimal.check(0.01) is None
    np.testing.assert_array_equal(Minimal.instability(np.empty((3, 0)), 0.01), [0.0, 0.0, 0.0])
    rest = Inputs(0.0, 0.0, 0.0, 0.0, 0.0)
    for function in (Minimal.advance, Minimal.observe):
        with pytest.raises(NotImplementedError):
            function((), 0.01, minimal.State(), rest)
