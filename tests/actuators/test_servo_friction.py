"""Friction of servos, against BAM, its equations in numpy, and integrations of sliding motion."""

import dataclasses
import json
import math

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, SampledLoop, ServoFriction, Supply, resolve
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.identify.result import base_motor
from codrl_mj.sizing import drive_limits, operating_points
from tests.actuators.test_shaft import hinge, on_a_shaft

BASE = {"base": 0.03, "viscous": 0.012}
STRIBECK = {"stribeck": 0.04, "stribeck_speed": 0.8, "stribeck_exponent": 1.4}
DIRECTIONAL = {
    "load_motor": 0.22,
    "load_external": 0.05,
    "load_motor_stribeck": 0.03,
    "load_external_stribeck": 0.16,
}
QUADRATIC = {"load_motor_quadratic": 0.06, "load_external_quadratic": 0.09}
EQUAL = {"load_motor": 0.12, "load_external": 0.12}
EQUAL_STRIBECK = {"load_motor_stribeck": 0.1, "load_external_stribeck": 0.1}
MODELS = {
    "m1": ServoFriction(**BASE),
    "m2": ServoFriction(**BASE, **STRIBECK),
    "m3": ServoFriction(**BASE, **EQUAL),
    "m4": ServoFriction(**BASE, **STRIBECK, **EQUAL, **EQUAL_STRIBECK),
    "m5": ServoFriction(**BASE, **STRIBECK, **DIRECTIONAL),
    "m6": ServoFriction(**BASE, **STRIBECK, **DIRECTIONAL, **QUADRATIC),
}
"""Numbers in the range of a Dynamixel's, for each of the six published models."""
every_model = pytest.mark.parametrize("model", MODELS)
# A pendulum: mass [kg], distance of its center [m], inertia about its hinge [kg*m^2].
MASS, LENGTH, ABOUT = 0.5, 0.15, 0.035
LOAD = {"inertia": ABOUT - MASS * LENGTH**2, "mass": MASS, "down": LENGTH}
MOTOR = GearMotor(resistance=1.0, inductance=1e-4, rotor_inertia=0.0)


def published_limit(model, friction, speed, motor, load):
    """Return the published budget of friction of a model, term by term, for arrays."""
    f = friction
    budget = f.base + f.viscous * np.abs(speed)
    fading = np.exp(-(np.abs(speed / f.stribeck_speed) ** f.stribeck_exponent))
    if model in ("m2", "m4", "m5", "m6"):
        budget = budget + f.stribeck * fading
    if model in ("m3", "m4"):
        budget = budget + f.load_motor * np.abs(motor - load)
    if model == "m4":
        budget = budget + fading * f.load_motor_stribeck * np.abs(motor - load)
    if model in ("m5", "m6"):
        budget = budget + np.abs(f.load_motor * motor - f.load_external * load)
        stribeck = f.load_motor_stribeck * motor - f.load_external_stribeck * load
        budget = budget + fading * np.abs(stribeck)
    if model == "m6":
        opposed = np.sign(motor) != np.sign(load)
        drives, yields = np.abs(motor) > np.abs(load), np.abs(motor) < np.abs(load)
        squares = drives * f.load_external_quadratic * load**2
        squares = squares + yields * f.load_motor_quadratic * motor**2
        budget = budget + fading * np.where(opposed, squares, 0.0)
    return budget


def grid():
    """Return speeds, motor torques and loads, with standstill and zero torques among them."""
    axes = np.meshgrid(np.linspace(-4, 4, 17), np.linspace(-2, 2, 17), np.linspace(-2, 2, 17))
    return [points.ravel() for points in axes]


@every_model
def test_the_limit_is_that_of_the_published_equations(model):
    friction, points = MODELS[model], grid()
    expected = published_limit(model, friction, *points)
    np.testing.assert_allclose(friction.limit(*points), expected, rtol=0.0, atol=1e-14)
    assert np.ptp(expected) > 0.02


@every_model
def test_the_limit_is_that_of_bam(model, tmp_path):
    reason = "NOT RUN: BAM is not installed: pip install --no-deps better-actuator-models"
    load_model = pytest.importorskip("bam.model", reason=reason).load_model

    file, points = tmp_path / "servo.json", grid()
    for name in ("mx64", "mx106", "xl320", "xl330", "erob80_50"):
        theirs = load_model(motor_name=name, model=model)
        numbers = {key: value.value for key, value in theirs.get_parameters().items()}
        file.write_text(json.dumps(numbers | {"model": model, "actuator": name}))
        friction_loss, damping = theirs.compute_frictions(points[1], points[2], points[0])
        expected = friction_loss + damping * np.abs(points[0])
        ours = resolve(file, None, "the test").friction.limit(*points)
        np.testing.assert_allclose(ours, expected, rtol=0.0, atol=1e-9)


