"""Heat, friction and dead band of a drive, against independent oracles."""

import dataclasses
import math
from fractions import Fraction

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, Inputs, SampledLoop, Supply, parameters_type
from codrl_mj.actuators.shaft import Shaft, TemperatureRises, friction, rises_after

HOT = GearMotor(
    thermal_resistance_winding=20.0, thermal_time_constant_winding=3.0, ambient_temperature=20.0
)


def advance_steps(actuator, timestep, torques, speed=0.0, inertia=math.inf):
    """Return the signals of all steps and the last state."""
    parameters, state = (
        parameters_type(type(actuator))(*actuator.parameter_values),
        actuator.State(*[0.0] * len(actuator.State._fields)),
    )
    signals_of_steps = []
    for torque in torques:
        state, _, signals = actuator.advance(
            parameters, timestep, state, Inputs(torque, 0.0, speed, 0.0, 0.0, inertia=inertia)
        )
        signals_of_steps.append(signals)
    return signals_of_steps, state


def hinge(timestep, inertia=1e-3, weight=0.0, mass=1.0, down=0.0):
    """Return the spec of a hinge with an inertia [kg*m^2] and a gravity torque [N*m]."""
    spec = mujoco.MjSpec()
    spec.option.timestep, body = timestep, spec.worldbody.add_body()
    body.explicitinertial, body.mass, body.inertia = True, mass, [inertia] * 3
    body.ipos = [weight / 9.81, 0.0, -down]
    body.add_joint(name="shaft", axis=[0.0, -1.0, 0.0])
    spec.add_actuator(name="it", target="shaft", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    return spec


def on_a_shaft(actuator, timestep, **load):
    """Return a compiled model of such a hinge with an actuator."""
    return codrl_mj.add_motors(hinge(timestep, **load), {"shaft": actuator}).compile()


def simulate(model, seconds, control=0.0):
    """Return the simulation of a model after some seconds under a control."""
    data = mujoco.MjData(model)
    data.ctrl[:] = control
    while data.time < seconds:
        mujoco.mj_step(model, data)
    return data


def test_the_winding_and_its_resistance_warm_up():
    """Compare a held current, which heats a growing resistance, with scipy's integration."""
    drive, amperes = Drive(HOT, supply=Supply(48.0)), 1.0
    steps, _ = advance_steps(drive, 0.002, [0.042 * amperes] * 5000)
    hot = HOT.resistance

    def warming(_, rise):
        resistance = hot * (1.0 + 0.00393 * (20.0 + rise - 25.0))
        return (amperes**2 * resistance * 20.0 - rise) / 3.0

    times = 0.002 * np.arange(1, 5001)
    exact = solve_ivp(warming, (0.0, 10.0), [0.0], t_eval=times, rtol=1e-10, atol=1e-10).y[0]
    np.testing.assert_allclose([signals.temperature for signals in steps], 20.0 + exact, atol=0.15)
    volts = hot * (1.0 + 0.00393 * (exact - 5.0)) * amperes
    np.testing.assert_allclose([signals.voltage for signals in steps[100:]], volts[100:], rtol=2e-3)


def test_winding_and_housing_warm_in_sequence():
    """Compare a constant resistance with the sum of two first-order responses."""
    motor = dataclasses.replace(
        HOT,
        thermal_resistance_housing=30.0,
        thermal_time_constant_housing=40.0,
        resistance_coefficient=0.0,
    )
    steps, _ = advance_steps(Drive(motor, supply=Supply(48.0)), 0.02, [0.042 * 0.5] * 3000)
    times, watts = 0.02 * np.arange(1, 3001), 0.25 * 8.4
    expected = 20.0 + watts * (20.0 * -np.expm1(-times / 3.0) + 30.0 * -np.expm1(-times / 40.0))
    np.testing.assert_allclose([signals.temperature for signals in steps], expected, atol=0.02)


def test_current_and_temperature_equal_those_of_mujocos_dcmotor():
    """Compare a blocked shaft; `<dcmotor>` heats by the current at the end of a step."""
    ends = {}
    for timestep in (0.002, 0.001):
        actuator = Drive(HOT, SampledLoop(10e3), Supply(48.0)).commands()["voltage"].actuator
        ours = on_a_shaft(actuator, timestep, inertia=1e9)
        spec = hinge(timestep, inertia=1e9)
        spec.actuator("it").set_to_dcmotor(
            motorconst=[HOT.torque_constant] * 2,
            resistance=HOT.resistance,
            inductance=[HOT.inductance, 0.0],
            thermal=[20.0, 3.0 / 20.0, 0.0, 0.00393, 25.0, 20.0],
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
        )
        theirs = spec.compile()
        data, reference_data, differences = mujoco.MjData(ours), mujoco.MjData(theirs), []
        readout = codrl_mj.engine.Readout(ours)
        for step in range(round(4.0 / timestep)):
            volts = 12.0 if int(step * timestep / 0.5) % 2 == 0 else -4.0
            data.ctrl[:], reference_data.ctrl[:] = HOT.torque_constant * volts, volts
            mujoco.mj_step(ours, data)
            mujoco.mj_step(theirs, reference_data)
            if step % 20 == 19:
                read = readout(data)
                differences.append(abs(read["temperature"].item() - 20.0 - reference_data.act[0]))
        assert reference_data.act[0] > 10.0
        assert read["current"].item() == pytest.approx(reference_data.act[1], rel=1e-3)
        ends[timestep] = max(differences)
    assert ends[0.001] < 0.02 * reference_data.act[0]
    assert 1.5 < ends[0.002] / ends[0.001] < 2.5


@pytest.mark.parametrize("constant", [1e-3, 3.0, 1e9])
def test_a_temperature_rises_by_its_share_to_the_last_digits(constant):
    motor = dataclasses.replace(
        HOT, thermal_time_constant_winding=constant, thermal_time_constant_housing=2.0 * constant
    )
    parameters = parameters_type(Drive)(*Drive(motor).parameter_values)
    # The series in exact fractions. A difference of 1 and the exponential would be off by 2e-5 at
    # the longest constant.
    x = -Fraction(0.002) / Fraction(constant)
    share, other_share = (
        float(-sum(ratio**k / math.factorial(k) for k in range(1, 40))) for ratio in (x, x / 2)
    )
    cold = rises_after(parameters, 0.002, TemperatureRises(0.0, 0.0), 2.0)
    assert cold == pytest.approx((40.0 * share, 0.0), rel=1e-14)
    warm = rises_after(parameters, 0.002, TemperatureRises(50.0, 10.0), 2.0)
    assert warm == pytest.approx((50.0 - 10.0 * share, 10.0 - 10.0 * other_share), rel=1e-12)


@pytest.mark.parametrize("step", [0.002, 0.02])
def test_the_thermal_limit_holds_and_ends_at_the_continuous_current(step):
    motor = dataclasses.replace(HOT, max_temperature=100.0)
    steps, _ = advance_steps(
        Drive(motor, supply=Supply(48.0)), step, [0.042 * 3.0] * round(20.0 / step)
    )
    temperatures = np.array([signals.temperature for signals in steps])
    # While it is cold, the winding carries the peak current.
    assert steps[0].reference_current == pytest.approx(3.0)
    assert temperatures.max() < 100.0 + 0.1
    continuous = math.sqrt(80.0 / (20.0 * 8.4 * (1.0 + 0.00393 * 75.0)))
    assert steps[-1].current == pytest.approx(continuous, rel=1e-3)
    at_limit = steps[-1].saturated, steps[-1].temperature_saturated, steps[-1].current_saturated
    assert at_limit == (1.0, 1.0, 0.0)
    assert temperatures[-1] == pytest.approx(100.0, abs=0.1)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"max_temperature": 20.0, "thermal_resistance_winding": 1.0},
            r"= 20: must be above ambient_temperature = 25",
        ),
        ({"max_temperature": 80.0}, r"max_temperature = 80: needs thermal_resistance_winding or"),
        (
            {"ambient_temperature": -260.0},
            r"= -260: .* no resistance; must be above -229\.453 degC",
        ),
    ],
)
def test_raises_if_temperatures_are_impossible(fields, message):
    with pytest.raises(ValueError, match=message):
        GearMotor(**fields)


