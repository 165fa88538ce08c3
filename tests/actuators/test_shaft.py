"""What a bench adds to a drive: heat, friction that depends on speed and load, a dead band. Oracles are not ours."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, Inputs, SampledLoop, Supply, parameters_type
from codrl_mj.actuators.shaft import Shaft, friction

HOT = GearMotor(
    thermal_resistance_winding=20.0, thermal_time_constant_winding=3.0, ambient_temperature=20.0
)


def advanced(one, timestep, torques, speed=0.0, inertia=math.inf):
    """Signals of steps, and the last state."""
    parameters, state = (
        parameters_type(type(one))(*one.parameter_values),
        one.State(*[0.0] * len(one.State._fields)),
    )
    found = []
    for torque in torques:
        state, _, signals = one.advance(
            parameters, timestep, state, Inputs(torque, 0.0, speed, 0.0, 0.0, inertia=inertia)
        )
        found.append(signals)
    return found, state


def hinge(timestep, inertia=1e-3, weight=0.0, mass=1.0, down=0.0):
    """The spec of a hinge with so much inertia [kg*m^2], and gravity's torque [N*m] in its initial position."""
    spec = mujoco.MjSpec()
    spec.option.timestep, body = timestep, spec.worldbody.add_body()
    body.explicitinertial, body.mass, body.inertia = True, mass, [inertia] * 3
    body.ipos = [weight / 9.81, 0.0, -down]
    body.add_joint(name="shaft", axis=[0.0, -1.0, 0.0])
    spec.add_actuator(name="it", target="shaft", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    return spec


def on_a_shaft(one, timestep, **load):
    """A compiled model of such a hinge behind an actuator."""
    return codrl_mj.add_motors(hinge(timestep, **load), {"shaft": one}).compile()


def after(model, seconds, control=0.0):
    """The simulation of a model under a control for a while."""
    data = mujoco.MjData(model)
    data.ctrl[:] = control
    while data.time < seconds:
        mujoco.mj_step(model, data)
    return data


def test_a_winding_warms_and_its_resistance_with_it():
    """A current that is held heats by its square and a resistance that grows: scipy integrates that."""
    one, amperes = Drive(HOT, supply=Supply(48.0)), 1.0
    found, _ = advanced(one, 0.002, [0.042 * amperes] * 5000)
    hot = HOT.resistance

    def warming(_, rise):
        resistance = hot * (1.0 + 0.00393 * (20.0 + rise - 25.0))
        return (amperes**2 * resistance * 20.0 - rise) / 3.0

    times = 0.002 * np.arange(1, 5001)
    exact = solve_ivp(warming, (0.0, 10.0), [0.0], t_eval=times, rtol=1e-10, atol=1e-10).y[0]
    np.testing.assert_allclose([one.temperature for one in found], 20.0 + exact, atol=0.15)
    volts = hot * (1.0 + 0.00393 * (exact - 5.0)) * amperes
    np.testing.assert_allclose([one.voltage for one in found[100:]], volts[100:], rtol=2e-3)


def test_winding_and_housing_warm_one_after_the_other():
    """Of a resistance that does not grow: the sum of two first-order responses."""
    motor = dataclasses.replace(
        HOT,
        thermal_resistance_housing=30.0,
        thermal_time_constant_housing=40.0,
        resistance_coefficient=0.0,
    )
    found, _ = advanced(Drive(motor, supply=Supply(48.0)), 0.02, [0.042 * 0.5] * 3000)
    times, watts = 0.02 * np.arange(1, 3001), 0.25 * 8.4
    expected = 20.0 + watts * (20.0 * -np.expm1(-times / 3.0) + 30.0 * -np.expm1(-times / 40.0))
    np.testing.assert_allclose([one.temperature for one in found], expected, atol=0.02)


def test_current_and_temperature_are_those_of_mujoco_s_own_motor():
    """A blocked shaft under voltages; `<dcmotor>` heats by the current at a step's end, which differs by the step."""
    ends = {}
    for timestep in (0.002, 0.001):
        one = Drive(HOT, SampledLoop(10e3), Supply(48.0)).commands()["voltage"].actuator
        ours = on_a_shaft(one, timestep, inertia=1e9)
        spec = hinge(timestep, inertia=1e9)
        spec.actuator("it").set_to_dcmotor(
            motorconst=[HOT.torque_constant] * 2,
            resistance=HOT.resistance,
            inductance=[HOT.inductance, 0.0],
            thermal=[20.0, 3.0 / 20.0, 0.0, 0.00393, 25.0, 20.0],
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
        )
        theirs = spec.compile()
        data, other, unequal = mujoco.MjData(ours), mujoco.MjData(theirs), []
        readout = codrl_mj.engine.Readout(ours)
        for step in range(round(4.0 / timestep)):
            volts = 12.0 if int(step * timestep / 0.5) % 2 == 0 else -4.0
            data.ctrl[:], other.ctrl[:] = HOT.torque_constant * volts, volts
            mujoco.mj_step(ours, data)
            mujoco.mj_step(theirs, other)
            if step % 20 == 19:
                read = readout(data)
                unequal.append(abs(read["temperature"].item() - 20.0 - other.act[0]))
        assert other.act[0] > 10.0
        assert read["current"].item() == pytest.approx(other.act[1], rel=1e-3)
        ends[timestep] = max(unequal)
    assert ends[0.001] < 0.02 * other.act[0]
    assert 1.5 < ends[0.002] / ends[0.001] < 2.5


@pytest.mark.parametrize("step", [0.002, 0.02])
def test_a_drive_keeps_the_winding_s_limit_and_then_gives_the_continuous_current(step):
    motor = dataclasses.replace(HOT, max_temperature=100.0)
    found, _ = advanced(Drive(motor, supply=Supply(48.0)), step, [0.042 * 3.0] * round(20.0 / step))
    temperatures = np.array([one.temperature for one in found])
    assert found[0].reference_current == pytest.approx(3.0)  # cold, it bears the peak
    assert temperatures.max() < 100.0 + 0.1
    continuous = math.sqrt(80.0 / (20.0 * 8.4 * (1.0 + 0.00393 * 75.0)))
    assert found[-1].current == pytest.approx(continuous, rel=1e-3)
    at_limit = found[-1].saturated, found[-1].temperature_saturated, found[-1].current_saturated
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
def test_temperatures_that_cannot_be_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        GearMotor(**fields)


def test_a_bridge_loses_its_dead_band():
    """A resistor of 8.4 ohm in the steady state, under voltages."""
    one = Drive(GearMotor(), SampledLoop(deadband=0.5), Supply(24.0)).commands()["voltage"].actuator
    for volts, left in ((3.0, 2.5), (-3.0, -2.5), (0.4, 0.0), (-0.4, 0.0)):
        found, _ = advanced(one, 0.02, [0.042 * volts] * 5)
        assert found[-1].current == pytest.approx(left / 8.4, abs=1e-12)
        assert found[-1].voltage == pytest.approx(left, abs=1e-12)


def parameters_of(**motor):
    return parameters_type(Drive)(*Drive(GearMotor(**motor)).parameter_values)


@pytest.mark.parametrize("speed", [-20.0, -3.0, 3.0, 20.0])
@pytest.mark.parametrize("torque", [-0.03, 0.0, 0.05])
def test_friction_in_motion_is_the_sum_of_its_laws(speed, torque):
    """Stribeck's, and the gear's on what the motor makes; nothing is stopped within so short a time."""
    parameters = parameters_of(stribeck_friction=0.01, stribeck_speed=4.0, gear_efficiency=0.7)
    taken = friction(parameters, 1e-6, torque, Shaft(1e-3, 0.0, speed))
    share = 0.3 if torque * speed > 0.0 else 3.0 / 7.0
    assert taken == pytest.approx(
        math.copysign(0.01 * math.exp(-((speed / 4.0) ** 2)) + share * abs(torque), speed)
    )


@pytest.mark.parametrize("step", [0.0005, 0.002])
@pytest.mark.parametrize("ratio", [1.0, 20.0])
def test_a_rotor_sticks_until_coulomb_and_stribeck_friction_are_overcome(step, ratio):
    friction = {
        "coulomb_friction": 0.01 / ratio,
        "stribeck_friction": 0.02 / ratio,
        "stribeck_speed": ratio,
    }
    one, alone = (
        Drive(GearMotor(gear_ratio=ratio, **fields), supply=Supply(48.0))
        for fields in (friction, friction | {"stribeck_friction": 0.0})
    )
    model = on_a_shaft(one, step)
    data = mujoco.MjData(model)
    while abs(data.qvel[0]) <= 0.02:
        data.ctrl[:] = 0.02 * data.time
        mujoco.mj_step(model, data)
    assert data.ctrl.item() == pytest.approx(0.03, rel=0.05)
    for each, weight, slides in ((one, 0.025, False), (one, 0.035, True), (alone, 0.025, True)):
        data = after(on_a_shaft(each, step, weight=weight), 2.0)
        assert (abs(data.qpos[0]) > 1.0) == slides
        assert slides or abs(data.qvel[0]) < 0.02  # MuJoCo's constraints creep


@pytest.mark.parametrize(("efficiency", "holds"), [(0.6, True), (1.0, False)])
def test_a_gear_that_loses_holds_what_its_motor_does_not(efficiency, holds):
    """Gravity 0.012, motor 0.010: the difference is less than the gear's loss, 0.01*(1/0.6 - 1)."""
    one = Drive(GearMotor(gear_ratio=20.0, gear_efficiency=efficiency), supply=Supply(48.0))
    data = after(on_a_shaft(one, 0.002, weight=0.012), 1.0, control=0.010)
    assert (abs(data.qpos[0]) < 1e-3) == holds


def test_friction_only_takes_energy():
    """A rotor in motion without a command comes to rest, and stays there."""
    one = Drive(
        GearMotor(gear_efficiency=0.6, stribeck_friction=0.002, stribeck_speed=5.0),
        supply=Supply(48.0),
    )
    model = on_a_shaft(one, 0.002)
    data = mujoco.MjData(model)
    data.qvel[:] = 4.0
    speeds = []
    while data.time < 5.0:
        mujoco.mj_step(model, data)
        speeds.append(data.qvel.item())
    assert (np.diff(speeds) <= 1e-12).all()
    assert abs(speeds[-1]) < 1e-6


MASS, LENGTH, ABOUT = (
    0.5,
    0.15,
    0.035,
)  # a pendulum: [kg], [m] to its centre, [kg*m^2] about its hinge


def servo_model(timestep, duration, start, friction_of, motor):
    """A pendulum's angles [rad] as Duclusaud et al. (2024) simulate servos: what stops it, within what friction can."""
    angle, speed, found = start, 0.0, []
    for step in range(round(duration / timestep)):
        pull = motor(step * timestep) - MASS * 9.81 * LENGTH * math.sin(angle)
        stops = ABOUT * speed / timestep + pull
        speed += (
            timestep
            / ABOUT
            * (pull - math.copysign(min(abs(stops), friction_of(abs(speed))), stops))
        )
        angle += timestep * speed
        found.append(angle)
    return np.array(found)


@pytest.mark.parametrize("ratio", [1.0, 50.0])
@pytest.mark.parametrize(
    ("start", "motor", "far"),
    [(-1.5, lambda _: 0.0, 0.1), (0.0, lambda time: 0.6 * math.sin(4.4 * time), 0.5)],
    ids=["released", "driven"],
)
def test_coulomb_viscous_and_stribeck_friction_are_those_of_a_servo_model(ratio, start, motor, far):
    """Numbers near those that were fitted to a Dynamixel MX-64; MuJoCo has the first two."""
    coulomb, stribeck, at, exponent, viscous = 0.06, 0.05, 1.5, 1.3, 0.015
    expected = servo_model(
        0.001,
        3.0,
        start,
        lambda w: coulomb + stribeck * math.exp(-((w / at) ** exponent)) + viscous * w,
        motor,
    )
    one = GearMotor(
        rotor_inertia=0.0,
        gear_ratio=ratio,
        coulomb_friction=coulomb / ratio,
        viscous_friction=viscous / ratio**2,
        stribeck_friction=stribeck / ratio,
        stribeck_speed=at * ratio,
        stribeck_exponent=exponent,
    )
    found = {}
    for name, changed in (
        ("with", one),
        ("without", dataclasses.replace(one, stribeck_friction=0.0)),
    ):
        load = {"inertia": ABOUT - MASS * LENGTH**2, "mass": MASS, "down": LENGTH}
        model = on_a_shaft(Drive(changed, supply=Supply(1e4)), 0.001, **load)
        data, rows = mujoco.MjData(model), []
        data.qpos[:] = start
        for _ in expected:
            data.ctrl[:] = motor(data.time)
            mujoco.mj_step(model, data)
            rows.append(data.qpos[0])
        found[name] = np.abs(np.array(rows) - expected).max()
    assert found["with"] < 0.015 * np.ptp(expected)
    assert found["without"] > far
