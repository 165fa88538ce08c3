"""Servos made from named motors: error under a load against the closed form, and error messages."""

import dataclasses
import json
import math
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import yaml

import codrl_mj
from codrl_mj.actuators import (
    Drive,
    Servo,
    ServoFriction,
    ServoLoop,
    SharedSupply,
    Supply,
    display_label,
    display_name,
    named_mapping,
    override_actuator,
    resolve,
)
from codrl_mj.cli import main
from codrl_mj.sizing import find_drive, find_loop
from codrl_mj.training import load_config
from codrl_mj.training.folder import prepare_run
from tests.cli.lines import TINY, assert_refused, run_ok

MOTOR, LENGTH, MASS = "maxon-ec45-flat-50w", 0.2, 0.5
ARM = f"""<mujoco><option timestep="0.001"/><worldbody><body><joint name="knee" axis="0 -1 0"/>
<inertial pos="{LENGTH} 0 0" mass="{MASS}" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody>
<actuator><motor name="knee" joint="knee"/></actuator></mujoco>"""
GAINS = {"position_gain": 10.0, "velocity_gain": 8.0}
SERVO = {
    "name": MOTOR,
    "family": "servo",
    "motor": {"gear_ratio": 50.0, "coulomb_friction": 0.0},
    "loop": GAINS,
}
DATASHEET = """[datasheet]
nominal_voltage = "24 V"
resistance = "0.9 ohm"
inductance = "0.4 mH"
torque_constant = "36 mNm/A"
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Create a datasheet, an actuator as written by `codrl-mj identify`, and servos of both."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sheet.toml").write_text(DATASHEET)
    fields = {
        **resolve(MOTOR, None, "x").as_mapping(),
        "identified": {"intervals": {"motor.resistance": [0.8, 1.1]}},
    }
    (tmp_path / "identified.yaml").write_text(yaml.safe_dump(fields))
    for name in ("sheet.toml", "identified.yaml"):
        (tmp_path / f"servo_{name[:5]}.yaml").write_text(yaml.safe_dump(SERVO | {"name": name}))


def settled(actuator, target):
    """Return the joint's position [rad] and its load [N*m] after two seconds."""
    model = codrl_mj.add_motors(mujoco.MjSpec.from_string(ARM), {"kn.*": actuator}).compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = target
    mujoco.mj_step(model, data, 2000)
    return data.qpos[0], MASS * 9.81 * LENGTH * math.cos(data.qpos[0])


@pytest.mark.parametrize("name", [MOTOR, "sheet.toml", "identified.yaml"])
def test_a_named_motor_becomes_a_servo_whose_error_under_load_is_the_closed_form(files, name):
    drive = resolve(name, None, "x")
    motor = dataclasses.replace(drive.motor, gear_ratio=50.0, coulomb_friction=0.0)
    parts = Servo(
        motor, drive.controller, drive.supply, ServoLoop(position_gain=10.0, velocity_gain=8.0)
    )
    position, load = settled(SERVO | {"name": name}, 0.3)
    assert 0.3 - position == pytest.approx(load / (10.0 * 8.0), rel=1e-6)
    assert resolve(SERVO | {"name": name}, None, "x") == parts
    assert position == settled(parts, 0.3)[0]


@pytest.mark.parametrize("name", ["sheet.toml", "identified.yaml"])
def test_a_file_can_make_a_servo_of_another_file(files, name):
    assert resolve(f"servo_{name[:5]}.yaml", None, "x") == resolve(
        SERVO | {"name": name}, None, "x"
    )


def test_a_servo_without_a_gain_gets_the_default_gain_and_reports_it():
    servo = resolve({"name": MOTOR, "family": "servo", "motor": {"gear_ratio": 20.0}}, None, "x")
    motor = resolve(MOTOR, None, "x").motor
    slope = motor.torque_constant * motor.back_emf_constant / motor.resistance * 20.0**2
    # The gain is rounded to three digits.
    assert servo.loop.velocity_gain == pytest.approx(10.0 * slope, rel=5e-3)
    assert servo.loop == ServoLoop(velocity_gain=servo.loop.velocity_gain)
    assert f"loop.velocity_gain = {servo.loop.velocity_gain:g} N*m*s/rad" in servo.assumed
    assert "loop" not in resolve(SERVO, None, "x").assumed
    assert "loop.velocity_gain = 0.1" in Servo().assumed


def test_a_servo_becomes_a_drive_again_and_keeps_its_name():
    servo, drive = resolve(SERVO, None, "x"), resolve(MOTOR, None, "x")
    # Its friction was changed.
    assert display_name(servo) == f"{MOTOR} servo, changed"
    plain = override_actuator(drive, {"family": "servo", "loop": ServoLoop(velocity_gain=2.0)})
    assert plain == Servo(drive.motor, drive.controller, drive.supply, ServoLoop(velocity_gain=2.0))
    assert override_actuator(drive, {"family": Servo, "loop": {"velocity_gain": 2.0}}) == plain
    again = override_actuator(plain, {"family": "drive"})
    assert (type(again), again, display_label(plain), display_label(again)) == (
        Drive,
        drive,
        f"{MOTOR} servo",
        MOTOR,
    )
    read = resolve(json.loads(json.dumps(named_mapping(plain))), None, "x")
    assert (read, display_label(read)) == (plain, display_label(plain))


