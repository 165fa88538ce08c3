"""Limits of drives, against datasheets and against the simulated drive under excessive commands."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, Ideal, SampledLoop, Supply
from codrl_mj.catalogue import motor_entry, motor_names
from codrl_mj.sizing import (
    catalogue_rows,
    describe_motor,
    drive_limits,
    find_drive,
    find_entry,
    simulate_loop,
    torque_limits,
)


@pytest.mark.parametrize("name", motor_names())
def test_stall_and_no_load_agree_with_the_datasheet(name):
    entry = motor_entry(name)
    can, printed = (
        drive_limits(Drive.from_motor_parameters(entry.parameters)),
        entry.datasheet.parsed_values(),
    )
    ratio = entry.parameters.gear_ratio
    for field, ours in (("stall_torque", can.stall_torque), ("no_load_speed", can.no_load_speed)):
        if field in printed:
            at_motor = printed[field].shaft == "motor"
            computed = (
                printed[field].value * (ratio if field == "stall_torque" else 1 / ratio) ** at_motor
            )
            assert ours == pytest.approx(computed, rel=entry.tolerance), field


def test_a_motor_without_redundant_values_reproduces_its_datasheet_exactly():
    can = drive_limits(find_drive("pololu-37d-30"))
    assert can.stall_torque == pytest.approx(140e-3 * 9.80665, rel=1e-9)  # 140 kgf*mm
    assert can.no_load_speed == pytest.approx(330 * 2 * math.pi / 60, rel=1e-9)  # 330 rpm
    assert can.no_load_current == pytest.approx(0.2, rel=1e-9)
    assert math.isnan(can.mechanical_time_constant)


@pytest.mark.parametrize("max_current", [math.inf, 1.0], ids=["voltage alone", "and current"])
@pytest.mark.parametrize("sag", [0.0, 2.0, 10.0])
def test_the_simulated_drive_settles_at_the_limits(max_current, sag):
    """Compare all four quadrants, and speeds beyond the no-load speed."""
    drive = Drive(
        GearMotor(gear_ratio=3.0), SampledLoop(max_current=max_current), Supply(24.0, sag)
    )
    speeds = np.linspace(-1.3, 1.3, 14) * 24.0 / 0.042
    for bound, ask in zip(
        torque_limits(drive, speeds / 3.0, max_current), (-1e3, 1e3), strict=True
    ):
        ends = [simulate_loop(drive, np.full(100, ask), speed).current[-1] for speed in speeds]
        np.testing.assert_allclose(bound, 3.0 * 0.042 * np.array(ends), rtol=1e-6, atol=1e-9)


def test_the_gear_s_efficiency_applies_before_friction():
    drive = Drive(
        GearMotor(
            gear_ratio=10.0, gear_efficiency=0.8, coulomb_friction=2e-3, viscous_friction=1e-5
        )
    )
    low, high = torque_limits(drive, [-20.0, 0.0, 20.0], 0.1)
    motor, friction = 0.042 * 0.1, 2e-3 + 1e-5 * 200.0
    expected = [motor / 0.8 + friction, 0.8 * motor - 2e-3, 0.8 * motor - friction]
    np.testing.assert_allclose(high, 10.0 * np.array(expected), rtol=1e-12)
    np.testing.assert_allclose(low, -high[::-1], rtol=1e-12)


LOSSY = GearMotor(
    gear_ratio=20.0, gear_efficiency=0.7, coulomb_friction=3e-3, viscous_friction=4e-6
)


def hinge(drive, inertia):
    """Return the model and data of a hinge with a motor that gets the largest command."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.compiler.boundmass = 5e-5, 0.0
    body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[inertia] * 3)
    body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    model = codrl_mj.add_motors(spec, {"hinge": drive}).compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = 1e3
    return model, data


@pytest.mark.parametrize("max_current", [math.inf, 1.0], ids=["voltage alone", "and current"])
@pytest.mark.parametrize("share", [-1.2, -0.5, 0.01, 0.5, 0.9, 1.2])
def test_the_limits_are_the_net_torques_on_a_hinge_in_mujoco(share, max_current):
    """At shares of the no-load speed, which a heavy load keeps constant."""
    drive = Drive(LOSSY, SampledLoop(max_current=max_current))
    model, data = hinge(drive, 100.0)
    data.qvel[:] = share * drive_limits(drive).no_load_speed
    mujoco.mj_step(model, data, 200)
    speed = data.qvel[0]
    mujoco.mj_step(model, data)
    moved = data.qacc[0] * (100.0 + drive.additions.armature)
    assert moved == pytest.approx(torque_limits(drive, speed, max_current)[1], rel=1e-5)
    if share == 0.01 and max_current == math.inf:
        assert moved == pytest.approx(drive_limits(drive).stall_torque, rel=0.02)


def test_a_free_hinge_runs_at_the_no_load_speed_with_the_no_load_current():
    drive = Drive(LOSSY)
    model, data = hinge(drive, 1e-9)
    mujoco.mj_step(model, data, 20_000)
    can = drive_limits(drive)
    assert data.qvel[0] == pytest.approx(can.no_load_speed, rel=1e-6)
    assert codrl_mj.signals(model, data)["current"] == pytest.approx(can.no_load_current, rel=1e-5)


def test_the_limits_cross_zero_at_the_no_load_speed():
    for name in motor_names():
        drive = find_drive(name)
        can = drive_limits(drive)
        assert abs(torque_limits(drive, can.no_load_speed)[1]) < 1e-9 * can.stall_torque
        assert torque_limits(drive, 0.0)[1] == pytest.approx(can.stall_torque, rel=1e-12)


