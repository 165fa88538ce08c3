"""Servos in files of BAM: numbers, units, law of the firmware, refusals, and motion."""

import json
import math

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, PwmServo, Servo, ServoFriction, resolve
from codrl_mj.actuators.bam import LAWS, bam_friction
from tests.actuators.test_servo_friction import MODELS
from tests.actuators.test_shaft import on_a_shaft

SERVO = {
    "model": "m1",
    "actuator": "xl330",
    "kt": 0.4,
    "R": 4.0,
    "armature": 2e-3,
    "q_offset": 0.03,
}
FRICTION = {"friction_base": 0.01, "friction_viscous": 5e-05}
M6 = {
    **FRICTION,
    "friction_stribeck": 0.005,
    "dtheta_stribeck": 2.9,
    "alpha": 1.5,
    "load_friction_motor": 0.26,
    "load_friction_external": 0.01,
    "load_friction_motor_stribeck": 0.02,
    "load_friction_external_stribeck": 0.08,
    "load_friction_motor_quad": 0.01,
    "load_friction_external_quad": 0.005,
}


@pytest.fixture
def read(tmp_path):
    """Return a function from the numbers of a file to the actuator."""

    def from_file(**numbers):
        path = tmp_path / "m6.json"
        path.write_text(json.dumps(SERVO | FRICTION | numbers))
        return resolve(path, None, "the test")

    return from_file


def test_a_file_gives_a_servo_with_the_law_of_its_firmware(read):
    servo = read()
    assert type(servo) is Servo
    assert servo.friction == ServoFriction(0.01, 5e-5)
    assert servo.motor.rotor_inertia == servo.additions.armature == 2e-3
    assert (servo.voltage_limit, servo.controller.max_current) == (7.5, 1.75)
    # 400 of the firmware is a duty of 2.877 per radian, of 7.5 V: kp*4096/(2*pi)/(256*885).
    volts = 7.5 * 400.0 * 4096.0 / (2.0 * math.pi) / (256.0 * 885.0)
    assert volts == pytest.approx(8.632, rel=1e-3)
    stiffness = servo.loop.position_gain * servo.loop.velocity_gain
    assert stiffness == pytest.approx(volts * 0.4 / 4.0, rel=1e-12)
    assert servo.loop.velocity_gain == pytest.approx(0.4**2 / 4.0, rel=1e-12)
    drive = resolve(
        {
            "family": "drive",
            **{k: v for k, v in servo.as_mapping().items() if k not in ("family", "loop")},
        },
        None,
        "the test",
    )
    assert type(drive) is Drive
    assert drive.friction == servo.friction


def test_numbers_of_the_firmware_in_the_file_replace_those_of_the_package(read):
    servo = read(kp=200.0, vin=6.0, error_gain=0.01, max_pwm=0.5, error_gain_ratio=1.5)
    assert servo.voltage_limit == 3.0
    assert servo.loop.position_gain == pytest.approx(6.0 * 200.0 * 0.01 * 1.5 / 0.4, rel=1e-12)


def test_a_current_controlled_servo_is_a_drive(read):
    drive = read(actuator="erob80_50")
    assert type(drive) is Drive
    assert (drive.voltage_limit, drive.controller.max_current) == (48.0, 12.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actuator": "sts3216"}, "unknown actuator of BAM sts3216; did you mean sts3215"),
        ({"actuator": "unitree_go1"}, "unknown actuator of BAM unitree_go1; .*known: mx64"),
        ({"model": "m7"}, "unknown model of friction m7"),
        ({"model": "m2"}, "model 'm2': needs friction_stribeck, dtheta_stribeck, alpha"),
        ({"friction_bsae": 1.0}, "unknown number of BAM's file friction_bsae; did you mean"),
        ({"friction_base": -1.0}, "ServoFriction.base = -1.0: must be a finite number >= 0"),
        ({"vin": math.inf, "actuator": "mx64"}, "PwmServo.supply.voltage = inf"),
        ({"kt": 0.0}, "GearMotor.torque_constant = 0.0"),
    ],
)
def test_a_wrong_file_is_refused_by_name(read, changes, message):
    with pytest.raises(ValueError, match=message):
        read(**changes)


