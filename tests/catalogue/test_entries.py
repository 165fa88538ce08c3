"""Catalogue: every motor loads, has sources for its values, and is consistent or says why not."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from gym_electric_motor.physical_systems.electric_motors import DcPermanentlyExcitedMotor

from codrl_mj.actuators import Drive, TorqueSpeed, resolve
from codrl_mj.catalogue import joint_names, motor_entry, motor_names
from codrl_mj.catalogue.datasheet import QUANTITY_SPECS, Datasheet

NAMES = motor_names()
JOINTS = joint_names()
EXPLAINED = {  # disagreements above 5 % -> explanation in the notes
    ("cubemars-ak80-6", "speed_constant"): "5 % off the back-EMF",
    ("cubemars-ak80-6", "no_load_speed"): "the speed at 24 V follows the former",
    ("cubemars-ak80-9", "no_load_speed"): "6 % slower",
    ("damiao-j4310", "no_load_speed"): "5 % above",
    ("damiao-j4340", "no_load_speed"): "7 % below",
    ("damiao-j8009p", "no_load_speed"): "6 % below",
    ("frc-cim", "torque_constant"): "12 % below the back-EMF constant",
    ("heinzmann-pmg-132", "continuous_speed"): "18 % more",
    ("maxon-ec45-flat-50w", "continuous_speed"): "11 % more",
    ("maxon-ec45-flat-50w", "continuous_torque"): "10 % less",
    ("quanser-qube-servo-3", "continuous_speed"): "15 % slower",
    ("rev-neo", "torque_constant"): "27 % above",
    ("robstride-02", "no_load_speed"): "11 % above",
    ("robstride-03", "continuous_torque_at_output"): "15 % less",
    ("robstride-03", "no_load_speed"): "9 % above",
    ("robstride-03", "torque_constant"): "7 % above",
    ("robstride-04", "torque_constant"): "17 % below",
    ("robstride-04", "no_load_speed"): "11 % above",
    ("robstride-04", "continuous_torque_at_output"): "10 % less",
    ("xiaomi-cybergear", "continuous_torque_at_output"): "11 % less",
    ("xiaomi-cybergear", "torque_constant"): "6 % above",
}
CUSTOM_FILE = """
manufacturer = "mine"
product = "one"
kind = "brushed"
[datasheet]
resistance = "1 ohm"
torque_constant = "0.1 N*m/A"
inductance = "1 mH"
[estimated]
inductance = "measured on another"
[sources]
"my bench" = "the rest"
"""


def test_the_catalogue_has_motors_of_many_kinds():
    assert len(NAMES) >= 40
    assert len(NAMES) + len(JOINTS) == len({*NAMES, *JOINTS}) >= 50
    kinds = {motor_entry(name).kind for name in NAMES}
    assert {
        "brushed",
        "brushless",
        "brushless, geared",
        "brushed, geared",
        "brushed, coreless",
    } <= kinds


@pytest.mark.parametrize("name", NAMES + JOINTS)
def test_every_value_has_a_source_or_a_reason(name):
    entry = motor_entry(name)
    printed = {field for field in QUANTITY_SPECS if getattr(entry.datasheet, field) is not None}
    assert entry.sources.keys() | entry.estimated.keys() == printed
    assert not entry.sources.keys() & entry.estimated.keys()
    assert all(len(text) > 20 for text in (*entry.sources.values(), *entry.estimated.values()))
    inductance = {"inductance", "electrical_time_constant"}
    assert set(entry.estimated) <= (inductance if name in NAMES else {"stall_torque"})


@pytest.mark.parametrize("name", NAMES)
def test_a_motor_is_consistent_or_its_notes_explain_why_not(name):
    entry = motor_entry(name)
    large = {
        disagreement.quantity
        for disagreement in entry.parameters.disagreements
        if abs(disagreement.difference) > 0.05 - 1e-4
    }
    assert large == {quantity for motor, quantity in EXPLAINED if motor == name}
    for quantity in large:
        assert EXPLAINED[name, quantity] in " ".join(entry.notes.split())


@pytest.mark.parametrize("name", NAMES)
def test_the_model_meets_the_printed_operating_points(name):
    """Solve two equations, winding and shaft, for the free motor, and for the blocked one."""
    entry = motor_entry(name)
    numbers, printed = entry.parameters, entry.datasheet.parsed_values()
    friction = (numbers.coulomb_friction or 0.0), (numbers.viscous_friction or 0.0)
    # The notes explain larger disagreements; see above.
    accuracy = entry.tolerance if (name, "no_load_speed") in EXPLAINED else 0.05
    if {"no_load_speed", "nominal_voltage"} <= printed.keys():
        matrix = [
            [numbers.resistance, numbers.back_emf_constant],
            [numbers.torque_constant, -friction[1]],
        ]
        _, speed = np.linalg.solve(matrix, [numbers.voltage, friction[0]])
        ratio = numbers.gear_ratio if printed["no_load_speed"].shaft == "output" else 1.0
        assert speed / ratio == pytest.approx(printed["no_load_speed"].value, rel=accuracy)
    if "stall_torque" in printed:
        past_gear = printed["stall_torque"].shaft == "output"
        current = numbers.voltage / numbers.resistance
        torque = numbers.torque_constant * (
            current - printed["no_load_current"].value if "no_load_current" in printed else current
        )
        torque *= numbers.gear_ratio * (numbers.gear_efficiency or 1.0) if past_gear else 1.0
        assert torque == pytest.approx(printed["stall_torque"].value, rel=0.05)
    if "mechanical_time_constant" in printed:
        constant = (
            numbers.resistance
            * numbers.rotor_inertia
            / (numbers.torque_constant * numbers.back_emf_constant)
        )
        assert constant == pytest.approx(printed["mechanical_time_constant"].value, rel=0.05)


@pytest.mark.parametrize("name", JOINTS)
def test_a_motor_without_a_winding_is_its_torque_speed_line(name):
    entry = motor_entry(name)
    printed, line = entry.datasheet.parsed_values(), entry.line
    assert (line.stall_torque, line.no_load_speed) == pytest.approx(
        (printed["stall_torque"].value, printed["no_load_speed"].value)
    )
    actuator = resolve(name, None, "a robot")
    assert type(actuator) is TorqueSpeed
    assert (actuator.stall_torque, actuator.no_load_speed) == (
        line.stall_torque,
        line.no_load_speed,
    )
    assert "resistance is not printed" in actuator.assumed
    if "peak_torque" in printed:
        assert actuator.max_torque == printed["peak_torque"].value


@pytest.mark.parametrize(
    ("name", "torque", "speed"),
    [
        ("unitree-go2", 20.2, 13.5),
        ("unitree-n5020-16", 24.8, 30.86),
        ("unitree-n7520-14", 71.0, 22.63),
        ("unitree-n7520-22", 111.0, 14.5),
    ],
)
def test_the_line_passes_through_the_published_knee(name, torque, speed):
    line = motor_entry(name).line
    assert line.max_torque == torque
    at_knee = line.stall_torque * (1.0 - speed / line.no_load_speed)
    assert at_knee == pytest.approx(torque, rel=1e-4)


def test_a_file_without_a_winding_trains_as_a_torque_speed_line(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('[datasheet]\nstall_torque = "2 N*m"\nno_load_speed = "10 rad/s"')
    assert resolve(path, None, "a robot") == TorqueSpeed(2.0, 10.0)
    text = 'resistance = "2 ohm"\nkt = "0.5 N*m/A"\nvoltage = "12 V"\npeak_torque = "1 N*m"'
    path.write_text(f"[datasheet]\n{text}")
    assert resolve(path, None, "a robot") == TorqueSpeed(3.0, 24.0, 1.0)
    path.write_text(f'[datasheet]\n{text}\ninductance = "1 mH"')
    assert type(resolve(path, None, "a robot")) is Drive


@pytest.mark.parametrize("name", ["faulhaber-1331-006", "maxon-ec45-flat-50w", "maxon-re65"])
def test_the_continuous_current_matches_the_thermal_parameters(name):
    """Check at 22 to 25 degC with copper's 0.0039/K; friction and iron losses add some heat."""
    numbers = motor_entry(name).parameters
    rise = numbers.max_temperature - 25.0
    heat = numbers.continuous_current**2 * numbers.resistance * (1.0 + 0.0039 * rise)
    assert 0.7 < numbers.thermal_resistance * heat / rise < 1.0
    assert numbers.thermal_time_constant_winding < numbers.thermal_time_constant_housing


