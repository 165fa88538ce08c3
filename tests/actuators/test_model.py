"""What a family says of itself, and what is made of it: numbers, paths, names."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from codrl_mj.actuators import (
    FAMILIES,
    IDEAL,
    Actuator,
    ActuatorModel,
    CurrentLoop,
    Drive,
    Inputs,
    Lag,
    Motor,
    Supply,
    family_name,
    family_number,
    field_paths,
    parameter_paths,
    parameters_type,
    reference,
)
from codrl_mj.fields import flag, integer, part, real
from tests.actuators.strategies import of_every_family


@dataclasses.dataclass(frozen=True)
class Inner:
    """A part of a family."""

    gain: float = real(1.0, least=0.0)
    count: int = integer(2, least=1)


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
class Other:
    """What has the fields of one and is none."""

    gain: float = real(1.0, least=0.0)
    count: int = integer(2, least=1)


@dataclasses.dataclass(frozen=True)
class Open(Nested):
    """A family that declares less of its parts than it has by default."""

    always: Inner = Finer(gain=3.0)
    maybe: Any = part(Inner(gain=4.0))


def test_parts_are_what_a_family_declares_and_not_what_it_has_by_default():
    assert Open(always=Inner(), maybe=Other(gain=2.0)).maybe.gain == 2.0
    assert Nested(always=Finer(), maybe=None).maybe is None
    for name in ("always", "maybe"):
        with pytest.raises(ValueError, match=rf"Nested\.{name} = Other\(.*\): must be a Inner; .*Nested\.from_mapping"):
            Nested(**{name: Other()})
    with pytest.raises(ValueError, match=r"Nested\.always = None: must be a Inner"):
        Nested(always=None)


@given(of_every_family)
def test_numbers_make_the_actuator_again(actuator):
    family = type(actuator)
    found = family.from_numbers(actuator.numbers, actuator.arm_radius)
    assert found.numbers == actuator.numbers
    assert len(actuator.numbers) == len(parameters_type(family)._fields)
    assert family.from_numbers(np.array(actuator.numbers), actuator.arm_radius) == found
    if family is Drive:  # the gear's ratio goes into the arm and out again
        assert found.motor.arm_radius == pytest.approx(actuator.motor.arm_radius, rel=1e-15)
        found = found.replaced({"motor.arm_radius": actuator.motor.arm_radius})
    if family in (Actuator, Drive):  # a supply that says what None does
        actuator = dataclasses.replace(actuator, supply=found.supply)
    assert found == actuator


def test_an_absent_part_and_one_of_its_numbers_are_one_actuator():
    absent, present = Actuator(), Actuator(supply=Supply())
    assert absent.numbers == present.numbers
    assert Actuator.from_numbers(present.numbers).supply is None
    assert Nested().numbers == Nested(maybe=Inner(gain=4.0)).numbers
    assert Nested.from_numbers(Nested(maybe=Inner(5.0)).numbers, 0.5) == Nested(maybe=Inner(5.0))


def test_paths_are_those_of_all_fields_and_parameters_all_but_the_arm():
    assert field_paths(Nested) == ("arm_radius", "on", "always.gain", "always.count", "maybe.gain", "maybe.count")
    assert dict(parameter_paths(Nested)) == {
        "on": "on",
        "gain": "always.gain",
        "count": "always.count",
        "maybe_gain": "maybe.gain",
        "maybe_count": "maybe.count",
    }
    assert Nested(on=False, always=Inner(2.0, 7)).numbers == (0.0, 2.0, 7.0, 4.0, 2.0)
    assert parameters_type(Actuator)._fields[:2] == ("resistance", "inductance")
    assert field_paths(type(IDEAL)) == ()
    assert parameters_type(type(IDEAL))._fields == ()


def test_two_parameters_of_one_name_are_refused():
    @dataclasses.dataclass(frozen=True)
    class Twice(ActuatorModel):
        gain: float = real(1.0)
        inner: Inner = Inner()

    with pytest.raises(ValueError, match=r"Twice: another parameter has the same name as gain: rename one"):
        parameter_paths(Twice)


def test_whole_numbers_and_flags_come_back_as_such():
    found = Nested.from_numbers((0.0, 2.0, 7.0, 4.0, 2.0), 0.25)
    assert found == Nested(0.25, False, Inner(2.0, 7))
    assert type(found.always.count) is int
    assert found.on is False


@pytest.mark.parametrize(("numbers", "arm"), [((0.0,) * 3, 1.0), ((0.0,) * 6, 1.0), ((0.5, 2.0, 7.0, 4.0, 2.0), 1.0)])
def test_too_few_or_many_numbers_or_ones_out_of_bounds_are_refused(numbers, arm):
    with pytest.raises(ValueError, match=r"zip|Nested\.on = 0\.5: must be true or false"):
        Nested.from_numbers(numbers, arm)


def test_fields_are_replaced_by_their_path():
    base = Actuator(Motor(resistance=2.0), CurrentLoop(kp=3.0))
    changed = base.replaced({"motor.inductance": 0.2, "controller.substeps": 4.0, "controller.bemf_compensation": 0.0})
    loop = CurrentLoop(kp=3.0, substeps=4, bemf_compensation=False)
    assert changed == Actuator(Motor(resistance=2.0, inductance=0.2), loop)
    assert Lag(0.1).replaced({"delay": 0.2}) == Lag(0.1, 0.2)
    assert Actuator(supply=Supply()).replaced({"supply.voltage": 12.0}).supply == Supply(voltage=12.0)
    assert base.replaced({"supply.voltage": 12.0}).supply == Supply(voltage=12.0)  # over what no supply stands for
    assert base.replaced({}) == base


def test_what_cannot_be_replaced_is_refused():
    with pytest.raises(ValueError, match=r"CurrentLoop\.substeps = 1\.5: must be an integer >= 1"):
        Actuator().replaced({"controller.substeps": 1.5})


def test_a_family_of_ours_has_its_name_and_anybody_elses_its_place():
    assert [family_name(family) for family in FAMILIES.values()] == [*FAMILIES]
    assert family_name(Nested) == reference(Nested) == f"{__name__}:Nested"


def test_a_name_of_ours_does_not_make_a_family_ours():
    @dataclasses.dataclass(frozen=True)
    class Impostor(ActuatorModel):
        family = "lag"

    assert family_name(Impostor) == reference(Impostor) != "lag"
    assert family_number(Impostor) != family_number(Lag)


def test_numbers_of_families_have_six_digits_and_differ():
    numbers = [family_number(family) for family in (*FAMILIES.values(), Nested)]
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


def test_an_actuator_is_random_where_a_field_that_draws_is_not_zero():
    noisy = Actuator(controller=CurrentLoop(current_noise=0.1))
    assert noisy.random
    assert not Actuator(controller=CurrentLoop(current_bias=0.1)).random
    assert noisy.commands()["voltage"].actuator.random


def test_the_current_loop_says_what_it_is_made_of():
    actuator = Actuator(Motor(resistance=2.0, inductance=0.3, arm_radius=0.15), CurrentLoop(max_voltage=math.inf))
    assert actuator.winding == (2.0, 0.3)
    assert actuator.arm_radius == 0.15
    assert actuator.voltage_limit == math.inf
    assert actuator.motor.electrical_time_constant == 0.15


@pytest.mark.parametrize("path", ["motor.inductanc", "motr.inductance", "gain"])
def test_an_unknown_field_is_not_replaced(path):
    with pytest.raises(ValueError, match=f"unknown actuator field {path}"):
        Actuator().replaced({path: 1.0})
