"""Mappings of columns to signals, and proposals for them."""

import math
import re

import numpy as np
import pytest

from codrl_mj.identify import proposal, propose_columns, read_log
from codrl_mj.identify.columns import parse_columns, sign_magnitude, twos_complement

TABLE = {
    "t": np.array([0.0, 1.0]),
    "a": np.array([2.0, -3.0]),
    "b": np.array([5.0, 7.0]),
    "motor current": np.ones(2),
}
TABLE |= {"lists[0]": np.array([1.0, 3.0]), "lists[1]": np.array([2.0, 4.0])}


def evaluate_entry(entry):
    """Return the values of a mapped signal in `TABLE`."""
    name = entry.partition("=")[0]
    return parse_columns(f"time=t:s,{entry}")[name].evaluate({**TABLE, "k": 4.0})


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("voltage=a*b:V", [10.0, -21.0]),
        ("voltage=-a*b/k + 1:V", [-1.5, 6.25]),
        # The unit of a formula is optional.
        ("voltage=a*b", [10.0, -21.0]),
        ("current=a:mA", [0.002, -0.003]),
        ("position=a:deg", np.deg2rad([2.0, -3.0])),
        ("position=a:mrad", [0.002, -0.003]),
        ("velocity=b:krpm", np.array([5.0, 7.0]) * 2000.0 * math.pi / 60.0),
        ("position=a:turn", [4.0 * math.pi, -6.0 * math.pi]),
        ("velocity=b:rpm", np.array([5.0, 7.0]) * 2.0 * math.pi / 60.0),
        ("torque=a:mNm", [0.002, -0.003]),
        ("torque=a:kgf*cm", np.array([2.0, -3.0]) * 9.80665 / 100.0),
        ("temperature=b:K", [-268.15, -266.15]),
        ("duty=b:percent", [0.05, 0.07]),
        ("current='motor current':A", [1.0, 1.0]),
        ("current=lists[1]:A", [2.0, 4.0]),
        ("current='lists'[1] - \"lists[0]\":A", [1.0, 1.0]),
        ("current=abs(a) - sqrt(k) + sign(a)*pi:A", [math.pi, 1.0 - math.pi]),
        ("command=a:deg", np.deg2rad([2.0, -3.0])),
    ],
)
def test_formulas_and_units(entry, expected):
    np.testing.assert_allclose(evaluate_entry(entry), expected, rtol=1e-12)


def test_registers_are_converted_angles_unwrapped_and_mean_voltages_declared():
    numbers = np.arange(0, 65536, 7)
    np.testing.assert_array_equal(
        twos_complement(numbers, 16), numbers.astype(np.uint16).astype(np.int16)
    )
    angle = np.linspace(0.0, 2000.0, 101)
    position = parse_columns("time=t:s,position=unwrap(q, 360):deg")["position"].evaluate(
        {"t": angle, "q": angle % 360.0}
    )
    np.testing.assert_allclose(position, np.deg2rad(angle), atol=1e-12)
    means = [
        parse_columns(f"time=t:s,voltage={text}:V")["voltage"].mean for text in ("mean(a*b)", "a*b")
    ]
    assert means == [True, False]


@pytest.mark.parametrize("bits", [11, 16])
def test_a_sign_in_the_highest_bit_is_converted(bits):
    """Feetech's servos write the magnitude below a bit that is set for negative numbers."""
    numbers = np.arange(-(2 ** (bits - 1)) + 1, 2 ** (bits - 1), 3)
    register = [abs(number) | (int(number < 0) << (bits - 1)) for number in map(int, numbers)]
    np.testing.assert_array_equal(sign_magnitude(np.array(register), bits), numbers)


