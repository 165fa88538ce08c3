"""Datasheets: printed values yield the original motor, and mistakes raise errors."""

import dataclasses
import math
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.catalogue import Datasheet, from_datasheet, motor_entry, relations, units
from codrl_mj.catalogue.datasheet import QUANTITY_SPECS, to_field_names

UNITS = {  # SI value of one unit, by definition
    "V": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "A": {"A": 1.0, "mA": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3},
    "N*m": {
        "N*m": 1.0,
        "mN*m": 1e-3,
        "mNm": 1e-3,
        "Ncm": 1e-2,
        "N·m": 1.0,
        "kgf*cm": 9.80665e-2,
        "ozf*in": 0.45359237 * 9.80665 / 16.0 * 0.0254,
    },
    "rad/s": {
        "rad/s": 1.0,
        "rpm": math.tau / 60.0,
        "min^-1": math.tau / 60.0,
        "turn/s": math.tau,
        "deg/s": math.pi / 180,
    },
    "rad/s/V": {"rad/s/V": 1.0, "rpm/V": math.tau / 60.0},
    "V*s/rad": {"V*s/rad": 1.0, "V/rpm": 60.0 / math.tau, "mV/rpm": 0.06 / math.tau, "Wb": 1.0},
    "N*m/A": {"N*m/A": 1.0, "mNm/A": 1e-3, "Ncm/A": 1e-2},
    "kg*m^2": {"kg*m^2": 1.0, "g*cm^2": 1e-7, "gcm²": 1e-7, "kgm2": 1.0},
    "ohm": {"ohm": 1.0, "Ω": 1.0, "mohm": 1e-3},
    "H": {"H": 1.0, "mH": 1e-3, "µH": 1e-6, "uH": 1e-6},
}
SIZES = st.floats(1e-3, 1e3)
CIM = {
    "nominal_voltage": "12 V",
    "stall_torque": "2.42 N*m",
    "stall_current": "133 A",
    "no_load_speed": "5310 rpm",
    "no_load_current": "2.7 A",
    "inductance": "59 uH",
}
GEARED = {"resistance": "1 ohm", "inductance": "1 mH", "gear_ratio": 10}
POLOLU = {
    "gear_ratio": "30:1",
    "nominal_voltage": "12 V",
    "stall_torque": "14 kgf*cm",
    "stall_current": "5.5 A",
    "no_load_speed": "330 rpm",
    "no_load_current": "0.2 A",
    "inductance": "1.3 mH",
}


@pytest.mark.parametrize(
    ("kind", "unit"),
    [(kind, unit) for kind, sizes in units._COMMON_UNITS.items() for unit in sizes],
)
def test_common_units_have_exactly_pints_sizes(kind, unit, monkeypatch):
    numbers = [
        units.to_si(number, unit, kind, mass_as_weight=True)
        for number in (1.0, 0.1, 12345.678, -3e-7)
    ]
    monkeypatch.setattr(units, "_COMMON_UNITS", {})
    assert numbers == [
        units.to_si(number, unit, kind, mass_as_weight=True)
        for number in (1.0, 0.1, 12345.678, -3e-7)
    ]


@st.composite
def _motors(draw):
    """Draw an ideal motor and the SI values of its datasheet at the motor's shaft."""
    voltage, resistance, constant, inertia = draw(SIZES), draw(SIZES), draw(SIZES), draw(SIZES)
    stall = voltage / resistance
    free = stall * draw(st.floats(0.0, 0.3))
    motor = {
        "resistance": resistance,
        "torque_constant": constant,
        "rotor_inertia": inertia,
        "voltage": voltage,
    }
    printed = {
        "nominal_voltage": voltage,
        "stall_torque": constant * (stall - free),
        "stall_current": stall,
        "no_load_speed": (voltage - resistance * free) / constant,
        "no_load_current": free,
        "mechanical_time_constant": resistance * inertia / constant**2,
        "electrical_time_constant": draw(SIZES) / resistance,
    }
    return motor, printed


