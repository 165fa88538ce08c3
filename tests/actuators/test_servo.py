"""Outer loops of a servo against linear models and statics, in environments and custom models."""

import dataclasses
import math

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy import signal

import codrl_mj
from codrl_mj import Uniform
from codrl_mj.actuators import (
    GearMotor,
    Inputs,
    SampledLoop,
    Servo,
    ServoLoop,
    Supply,
    UnstableError,
    parameters_type,
)
from codrl_mj.engine.reading import check_shafts
from tests.matrix import matrix_params

INERTIA, RATIO = 0.02, 10.0
MOTOR = GearMotor(gear_ratio=RATIO, rotor_inertia=1e-6)
TOTAL = INERTIA + 1e-6 * RATIO**2


def servo(supply=1e4, **loop):
    return Servo(MOTOR, SampledLoop(20e3), Supply(supply), ServoLoop(**loop))


def hinge(timestep=0.001):
    """Return the spec of a hinge with a motor, under an integrator that uses derivatives."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity, body = timestep, [0.0] * 3, spec.worldbody.add_body()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The geom is a ball.
    body.add_geom(size=[0.1] * 3, mass=INERTIA / 0.4 / 0.01)
    body.add_joint(name="shaft", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(name="it", target="shaft", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    return spec


def run(model, targets, load=0.0, start=0.0):
    """Return positions [rad] and speeds [rad/s] under a target per step and a load torque [N*m]."""
    data, rows = mujoco.MjData(model), []
    data.qfrc_applied[:], data.qpos[:] = load, start
    for target in targets:
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
        rows.append((data.qpos[0], data.qvel[0]))
    return np.array(rows).T


def run_servo(actuator, targets, timestep=0.001, load=0.0):
    return run(codrl_mj.add_motors(hinge(timestep), {"shaft": actuator}).compile(), targets, load)


@pytest.mark.parametrize(
    ("timestep", "rate"),
    matrix_params([(0.001, 2000.0)], [(0.0005, 2000.0), (0.001, 2000.0), (0.0005, 500.0)]),
)
def test_a_position_loop_equals_its_linear_model(timestep, rate):
    """Compare with a torque g*(K*(q* - q) - w), held over a sample, on an inertia."""
    actuator = servo(velocity_gain=1.5, position_gain=15.0, servo_rate=rate)
    steps = round(0.5 / timestep)
    positions, speeds = run_servo(actuator, [0.3] * steps, timestep)
    plant = signal.cont2discrete(
        (np.eye(2, k=1), np.array([[0.0], [1.0 / TOTAL]]), np.eye(2), np.zeros((2, 1))), 1 / rate
    )
    state, states = np.zeros(2), []
    for _ in range(round(0.5 * rate)):
        state = plant[0] @ state + plant[1][:, 0] * 1.5 * (15.0 * (0.3 - state[0]) - state[1])
        states.append(state)
    times = np.linspace(0.1, 0.5, 9)
    ours = np.stack([positions, speeds])[:, np.round(times / timestep).astype(int) - 1]
    theirs = np.array(states).T[:, np.round(times * rate).astype(int) - 1]
    np.testing.assert_allclose(ours[0], theirs[0], atol=0.006 * 0.3)
    np.testing.assert_allclose(ours[1], theirs[1], atol=0.006 * 0.3 * 15.0)
    assert positions[-1] == pytest.approx(0.3, abs=1e-3)


@pytest.mark.parametrize("integral", [0.0, 20.0])
@pytest.mark.parametrize(("timestep", "rate"), [(0.05, 1000.0), (0.01, 2000.0), (0.004, 250.0)])
def test_a_servo_samples_at_its_own_rate_within_a_long_step(timestep, rate, integral):
    """Compare one or a few long steps with the recursion of a PI velocity loop on an inertia."""
    actuator = servo(
        controls="velocity", velocity_gain=1.5, velocity_integral_gain=integral, servo_rate=rate
    )
    actuator = dataclasses.replace(actuator, controller=SampledLoop(100e3))
    _, speeds = run_servo(actuator, [2.0] * 4, timestep)
    speed, torque, expected = 0.0, 0.0, []
    for _ in range(round(4 * timestep * rate)):
        error = 2.0 - speed
        speed, torque = (
            speed + (1.5 * error + torque) / TOTAL / rate,
            torque + 1.5 * integral * error / rate,
        )
        expected.append(speed)
    np.testing.assert_allclose(
        speeds, expected[round(timestep * rate) - 1 :: round(timestep * rate)], rtol=0.01
    )


@pytest.mark.parametrize("saved", [False, True])
def test_a_servo_of_the_model_is_replaced(saved):
    """Replace `<position kp="3" kv="30">` under an implicit integrator; check the XML."""
    ways = []
    for has_servo in (True, False):
        spec = hinge(0.002)
        if has_servo:
            spec.actuator("it").set_to_position(kp=3.0, kv=30.0)
        motors_added = codrl_mj.add_motors(
            spec, {"shaft": servo(velocity_gain=1.5, servo_rate=500.0)}
        )
        model = motors_added.compile()
        ways.append(
            run(
                mujoco.MjModel.from_xml_string(motors_added.to_xml()) if saved else model,
                [0.3] * 250,
            )[0]
        )
    np.testing.assert_array_equal(*ways)
    assert ways[0][-1] == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize(("integral", "left"), [(0.0, 0.2 / 1.5), (20.0, 0.0)])
def test_the_integral_removes_the_error_under_a_load(integral, left):
    actuator = servo(controls="velocity", velocity_gain=1.5, velocity_integral_gain=integral)
    _, speeds = run_servo(actuator, [2.0] * 2000, load=-0.2)
    assert speeds[-1] == pytest.approx(2.0 - left, abs=1e-3)


def test_the_integral_does_not_wind_up():
    """Command a speed that the shaft cannot reach for two seconds, then a possible one."""
    actuator = servo(
        supply=4.0,
        controls="velocity",
        velocity_gain=1.5,
        velocity_integral_gain=20.0,
        max_torque=0.3,
    )
    targets = np.where(np.arange(3000) < 2000, 100.0, 3.0)
    _, speeds = run_servo(actuator, targets)
    # The limit is a share of the no-load speed, reached in 2 s.
    reached = -math.expm1(-2.0 * 0.042**2 / (8.4 * TOTAL / RATIO**2))
    assert speeds[1999] == pytest.approx(reached * 4.0 / (0.042 * RATIO), rel=1e-3)
    assert (np.abs(speeds[2450:] - 3.0) < 0.05).all()


def test_speed_and_torque_stay_within_their_limits():
    actuator = servo(velocity_gain=1.5, max_velocity=2.0, max_torque=0.4)
    _, speeds = run_servo(actuator, [3.0] * 1400)
    assert speeds[50] == pytest.approx(0.4 / TOTAL * 0.051, rel=0.02)
    assert speeds[700] == pytest.approx(2.0, rel=1e-3)
    assert speeds.max() < 2.01


def test_feed_forward_removes_the_lag():
    targets = 0.5 * np.arange(1, 2001) * 0.001
    lags = [
        targets[-1]
        - run_servo(servo(velocity_gain=1.5, velocity_feed_forward=share), targets)[0][-1]
        for share in (0.0, 1.0)
    ]
    assert lags[0] == pytest.approx(0.5 / 20.0, rel=0.05)
    assert abs(lags[1]) < 0.05 * lags[0]
    ramp = 2.0 * np.arange(1, 2001) * 0.001
    for inertia, left in ((0.0, 2.0 * TOTAL / 1.5), (TOTAL, 0.0)):
        actuator = servo(controls="velocity", velocity_gain=1.5, inertia_feed_forward=inertia)
        _, speeds = run_servo(actuator, ramp)
        assert ramp[-1] - speeds[-1] == pytest.approx(left, abs=0.003)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"velocity_gain": 80.0},
            r"outer loops are unstable: spectral radius .* The inertia at the joint is 0\.0201 kg\*m\^2",
        ),
        ({"position_gain": 9000.0}, r"position_gain \(now 9000\) well below 2\*pi\*f"),
        (
            {"servo_rate": 700.0},
            r"servo_rate = 700: must be a multiple or a divisor of the mechanical step's rate, 1000 Hz",
        ),
        ({"controls": "force"}, r"controls = 'force': must be one of position, velocity"),
        (
            {"inertia_feed_forward": 0.1},
            r"inertia_feed_forward = 0\.1: must be 0 if controls = 'position'",
        ),
    ],
)
def test_raises_if_a_servo_cannot_work(change, message):
    with pytest.raises(ValueError, match=message):
        run_servo(servo(**{"velocity_gain": 1.5, **change}), [])


@pytest.mark.filterwarnings("ignore:motor.rotor_inertia = 0")
@pytest.mark.parametrize("controls", ["position", "velocity"])
@pytest.mark.parametrize(
    ("mass", "message"),
    [
        # The inertia of the sphere is 2/5*m*r^2.
        (
            1e-3,
            r"^m: the outer loops are unstable: .* must be < 1\. motor\.rotor_inertia = 0: the loops"
            r" move only the load, 4e-08 kg\*m\^2 at the joint; must be > 0 if the load is light: set"
            r" it to the rotor's, from the motor's datasheet",
        ),
        (
            1e-5,
            r"^m: motor\.rotor_inertia = 0: .* must be < 2; the motor moves only the load, 4e-10"
            r" kg\*m\^2 at its shaft: set motor\.rotor_inertia > 0, from the motor's datasheet",
        ),
    ],
)
def test_raises_and_names_a_rotor_without_inertia_as_the_cause(controls, mass, message):
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><worldbody><body><joint name="j" axis="0 0 1"/>
        <geom size=".01" mass="{mass}"/></body></worldbody>
        <actuator><motor name="m" joint="j"/></actuator></mujoco>"""
    )
    loop = ServoLoop(controls=controls, velocity_gain=1e-3)
    with pytest.raises(UnstableError, match=message):
        codrl_mj.add_motors(spec, {"m": Servo(GearMotor(rotor_inertia=0.0), loop=loop)})
    # The default motor's rotor of 4e-6 kg*m^2 is enough for these gains.
    codrl_mj.add_motors(spec, {"m": Servo(GearMotor(), loop=loop)})


