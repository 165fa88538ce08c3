"""Motors in the notations of other simulators, and their losses."""

import ast
import json
import math
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import Drive, Lag, ServoFriction, TorqueSpeed, field_paths
from codrl_mj.arrays import write_motor
from codrl_mj.arrays.written_losses import _PLACES, _THERMAL, steady_torque
from codrl_mj.arrays.written_models import bam_torque, torque_speed_line, winding_of, winding_torque
from codrl_mj.catalogue import motor_entry
from codrl_mj.cli import main

PAGE = Path(__file__).parents[2] / "docs" / "arrays.md"
MOTOR = "maxon-ec45-flat-50w"
CATALOGUE = Drive.from_motor_parameters(motor_entry(MOTOR).parameters)
GEARED = CATALOGUE.replaced({"motor.gear_ratio": 20.0, "controller.max_current": 10.0})
LOSSY = GEARED.replaced(
    {
        "motor.gear_efficiency": 0.8,
        "motor.stribeck_friction": 0.004,
        "motor.stribeck_speed": 3.0,
        "motor.viscous_friction": 1e-6,
        "motor.torque_constant": 0.03,
        "supply.resistance": 0.1,
    }
)
# A tenth of the stall current, which the back-EMF alone exceeds slightly above the no-load speed.
LIMITED = GEARED.replaced({"controller.max_current": 2.5, "motor.torque_constant": 0.03})
LINE = TorqueSpeed(stall_torque=2.0, no_load_speed=30.0, max_torque=1.5)


def keywords(text):
    """Return the keyword arguments of the call in a written configuration."""
    call = next(node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
    return {word.arg: ast.literal_eval(word.value) for word in call.keywords}


def lost_paths(written):
    return {path for row in written.lost for path in row.fields}


def test_a_line_has_the_torques_and_speeds_of_the_joint():
    written = keywords(write_motor(GEARED, "mjlab", r"\w+_hip").text)
    motor, voltage = GEARED.motor, 24.0
    constant = motor.torque_constant
    assert written["target_names_expr"] == (r"\w+_hip",)
    assert written["saturation_effort"] == pytest.approx(
        20.0 * constant * voltage / 0.942, rel=1e-8
    )
    assert written["velocity_limit"] == pytest.approx(
        voltage / motor.back_emf_constant / 20.0, rel=1e-8
    )
    assert written["effort_limit"] == pytest.approx(20.0 * constant * 10.0, rel=1e-8)
    assert written["armature"] == pytest.approx(400.0 * motor.rotor_inertia, rel=1e-8)
    assert written["frictionloss"] == pytest.approx(20.0 * motor.coulomb_friction, rel=1e-8)
    isaaclab = keywords(write_motor(GEARED, "isaaclab").text)
    assert isaaclab["joint_names_expr"] == [".*"]
    assert isaaclab["friction"] == isaaclab["dynamic_friction"] == written["frictionloss"]
    for name in ("saturation_effort", "armature"):
        assert isaaclab[name] == written[name]
    for name in ("velocity_limit", "effort_limit"):
        assert isaaclab[f"actuator_{name}"] == written[name]


def test_a_function_for_newton_has_the_same_line():
    text = write_motor(GEARED, "newton", "hip").text
    line = next(
        ast.literal_eval(node.value)
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign)
    )
    written = keywords(write_motor(GEARED, "mjlab").text)
    assert line["saturation_effort"] == written["saturation_effort"]
    assert line["velocity_limit"] == written["velocity_limit"]
    assert line["max_motor_effort"] == written["effort_limit"]
    assert f"builder.joint_armature[dof] += {written['armature']}" in text


def test_a_slide_is_written_with_forces():
    drive = GEARED.replaced({"motor.arm_radius": 0.05})
    written = write_motor(drive, "mjlab")
    assert "in N and m/s" in written.text
    assert written.slides
    hinge, slide = keywords(write_motor(GEARED, "mjlab").text), keywords(written.text)
    assert slide["saturation_effort"] == pytest.approx(hinge["saturation_effort"] / 0.05, rel=1e-8)
    assert slide["velocity_limit"] == pytest.approx(hinge["velocity_limit"] * 0.05, rel=1e-8)


@pytest.mark.parametrize("target", ["mjlab", "isaaclab", "newton", "dcmotor"])
def test_a_line_loses_nothing(target):
    written = write_motor(LINE, target)
    assert written.lost == ()
    assert written.comparison.torque_error < 1e-14
    # MuJoCo reads numbers of nine digits.
    assert written.comparison.motion_gap < 1e-7
    assert written.comparison.motion_range > 1.0