def test_the_pmg_132_equals_that_of_gym_electric_motor():
    theirs, ours = (
        DcPermanentlyExcitedMotor._default_motor_parameter,
        motor_entry("heinzmann-pmg-132").parameters,
    )
    assert (ours.resistance, ours.inductance) == pytest.approx((theirs["r_a"], theirs["l_a"]))
    assert (ours.torque_constant, ours.rotor_inertia) == pytest.approx(
        (theirs["psi_e"], theirs["j_rotor"])
    )


def test_a_custom_file_is_an_entry(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(CUSTOM_FILE)
    entry = motor_entry(str(path))
    assert (entry.name, entry.parameters.inductance) == ("mine", pytest.approx(1e-3))
    assert entry.sources == {"resistance": "my bench", "torque_constant": "my bench"}


def test_a_custom_file_needs_no_maker_and_its_values_are_checked_first(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'kind = ""\n[datasheet]\nshaft = ""\nR = ""\nkv = "340 RPM/V"\nresistance = "64'
        ' mΩ"\ninductance = "30 µH"'
    )
    with pytest.raises(ValueError, match="unknown datasheet field R"):
        motor_entry(str(path))
    path.write_text(path.read_text().replace('R = ""', 'rotor_inertia = ""'))
    entry = motor_entry(str(path))
    assert (entry.manufacturer, entry.product, entry.kind, entry.sources) == ("", "mine", "", {})
    assert entry.parameters.torque_constant == pytest.approx(60.0 / (2.0 * np.pi * 340.0))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[datasheet]", "[notes]", "datasheet missing; write [datasheet]"),
        ('kind = "brushed"', 'sort = "brushed"', "unknown entry sort"),
        (
            '"1 ohm"',
            '"1"',
            (
                "datasheet.resistance = '1': has no unit; write a number and its unit, such as"
                ' resistance = "0.464 ohm"'
            ),
        ),
        ("resistance =", "resistanse =", "did you mean resistance?"),
        ('= "the rest"', '= ["resistance"]', "none for torque_constant"),
        ('= "the rest"', "= 5", "must be a list of entries"),
        ('= "the rest"', "= [5]", "must be a list of entries"),
        ('kind = "brushed"', "kind = 5", "kind = 5: must be text"),
        ('kind = "brushed"', "notes = []", "notes = []: must be text"),
        ('kind = "brushed"', "tolerance = []", "tolerance = []: must be a number > 0"),
        ('= "the rest"', '= ["inductance"]', "unknown entry sources"),
        (
            "[estimated]\ninductance",
            "[estimated]\nrotor_inertia",
            "unknown entry estimated.rotor_inertia",
        ),
        ("[estimated]\ninductance =", "estimated =", "unknown datasheet field estimated"),
        ("[datasheet]", "[datasheet", "is not a readable TOML file"),
    ],
)
def test_raises_if_a_file_is_incomplete(tmp_path, old, new, words):
    path = tmp_path / "mine.toml"
    path.write_text(CUSTOM_FILE.replace(old, new))
    with pytest.raises(ValueError, match=r"mine\.toml") as error:
        motor_entry(str(path))
    assert words in str(error.value)