def growth(model, steps=1500):
    """Return the growth of a disturbance at rest without gravity, as a ratio of largest speeds."""
    data, speeds = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = 1e-6 * np.arange(1, model.nq + 1), 1e-6
    while len(speeds) < steps and np.abs(data.qvel).max() < 1e-3:
        mujoco.mj_step(model, data)
        speeds.append(np.abs(data.qvel).max())
    return (
        math.inf
        if len(speeds) < steps
        else max(speeds[-steps // 10 :]) / max(speeds[: steps // 10])
    )


@pytest.mark.parametrize(
    ("rate", "gains", "integrator", "links", "damping"),
    [
        (1000.0, ("position", 20.0, 0.0), "EULER", 1, 0.0),
        (500.0, ("position", 60.0, 5.0), "IMPLICITFAST", 1, 0.0),
        (2000.0, ("position", 40.0, 30.0), "RK4", 1, 15.0),
        (250.0, ("velocity", 20.0, 5.0), "EULER", 2, 0.0),
        (1000.0, ("position", 20.0, 0.0), "RK4", 3, 0.0),
    ],
)
def test_the_stability_check_finds_the_actual_bound(rate, gains, integrator, links, damping):
    """Check that a disturbance decays 3 % below the rejected gain and grows 3 % above it."""
    controls, position, integral = gains
    spec, parent = mujoco.MjSpec(), None
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
    spec.option.timestep, spec.option.gravity = 0.001, [0.0] * 3
    for link in range(links):
        parent = (parent or spec.worldbody).add_body(pos=[0.3 * (link > 0), 0.0, 0.0])
        parent.add_geom(size=[0.1] * 3, pos=[0.15, 0.0, 0.0], mass=0.5)
        parent.add_joint(name=f"j{link}", axis=[0.0, 0.0, 1.0], damping=[damping, 0.0, 0.0])
        spec.add_actuator(
            name=f"a{link}", target=f"j{link}", trntype=mujoco.mjtTrn.mjTRN_JOINT
        ).set_to_motor()

    def motors_added(gain, allow_unstable):
        actuator = servo(
            1e9,
            controls=controls,
            position_gain=position,
            velocity_gain=gain,
            velocity_integral_gain=integral,
            servo_rate=rate,
        )
        return codrl_mj.add_motors(
            spec, {f"a{link}": actuator for link in range(links)}, allow_unstable
        )

    low, high = 0.2, 2000.0
    while high / low > 1.01:
        middle = math.sqrt(low * high)
        stable = (
            check_shafts(motors_added(middle, True).compile(), allow_unstable=True) < 1.0 + 1e-6
        )
        low, high = (middle, high) if stable else (low, middle)
    assert (
        growth(motors_added(low / 1.03, False).compile())
        < 1.0
        < growth(motors_added(high * 1.03, True).compile())
    )
    with pytest.raises(UnstableError, match=r"spectral radius 1\."):
        motors_added(high * 1.03, False)


ASKED = Servo(
    GearMotor(gear_ratio=20.0), SampledLoop(20e3), Supply(48.0), ServoLoop(velocity_gain=3.0)
)


def test_an_agent_commands_positions_of_a_servo():
    env = gymnasium.make(
        "codrl_mj/Pendulum-v0", actuator=ASKED, action="position", max_episode_steps=500
    )
    assert env.action_space.high == pytest.approx(math.pi)
    env.reset(seed=0)
    for _ in range(100):
        _, _, _, _, info = env.step(np.array([1.0], np.float32))
    # The position has the units of the joint. Without an integral, gravity causes an error.
    assert info["error"] == pytest.approx(1.0 - env.unwrapped.data.qpos[0], abs=1e-6)
    assert abs(info["error"]) < 0.1
    assert info["desired_force"] == info["actual_force"]


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        ("Pendulum-v0", {}, "a Servo does not take forces; must be one of position"),
        (
            "Acrobot-v0",
            {"levels": (-1.0, 0.0, 1.0)},
            r"acrobot wraps theta1 .*theta2 .*, and a position that jumps",
        ),
    ],
)
def test_raises_if_a_servo_cannot_follow_the_action(env_id, options, message):
    action = {"action": "position", **options} if options else {}
    with pytest.raises(ValueError, match=message):
        gymnasium.make(f"codrl_mj/{env_id}", actuator=ASKED, **action)