def simulated(friction, timestep, duration, start, torque, gear_ratio=1.0):
    """Return the angles [rad] of a pendulum under a motor torque of time, in our engine."""
    motor = dataclasses.replace(MOTOR, gear_ratio=gear_ratio)
    model = on_a_shaft(Drive(motor, supply=Supply(1e4), friction=friction), timestep, **LOAD)
    data, angles = mujoco.MjData(model), []
    data.qpos[:] = start
    for _ in range(round(duration / timestep)):
        data.ctrl[:] = torque(data.time)
        mujoco.mj_step(model, data)
        angles.append(data.qpos[0])
    return np.array(angles)


def published_motion(model, friction, timestep, duration, start, torque):
    """Return the angles [rad] by the published step: the stopping torque within the budget."""
    angle, speed, angles = start, 0.0, []
    for step in range(round(duration / timestep)):
        motor, load = torque(step * timestep), -MASS * 9.81 * LENGTH * math.sin(angle)
        stops = ABOUT * speed / timestep + motor + load
        budget = float(published_limit(model, friction, speed, motor, load))
        resisting = math.copysign(min(abs(stops), budget), stops)
        speed += timestep / ABOUT * (motor + load - resisting)
        angle += timestep * speed
        angles.append(angle)
    return np.array(angles)


@pytest.mark.parametrize("gear_ratio", [1.0, 50.0])
@every_model
def test_a_pendulum_moves_as_in_the_published_simulation(model, gear_ratio):
    friction, arguments = MODELS[model], (3.0, -0.5, lambda time: 0.9 * math.sin(4.4 * time))
    expected = published_motion(model, friction, 0.0005, *arguments)
    errors = []
    for timestep in (0.002, 0.001):
        angles = simulated(friction, timestep, *arguments, gear_ratio)
        stride = round(timestep / 0.0005)
        errors.append(np.abs(angles - expected[stride - 1 :: stride]).max())
    assert np.ptp(expected) > 0.5
    # The load is observed in the previous steps, so the error is that of a step.
    assert errors[1] < 0.01 * np.ptp(expected)
    assert errors[1] < 0.75 * errors[0]


def test_a_pendulum_moves_otherwise_if_friction_ignores_the_load():
    arguments = (3.0, -0.5, lambda time: 0.9 * math.sin(4.4 * time))
    complete, plain = (simulated(MODELS[name], 0.001, *arguments) for name in ("m6", "m2"))
    assert np.abs(complete - plain).max() > 0.1 * np.ptp(complete)


@every_model
def test_a_pendulum_breaks_loose_and_slides_as_in_an_exact_integration(model):
    """The torque first holds the pendulum at an angle, and grows until it breaks loose."""
    friction, start = MODELS[model], 0.3

    def weight(angle):
        return -MASS * 9.81 * LENGTH * math.sin(angle)

    def torque(time):
        return 0.25 * time - weight(start)

    def net(time, angle, speed):
        motor, load = torque(time), weight(angle)
        return motor + load - float(published_limit(model, friction, speed, motor, load))

    loose = brentq(lambda time: net(time, start, 0.0), 0.0, 10.0)
    duration = loose + 0.25
    motion = solve_ivp(
        lambda time, state: [state[1], net(time, *state) / ABOUT],
        (loose, duration),
        [start, 0.0],
        rtol=1e-10,
        atol=1e-12,
        dense_output=True,
    )
    timestep = 0.0005
    angles = simulated(friction, timestep, duration, start, torque)
    times = timestep * np.arange(1, len(angles) + 1)
    slides = times > loose
    expected = np.where(slides, motion.sol(np.maximum(times, loose))[0], start)
    assert expected[-1] - start > 0.01
    # Until it breaks loose it stays, but for the first steps, in which the load is not yet known.
    assert np.abs(angles[times < loose - 0.01] - start).max() < 1e-5
    # The rest is the delay of the current loop.
    assert np.abs(angles - expected).max() < 0.004 * (expected[-1] - start)


def test_a_held_load_does_not_creep():
    """MuJoCo's own friction constraint creeps; this friction comes to rest exactly."""
    friction = dataclasses.replace(MODELS["m6"], base=0.3)
    angles = simulated(friction, 0.001, 4.0, 0.3, lambda _: 0.05)
    assert abs(angles[-1] - angles[1000]) < 1e-12
    assert abs(angles[-1] - 0.3) < 1e-4