@st.composite
def _print(draw, printed):
    """Return the values as text, each in a randomly chosen unit."""
    text = {}
    for name, value in printed.items():
        unit, size = draw(st.sampled_from(sorted(UNITS[QUANTITY_SPECS[name].unit].items())))
        text[name] = f"{value / size!r} {unit}"
    return text


@given(st.data())
def test_stall_and_no_load_points_yield_the_motor(data):
    motor, printed = data.draw(_motors())
    numbers = from_datasheet(**data.draw(_print(printed)))
    for name, value in motor.items():
        assert getattr(numbers, name) == pytest.approx(value, rel=1e-12), name
    assert numbers.back_emf_constant == pytest.approx(motor["torque_constant"], rel=1e-12)
    assert numbers.inductance == pytest.approx(
        printed["electrical_time_constant"] * motor["resistance"], rel=1e-12
    )
    assert numbers.coulomb_friction == pytest.approx(
        motor["torque_constant"] * printed["no_load_current"], rel=1e-12
    )
    assert numbers.viscous_friction == 0.0
    assert numbers.disagreements == ()


@given(st.data(), st.floats(1.0, 500.0), st.floats(0.25, 0.99))
def test_values_at_the_output_yield_the_motor(data, ratio, efficiency):
    motor, printed = data.draw(_motors())
    printed["stall_torque"] *= ratio * efficiency
    printed["no_load_speed"] /= ratio
    printed["rotor_inertia"] = motor["rotor_inertia"] * ratio**2
    text = data.draw(_print(printed))
    text["rotor_inertia"] += " at output"
    numbers = from_datasheet(shaft="output", gear_ratio=ratio, **text)
    # The gear transmits this share of the torque.
    assert numbers.gear_efficiency == pytest.approx(efficiency, rel=1e-11)
    free = efficiency * motor["torque_constant"] * printed["no_load_current"]
    assert numbers.coulomb_friction == pytest.approx(free, rel=1e-11)
    # Without these, the constant follows from the torque if the efficiency is printed.
    for name, value in motor.items():
        assert getattr(numbers, name) == pytest.approx(value, rel=1e-12), name
    del text["no_load_speed"]
    numbers_without_loss = from_datasheet(
        shaft="output",
        gear_ratio=f"{ratio!r}:1",
        gear_efficiency=f"{efficiency * 100.0!r} %",
        **text,
    )
    assert numbers_without_loss.torque_constant == pytest.approx(
        motor["torque_constant"], rel=1e-12
    )


@given(st.data())
def test_constants_yield_the_motor(data):
    motor, printed = data.draw(_motors())
    constant, ohms = motor["torque_constant"], motor["resistance"]
    inertia, henries = motor["rotor_inertia"], printed["electrical_time_constant"] * ohms
    printed_constant = data.draw(
        st.sampled_from(
            [
                {"torque_constant": constant},
                {"back_emf_constant": constant},
                {"speed_constant": 1 / constant},
            ]
        )
    )
    numbers = from_datasheet(
        **data.draw(
            _print(
                {
                    "resistance": ohms,
                    "inductance": henries,
                    "rotor_inertia": inertia,
                    **printed_constant,
                }
            )
        )
    )
    expected = (ohms, henries, constant, constant, inertia)
    constants = (
        numbers.resistance,
        numbers.inductance,
        numbers.torque_constant,
        numbers.back_emf_constant,
    )
    assert (*constants, numbers.rotor_inertia) == pytest.approx(expected, rel=1e-12)
    assert numbers.voltage is numbers.coulomb_friction is numbers.continuous_current is None


@given(st.data(), st.floats(0.35, 0.9))
def test_two_points_of_the_line_yield_the_motor(data, load):
    motor, printed = data.draw(_motors())
    current = load * printed["stall_current"]
    point = {
        "continuous_current": current,
        "continuous_speed": (
            (motor["voltage"] - motor["resistance"] * current) / motor["torque_constant"]
        ),
        "continuous_torque": motor["torque_constant"] * (current - printed["no_load_current"]),
    }
    free = {name: printed[name] for name in ("nominal_voltage", "no_load_speed", "no_load_current")}
    numbers = from_datasheet(inductance="1 mH", **data.draw(_print(free | point)))
    assert numbers.resistance == pytest.approx(motor["resistance"], rel=1e-12)
    assert numbers.torque_constant == pytest.approx(motor["torque_constant"], rel=1e-11)