def test_servos_in_a_batch_equal_single_ones():
    draws = {"motor.resistance": Uniform(4.0, 12.0), "loop.velocity_gain": Uniform(1.0, 5.0)}
    actuator = dataclasses.replace(ASKED, loop=ServoLoop("velocity", velocity_gain=3.0))
    arguments = {"actuator": actuator, "action": "velocity", "randomize": draws}
    both = [
        gymnasium.make_vec("codrl_mj/Pendulum-v0", 3, kind, **arguments)
        for kind in ("vector_entry_point", "sync")
    ]
    np.testing.assert_array_equal(*(envs.reset(seed=3)[0] for envs in both))
    for action in np.random.default_rng(0).uniform(-10, 10, size=(40, 3, 1)).astype(np.float32):
        ours, separate = (envs.step(action) for envs in both)
        np.testing.assert_array_equal(ours[0], separate[0])
        np.testing.assert_array_equal(ours[4]["error"], separate[4]["error"])


@pytest.mark.parametrize(
    ("limits", "met"),
    [
        ({}, ""),
        ({"max_torque": 0.05}, "current"),
        ({"max_current": 0.1}, "current"),
        ({"volts": 2.0}, "voltage"),
    ],
)
def test_signals_report_the_limit_reached_and_the_power(limits, met):
    """Check at a held speed that the power is heat, work and change of field energy."""
    kinds = {name: limits[name] for name in limits if name == "max_torque"}
    current = {name: limits[name] for name in limits if name == "max_current"}
    loop = ServoLoop("velocity", servo_rate=1000.0, velocity_gain=0.05, **kinds)
    actuator = Servo(MOTOR, SampledLoop(20e3, **current), Supply(limits.get("volts", 1e4)), loop)
    parameters, state, speed = (
        parameters_type(Servo)(*actuator.parameter_values),
        actuator.State(*[0.0] * 13),
        20.0,
    )
    motor, before = actuator.motor, 0.0
    for target in (80.0, -60.0):
        state, _, signals = actuator.advance(
            parameters, 0.002, state, Inputs(target, 0.0, speed, 0.0, 0.0, math.inf)
        )
        limits_reached = {
            name: getattr(signals, f"{name}_saturated")
            for name in ("voltage", "current", "temperature")
        }
        assert limits_reached == {name: float(name == met) for name in limits_reached}
        assert signals.saturated == float(met != "")
        field = 0.5 * motor.inductance * (state.current**2 - before**2) / 0.002
        moved = motor.back_emf_constant * speed * signals.current
        assert signals.electrical_power == pytest.approx(
            signals.copper_loss + moved + field, rel=1e-12
        )
        before = state.current