def test_every_field_has_a_place_or_is_lost():
    assert {path for row in _PLACES for path in row.fields} | {*_THERMAL} == {*field_paths(Drive)}
    changed = {
        "motor.gear_efficiency": 0.9,
        "motor.stribeck_friction": 1e-3,
        "motor.load_inertia": 1e-3,
        "supply.resistance": 0.2,
        "controller.bemf_compensation": False,
    }
    lost = lost_paths(write_motor(GEARED.replaced(changed), "mjlab"))
    assert changed.keys() <= lost
    assert not changed.keys() & lost_paths(write_motor(GEARED, "mjlab"))
    row = next(
        row for row in write_motor(GEARED, "bam").lost if "controller.anti_windup" in row.fields
    )
    assert row.values[row.fields.index("controller.anti_windup")] == "back_calculation"


@pytest.mark.parametrize(
    ("drive", "share"),
    # Without a current limit, a braking motor exceeds its stall torque. With one, the line is exact
    # up to speeds at which the back-EMF alone drives more than the largest current. A braking gear
    # of efficiency e delivers 1/e - e of the largest torque more than a line for driving.
    [(GEARED, 0.0), (CATALOGUE, 0.2), (LOSSY, 0.244)],
    ids=["geared", "direct", "lossy"],
)
def test_the_largest_error_of_a_line_is_that_of_random_points(drive, share):
    comparison = write_motor(drive, "mjlab").comparison
    line, random = torque_speed_line(drive), np.random.default_rng(0)
    speeds = random.uniform(-1.2, 1.2, 3000) * line.no_load_speed
    torques = random.uniform(-1.2, 1.2, 3000) * line.stall_torque
    limit = np.minimum(line.max_torque, line.stall_torque)
    upper = np.clip(line.stall_torque * (1.0 - speeds / line.no_load_speed), -limit, limit)
    lower = np.clip(line.stall_torque * (-1.0 - speeds / line.no_load_speed), -limit, limit)
    errors = np.abs(steady_torque(drive, torques, speeds) - np.clip(torques, lower, upper))
    assert errors.max() == pytest.approx(comparison.torque_error, rel=0.05, abs=1e-12)
    assert comparison.torque_error / line.stall_torque == pytest.approx(share, abs=0.01)


def test_the_steady_torque_without_losses_is_that_of_a_winding():
    random = np.random.default_rng(1)
    drive = GEARED.replaced({"motor.torque_constant": 0.03, "controller.max_current": math.inf})
    speeds, torques = random.uniform(-40.0, 40.0, 500), random.uniform(-20.0, 20.0, 500)
    ours = steady_torque(drive, torques, speeds)
    np.testing.assert_allclose(
        winding_torque(winding_of(drive, "dcmotor"), torques, speeds), ours, rtol=0.0, atol=1e-12
    )
    # BAM limits the current before the voltage, as our drive does.
    ours = steady_torque(LIMITED, torques, speeds)
    limit = winding_of(LIMITED, "bam").max_force
    assert (np.abs(ours) > 1.1 * limit).sum() > 10
    np.testing.assert_allclose(bam_torque(LIMITED, torques, speeds), ours, rtol=0.0, atol=1e-9)
    # A driving motor of BAM loses the same torque in its gear.
    lossy = LOSSY.replaced({"controller.max_current": math.inf, "supply.resistance": 0.0})
    drives = torques * speeds > 0.0
    ours, theirs = steady_torque(lossy, torques, speeds), bam_torque(lossy, torques, speeds)
    drives &= (ours * speeds > 0.0) & (np.abs(theirs) > 0.0) & (theirs * speeds > 0.0)
    assert drives.sum() > 100
    np.testing.assert_allclose(theirs[drives], ours[drives], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    "actuator", [GEARED, LOSSY, LIMITED, LINE], ids=["geared", "lossy", "limited", "line"]
)
def test_mujoco_steps_a_dcmotor_to_the_steady_torque(actuator):
    text = write_motor(actuator, "dcmotor", "it").text
    comment, _, element = text.partition("-->")
    joint = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="it" armature="1e9"/>
    <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-15 1e-15 1e-15"/></body></worldbody>"""
    model = mujoco.MjModel.from_xml_string(f"{joint}{element}</mujoco>")
    per_force, per_speed = (float(part.split()[-1]) for part in comment.rsplit("*", 2)[:2])
    winding, line = winding_of(actuator, "dcmotor"), torque_speed_line(actuator)
    volts = winding.voltage
    assert model.actuator_ctrlrange[0] == pytest.approx([-volts, volts])
    for speed in np.linspace(-1.3, 1.3, 6) * line.no_load_speed:
        for torque in np.linspace(-1.3, 1.3, 6) * line.stall_torque:
            data = mujoco.MjData(model)
            data.qvel[0], data.ctrl[0] = speed, per_force * torque + per_speed * speed
            for _ in range(30):
                mujoco.mj_step(model, data)
            expected = winding_torque(winding, np.array(torque), np.array(speed))
            warmed = 0.01 * line.stall_torque if isinstance(actuator, Drive) else 0.0
            assert data.qfrc_actuator[0] == pytest.approx(
                float(expected), abs=warmed + 1e-8 * line.stall_torque
            )