@given(st.floats(0.01, 0.9))
def test_printed_friction_is_part_of_the_no_load_current(share):
    free = {
        "resistance": "1 ohm",
        "inductance": "1 mH",
        "torque_constant": "0.1 N*m/A",
        "no_load_current": "1 A",
    }
    coulomb = from_datasheet(
        **free, no_load_speed="100 rad/s", coulomb_friction=f"{0.1 * share!r} N*m"
    )
    assert coulomb.viscous_friction == pytest.approx(0.1 * (1.0 - share) / 100.0)
    more = from_datasheet(
        **free, no_load_speed="100 rad/s", coulomb_friction=f"{0.1 + 0.01 * share!r} N*m"
    )
    assert more.viscous_friction == 0.0
    more = from_datasheet(
        **free, no_load_speed="100 rad/s", viscous_friction=f"{1e-3 + 1e-4 * share!r} N*m*s/rad"
    )
    assert more.coulomb_friction == 0.0
    viscous = from_datasheet(
        **free, no_load_speed="100 rad/s", viscous_friction=f"{1e-3 * share!r} N*m*s/rad"
    )
    assert viscous.coulomb_friction == pytest.approx(0.1 * (1.0 - share))


@pytest.mark.parametrize("known", ["torque_constant", "back_emf_constant", "speed_constant"])
def test_constants_at_the_output_are_converted_by_the_ratio(known):
    value = {
        "torque_constant": "3 N*m/A",
        "back_emf_constant": "3 V*s/rad",
        "speed_constant": "1 rad/s/V",
    }[known]
    factor = 1.0 if known == "speed_constant" else 3.0
    numbers = from_datasheet(
        resistance="1 ohm", inductance="1 mH", gear_ratio=30, shaft="output", **{known: value}
    )
    assert (numbers.torque_constant, numbers.back_emf_constant) == pytest.approx(
        (factor / 30.0, factor / 30.0)
    )


def test_without_a_no_load_current_none_is_subtracted():
    numbers = from_datasheet(
        **{name: value for name, value in CIM.items() if name != "no_load_current"}
    )
    assert numbers.torque_constant == pytest.approx(2.42 / 133.0)
    assert numbers.back_emf_constant == pytest.approx(12.0 / (5310.0 * math.tau / 60.0))
    assert numbers.coulomb_friction is numbers.viscous_friction is None


def test_a_gear_efficiency_is_at_most_1():
    """Check that 1.05 by rounding becomes 1 and a disagreement, and that larger values raise."""
    geared = {**GEARED, "torque_constant": "0.1 N*m/A at motor"}
    numbers = from_datasheet(
        **geared, continuous_current="2 A", continuous_torque="2.1 N*m at output"
    )
    assert numbers.gear_efficiency == 1.0
    assert numbers.disagreements[0].difference == pytest.approx(2.0 / 2.1 - 1.0)
    with pytest.raises(ValueError, match=r"gear_efficiency = 1\.5"):
        from_datasheet(**geared, continuous_current="2 A", continuous_torque="3 N*m at output")


def test_the_continuous_torque_at_the_output_yields_the_current():
    geared = {**GEARED, "torque_constant": "0.1 N*m/A at motor"}
    numbers = from_datasheet(
        **geared, gear_efficiency=0.5, continuous_torque="2 N*m at output", no_load_current="1 A"
    )
    assert numbers.continuous_current == pytest.approx(2.0 / (10.0 * 0.5 * 0.1) + 1.0)
    assert numbers.disagreements == ()