def test_a_missing_resistance_is_not_replaced_by_a_start_value(tmp_path):
    numbers = SERVO | FRICTION
    del numbers["R"]
    (tmp_path / "m1.json").write_text(json.dumps(numbers))
    with pytest.raises(ValueError, match=r"m1.json: R: missing in BAM's file, .*; add it"):
        resolve(tmp_path / "m1.json", None, "the test")


@pytest.mark.parametrize("name", ["command_delay", "max_velocity"])
def test_numbers_without_a_field_are_refused_by_name(read, name):
    with pytest.raises(ValueError, match=f"{name} = 0.02: BAM's xl330 becomes .*; remove it"):
        read(**{name: 0.02})


def test_firmware_without_a_current_limit_gives_a_servo_of_duty_cycles(read):
    numbers = {"command_delay": 0.02, "error_gain_ratio": 1.5}
    servo = read(actuator="sts3215", **numbers)
    assert type(servo) is PwmServo
    assert servo.loop.position_gain == pytest.approx(32.0 * 0.166 * 1.5, rel=1e-12)
    assert (servo.voltage_limit, servo.loop.max_duty) == (7.4, 0.97)
    assert servo.loop.command_delay == 0.02
    # 3,400 of 4,096 counts a second, unless the file has another speed.
    assert servo.loop.max_velocity == pytest.approx(5.2155, rel=1e-4)
    assert read(actuator="sts3215", max_velocity=4.0).loop.max_velocity == 4.0
    assert servo.friction == ServoFriction(0.01, 5e-5)
    assert math.isinf(read(actuator="mx64").loop.max_velocity)


def test_every_number_of_the_largest_model_is_read_and_written_back(read):
    servo = read(model="m6", **M6)
    numbers = vars(servo.friction)
    assert sorted(numbers.values()) == sorted(M6.values())
    assert bam_friction(servo.friction) == {"model": "m6", **M6}


@pytest.mark.parametrize("model", MODELS)
def test_friction_is_written_as_the_smallest_model_that_has_it(model, read):
    written = bam_friction(MODELS[model])
    assert written["model"] == model
    again = read(**written).friction
    # Models without Stribeck's friction do not write its shape, which has no effect.
    shape = {"stribeck_speed": 1.0, "stribeck_exponent": 2.0} if model in ("m1", "m3") else {}
    assert vars(again) == vars(MODELS[model]) | shape