def test_a_current_limit_reduces_torque_and_power():
    """At 12 V, 2 ohm, 0.1 N*m/A: 3 A make 3*(12 - 2*3) W, 1 A makes 1*(12 - 2*1) W."""
    motor = GearMotor(2.0, 1e-3, 0.1, 0.1, gear_ratio=5.0)
    for max_current, amperes in ((math.inf, 3.0), (1.0, 1.0)):
        can = drive_limits(Drive(motor, SampledLoop(max_current=max_current), Supply(12.0)))
        assert can.power == pytest.approx(amperes * (12.0 - 2.0 * amperes))
        assert can.peak_torque == pytest.approx(0.5 * min(max_current, 6.0))
        assert can.stall_torque == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("drive", "text"),
    [
        (Drive(GearMotor(), SampledLoop(max_current=3.0), Supply(5.0)), ""),
        (
            Drive(GearMotor(), SampledLoop(max_current=3.0)),
            "assumed, because not specified: supply.voltage = 24 V",
        ),
        (
            Drive(GearMotor(rotor_inertia=0.0), SampledLoop(), Supply(5.0)),
            "max_current = inf, motor.rotor_inertia = 0",
        ),
        (Ideal(), ""),
    ],
)
def test_a_drive_reports_its_assumptions(drive, text):
    assert text in drive.assumed
    assert (text == "") == (drive.assumed == "")


def test_a_motor_without_back_emf_has_an_infinite_no_load_speed():
    can = drive_limits(Drive(GearMotor(back_emf_constant=0.0)))
    assert can.no_load_speed == math.inf
    assert can.no_load_current == 0.0


def test_flags_override_fields_of_the_named_drive(tmp_path):
    drive = find_drive("maxon-ec45-flat-50w", 12.0, 40e3, 1e3, 12.0, True, 8.0)
    assert (drive.motor.gear_ratio, drive.voltage_limit, drive.motor.rotor_inertia) == (
        12.0,
        12.0,
        pytest.approx(135e-7),
    )
    assert drive.controller == SampledLoop(40e3, 1e3, delayed=True, max_current=8.0)
    overridden = tmp_path / "own.yaml"
    overridden.write_text("family: drive\ncontroller: {delayed: true}\n")
    assert find_drive(str(overridden)) == Drive(controller=SampledLoop(delayed=True))
    assert not find_drive(str(overridden), delayed=False).controller.delayed
    assert find_drive(drive) == drive
    assert find_entry(str(overridden)) is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("maxon-ec45-flat-50",), "did you mean 'maxon-ec45-flat-50w'"),
        (
            ("ideal",),
            (
                "motor = 'ideal': is not a drive, but of the actuator family ideal; name a"
                " motor of the"
            ),
        ),
        (("current_loop",), "is not a drive, but of the actuator family current_loop"),
        (("rev-neo", 0.0), r"GearMotor\.gear_ratio = 0\.0: must be a finite number > 0"),
        (
            ("rev-neo", None, 10e3, 2e3),
            r"bandwidth = 2000: must be <= 1591\.55 Hz at sample_rate = 10000",
        ),
        (("rev-neo", None, None, None, -1.0), r"Supply\.voltage = -1\.0: must be"),
    ],
)
def test_raises_if_the_input_is_invalid(arguments, message):
    with pytest.raises(ValueError, match=message):
        find_drive(*arguments)


def test_catalogue_rows_are_sorted_with_unknown_values_last():
    rows = catalogue_rows("mechanical_time_constant")
    assert sorted(row["name"] for row in rows) == motor_names()
    known = [
        row["mechanical_time_constant"]
        for row in rows
        if row["mechanical_time_constant"] is not None
    ]
    assert known == sorted(known, reverse=True)
    assert rows[-1]["mechanical_time_constant"] is None
    row = next(row for row in rows if row["name"] == "quanser-qube-servo-2")
    assert row["electrical_time_constant"] == pytest.approx(1.16e-3 / 8.4, rel=1e-12)
    assert row["mechanical_time_constant"] == pytest.approx(8.4 * 4e-6 / 0.042**2, rel=1e-12)
    with pytest.raises(
        ValueError, match=r"unknown column stall_torqe; did you mean stall_torque\?"
    ):
        catalogue_rows("stall_torqe")


@pytest.mark.parametrize("name", motor_names())
def test_explain_has_the_origin_of_every_number(name):
    entry = motor_entry(name)
    report = describe_motor(Drive.from_motor_parameters(entry.parameters), entry)
    shown = {row["name"]: row for row in report["numbers"]}
    fields = {field.name for field in dataclasses.fields(entry.parameters)} - {
        "derived",
        "disagreements",
    }
    assert shown.keys() | set(report["unknown"]) == fields
    assert shown["inductance"]["unit"] == "H"
    for field, row in shown.items():
        assert row["how"] == entry.parameters.derived[field]
        if (
            "printed" in row["how"]
            and not row["how"].endswith("is printed")
            and field not in entry.estimated
        ):
            assert row["sources"], field
    reported = [
        line
        for line in report["disagreements"]
        if not line.startswith("less than 1%, by rounding: ")
    ]
    large = [item for item in entry.parameters.disagreements if abs(item.difference) >= 0.01]
    small = ", ".join(
        item.quantity for item in entry.parameters.disagreements if abs(item.difference) < 0.01
    )
    assert reported == list(map(str, large))
    assert report["disagreements"][len(reported) :] == (
        [f"less than 1%, by rounding: {small}"] if small else []
    )