def test_every_parameter_has_an_origin():
    numbers = from_datasheet(
        **CIM,
        max_winding_temperature="125 °C",
        thermal_resistance_winding="3 °C/W",
        thermal_resistance_housing="2 degC/W",
    )
    assert (
        numbers.derived["resistance"]
        == "resistance = nominal_voltage / stall_current = 12 V / 133 A = 0.09023 ohm"
    )
    assert numbers.derived["voltage"] == "voltage = 12 V, printed as nominal_voltage"
    assert (numbers.max_temperature, numbers.thermal_resistance_winding) == pytest.approx(
        (125.0, 3.0)
    )
    assert numbers.thermal_resistance_housing == pytest.approx(2.0)
    assert numbers.derived["thermal_resistance"].endswith("= 3 K/W + 2 K/W = 5 K/W")
    for name in vars(numbers):
        known = getattr(numbers, name) is not None and name not in ("derived", "disagreements")
        assert (name in numbers.derived) == known


def test_thermal_values_are_read_with_offsets_and_from_both_forms():
    """Check that a temperature has an offset, and a difference in K/W or degC/W has none."""
    kelvin = from_datasheet(
        **CIM,
        max_winding_temperature="398.15 K",
        thermal_resistance="5 K/W",
        thermal_time_constant_winding="0.5 min",
    )
    assert kelvin.max_temperature == pytest.approx(125.0)
    assert from_datasheet(
        **CIM, max_winding_temperature="257 degF"
    ).max_temperature == pytest.approx(125.0)
    assert (kelvin.thermal_resistance, kelvin.thermal_time_constant_winding) == pytest.approx(
        (5.0, 30.0)
    )
    assert kelvin.thermal_resistance_winding is from_datasheet(**CIM).thermal_resistance is None
    parts = {"thermal_resistance_winding": "3 K/W", "thermal_resistance_housing": "2 K/W"}
    with pytest.raises(
        ValueError, match=r"thermal_resistance = 9 K/W, but .* = 3 K/W \+ 2 K/W = 5 K/W"
    ):
        from_datasheet(**CIM, **parts, thermal_resistance="9 K/W")


def test_a_disagreement_has_both_values_and_an_explanation():
    (disagreement,) = from_datasheet(**CIM).disagreements
    assert disagreement.quantity == "torque_constant"
    assert disagreement.printed == pytest.approx(2.42 / (133.0 - 2.7))
    assert disagreement.computed == pytest.approx(
        (12.0 - 12.0 / 133.0 * 2.7) / (5310.0 * math.tau / 60.0)
    )
    assert disagreement.difference == pytest.approx(
        disagreement.computed / disagreement.printed - 1.0
    )
    assert "equal in SI" in str(disagreement)


def test_a_phase_of_a_star_may_be_written_as_a_product():
    assert Datasheet(resistance="2 * 0.3 ohm").parsed_values()["resistance"].value == pytest.approx(
        0.6
    )


@pytest.mark.parametrize(
    ("name", "printed", "value"),
    [
        *(
            ("stall_torque", f"14 {unit}", 1.372931)
            for unit in ("kg*cm", "kg.cm", "kg-cm", "kgf.cm", "Kg cm", "kgcm")
        ),
        *(
            ("stall_torque", f"60 {unit}", 0.42369310)
            for unit in ("oz-in", "oz*in", "ozf*in", "ozin", "OZ-IN")
        ),
        ("stall_torque", "2 lb-ft", 2.7116359),
        ("kt", "3 oz-in/A", 0.021184655),
        ("rotor_inertia", "1e-3 oz-in-s^2", 7.0615518e-6),
        ("rotor_inertia", "1 oz-in^2", 1.8289978e-5),
        *(
            ("no_load_speed", f"330 {unit}", 34.557519)
            for unit in ("RPM", "Rpm", "rev/min", "r/min", "1/min", "min-1")
        ),
        *(
            (name, "340 RPM/V", 35.604717)
            for name in ("Kv", "kv", "speed_constant", "Speed_Constant")
        ),
        ("Voltage", "12 Volts", 12.0),
        ("resistance", "64 mOhm", 0.064),
        ("rated_current", "2 Amps", 2.0),
        ("gear_ratio", "20:1", 20.0),
        ("no_load_speed", "1e5 rpm", 10471.976),
    ],
)
def test_values_are_read_in_manufacturers_spellings(name, printed, value):
    """Compare with definitions: kgf 9.80665 N, oz 28.349523 g, in 25.4 mm, a turn 2 pi."""
    (reading,) = Datasheet(**to_field_names({name: printed})).parsed_values().values()
    assert reading.value == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "printed", "mechanical"),
    [
        ("no_load_speed", "60000 eRPM", "6000 rpm"),
        ("kv", "3600 erpm/V", "360 rpm/V"),
        ("ke", "0.1 mV/eRPM", "1 mV/rpm"),
    ],
)
def test_electrical_turns_are_pole_pairs_times_as_many(name, printed, mechanical):
    fields = to_field_names({"pole_pairs": 10, name: printed})
    electrical = Datasheet(**fields).parsed_values()
    ((field, plain),) = Datasheet(**to_field_names({name: mechanical})).parsed_values().items()
    assert electrical[field].value == pytest.approx(plain.value, rel=1e-12)


