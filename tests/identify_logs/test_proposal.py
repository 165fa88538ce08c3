"""Proposed columns for logs of common tools; units that are ambiguous stay open."""

import gzip
import json
import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest

from codrl_mj.cli import main
from codrl_mj.identify import check, propose_columns, read_log
from codrl_mj.identify.identify import check_arguments
from codrl_mj.identify.log import SIGNALS

ROWS = np.arange(600)
TIME = 0.01 * ROWS
SPEED = 3.0 * np.sin(np.pi * TIME)
ANGLE = 3.0 / np.pi * (1.0 - np.cos(np.pi * TIME))
VOLTS = 5.0 * np.sin(np.pi * TIME + 0.3)
CURRENT = 0.8 * np.sin(np.pi * TIME + 0.4) + 0.01 * np.random.default_rng(0).standard_normal(600)
SUPPLY = 24.0 + 0.05 * np.sin(TIME)
COUNTS = np.round(2048 + ANGLE / (2.0 * np.pi) * 4096).astype(int)
LOAD = np.round(VOLTS / 12.0 * 1000).astype(int)
ZERO = 0 * ROWS
EPOCH = 1_700_000_000

TOOLS = {
    "Dynamixel Wizard": (
        {
            "Time(ms)": 10 * ROWS,
            "Present Position": COUNTS,
            "Present Current": LOAD,
            "Present PWM": LOAD,
        }
        | {"Present Input Voltage": ZERO + 120},
        (
            'time="Time(ms)":ms,position="Present Position":UNIT,current="Present'
            ' Current":UNIT,duty="Present PWM":UNIT,bus="Present Input Voltage":UNIT'
        ),
    ),
    "Feetech debugger": (
        {"Time": 10 * ROWS, "Position": COUNTS, "Goal": COUNTS, "Load": LOAD, "Current": LOAD}
        | {"Voltage": ZERO + 74},
        "time=Time:ms,position=Position:UNIT,command=Goal:UNIT,duty=Load:UNIT,current=Current:UNIT,bus=Voltage:UNIT",
    ),
    "LeRobot's registers": (
        {
            "timestamp": TIME,
            "Goal_Position": COUNTS,
            "Present_Position": COUNTS,
            "Present_Current": LOAD,
        },
        "time=timestamp:s,command=Goal_Position:UNIT,position=Present_Position:UNIT,current=Present_Current:UNIT",
    ),
    "ODrive": (
        {
            "timestamp": EPOCH + TIME,
            "pos_estimate": ANGLE,
            "vel_estimate": SPEED,
            "Iq_measured": CURRENT,
        }
        | {"vbus_voltage": SUPPLY, "Vq": VOLTS, "pos_setpoint": ANGLE, "current_state": ZERO},
        (
            "time=timestamp:s,position=pos_estimate:UNIT,velocity=vel_estimate:UNIT,current=Iq_measured:UNIT,"
            "bus=vbus_voltage:V,voltage=Vq:V,command=pos_setpoint:UNIT"
        ),
    ),
    "moteus": (
        {"timestamp": TIME, "MODE": ZERO, "POSITION": ANGLE, "VELOCITY": SPEED, "TORQUE": CURRENT}
        | {"Q_CURRENT": CURRENT, "D_CURRENT": 0.1 * CURRENT, "VOLTAGE": SUPPLY, "FAULT": ZERO},
        (
            "time=timestamp:s,position=POSITION:UNIT,velocity=VELOCITY:UNIT,torque=TORQUE:UNIT,current=Q_CURRENT:UNIT,"
            "bus=VOLTAGE:V"
        ),
    ),
    "VESC Tool": (
        {
            "ms_today": 36_000_000 + 20 * ROWS,
            "input_voltage": SUPPLY,
            "current_motor": CURRENT,
            "current_in": CURRENT,
        }
        | {
            "d_axis_current": CURRENT,
            "q_axis_current": CURRENT,
            "erpm": SPEED,
            "duty_cycle": VOLTS / 24.0,
        }
        | {"encoder_position": ANGLE, "d_axis_voltage": VOLTS},
        (
            "time=ms_today:ms,bus=input_voltage:V,current=current_motor:UNIT,duty=duty_cycle:1,"
            "position=encoder_position:UNIT,voltage=duty_cycle*input_voltage:V"
        ),
    ),
    "ROS 1": (
        {
            "%time": 10_000_000 * ROWS,
            "field.header.seq": ROWS,
            "field.position0": ANGLE,
            "field.effort0": CURRENT,
        },
        'time="%time":ns,position="field.position0":UNIT,torque="field.effort0":UNIT',
    ),
    "ROS 2": (
        {
            "header.stamp.sec": EPOCH + ROWS // 100,
            "header.stamp.nanosec": ROWS % 100 * 10_000_000,
            "position": ANGLE,
        }
        | {"effort": CURRENT},
        'time="header.stamp.sec"+"header.stamp.nanosec"/1e9:s,position=position:UNIT,torque=effort:UNIT',
    ),
    "PlotJuggler": (
        {
            "__time": EPOCH + TIME,
            "/joint_states/j0/position": ANGLE,
            "/joint_states/j0/effort": CURRENT,
        },
        'time=__time:s,position="/joint_states/j0/position":UNIT,torque="/joint_states/j0/effort":UNIT',
    ),
    "Arduino": (
        {"millis": 10 * ROWS, "pwm": LOAD // 4, "encoder": COUNTS, "i": CURRENT},
        "time=millis:ms,duty=pwm:UNIT,position=encoder:UNIT,current=i:UNIT",
    ),
    "microseconds": (
        {"micros": 1000 * ROWS, "rpm": SPEED, "iq": CURRENT},
        "time=micros:us,velocity=rpm:rpm,current=iq:UNIT",
    ),
    "an oscilloscope": (
        {"Time [s]": TIME, "CH1 voltage [mV]": 1000.0 * VOLTS, "CH2 current [A]": CURRENT},
        'time="Time [s]":s,voltage="CH1 voltage [mV]":mV,current="CH2 current [A]":A',
    ),
    "a table of degrees": (
        {
            "time_s": TIME,
            "commanded_deg_s": SPEED,
            "angle_deg": (200.0 * ANGLE) % 360.0,
            "feedback_deg_s": SPEED,
        }
        | {"torque_N_m": CURRENT},
        (
            "time=time_s:s,command=commanded_deg_s:deg/s,position=unwrap(angle_deg,360):deg,velocity=feedback_deg_s:deg/s,"
            "torque=torque_N_m:N*m"
        ),
    ),
    "turns that wrap": (
        {"t_s": TIME, "pos": (2.0 * ANGLE) % 1.0, "u_V": VOLTS},
        "time=t_s:s,position=unwrap(pos,1):turn,voltage=u_V:V",
    ),
    "radians that wrap": (
        {"t_s": TIME, "pos": (9.0 * ANGLE) % (2.0 * np.pi) - np.pi, "u_V": VOLTS},
        "time=t_s:s,position=unwrap(pos,2*pi):rad,voltage=u_V:V",
    ),
    "an encoder's degrees": (
        {"t_s": TIME, "pos": COUNTS * 360.0 / 4096, "u_V": VOLTS},
        "time=t_s:s,position=pos:deg,voltage=u_V:V",
    ),
    "names of others": (
        {"time": TIME, "goal_position": ANGLE, "goal_current": CURRENT, "current_position": ANGLE}
        | {
            "current_velocity": SPEED,
            "current_limit": ZERO,
            "bus_current": CURRENT,
            "present_current": CURRENT,
        },
        (
            "time=time:s,command=goal_position:UNIT,position=current_position:UNIT,velocity=current_velocity:UNIT,"
            "current=present_current:UNIT"
        ),
    ),
    "one letter each": (
        {"t": TIME, "q": ANGLE, "w": SPEED, "u": CURRENT, "i": CURRENT},
        "time=t:s,position=q:UNIT,velocity=w:UNIT,voltage=u:UNIT,current=i:UNIT",
    ),
    "ten rows a second, or ten thousand": (
        {"t": 10.0 * TIME, "q_rad": ANGLE, "u_V": VOLTS},
        "time=t:UNIT,position=q_rad:rad,voltage=u_V:V",
    ),
    "an inverter": (
        {
            "t_s": TIME,
            "motor_voltage_V": VOLTS,
            "dc_voltage_V": SUPPLY,
            "dc_current_A": CURRENT,
            "motor_current_A": CURRENT,
        },
        "time=t_s:s,voltage=motor_voltage_V:V,bus=dc_voltage_V:V,current=motor_current_A:A",
    ),
}
"""Source of a log -> its columns, and the expected proposal."""
SI = {"duty": "1", "command": "1", "time": "s"} | {
    name: unit for name, unit in SIGNALS.items() if unit
}


def write_columns(folder, columns, name="log.csv"):
    """Write columns as CSV, and return the path."""
    table = np.column_stack([*columns.values()])
    lines = [
        ",".join(f'"{column}"' for column in columns),
        *(",".join(f"{value:.17g}" for value in row) for row in table),
    ]
    (folder / name).write_text("\n".join(lines))
    return folder / name


def fill_units(columns, time="s"):
    """Return columns with a unit instead of each `UNIT`."""
    return re.sub(
        r"(\w+)=([^,]*):UNIT",
        lambda match: f"{match[1]}={match[2]}:{(SI | {'time': time})[match[1]]}",
        columns,
    )


@pytest.mark.parametrize("source", TOOLS)
def test_columns_are_proposed_and_valid_once_the_units_are_filled_in(tmp_path, source):
    columns, expected = TOOLS[source]
    proposal = propose_columns(write_columns(tmp_path, columns))
    assert proposal.columns == expected
    assert proposal.problem is None
    if "UNIT" in expected:
        with pytest.raises(
            ValueError, match="the unit is not filled in; write the unit of the column, such as"
        ):
            read_log(tmp_path / "log.csv", expected)
    log = read_log(tmp_path / "log.csv", fill_units(expected, "ms"))
    assert {finding.check for finding in check(log)}.isdisjoint({"signals", "rows", "wrapped"})
    check_arguments([log], "free", {"load_inertia": 0.0})


@pytest.mark.parametrize(
    ("header", "expected", "factor"),
    [
        ("current [0.1 A]", 'current="current [0.1 A]"*0.1:A', 0.1),
        ("current (x10 mA)", 'current="current (x10 mA)"*10:mA', 0.01),
        ("position (0.088deg)", 'position="position (0.088deg)"*0.088:deg', np.radians(0.088)),
        ("velocity [10 rpm]", 'velocity="velocity [10 rpm]"*10:rpm', np.pi / 3.0),
        ("torque [1e-3 N*m]", 'torque="torque [1e-3 N*m]"*1e-3:N*m', 1e-3),
        ("Drehzahl [min-1]", 'velocity="Drehzahl [min-1]":min-1', np.pi / 30.0),
        ("pos (axis 1) deg", 'position="pos (axis 1) deg":deg', np.pi / 180.0),
        ("motor_2_current_A", "current=motor_2_current_A:A", 1.0),
        ("Winkel °", 'position="Winkel °":deg', np.pi / 180.0),
        ("turns", "position=turns:turns", 2.0 * np.pi),
        ("Strom in mA", 'current="Strom in mA":mA', 1e-3),
    ],
)
def test_a_unit_keeps_the_factor_that_a_header_states(tmp_path, header, expected, factor):
    path = write_columns(tmp_path, {"t [s]": TIME, "U [V]": VOLTS, header: CURRENT})
    columns = propose_columns(path).columns
    assert columns.endswith(f",{expected}")
    log = read_log(path, columns)
    np.testing.assert_allclose(log.signals[expected.split("=")[0]], factor * CURRENT, rtol=1e-12)


@pytest.mark.parametrize(
    "header", ["position (deg x10)", "speed [rpm/10]", "current_10mA", "pos_01deg", "pos_x100_deg"]
)
def test_a_factor_that_can_be_read_in_two_ways_leaves_the_unit_open(tmp_path, header):
    path = write_columns(tmp_path, {"t [s]": TIME, "U [V]": VOLTS, header: CURRENT})
    assert propose_columns(path).columns.endswith(":UNIT")


MOTION = {"position_rad": ANGLE, "velocity_rad_s": SPEED}
EFFORTS = {"torque_Nm": CURRENT, "current_A": CURRENT, "voltage_V": VOLTS}


@pytest.mark.parametrize("motion", [(), ("position_rad",), ("velocity_rad_s",), tuple(MOTION)])
@pytest.mark.parametrize(
    "effort", [(), ("torque_Nm",), ("current_A",), ("voltage_V",), ("voltage_V", "current_A")]
)
@pytest.mark.parametrize(("step", "count"), [(0.01, 600), (0.1, 600), (0.01, 12)])
def test_proposal_check_and_fit_agree_on_usable_logs(tmp_path, motion, effort, step, count):
    """A fit needs voltage and current, or effort and motion, and enough rows within 50 ms."""
    if not motion + effort:
        return
    columns = {
        "t_s": step * ROWS,
        **{name: (MOTION | EFFORTS)[name] for name in (*motion, *effort)},
    }
    path = write_columns(tmp_path, {name: values[:count] for name, values in columns.items()})
    has_signals = len(effort) == 2 or (motion and effort)
    possible = has_signals and (step <= 0.05 or not motion) and count > 20
    proposal = propose_columns(path)
    assert (proposal.problem is None) == bool(possible), proposal.problem
    log = read_log(path, proposal.columns)
    assert bool({finding.check for finding in check(log)} & {"signals", "rows"}) is not bool(
        possible
    )
    if possible:
        check_arguments([log], "free", {"load_inertia": 0.0})
        return
    with pytest.raises(
        ValueError, match=r"nothing can be identified|a row every 0.1 s, must be at most|12 rows in"
    ):
        check_arguments([log], "free", {"load_inertia": 0.0})


def run_identify(capsys, *words):
    """Run `codrl-mj identify`, and return its status, output and errors."""
    status = main(["identify", *map(str, words)])
    out, error = capsys.readouterr()
    return status, out, error


def test_the_printed_next_command_runs_or_there_is_none(tmp_path, capsys):
    """Without open units it is the fit, or the check if that finds errors; there may be none."""
    good = {"t_s": TIME, "u_V": VOLTS, "i_A": CURRENT, "q_rad": np.round(ANGLE, 3)}
    status, out, _ = run_identify(capsys, "columns", write_columns(tmp_path, good))
    line = out.splitlines()[-1]
    assert status == 0
    assert line.startswith("codrl-mj identify ")
    assert line.endswith("--rig RIG --out motor")
    line = line.replace("--rig RIG --out motor", "--rig free --known load_inertia=0")
    assert run_identify(capsys, *shlex.split(line)[2:])[0] in (0, 1)
    bad = good | {"i_A": -CURRENT}
    status, out, _ = run_identify(capsys, "columns", write_columns(tmp_path, bad))
    line = out.splitlines()[-1]
    assert status == 0
    assert line.startswith("codrl-mj identify check ")
    status, out, _ = run_identify(capsys, *shlex.split(line)[2:])
    assert status == 1
    assert "sign" in out
    status, out, _ = run_identify(
        capsys,
        "columns",
        write_columns(tmp_path, {"t_s": TIME, "goal_deg": ANGLE, "present_deg": ANGLE}),
    )
    assert status == 0
    line = out.splitlines()[-1]
    assert line.startswith("codrl-mj identify servo ")
    assert "--columns time=t_s:s,command=goal_deg:deg,position=present_deg:deg" in line
    assert "--load pendulum --known mass=0.5 length=0.1" in line


def test_measured_columns_are_preferred_and_other_joints_are_named(tmp_path):
    """Two joints of a robot: commands, parts of them and filtered signals are not what is fitted."""
    columns = {"time": TIME}
    for name, values in (("pos_filt", ANGLE), ("pos_meas", ANGLE), ("vel_meas", SPEED)):
        columns |= {f"{name}{joint}": values for joint in (1, 2)}
    for name in ("tau_con", "tau_fric", "tau_meas"):
        columns |= {f"{name}{joint}": CURRENT for joint in (1, 2)}
    proposal = propose_columns(write_columns(tmp_path, columns))
    expected = {
        "time=time:s",
        "position=pos_meas1:UNIT",
        "velocity=vel_meas1:UNIT",
        "torque=tau_meas1:UNIT",
    }
    assert {*proposal.columns.split(",")} == expected
    assert (
        "pos_meas1, pos_meas2: several joints, of which pos_meas1 is taken: a fit of one"
        in (proposal.doubts[-1])
    )


def test_an_input_of_the_plant_is_proposed_as_the_voltage_with_an_open_unit(tmp_path):
    columns = {"t": TIME, "theta": np.round(ANGLE, 4), "feedforward": VOLTS, "plant_input": VOLTS}
    proposal = propose_columns(write_columns(tmp_path, columns))
    assert proposal.problem is None
    assert proposal.columns.endswith("voltage=plant_input:UNIT")
    assert not any("plant_input: not known" in doubt for doubt in proposal.doubts)
    # A column that is a voltage by its name is taken instead.
    proposal = propose_columns(write_columns(tmp_path, columns | {"u_V": VOLTS}))
    assert "voltage=u_V:V" in proposal.columns


def test_the_command_of_a_pwm_is_the_duty(tmp_path):
    columns = {"t_s": TIME, "pwm_command": VOLTS / 12.0, "voltage": SUPPLY, "q_rad": ANGLE}
    assert (
        "voltage=pwm_command*voltage:V" in propose_columns(write_columns(tmp_path, columns)).columns
    )


def test_a_duty_without_a_supply_gets_a_remedy(tmp_path):
    proposal = propose_columns(
        write_columns(tmp_path, {"t_s": TIME, "present_deg": ANGLE, "duty": VOLTS / 12.0})
    )
    assert proposal.columns == "time=t_s:s,position=present_deg:deg,duty=duty:1"
    assert "voltage=duty*12:V if the supply has 12 V" in proposal.problem


EPISODE = [
    {
        "timestamp": k / 30,
        "action": [a, 0.5],
        "observation.state": [a - 1.0, 1.0],
        "effort": [u, 0.0],
    }
    for k, a, u in zip(range(90), map(float, ANGLE), map(float, CURRENT), strict=False)
]
FEATURES = {
    "action": {"names": ["shoulder_pan.pos", "elbow"]},
    "observation.state": {"names": {"motors": ["shoulder_pan", "elbow"]}},
    "timestamp": {"names": None},
}
LIST_COLUMNS = "time=timestamp:s,torque=effort[0]:N*m,"


def write_episode(folder, kind):
    """Write the episode in a format, and return the path and the columns.

    A file of Parquet is empty: tests replace pyarrow.
    """
    columns = {name: [row[name] for row in EPISODE] for name in EPISODE[0]}
    rows = ["timestamp;action;observation.state;effort"]
    rows += [";".join(str(value) for value in row.values()) for row in EPISODE]
    content = {
        "json": json.dumps(EPISODE),
        "columns.json": json.dumps(columns),
        "features.json": json.dumps({"features": FEATURES, "rows": EPISODE}),
        "csv": "\n".join(rows),
        "numpy.csv": "\n".join(rows).replace(", ", " "),
        "parquet": "",
    }[kind]
    path = folder / "data" / "chunk-000" / f"episode.{kind}"
    path.parent.mkdir(parents=True)
    path.write_text(content)
    return path, columns


@pytest.mark.parametrize(
    "kind", ["json", "columns.json", "features.json", "csv", "numpy.csv", "parquet"]
)
def test_entries_of_lists_are_columns(tmp_path, monkeypatch, kind):
    path, columns = write_episode(tmp_path, kind)
    table = SimpleNamespace(to_pydict=lambda: columns)
    monkeypatch.setitem(
        __import__("sys").modules, "pyarrow.parquet", SimpleNamespace(read_table=lambda _: table)
    )
    log = read_log(path, LIST_COLUMNS + 'command=action[1]:deg,position="observation.state"[0]:deg')
    np.testing.assert_allclose(log.signals["command"], np.deg2rad(0.5))
    np.testing.assert_allclose(log.signals["position"], np.deg2rad(ANGLE[:90] - 1.0))
    with pytest.raises(
        ValueError,
        match=r"action holds lists of 2 numbers; choose an entry, such as action\[0\]",
    ):
        read_log(path, LIST_COLUMNS + "command=action:deg")
    proposal = propose_columns(path)
    assert (
        'command=action[0]:UNIT,position="observation.state[0]":UNIT,torque=effort[0]:UNIT'
        in proposal.columns
    )
    read_log(path, fill_units(proposal.columns))


@pytest.mark.parametrize("location", ["in the file", "beside it"])
def test_entries_of_lists_have_the_names_of_joints_if_known(tmp_path, location):
    path, _ = write_episode(tmp_path, "features.json" if location == "in the file" else "json")
    if location == "beside it":
        (tmp_path / "meta").mkdir()
        (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": 30, "features": FEATURES}))
    columns = (
        LIST_COLUMNS + "command=action[elbow]:deg,position=observation.state[shoulder_pan]:deg"
    )
    log = read_log(path, columns)
    np.testing.assert_allclose(log.signals["command"], np.deg2rad(0.5))
    np.testing.assert_allclose(log.signals["position"], np.deg2rad(ANGLE[:90] - 1.0))
    (first,) = [doubt for doubt in propose_columns(path).doubts if doubt.startswith("action")]
    assert "the first of shoulder_pan.pos, elbow is taken" in first
    with pytest.raises(ValueError, match=r"unknown column action\[wrist\]"):
        read_log(path, LIST_COLUMNS + "command=action[wrist]:deg")


def test_columns_of_a_compressed_log_are_proposed(tmp_path):
    path = write_columns(tmp_path, {"t_s": TIME, "u_V": VOLTS, "q_rad": ANGLE})
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert propose_columns(tmp_path / "log.csv.gz") == propose_columns(path)