def test_the_bridge_loses_its_dead_band():
    """Check the steady state of a resistor of 8.4 ohm."""
    actuator = (
        Drive(GearMotor(), SampledLoop(deadband=0.5), Supply(24.0)).commands()["voltage"].actuator
    )
    for volts, left in ((3.0, 2.5), (-3.0, -2.5), (0.4, 0.0), (-0.4, 0.0)):
        steps, _ = advance_steps(actuator, 0.02, [0.042 * volts] * 5)
        assert steps[-1].current == pytest.approx(left / 8.4, abs=1e-12)
        assert steps[-1].voltage == pytest.approx(left, abs=1e-12)


def parameters_of(**motor):
    return parameters_type(Drive)(*Drive(GearMotor(**motor)).parameter_values)


@pytest.mark.parametrize("speed", [-20.0, -3.0, 3.0, 20.0])
@pytest.mark.parametrize("torque", [-0.03, 0.0, 0.05])
def test_friction_in_motion_is_the_sum_of_its_parts(speed, torque):
    """Check Stribeck friction and gear loss in a time too short to stop the rotor."""
    parameters = parameters_of(stribeck_friction=0.01, stribeck_speed=4.0, gear_efficiency=0.7)
    loss = friction(parameters, 1e-6, torque, Shaft(1e-3, 0.0, speed))
    share = 0.3 if torque * speed > 0.0 else 3.0 / 7.0
    assert loss == pytest.approx(
        math.copysign(0.01 * math.exp(-((speed / 4.0) ** 2)) + share * abs(torque), speed)
    )