def test_a_peak_torque_yields_the_peak_current():
    constants = {**GEARED, "torque_constant": "0.1 N*m/A at motor", "no_load_current": "1 A"}
    at_motor = from_datasheet(**constants, max_torque="2 N*m at motor")
    assert at_motor.max_current == pytest.approx(2.0 / 0.1 + 1.0)
    at_output = from_datasheet(
        **constants, gear_efficiency=0.5, peak_torque="10 N*m at output", shaft="motor"
    )
    assert at_output.max_current == pytest.approx(10.0 / (10.0 * 0.5 * 0.1) + 1.0)
    assert at_output.derived["max_current"].startswith("max_current = peak_torque_at_output / ")
    printed = from_datasheet(**constants, peak_current="7 A", continuous_current="3 A")
    assert printed.max_current == 7.0


@given(st.data(), st.floats(1.0, 500.0))
def test_without_a_winding_there_is_the_torque_speed_line(data, ratio):
    """Two printed points, or resistance, voltage and constant without an inductance."""
    motor, printed = data.draw(_motors())
    points = {name: printed[name] for name in ("stall_torque", "no_load_speed")}
    text = data.draw(_print(points))
    line = Datasheet(gear_ratio=f"{ratio!r}", shaft="motor", **text).torque_speed_line()
    assert line.stall_torque == pytest.approx(ratio * printed["stall_torque"], rel=1e-12)
    assert line.no_load_speed == pytest.approx(printed["no_load_speed"] / ratio, rel=1e-12)
    assert line.max_torque is None
    constants = {name: motor[name] for name in ("resistance", "torque_constant")}
    constants |= {name: printed[name] for name in ("nominal_voltage", "no_load_current")}
    text = data.draw(_print(constants))
    line = Datasheet(**text, peak_torque="1 N*m").torque_speed_line()
    assert line[:3] == pytest.approx(
        (printed["stall_torque"], printed["no_load_speed"], 1.0), rel=1e-11
    )
    assert "datasheet.inductance is not printed" in line.reason
    assert Datasheet(**text, inductance="1 mH").torque_speed_line() is None


def test_raises_if_neither_a_winding_nor_a_line_follows():
    with pytest.raises(ValueError, match=r"resistance is not printed"):
        Datasheet(stall_torque="1 N*m").torque_speed_line()
    contradicting = {**CIM, "inductance": None, "stall_torque": "2.42 mN*m"}
    with pytest.raises(ValueError, match="units of stall_torque"):
        Datasheet(**contradicting).torque_speed_line()