def test_mujoco_heats_a_dcmotor_to_the_final_temperature_of_the_motor():
    element = ET.fromstring(write_motor(GEARED, "dcmotor").text.partition("-->")[2])[0]
    resistance, _, constant, *_ = map(float, element.get("thermal").split())
    motor = GEARED.motor
    winding, housing = motor.thermal_resistance_winding, motor.thermal_resistance_housing
    assert resistance == pytest.approx(winding + housing)
    # The area between a step response and its end is the same.
    assert resistance * constant == pytest.approx(
        winding * motor.thermal_time_constant_winding
        + housing * motor.thermal_time_constant_housing
    )
    assert element.get("joint") == "joint"
    cold = GEARED.replaced(
        {
            "motor.max_temperature": math.inf,
            "motor.thermal_resistance_winding": 0.0,
            "motor.thermal_resistance_housing": 0.0,
        }
    )
    assert "thermal" not in write_motor(cold, "dcmotor").text


def test_bam_gets_every_parameter_of_the_friction_model():
    plain = json.loads(write_motor(GEARED, "bam").text)
    assert plain["model"] == "m1"
    assert "alpha" not in plain
    assert plain["kt"] == pytest.approx(20.0 * GEARED.motor.back_emf_constant)
    # Torque and slope of the line are those of the motor.
    motor = GEARED.motor
    assert plain["kt"] / plain["R"] == pytest.approx(20.0 * motor.torque_constant / 0.942)
    lossy = json.loads(write_motor(LOSSY, "bam").text)
    assert lossy["model"] == "m5"
    assert lossy["load_friction_motor"] == pytest.approx(0.2)
    assert lossy["friction_stribeck"] == pytest.approx(20.0 * 0.004)
    assert lossy["dtheta_stribeck"] == pytest.approx(3.0 / 20.0)
    assert lossy["friction_viscous"] == pytest.approx(400.0 * 1e-6)
    stribeck = json.loads(
        write_motor(GEARED.replaced({"motor.stribeck_friction": 0.004}), "bam").text
    )
    assert stribeck["model"] == "m2"
    assert "load_friction_motor" not in stribeck


FRICTIONAL = CATALOGUE.replaced(
    {"motor.gear_ratio": 20.0, "motor.coulomb_friction": 0.0, "controller.max_current": 10.0}
).replaced({"friction": ServoFriction(0.1, 0.02, 0.15, 0.5, 1.3, 0.2, 0.1, 0.05, 0.1, 0.01, 0.02)})


def test_the_friction_of_servos_is_written_for_bam_without_a_loss():
    written = write_motor(FRICTIONAL, "bam")
    values = json.loads(written.text)
    assert values["model"] == "m6"
    assert (values["friction_base"], values["friction_viscous"]) == (0.1, 0.02)
    assert (values["load_friction_motor_quad"], values["dtheta_stribeck"]) == (0.01, 0.5)
    assert not any(path.startswith("friction.") for path in lost_paths(written))
    assert written.comparison.torque_error < 1e-11
    assert written.comparison.motion_gap < 0.01 * written.comparison.motion_range
    # A slide has forces and speeds of its pinion.
    slide = json.loads(write_motor(FRICTIONAL.replaced({"motor.arm_radius": 0.05}), "bam").text)
    assert slide["friction_base"] == pytest.approx(0.1 / 0.05)
    assert slide["dtheta_stribeck"] == pytest.approx(0.5 * 0.05)
    assert slide["load_friction_motor"] == 0.2
    assert slide["load_friction_motor_quad"] == pytest.approx(0.01 * 0.05)