@pytest.mark.parametrize("controls", ["position", "velocity"])
def test_an_agent_commands_positions_or_speeds_of_a_named_motor(controls):
    setting = {
        "name": MOTOR,
        "family": "servo",
        "motor": {"gear_ratio": 20.0},
        "loop": {"controls": controls},
    }
    env = gymnasium.make("codrl_mj/Pendulum-v0", actuator=setting, action=controls)
    free = 24.0 / resolve(MOTOR, None, "x").motor.back_emf_constant / 20.0
    assert env.action_space.high == pytest.approx(
        {"position": math.pi, "velocity": free}[controls], rel=1e-6
    )
    env.reset(seed=0)
    for _ in range(40):
        *_, info = env.step(np.array([0.5], np.float32))
    # The pendulum's weight is at most 5 N*m.
    gain = resolve(setting, None, "x").loop.velocity_gain
    assert 0.0 < abs(info["error"]) <= 5.0 / gain / {"position": 20.0, "velocity": 1.0}[controls]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            {"family": "servo", "controls": "velocity"},
            r"field controls; did you mean loop\.controls\?",
        ),
        (
            {"name": MOTOR, "loop": {"position_gain": 3}},
            "field loop.position_gain of a drive: add family = 'pwm_servo' or 'servo'",
        ),
        (
            {"name": MOTOR, "supply": {"number": 2}},
            "unknown actuator field supply.number of a drive: add family = 'shared_drive'",
        ),
        (
            {"name": MOTOR, "family": "servo", "loop": {"start_duty": 0.1}},
            "field loop.start_duty of a servo: add family = 'pwm_servo'",
        ),
        ({"family": "servo", "motor": MOTOR}, f"write name = '{MOTOR}' beside the family"),
        ({"name": "lag", "family": "servo"}, "cannot replace the family 'lag'"),
        ({"name": MOTOR, "family": "servoo"}, "unknown family 'servoo': did you mean 'servo'"),
        ({"name": "ideal", "family": "servo"}, "the ideal actuator has no motor"),
        (
            {**SERVO, "motor": {"back_emf_constant": 0.0}, "loop": {}},
            r"loop\.velocity_gain is missing",
        ),
        (
            {"name": MOTOR, "temperature": 1.0},
            r"did you mean motor\.ambient_temperature or motor\.max_temperature",
        ),
        ({"name": MOTOR, "friction": 1.0}, "'friction' = 1.0: must be a mapping of ServoFriction"),
    ],
)
def test_raises_with_a_remedy_if_a_servo_cannot_be_made(setting, message):
    with pytest.raises(ValueError, match=message):
        resolve(setting, None, "x")


def test_the_command_line_makes_a_named_servo_and_a_run_stores_it(files, monkeypatch):
    configs = []
    monkeypatch.setattr("codrl_mj.training.train", lambda config, *_, **__: configs.append(config))
    line = "--actuator sheet.toml --actuator.family servo --actuator.loop.position-gain 10"
    run_ok(
        f"train pendulum {line} --actuator.motor.gear-ratio 50 --env.action position {TINY}"
        " --out run"
    )
    Path("run").mkdir()
    Path("run/config.json").write_text(
        json.dumps(prepare_run(Path("other"), configs[0], resume=False, accept_changes=False))
    )
    actuator = load_config(Path("run")).actuators[0]
    changes = {"motor": {"gear_ratio": 50.0}, "loop": {"position_gain": 10.0}}
    assert actuator == resolve({"name": "sheet.toml", "family": "servo", **changes}, None, "x")
    assert display_label(actuator) == "sheet servo"


def test_messages_explain_how_to_make_a_servo(capsys, files):
    train = "train pendulum --actuator sheet.toml"
    assert "(--actuator.family servo)" in assert_refused(capsys, f"{train} --env.action position")
    assert "--actuator.loop.controls velocity)" in assert_refused(
        capsys, f"{train} --env.action velocity"
    )
    assert "add --actuator.family pwm_servo or --actuator.family servo to make" in assert_refused(
        capsys, f"{train} --actuator.loop.position-gain 3"
    )


def test_a_servo_in_a_file_is_shown_with_its_motor_and_loops(capsys, files):
    assert main(["motor", "show", "servo_sheet.yaml"]) == 0
    assert "loop.velocity_gain" in capsys.readouterr().out
    assert find_loop("servo_sheet.yaml") == ServoLoop(**GAINS)
    assert find_loop("sheet.toml") is None
    assert find_drive("servo_sheet.yaml") == override_actuator(
        find_drive("sheet.toml"), {"motor": SERVO["motor"]}
    )


@pytest.mark.parametrize("family", ["shared_drive", "servo", "pwm_servo"])
def test_another_family_keeps_the_supply_and_goes_back(family):
    drive = Drive(supply=Supply(48.0, 0.1), friction=ServoFriction(base=0.2))
    changed = override_actuator(drive, {"family": family})
    assert (changed.supply.voltage, changed.supply.resistance) == (48.0, 0.1)
    assert override_actuator(changed, {"family": "drive"}) == drive
    nominal = resolve(MOTOR, None, "x").supply.voltage
    assert resolve({"name": MOTOR, "family": family}, None, "x").supply.voltage == nominal


def test_a_shared_drive_becomes_a_servo_on_a_supply_of_its_own():
    drive = override_actuator(
        Drive(supply=Supply(48.0)), {"family": "shared_drive", "supply": {"number": 3}}
    )
    assert drive.supply == SharedSupply(48.0, number=3)
    assert override_actuator(drive, {"family": "servo"}).supply == Supply(48.0)