def test_raises_with_the_nearest_name_of_an_unknown_motor():
    with pytest.raises(ValueError, match="did you mean maxon-re65"):
        motor_entry("maxon-re-65")


def test_the_docs_list_every_motor_and_their_examples_run(tmp_path, capsys):
    docs = Path(__file__).parents[2] / "docs"
    catalogue = (docs / "actuators_in_numbers.md").read_text().partition("## The catalogue")[2]
    assert re.findall(r"^\| `([\w-]+)`", catalogue, re.M) == NAMES + JOINTS
    page, names = (docs / "motors.md").read_text(), {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        if "motor_entry" in block:
            exec(block, names)
    assert "gear_efficiency = stall_torque_at_output" in capsys.readouterr().out
    path, written = tmp_path / "my_motor.toml", re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (line,) = (text for text in written if "without electrical values" in text)
    written.remove(line)
    for upto in range(1, len(written) + 1):
        path.write_text("".join(written[:upto]))
        assert motor_entry(str(path)).parameters.rotor_inertia == pytest.approx(1.05e-6)
    path.write_text(line)
    assert motor_entry(str(path)).line[:3] == pytest.approx((0.22555, 10.472, 0.15691), rel=1e-4)
    path.write_text("".join(written))
    assert motor_entry(str(path)).sources["stall_torque"] == "a page"
    assert set(motor_entry(str(path)).estimated) == {"inductance"}


def test_the_docs_list_every_field_of_a_datasheet():
    page = (Path(__file__).parents[2] / "docs" / "motors.md").read_text()
    named = set(
        re.findall(
            r"`(\w+)`", page.partition("## What you can write")[2].partition("Mind three")[0]
        )
    )
    assert {field.name for field in dataclasses.fields(Datasheet)} <= named