@pytest.mark.parametrize("target", ["mjlab", "dcmotor"])
def test_other_simulators_get_the_constant_friction_and_name_the_rest(target):
    written = write_motor(FRICTIONAL, target)
    lost = lost_paths(written)
    assert {"friction.stribeck", "friction.load_motor", "friction.load_external_quadratic"} <= lost
    assert "friction.base" not in lost
    if target == "mjlab":
        numbers = keywords(written.text)
        assert (numbers["frictionloss"], numbers["viscous_damping"]) == (0.1, 0.02)
    else:
        assert 'damping="0.02" frictionloss="0.1"' in written.text
    constant = FRICTIONAL.replaced({"friction": ServoFriction(0.1, 0.02)})
    written = write_motor(constant, target)
    assert not any(path.startswith("friction.") for path in lost_paths(written))
    assert written.comparison.torque_error < 1e-9


def test_the_voltage_and_current_to_set_in_bam_are_those_of_its_winding():
    drive = LIMITED.replaced({"controller.deadband": 0.5})
    effects = {row.fields[0]: row.effect for row in write_motor(drive, "bam").lost}
    assert "actuator.vin = 23.5 and max_pwm = 1 " in effects["supply.voltage"]
    current = 2.5 * 0.03 / drive.motor.back_emf_constant
    assert f"actuator.max_current = {current:.6g} " in effects["controller.max_current"]
    lost = lost_paths(write_motor(CATALOGUE, "bam"))
    assert "supply.voltage" in lost
    assert "controller.max_current" not in lost


@pytest.mark.parametrize(
    ("actuator", "target", "message"),
    [
        (LINE, "bam", "TorqueSpeed has no torque_constant and no resistance, which bam needs"),
        (Lag(), "mjlab", "actuator = Lag: cannot be written for mjlab.*write it as c"),
        (GEARED, "gazebo", "target = 'gazebo': must be one of c, mjlab, isaaclab"),
        (
            GEARED.replaced({"motor.back_emf_constant": 0.0}),
            "dcmotor",
            r"motor\.back_emf_constant = 0: .*which dcmotor needs",
        ),
        (
            GEARED.replaced({"supply.voltage": math.inf}),
            "newton",
            r"supply\.voltage = inf: .*which a torque-speed line needs",
        ),
        (
            GEARED.replaced({"controller.deadband": 30.0}),
            "mjlab",
            r"controller\.deadband = 30: no voltage remains",
        ),
    ],
)
def test_missing_numbers_are_named(actuator, target, message):
    with pytest.raises(ValueError, match=message):
        write_motor(actuator, target)


def test_the_command_line_writes_text_and_losses(capsys, tmp_path):
    words = ["motor", "write", MOTOR, "--gear-ratio", "20", "--max-current", "10", "--as", "mjlab"]
    out = tmp_path / "folder" / "motor.py"
    assert main([*words, "--joint", "hip"]) == 0
    text = write_motor(GEARED, "mjlab", "hip").text
    printed = capsys.readouterr().out
    assert printed.startswith(text)
    assert "motor.inductance" in printed
    assert "largest gap in a test motion" in printed
    assert main([*words, "--joint", "hip", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"wrote {out}\n")
    assert "Fields without a place" in printed
    assert out.read_text() == text


def test_the_command_line_writes_a_line_and_refuses_its_winding(capsys, tmp_path):
    line = tmp_path / "line.yaml"
    line.write_text("{family: torque_speed, stall_torque: 2.0, no_load_speed: 30.0}")
    assert main(["motor", "write", str(line), "--as", "isaaclab"]) == 0
    printed = capsys.readouterr().out
    assert "saturation_effort=2.0," in printed
    assert "the steady torques are equal" in printed
    assert "Fields without a place" not in printed
    assert main(["motor", "write", str(line), "--as", "bam"]) == 2
    assert "no resistance, which bam needs" in capsys.readouterr().err
    assert main(["motor", "write", str(line), "--as", "mjlab", "--gear-ratio", "3"]) == 2
    assert "is not a drive" in capsys.readouterr().err


def test_the_page_shows_what_is_written():
    page = PAGE.read_text()
    assert f"```py\n{write_motor(GEARED, 'mjlab', '.*_hip').text}```" in page
    unlimited = GEARED.replaced({"controller.max_current": math.inf})
    for target, label in {"mjlab": "`mjlab`, `isaaclab`, `newton`"}.items() | {
        (target, f"`{target}`") for target in ("dcmotor", "bam")
    }:
        cells = []
        for drive in (GEARED, unlimited):
            difference = write_motor(drive, target).comparison
            share = 100.0 * difference.torque_error / difference.stall_torque
            error = f"{share:.2g} % of the stall torque" if share > 1e-9 else "0"
            motion = f"{difference.motion_gap:.2g} of {difference.motion_range:.2g} rad"
            cells += [error, motion]
        assert f"| {label} | {' | '.join(cells)} |" in page