def test_mappings_are_equivalent_to_text():
    assert parse_columns({"time": "t:s", "current": "a:A"}) == parse_columns(
        "time=t:s, current=a:A"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time=t:s", "nothing but time"),
        ("current=a:A", "no time"),
        ("time=t:s,current=a", "current=a:A"),
        ("time=t,current=a:A", "time=t:s"),
        ("time=t:s,current=a:V", "is not a unit of current"),
        ("time=t:s,current=a:blub", "blub"),
        ("time=t:s,velocity=a:Hz", "rad/s"),
        ("time=t:s,velocity=a:1/s", "turns or radians"),
        ("time=t:s,velocity=a:deg", "'deg' is not a unit of velocity, which is in rad/s"),
        ("time=t:s,position=a:1/deg", "position=a:1/deg: '1/deg' is not a unit of position"),
        ("time=t:s,position=a:deg**2", "'deg**2' is not a unit of position, which is in rad"),
        ("time=t:s,position=a:percent", "not a unit of position, which is in rad; write rad, or"),
        ("time=t:s,position=a:count", "'count' is not a unit of position"),
        ("time=t:s/rad,current=a:A", "time=t:s/rad: 's/rad' is not a unit of time"),
        ("time=t:s,voltage=a:V/deg", "'V/deg' is not a unit of voltage"),
        ("time=t:s,bus=a:deg*V", "'deg*V' is not a unit of bus"),
        ("time=t:s,current=a:A/turn", "'A/turn' is not a unit of current"),
        ("time=t:s,torque=a:N*m/deg", "'N*m/deg' is not a unit of torque, which is in N*m"),
        ("time=t:s,velocity=a:rad**2/s", "'rad**2/s' is not a unit of velocity"),
        ("time=t:s,duty=a:1/deg", "'1/deg' is not a unit of duty, which is in no unit; write 1"),
        ("time=t:s,duty=a:deg", "'deg' is not a unit of duty"),
        ("time=t:s,duty=a:count", "'count' is not a unit of duty"),
        ("time=t:s,duty=a:dB", "duty=a:dB: 'dB' is logarithmic, must be proportional"),
        ("time=t:s,only=a:deg", "'deg' is not a unit of only"),
        (
            "time=t:s,temperature=a:delta_degC",
            "temperature=a:delta_degC: 'delta_degC' is a difference of temperatures, must be a"
            " temperature; write degC",
        ),
        ("time=t:s,temperature=a:K/W", "'K/W' is not a unit of temperature, which is in degC"),
        ("time=t:s,command=a:V**1000", "the unit 'V**1000' is not known"),
        ("time=t:s,currant=a:A", "did you mean current"),
        ("time=t:s,current=a:A,current=b:A", "twice"),
        ("time=t:s,current=a:A:V", "two colons"),
        ("time=t:s,current", "signal=formula:unit"),
        ("time=t:s,current=a b:A", "not a formula"),
        ("time=t:s,current=a**2:A", "not allowed"),
        ("time=t:s,current=a[0]:A", "unknown column a[0]"),
        ("time=t:s,current=a[-1]:A", "not allowed"),
        ("time=t:s,current=a[0:1]:A", "not allowed"),
        ("time=t:s,current=a[0]", "current=a[0]:A"),
        (
            "time=t:s,current=lists:A",
            "lists holds lists of 2 numbers; choose an entry, such as lists[0]",
        ),
        (
            "time=t:s,position=a:UNIT",
            "the unit is not filled in; write the unit of the column, such as rad, deg or turn",
        ),
        ("time=t:s,current=a.real:A", "not allowed"),
        ("time=t:s,current=[a for a in b]:A", "not allowed"),
        ("time=t:s,current=open('x'):A", "unknown function open"),
        ("time=t:s,current=(lambda: 1)():A", "not allowed"),
        ("time=t:s,current=twos_complement(a):A", "takes 2 arguments"),
        ("time=t:s,current=twos_complement(a, b):A", "must be a number"),
        ("time=t:s,current=mean(a):A", "unknown function mean"),
        ("time=t:s,current=c*2:A", "unknown column"),
    ],
)
def test_invalid_columns_raise_an_error_with_the_reason(text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        parse_columns(text)["current"].evaluate(TABLE)


PROPOSED = {
    "t [s],u [V],current(mA),pos_deg\n0,1,2,3\n1,2,3,4": (
        'time="t [s]":s,voltage="u [V]":V,current="current(mA)":mA,position=pos_deg:deg'
    ),
    "time;speed;current\nms;rpm;A\n0;1;2,5\n1;2;3,5": (
        "time=time:ms,velocity=speed:rpm,current=current:A"
    ),
    "t,u,i,q,spare\n0,1,2,3,9\n0.01,2,3,4,9": (
        "time=t:s,voltage=u:UNIT,current=i:UNIT,position=q:UNIT | spare: not known"
    ),
    "t,voltage,i\n0,1.5,2\n0.1,2,3": (
        "time=t:UNIT,voltage=voltage:V,current=i:UNIT | replace UNIT by s or ms"
    ),
    "t,iMotor,angle\n0,900,0\n2,-800,90\n4,1,45": (
        "time=t:ms,current=iMotor:UNIT,position=angle:UNIT | replace UNIT by A or mA"
    ),
    "t_s,commanded_deg_s,angle_deg,feedback_deg_s,torque_N_m\n0,1,2,3,4\n1,2,3,4,5": (
        "time=t_s:s,command=commanded_deg_s:deg/s,position=angle_deg:deg,velocity=feedback_deg_s:deg/s,"
        "torque=torque_N_m:N*m"
    ),
    "t_s,duty,vbus\n0,0.5,12\n0.1,-0.5,12": (
        "time=t_s:s,duty=duty:1,bus=vbus:V,voltage=duty*vbus:V | times the bus voltage"
    ),
    "t_s,duty,voltage\n0,0.5,12\n0.1,-0.5,12.1": (
        "time=t_s:s,duty=duty:1,bus=voltage:V,voltage=duty*voltage:V | voltage: hardly changes,"
        " taken as the supply's"
    ),
    "t_s,current_mA,bus_mV,duty_percent,pos_mrad,größe\n0,1,2,3,4,5\n1,2,3,4,5,6": (
        "time=t_s:s,current=current_mA:mA,bus=bus_mV:mV,duty=duty_percent:percent,position=pos_mrad:mrad,voltage=duty_percent/100*bus_mV:mV"
        " | größe: not known"
    ),
    "T_S,VOLTAGE_KV,I_UA,Größe der Position\n0,1,2,3\n1,2,3,4": (
        'time=T_S:s,voltage=VOLTAGE_KV:kV,current=I_UA:uA,position="Größe der Position":UNIT | rad,'
        " deg or turn"
    ),
    "t_s,enable,i_A\n0,on,1\n1,off,2": (
        "time=t_s:s,current=i_A:A | enable: holds no numbers, left out"
    ),
    "t,i,,\n0,1,,\n0.01,2,,\n": "time=t:s,current=i:UNIT | : not known",
    "t_ms,i_A,bus_current_A,current_limit,goal_current_A,goal_position\n0,1,2,3,4,5\n1,2,3,4,5,6": (
        "time=t_ms:ms,current=i_A:A,command=goal_current_A:A | bus_current_A: by its name the"
        " supply's current"
    ),
}
"""Contents of a file -> proposed columns | part of a doubt."""


@pytest.mark.parametrize("lines", PROPOSED)
def test_columns_are_proposed_from_names_units_and_values(tmp_path, lines):
    columns, _, doubt = PROPOSED[lines].partition(" | ")
    (tmp_path / "log.csv").write_text(lines)
    proposal = propose_columns(tmp_path / "log.csv")
    assert proposal.columns == columns
    assert proposal.doubts == () if not doubt else doubt in " ".join(proposal.doubts)
    if "UNIT" in columns:
        with pytest.raises(ValueError, match="the unit is not filled in"):
            read_log(tmp_path / "log.csv", columns)
    read_log(tmp_path / "log.csv", fill_units(columns))


def fill_units(columns):
    """Return columns with a unit instead of each `UNIT`."""
    return re.sub(
        r"(\w+)=([^,]*):UNIT", lambda match: f"{match[1]}={match[2]}:{SI[match[1]]}", columns
    )


SI = {
    "time": "s",
    "voltage": "V",
    "bus": "V",
    "current": "A",
    "position": "rad",
    "velocity": "rad/s",
    "torque": "N*m",
}
SI |= {"duty": "1", "command": "rad", "temperature": "degC"}


def test_each_header_is_parsed_once(tmp_path, monkeypatch):
    names = []

    def parse_header(name, table, original=proposal._parse_header):
        names.append(name)
        return original(name, table)

    monkeypatch.setattr(proposal, "_parse_header", parse_header)
    (tmp_path / "log.csv").write_text("t [s],pos [0.1 deg],i (mA)\n0,1,2\n1,2,3")
    columns = 'time="t [s]":s,position="pos [0.1 deg]"*0.1:deg,current="i (mA)":mA'
    assert propose_columns(tmp_path / "log.csv").columns == columns
    assert names == ["t [s]", "pos [0.1 deg]", "i (mA)"]


def test_raises_if_no_column_is_the_time(tmp_path):
    (tmp_path / "log.csv").write_text("a,u\n1,2\n")
    with pytest.raises(ValueError, match=r"no time.* a, u"):
        propose_columns(tmp_path / "log.csv")