def test_friction_grows_with_the_motor_torque_that_drives_a_load():
    """Lift and lower a load at a held speed: efficiency when driving, and when driven."""
    friction = ServoFriction(load_motor=0.2, load_external=0.1)
    lifted, lowered = friction.net_torque(np.array([1.0, 1.0]), np.array([2.0, -2.0]))
    # tau - 0.2*tau - 0.1*net = net, and tau + 0.2*tau + 0.1*net = net.
    assert lifted == pytest.approx(0.8 / 1.1, rel=1e-12)
    assert lowered == pytest.approx(1.2 / 0.9, rel=1e-12)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("coulomb_friction", 0.01),
        ("viscous_friction", 0.01),
        ("stribeck_friction", 0.01),
        ("gear_efficiency", 0.9),
    ],
)
def test_a_motor_has_either_kind_of_friction(field, value):
    motor = GearMotor(**{field: value})
    with pytest.raises(ValueError, match=f"motor.{field} = {value:g}: must be .* if friction is"):
        Drive(motor, friction=MODELS["m1"])
    # A part without friction describes none.
    assert Drive(motor, friction=ServoFriction()).motor == motor
    parameters = np.array([Drive(motor).parameter_values, Drive().parameter_values])
    base = list(codrl_mj.actuators.parameter_paths(Drive)).index("friction_base")
    parameters[:, base] = 0.1
    radii = Drive.instability(parameters, 0.002)
    assert np.isinf(radii[0])
    assert radii[1] < 1.0


def test_a_drive_without_this_friction_is_written_as_before():
    assert "friction" not in Drive().as_mapping()
    drive = Drive(friction=MODELS["m6"])
    assert resolve(drive.as_mapping(), None, "the test") == drive
    assert Drive.from_parameter_values(drive.parameter_values) == drive
    assert drive.commands()["voltage"].actuator.friction == MODELS["m6"]
    assert drive.additions.friction == drive.additions.damping == 0.0


def test_friction_is_drawn_at_each_reset():
    drive = Drive(
        GearMotor(gear_ratio=20.0), SampledLoop(10e3), friction=ServoFriction(load_motor=0.1)
    )
    env = ActuatedEnv(
        "pendulum", drive, randomize={"friction.load_motor": codrl_mj.Uniform(0.2, 0.6)}
    )
    observations = []
    for seed in range(2):
        env.reset(seed=seed)
        drawn = env.actuator.friction.load_motor
        assert drawn == env.randomization["friction.load_motor"]
        assert 0.2 <= drawn <= 0.6
        fixed = ActuatedEnv("pendulum", env.actuator)
        fixed.reset(seed=seed)
        fixed.state = env.state
        for _ in range(5):
            action = np.array([1.0], np.float32)
            observations.append(env.step(action)[0])
            np.testing.assert_array_equal(fixed.step(action)[0], observations[-1])


def test_a_model_whose_joint_has_the_friction_of_its_motor_is_warned_of():
    """The friction is part of the torque, and adding the joint's own would count it twice."""
    spec = hinge(0.002)
    spec.joint("shaft").frictionloss = 0.2
    drive = Drive(MOTOR, friction=ServoFriction(base=0.1))
    with pytest.warns(
        codrl_mj.engine.MotorWarning, match=r"frictionloss 0\.2 \(the motor's is 0\.1\)"
    ):
        codrl_mj.add_motors(spec, {"shaft": drive})
    replaced = codrl_mj.add_motors(spec, {"shaft": drive}, joint_dynamics="replace").compile()
    assert replaced.dof_frictionloss[0] == 0.0


def test_limits_at_the_output_subtract_the_friction():
    friction = ServoFriction(base=0.1, viscous=0.01, load_motor=0.2, load_external=0.05)
    motor = GearMotor(resistance=2.0, torque_constant=0.5, back_emf_constant=0.5)
    limits = drive_limits(Drive(motor, supply=Supply(12.0), friction=friction))
    # 3 N*m at stall: 3 - 0.1 - 0.2*3 - 0.05*net = net.
    assert limits.stall_torque == pytest.approx((3.0 - 0.1 - 0.6) / 1.05, rel=1e-9)
    # Without a load, the motor's torque t balances 0.1 + 0.01*w + 0.2*t.
    speed = limits.no_load_speed
    torque = 0.5 * (12.0 - 0.5 * speed) / 2.0
    assert torque == pytest.approx(0.1 + 0.01 * speed + 0.2 * torque, rel=1e-9)
    assert limits.no_load_current == pytest.approx(torque / 0.5, rel=1e-9)


def test_sizing_and_identification_refuse_this_friction_by_name():
    drive = Drive(friction=ServoFriction(load_motor=0.2))
    with pytest.raises(ValueError, match=r"friction: .* remove friction, and set motor.coulomb"):
        operating_points(None, drive)
    with pytest.raises(ValueError, match=r"friction: identification estimates .* remove friction"):
        base_motor(drive.as_mapping())