@pytest.mark.parametrize("name", ["xl330", "mx106", "feetech_sts3215_7_4V"])
def test_a_servo_moves_as_in_bams_simulation(tmp_path, name):
    reason = "NOT RUN: BAM is not installed: pip install --no-deps better-actuator-models"
    models = pytest.importorskip("bam.model", reason=reason)
    from bam.simulate import Simulator

    # The only published model of the STS3215 is M1.
    kind, actuator = ("m1", "sts3215") if name.startswith("feetech") else ("m6", name)
    log = {"mass": 0.12 if name == "xl330" else 1.0, "arm_mass": 0.03, "length": 0.12}
    log["kp"] = LAWS[actuator].gain
    inertia = (log["mass"] + log["arm_mass"] / 3.0) * log["length"] ** 2
    moment = (log["mass"] + log["arm_mass"] / 2.0) * log["length"]
    timestep, gaps = 0.001, {}
    theirs = models.load_model(motor_name=name, model=kind)
    numbers = {key: number.value for key, number in theirs.get_parameters().items()}
    (tmp_path / "m6.json").write_text(json.dumps(numbers | {"model": kind, "actuator": actuator}))
    theirs.q_offset.value = 0.0
    theirs.actuator.load_log(log)
    times = timestep * np.arange(1500)
    targets = 0.9 * np.sin(math.pi * times) + np.where(times > 1.0, 0.5, 0.0)
    simulator, expected = Simulator(theirs), []
    for target in targets:
        expected.append(float(simulator.q))
        control = theirs.actuator.compute_control(target, simulator.q, simulator.dq, timestep)
        simulator.step(control, True, timestep)
    servo = resolve(tmp_path / "m6.json", None, "the test")
    for label, friction in (("all", servo.friction), ("part", only_constant(servo.friction))):
        changed = servo.replaced({"friction": friction})
        mass = log["mass"] + log["arm_mass"]
        model = on_a_shaft(
            changed,
            timestep,
            inertia=inertia - moment**2 / mass,
            mass=mass,
            down=moment / mass,
        )
        data, angles = mujoco.MjData(model), []
        model.opt.gravity[2] = -9.80665
        for target in targets:
            angles.append(data.qpos[0])
            data.ctrl[0] = target
            mujoco.mj_step(model, data)
        gaps[label] = np.abs(np.array(angles) - expected).max() / np.ptp(expected)
    assert gaps["all"] < 0.005
    assert gaps["part"] > 2.0 * gaps["all"]


def only_constant(friction):
    """Return friction with Coulomb's term alone."""
    return ServoFriction(base=friction.base)


TWO_JOINTS = """
<mujoco>
  <option timestep="0.001" gravity="0 0 -9.80665" noslip_iterations="1"/>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0"/>
      <inertial pos="0 0 -0.06" mass="0.06" diaginertia="1e-4 1e-4 1e-4"/>
      <body pos="0 0 -0.12">
        <joint name="b" axis="0 1 0"/>
        <inertial pos="0 0 -0.06" mass="0.05" diaginertia="1e-4 1e-4 1e-4"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator>
</mujoco>
"""


def test_an_arm_of_two_servos_moves_as_under_bams_controller_in_mujoco(tmp_path):
    """BAM's load is that of the joint alone; ours includes the motion of the other joint."""
    reason = "NOT RUN: BAM is not installed: pip install --no-deps better-actuator-models"
    pytest.importorskip("bam.model", reason=reason)
    from bam.model import load_model
    from bam.mujoco import MujocoController

    theirs = load_model(motor_name="xl330", model="m6")
    numbers = {key: number.value for key, number in theirs.get_parameters().items()}
    (tmp_path / "m6.json").write_text(json.dumps(numbers | {"model": "m6", "actuator": "xl330"}))
    servo = resolve(tmp_path / "m6.json", None, "the test")
    times = 0.001 * np.arange(1500)
    first, second = 0.8 * np.sin(np.pi * times), 0.6 * np.sin(5.0 * times) + 0.5 * (times > 1.0)
    targets = np.stack([first, second], axis=1)
    model = mujoco.MjModel.from_xml_string(TWO_JOINTS)
    data, expected = mujoco.MjData(model), []
    controller = MujocoController(theirs, ["a", "b"], model, data)
    for target in targets:
        expected.append(data.qpos.copy())
        controller.q_target[:] = target
        controller.update()
        mujoco.mj_step(model, data)
    gaps = []
    for friction in (servo.friction, only_constant(servo.friction)):
        spec = mujoco.MjSpec.from_string(TWO_JOINTS)
        motors = {"a|b": servo.replaced({"friction": friction})}
        model, angles = codrl_mj.add_motors(spec, motors).compile(), []
        data = mujoco.MjData(model)
        for target in targets:
            angles.append(data.qpos.copy())
            data.ctrl[:] = target
            mujoco.mj_step(model, data)
        gaps.append((np.abs(np.array(angles) - expected) / np.ptp(expected, axis=0)).max())
    assert gaps[0] < 0.003
    assert gaps[1] > 10.0 * gaps[0]