@pytest.mark.parametrize("step", [0.0005, 0.002])
@pytest.mark.parametrize("ratio", [1.0, 20.0])
def test_a_rotor_sticks_until_its_friction_is_overcome(step, ratio):
    friction = {
        "coulomb_friction": 0.01 / ratio,
        "stribeck_friction": 0.02 / ratio,
        "stribeck_speed": ratio,
    }
    rough, smooth = (
        Drive(GearMotor(gear_ratio=ratio, **fields), supply=Supply(48.0))
        for fields in (friction, friction | {"stribeck_friction": 0.0})
    )
    model = on_a_shaft(rough, step)
    data = mujoco.MjData(model)
    while abs(data.qvel[0]) <= 0.02:
        data.ctrl[:] = 0.02 * data.time
        mujoco.mj_step(model, data)
    assert data.ctrl.item() == pytest.approx(0.03, rel=0.05)
    for actuator, weight, slides in (
        (rough, 0.025, False),
        (rough, 0.035, True),
        (smooth, 0.025, True),
    ):
        data = simulate(on_a_shaft(actuator, step, weight=weight), 2.0)
        assert (abs(data.qpos[0]) > 1.0) == slides
        # MuJoCo's constraints creep.
        assert slides or abs(data.qvel[0]) < 0.02


@pytest.mark.parametrize(("efficiency", "holds"), [(0.6, True), (1.0, False)])
def test_a_gear_with_losses_holds_a_load_that_its_motor_cannot(efficiency, holds):
    """Check gravity 0.012, motor 0.010: the gear's loss 0.01*(1/0.6 - 1) is larger than 0.002."""
    actuator = Drive(GearMotor(gear_ratio=20.0, gear_efficiency=efficiency), supply=Supply(48.0))
    data = simulate(on_a_shaft(actuator, 0.002, weight=0.012), 1.0, control=0.010)
    assert (abs(data.qpos[0]) < 1e-3) == holds


def test_friction_only_removes_energy():
    """Check that a rotor without a command comes to rest and stays there."""
    actuator = Drive(
        GearMotor(gear_efficiency=0.6, stribeck_friction=0.002, stribeck_speed=5.0),
        supply=Supply(48.0),
    )
    model = on_a_shaft(actuator, 0.002)
    data = mujoco.MjData(model)
    data.qvel[:] = 4.0
    speeds = []
    while data.time < 5.0:
        mujoco.mj_step(model, data)
        speeds.append(data.qvel.item())
    assert (np.diff(speeds) <= 1e-12).all()
    assert abs(speeds[-1]) < 1e-6


# A pendulum: mass [kg], distance of its center [m], inertia about its hinge [kg*m^2].

MASS, LENGTH, ABOUT = (
    0.5,
    0.15,
    0.035,
)


def servo_model(timestep, duration, start, friction_of, motor):
    """Return angles [rad] of a pendulum with the servo friction of Duclusaud et al. (2024)."""
    angle, speed, angles = start, 0.0, []
    for step in range(round(duration / timestep)):
        pull = motor(step * timestep) - MASS * 9.81 * LENGTH * math.sin(angle)
        stops = ABOUT * speed / timestep + pull
        speed += (
            timestep
            / ABOUT
            * (pull - math.copysign(min(abs(stops), friction_of(abs(speed))), stops))
        )
        angle += timestep * speed
        angles.append(angle)
    return np.array(angles)


@pytest.mark.parametrize("ratio", [1.0, 50.0])
@pytest.mark.parametrize(
    ("start", "motor", "far"),
    [(-1.5, lambda _: 0.0, 0.1), (0.0, lambda time: 0.6 * math.sin(4.4 * time), 0.5)],
    ids=["released", "driven"],
)
def test_friction_equals_that_of_a_published_servo_model(ratio, start, motor, far):
    """Compare with values close to a Dynamixel MX-64's; MuJoCo has two of the three."""
    coulomb, stribeck, speed_scale, exponent, viscous = 0.06, 0.05, 1.5, 1.3, 0.015
    expected = servo_model(
        0.001,
        3.0,
        start,
        lambda w: coulomb + stribeck * math.exp(-((w / speed_scale) ** exponent)) + viscous * w,
        motor,
    )
    gear_motor = GearMotor(
        rotor_inertia=0.0,
        gear_ratio=ratio,
        coulomb_friction=coulomb / ratio,
        viscous_friction=viscous / ratio**2,
        stribeck_friction=stribeck / ratio,
        stribeck_speed=speed_scale * ratio,
        stribeck_exponent=exponent,
    )
    errors = {}
    for name, changed in (
        ("with", gear_motor),
        ("without", dataclasses.replace(gear_motor, stribeck_friction=0.0)),
    ):
        load = {"inertia": ABOUT - MASS * LENGTH**2, "mass": MASS, "down": LENGTH}
        model = on_a_shaft(Drive(changed, supply=Supply(1e4)), 0.001, **load)
        data, rows = mujoco.MjData(model), []
        data.qpos[:] = start
        for _ in expected:
            data.ctrl[:] = motor(data.time)
            mujoco.mj_step(model, data)
            rows.append(data.qpos[0])
        errors[name] = np.abs(np.array(rows) - expected).max()
    assert errors["with"] < 0.015 * np.ptp(expected)
    assert errors["without"] > far