REFUSED = {
    "no unit": ({"resistance": "25.1"}, "resistance", "25.1", 'resistance = "0.464 ohm"'),
    "a number": ({"resistance": 25.1}, "resistance", "25.1", 'resistance = "0.464 ohm"'),
    "wrong dimension": ({"stall_torque": "25.1 mN"}, "stall_torque", "25.1 mN", "N*m"),
    "mass for force": ({"peak_current": "140 kg*mm"}, "peak_current", "140 kg*mm", "which is in A"),
    "electrical rpm": (
        {"no_load_speed": "9000 eRPM"},
        "no_load_speed",
        "9000 eRPM",
        "write pole_pairs = 7",
    ),
    "a flux": ({"flux_linkage": "4.5 mWb"}, "flux_linkage", "sqrt(3) * pole pairs"),
    "a phase": (
        {"phase_resistance": "0.3 ohm"},
        "phase_resistance",
        "two thirds for a delta",
        '"2 * 0.3 ohm"',
    ),
    "two names": (
        {"kv": "1 rpm/V", "speed_constant": "1 rpm/V"},
        "speed_constant",
        "specified already",
        "omit one",
    ),
    "which shaft": (POLOLU, "shaft is missing", "stall_torque, no_load_speed", 'shaft = "output"'),
    "the other shaft": (
        {**POLOLU, "shaft": "motor"},
        "back_emf",
        "+29.2%",
        "and at which shaft they are (shaft",
    ),
    "one value's shaft": (
        {**GEARED, "kt": "1 Nm/A"},
        "shaft is missing",
        "torque_constant",
        '"... at motor"',
    ),
    "unknown unit": (
        {"inductance": "3 henrys of iron"},
        "inductance",
        "henrys",
        'inductance = "0.322 mH"',
    ),
    "code": (
        {"inductance": "3 __import__('os')"},
        "inductance",
        "__import__",
        'inductance = "0.322 mH"',
    ),
    "a thousand's space": (
        {"no_load_speed": "10 600 rpm"},
        "no_load_speed",
        "10 600 rpm",
        'no_load_speed = "5310 rpm"',
    ),
    "a decimal comma": ({"resistance": "0,46 ohm"}, "resistance", "0,46 ohm", "must be one number"),
    "turns or radians": ({"no_load_speed": "100 Hz"}, "no_load_speed", "100 Hz", "rpm"),
    "volts per hertz": ({"back_emf_constant": "0.4 V/Hz"}, "back_emf_constant", "0.4 V/Hz", "rpm"),
    "an angle per angle": (
        {"no_load_speed": "100 rad^2/s"},
        "no_load_speed",
        "'rad^2/s' is not a unit of this quantity, which is in rad/s",
        'no_load_speed = "5310 rpm"',
    ),
    "a stiffness": (
        {**CIM, "stall_torque": "2.42 N*m/deg"},
        "stall_torque",
        "'N*m/deg' is not a unit of this quantity, which is in N*m",
        'stall_torque = "2.42 N*m"',
    ),
    "a ratio in degrees": (
        {"gear_ratio": "30 deg"},
        "gear_ratio",
        "'deg' is not a unit of this quantity, which is in no unit",
        'gear_ratio = "30"',
    ),
    "a loss in decibels": ({"gear_efficiency": "-3 dB"}, "'dB' is logarithmic", "gear_efficiency"),
    "a difference of temperatures": (
        {"max_winding_temperature": "100 delta_degC"},
        "max_winding_temperature",
        "'delta_degC' is a difference of temperatures, must be a temperature",
        'max_winding_temperature = "125 degC"',
    ),
    "gear of zero": ({"gear_ratio": 0}, "gear_ratio", "0", "> 0"),
    "negative": ({"resistance": "-1 ohm"}, "resistance", "-1 ohm", "> 0"),
    "not finite": ({"resistance": "1e999 ohm"}, "resistance", "1e999", "finite"),
    "efficiency": ({"gear_efficiency": "140 %"}, "gear_efficiency", "140 %", "<= 1"),
    "misspelt": (
        {"resistence": "1 ohm"},
        "resistence",
        "datasheet field",
        "did you mean resistance?",
    ),
    "shaft": ({"shaft": "wheel"}, "shaft", "wheel", "motor or output"),
    "no gear": (
        {"torque_constant": "1 N*m/A at output"},
        "torque_constant",
        "1 N*m/A",
        "gear_ratio = 30",
    ),
    "no inductance": (
        {**CIM, "inductance": None},
        "inductance",
        "not printed",
        'inductance = "0.3 mH"',
    ),
    "nothing": (
        {"inductance": "1 mH"},
        "resistance",
        "not printed",
        "nominal_voltage and stall_current",
    ),
    "milli": (
        {**CIM, "stall_torque": "2.42 mN*m"},
        "torque_constant",
        "1.857e-05",
        "units of stall_torque",
    ),
    "stall current": (
        {**CIM, "resistance": "0.9 ohm"},
        "stall_current",
        "133 A",
        "units of stall_current",
    ),
    "speed constant": (
        {**CIM, "torque_constant": "0.0211 N*m/A", "speed_constant": "45.2 rpm/V"},
        *("torque_constant", "0.0211 N*m/A", "units of torque_constant, speed_constant"),
    ),
    "free above stall": (
        {**CIM, "no_load_current": "140 A"},
        "torque_constant",
        "140 A",
        "must be > 0",
    ),
    "free at stall": (
        {**CIM, "no_load_current": "133 A"},
        "torque_constant",
        "133 A",
        "divides by 0",
    ),
    "gear of milli": (
        {
            **CIM,
            "shaft": "output",
            "gear_ratio": 30,
            "stall_torque": "2.42 mN*m",
            "no_load_speed": "177 rpm",
        },
        *("gear_efficiency", "0.00242 N*m", "check the units"),
    ),
    "tolerance": ({**CIM, "tolerance": 0}, "tolerance", "0", "> 0"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_raises_with_field_value_and_remedy(case):
    printed, *words = REFUSED[case]
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the words are the match
        from_datasheet(**printed)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("unit", "kind", "size"),
    [
        # kT = kE, and J = torque/acceleration.
        ("mV/rpm", "N*m/A", 0.06 / math.tau),
        ("mV*s/rad", "N*m/A", 1e-3),
        ("V*s", "V*s/rad", 1.0),
        ("N*m*s^2/rad", "kg*m^2", 1.0),
        ("N*m*s", "N*m*s/rad", 1.0),
        ("mN*m/rpm", "N*m*s/rad", 0.06 / math.tau),
        ("kg*cm/rpm", "N*m*s/rad", 0.0980665 * 60.0 / math.tau),
        ("turn/min/V", "rad/s/V", math.tau / 60.0),
        ("degC/W", "K/W", 1.0),
    ],
)
def test_a_division_by_an_angle_is_optional_where_it_is_not_printed(unit, kind, size):
    assert units.to_si(3.0, unit, kind, mass_as_weight=True) == pytest.approx(3.0 * size, rel=1e-12)


def test_contradictions_are_only_listed_if_not_strict():
    numbers = from_datasheet(**CIM | {"stall_torque": "2.42 mN*m"}, strict=False)
    assert numbers.disagreements[0].quantity == "torque_constant"
    assert abs(numbers.disagreements[0].difference) > 100.0


def test_the_rules_use_fields_only():
    for quantity, formula in (*relations.RULES, *(check[:2] for check in relations.CHECKS)):
        assert {quantity, *relations.compile_formula(formula).co_names} <= {
            *QUANTITY_SPECS,
            *relations.AT_OUTPUT,
        }, formula
    first = relations.compile_formula(relations.RULES[0][1])
    assert first.co_names == ("nominal_voltage", "stall_current")
    assert eval(first, {}, {"nominal_voltage": 12.0, "stall_current": 133.0}) == 12.0 / 133.0


def test_pint_is_imported_only_for_a_datasheet():
    script = "import sys, codrl_mj.catalogue.datasheet; assert 'pint' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)


SERVO = {
    "gear_ratio": "345:1",
    "shaft": "output",
    "nominal_voltage": "12 V",
    "stall_torque": "30 kg.cm",
    "stall_current": "2.7 A",
    "no_load_speed": "0.222 s/60deg",
    "no_load_current": "180 mA",
    "electrical_time_constant": "0.3 ms",
}
"""Values in the form of servo datasheets: Feetech's STS3215."""


@pytest.mark.parametrize(
    "printed",
    [
        *(
            "0.222 s/60deg",
            "0.222sec/60°",
            "0.222 Sec / 60 degrees",
            "222 ms/60º",
            "0.222 seconds per 60 deg",
        ),
        *("60°/0.222s", "0.222 s/60deg at output", "0.222s/60Deg"),
    ],
)
def test_the_time_for_an_angle_is_a_speed(printed):
    reading = Datasheet(**SERVO | {"no_load_speed": printed}).parsed_values()["no_load_speed"]
    assert reading.value == pytest.approx(math.pi / 3.0 / 0.222, rel=1e-15)
    assert reading.shaft == "output"


@pytest.mark.parametrize(
    "printed", ["0 s/60deg", "0.2 s/60", "0.2 s", "0.2 s/60deg at 6 V", "0,2 s/60deg"]
)
def test_raises_if_the_time_for_an_angle_is_malformed(printed):
    with pytest.raises(ValueError, match=r"^datasheet\.no_load_speed = "):
        from_datasheet(**SERVO | {"no_load_speed": printed})


def test_the_inertia_behind_a_gear_must_name_its_shaft():
    """Check that the rotor's inertia, which is usually printed, differs from the reflected one."""
    for unit in ("g*cm2", "g.cm2", "g cm²", "gcm2", "g*cm^2"):
        assert from_datasheet(
            **SERVO, rotor_inertia=f"60 {unit} at motor"
        ).rotor_inertia == pytest.approx(6e-6)
    reflected = from_datasheet(**SERVO, rotor_inertia="60 gcm2 at output").rotor_inertia
    assert reflected == pytest.approx(6e-6 / 345.0**2)
    with pytest.raises(
        ValueError, match=r'rotor_inertia = \'60 gcm2\'.*"60 gcm2 at motor".*"60 gcm2 at output"'
    ):
        from_datasheet(**SERVO, rotor_inertia="60 gcm2")
    unsaid = {**SERVO, "gear_ratio": 1, "stall_torque": "0.04 Nm"} | {"no_load_speed": "1600 rad/s"}
    assert from_datasheet(
        strict=False, **unsaid, rotor_inertia="60 gcm2"
    ).rotor_inertia == pytest.approx(6e-6)


def test_a_torque_constant_at_the_output_includes_the_gears_loss():
    """Check V = R*I0 + kE*w0 and kT = kE: the printed value over N*kT is the efficiency."""
    speed, resistance = 345.0 * math.pi / 3.0 / 0.222, 12.0 / 2.7
    constant = (12.0 - resistance * 0.18) / speed
    with_it = from_datasheet(**SERVO, torque_constant="11 kg.cm/A")
    assert with_it.torque_constant == pytest.approx(constant, rel=1e-12)
    assert with_it == dataclasses.replace(
        from_datasheet(**SERVO), disagreements=with_it.disagreements
    )
    parameters = from_datasheet(
        **{k: v for k, v in SERVO.items() if k != "stall_torque"}, torque_constant="11 kg.cm/A"
    )
    assert parameters.gear_efficiency == pytest.approx(
        11.0 * 0.0980665 / (345.0 * constant), rel=1e-12
    )
    # These values are the motor's own, but marked as those of the output.
    with pytest.raises(ValueError, match="contradicts the rest"):
        from_datasheet(**SERVO, torque_constant="6.88 mNm/A")
    for values in (
        {"torque_constant": "2.5 Nm/A"},
        {"torque_constant": "11 kg.cm/A", "gear_efficiency": "45 %"},
    ):
        # Without strictness, a gear has no losses by default.
        parameters_ = from_datasheet(strict=False, **SERVO, **values)
        value = {"2": 2.5, "1": 11.0 * 0.0980665}[values["torque_constant"][0]]
        assert parameters_.torque_constant == pytest.approx(value / 345.0, rel=1e-12)


def test_files_are_read_in_any_encoding(tmp_path):
    file = tmp_path / "servo.toml"
    lines = ["[datasheet]", *(f'{name} = "{value}"' for name, value in SERVO.items())]
    expected = from_datasheet(**SERVO)
    for end in ("\n", "\r\n"):
        for encoding in ("utf-8", "utf-8-sig", "utf-16"):
            file.write_bytes(end.join(lines).encode(encoding))
            assert motor_entry(str(file)).parameters == expected
    file.write_bytes("\n".join([*lines, 'rotor_inertia = "60 µg*m^2 at motor"']).encode("cp1252"))
    with pytest.raises(
        ValueError, match=r"line 10 has the byte 0xb5 \(µ in Windows-1252\).*save the file as UTF-8"
    ):
        motor_entry(str(file))
