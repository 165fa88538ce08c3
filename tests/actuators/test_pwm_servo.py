"""Servos without a current loop against an integrator, closed forms and BAM's control law."""

import dataclasses
import math
import re

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import codrl_mj
from codrl_mj import Uniform
from codrl_mj.actuators import (
    Drive,
    GearMotor,
    Inputs,
    PwmLoop,
    PwmServo,
    Supply,
    UnstableError,
    display_label,
    override_actuator,
    parameters_type,
    resolve,
)
from codrl_mj.actuators.firmware import FIRMWARES

MOTOR = GearMotor(
    resistance=2.96,
    inductance=1.776e-3,
    torque_constant=3.7e-3,
    back_emf_constant=3.7e-3,
    rotor_inertia=2.4e-7,
    gear_ratio=345.0,
)
RATIO, VOLTAGE = 345.0, 7.4


def servo(resistance=0.0, motor=MOTOR, **loop):
    return PwmServo(motor, PwmLoop(**loop), Supply(VOLTAGE, resistance))


class Bench:
    """A servo whose shaft is at given positions and speeds, both at the output."""

    def __init__(self, actuator, timestep=0.002, inertia=math.inf, noise_key=7.0):  # noqa: D107
        self.family, self.timestep, self.inertia = type(actuator), timestep, inertia
        self.parameters = parameters_type(PwmServo)(*actuator.parameter_values)
        self.state = PwmServo.State(*[0.0] * len(PwmServo.State._fields))
        self.steps, self.noise_key = 0, noise_key

    def step(self, command, position=0.0, speed=0.0):
        """Return the torque at the rotor and the signals."""
        inputs = Inputs(
            command * RATIO,
            position * RATIO,
            speed * RATIO,
            self.steps * self.timestep,
            self.noise_key,
            self.inertia,
        )
        self.state, torque, signals = PwmServo.advance(
            self.parameters, self.timestep, self.state, inputs
        )
        self.steps += 1
        return torque, signals


@pytest.mark.parametrize("resistance", [0.0, 0.4])
@pytest.mark.parametrize("speed", [0.0, 3.0, -4.0])
def test_the_winding_equals_a_stiff_integration(resistance, speed):
    """Compare current, mean current, voltage, power and heat with Radau at a held speed."""
    actuator = servo(resistance, position_gain=2.0, servo_rate=1000.0)
    bench, current, rotor = Bench(actuator), 0.0, speed * RATIO
    for command, position in ((0.3, 0.0), (0.1, 0.2), (-0.8, 0.1)):
        _, signals = bench.step(command, position, speed)
        means = np.zeros(4)
        for sample in range(2):
            duty = 2.0 * (command - position - speed * sample * 1e-3)
            duty = min(max(duty, -1.0), 1.0)

            def rates(time, values, duty=duty):
                i = values[0]
                volts = duty * (VOLTAGE - resistance * duty * i)
                slope = (volts - MOTOR.resistance * i - MOTOR.back_emf_constant * rotor) / (
                    MOTOR.inductance
                )
                return [slope, i, volts, volts * i, MOTOR.resistance * i * i]

            start = np.array([current, *means * 2e-3])
            solution = solve_ivp(rates, (0.0, 1e-3), start, "Radau", rtol=1e-12, atol=1e-15)
            current, *totals = solution.y[:, -1]
            means = np.array(totals) / 2e-3
        ours = [signals.current, signals.voltage, signals.electrical_power, signals.copper_loss]
        np.testing.assert_allclose(ours, means, rtol=1e-9, atol=1e-12)
        assert bench.state.current == pytest.approx(current, rel=1e-9)


def test_drawn_power_is_heat_work_and_field_energy():
    bench, before = Bench(servo(0.3, position_gain=1.0)), 0.0
    for speed in (0.5, -2.0, 4.0):
        _, signals = bench.step(0.4, 0.1, speed)
        field = 0.5 * MOTOR.inductance * (bench.state.current**2 - before**2) / 0.002
        work = MOTOR.back_emf_constant * speed * RATIO * signals.current
        total = signals.copper_loss + work + field
        assert signals.electrical_power == pytest.approx(total, rel=1e-9)
        before = bench.state.current


@pytest.mark.parametrize(("resistance", "error"), [(0.0, 0.1), (0.5, 0.1), (0.5, 3.0)])
def test_the_torque_at_a_stall_is_the_closed_form(resistance, error):
    """Check kT*n*d*V/(R + d^2*r), with the duty cycle d for the error, at most `max_duty`."""
    actuator = servo(resistance, position_gain=4.0, max_duty=0.9)
    bench = Bench(actuator)
    for _ in range(20):
        torque, signals = bench.step(error)
    duty = min(4.0 * error, 0.9)
    current = duty * VOLTAGE / (MOTOR.resistance + duty**2 * resistance)
    assert signals.duty == pytest.approx(duty, rel=1e-12)
    assert torque == pytest.approx(MOTOR.torque_constant * current, rel=1e-12)
    assert signals.voltage_saturated == float(error > 0.9 / 4.0)
    if resistance == 0.0:
        assert torque * RATIO == pytest.approx(actuator.stiffness * error, rel=1e-12)


def hinge(timestep=0.002, inertia=1e-3):
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity, body = timestep, [0.0] * 3, spec.worldbody.add_body()
    body.add_geom(size=[0.1] * 3, mass=inertia / 0.4 / 0.01)
    body.add_joint(name="shaft", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(name="it", target="shaft", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    return spec


def run(actuator, command, steps, timestep=0.002, load=0.0, inertia=1e-3):
    """Return positions [rad] and speeds [rad/s] of a free hinge under a constant command."""
    model = codrl_mj.add_motors(hinge(timestep, inertia), {"it": actuator}).compile()
    data, rows = mujoco.MjData(model), []
    data.ctrl[0], data.qfrc_applied[0] = command, load
    for _ in range(steps):
        mujoco.mj_step(model, data)
        rows.append((data.qpos[0], data.qvel[0]))
    return np.array(rows).T


def test_the_free_speed_is_the_share_of_the_supply_over_the_back_emf():
    _, speeds = run(servo(position_gain=5.0, max_duty=0.8), 1e3, 500)
    free = 0.8 * VOLTAGE / MOTOR.back_emf_constant / RATIO
    assert speeds[-1] == pytest.approx(free, rel=1e-6)


def test_a_steady_load_sags_by_load_over_stiffness():
    actuator = servo(position_gain=4.0)
    positions, _ = run(actuator, 0.5, 1000, load=-0.8)
    assert 0.5 - positions[-1] == pytest.approx(0.8 / actuator.stiffness, rel=1e-4)


def test_a_step_equals_the_coupled_equations():
    """Compare with winding and rotor integrated together between the servo's samples."""
    gain, rate, inertia = 5.0, 1000.0, 2e-3
    actuator = servo(position_gain=gain, servo_rate=rate)
    ours, speeds = run(actuator, 0.4, 1600, timestep=2.5e-4, inertia=inertia)[:, 3::4]
    total = inertia / RATIO**2 + MOTOR.rotor_inertia
    values, theirs = np.zeros(3), []
    for _ in range(400):
        duty = min(max(gain * (0.4 - values[0]), -1.0), 1.0)

        def rates(time, state, duty=duty):
            _, speed, i = state
            volts = duty * VOLTAGE - MOTOR.back_emf_constant * speed * RATIO
            slope = (volts - MOTOR.resistance * i) / MOTOR.inductance
            return [speed, MOTOR.torque_constant * i / total / RATIO, slope]

        values = solve_ivp(rates, (0.0, 1.0 / rate), values, "Radau", rtol=1e-9, atol=1e-12).y[
            :, -1
        ]
        theirs.append(values)
    theirs = np.array(theirs).T[:2]
    # MuJoCo's positions are half a step of 0.25 ms ahead of their speeds.
    np.testing.assert_allclose(ours, theirs[0], atol=0.0015)
    np.testing.assert_allclose(speeds, theirs[1], atol=0.01 * np.abs(theirs[1]).max())


@pytest.mark.parametrize("acceleration", [math.inf, 20.0])
def test_the_target_moves_at_its_largest_speed_and_acceleration(acceleration):
    """Compare the way of the target with a ramp, or a trapezoid of the same limits."""
    limit = 2.0
    bench = Bench(servo(max_velocity=limit, max_acceleration=acceleration))
    bench.step(0.1, 0.1)
    path = np.array([0.1, *(bench.step(1.1, 0.1)[1].target for _ in range(500))])
    speed = np.diff(path) / 0.002
    assert path[-1] == path.max() == 1.1
    assert speed.max() == pytest.approx(limit, rel=1e-9)
    # Each sample of 1 ms has one speed, so that a ramp takes half a sample more.
    lasts = 1.0 / limit + (0.0 if math.isinf(acceleration) else limit / acceleration)
    assert np.count_nonzero(path < 1.1) * 0.002 == pytest.approx(lasts, abs=0.004)
    if math.isfinite(acceleration):
        assert np.abs(np.diff(speed)).max() / 0.002 <= acceleration * (1.0 + 1e-9)


def test_duty_cycles_equal_the_law_of_bam():
    """Compare with the law in BAM's class of the STS3215, written down in numpy."""
    step, rng = 0.005, np.random.default_rng(0)
    loop = {"servo_rate": 1.0 / step, "max_duty": 0.97, "max_velocity": 3400 * 2 * np.pi / 4096}
    actuator = servo(firmware="feetech-sts", position_p=32.0, **loop)
    bench, smooth, ours, theirs = Bench(actuator, step), 0.0, [], []
    bench.step(0.0)
    for _ in range(400):
        command, position = rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2)
        change = loop["max_velocity"] * step
        smooth = np.clip(command, smooth - change, smooth + change)
        theirs.append(np.clip((smooth - position) * 32 * 0.166, -0.97, 0.97))
        ours.append(bench.step(command, position)[1].duty)
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-12)
    assert 0.05 < np.mean(np.abs(theirs) == 0.97) < 0.95


def test_integral_and_derivative_are_those_of_a_pid():
    gains, samples, rng = (3.0, 20.0, 0.05), 200, np.random.default_rng(1)
    loop = dict(zip(("position_gain", "integral_gain", "derivative_gain"), gains, strict=True))
    bench, total, before = Bench(servo(servo_rate=500.0, **loop)), 0.0, None
    for position in rng.uniform(-0.02, 0.02, samples):
        duty = bench.step(0.0, position)[1].duty
        error = -position
        total += error * 0.002
        rate = 0.0 if before is None else (error - before) / 0.002
        assert duty == pytest.approx(np.dot(gains, [error, total, rate]), abs=1e-12)
        before = error


def test_the_integral_stops_at_the_limit():
    bench = Bench(servo(position_gain=1.0, integral_gain=50.0, max_duty=0.5, servo_rate=500.0))
    for _ in range(200):
        bench.step(0.4)
    assert bench.state.integral <= 0.5
    assert bench.step(-0.1)[1].duty < 0.5


def test_deadband_start_and_counts_shape_the_duty_cycle():
    count = 2.0 * math.pi / 4096.0
    loop = {"position_gain": 5.0, "servo_rate": 500.0}
    assert Bench(servo(deadband=count, **loop)).step(0.0, 0.9 * count)[1].duty == 0.0
    assert Bench(servo(deadband=count, **loop)).step(0.0, 1.1 * count)[1].duty == pytest.approx(
        -5.5 * count
    )
    started = Bench(servo(start_duty=0.016, **loop))
    assert [started.step(0.0, position)[1].duty for position in (0.0, 1e-4, 0.1)] == [
        0.0,
        -0.016,
        -0.5,
    ]
    counted = Bench(servo(encoder_counts=4096.0, **loop))
    positions = [0.49 * count, 0.51 * count, 7.4 * count]
    assert [counted.step(0.0, position)[1].duty for position in positions] == pytest.approx(
        [0.0, -5.0 * count, -35.0 * count]
    )


def arrivals(actuator, commands, noise_key=7.0):
    """Return the commands in force at each step."""
    bench = Bench(actuator, noise_key=noise_key)
    return np.array([bench.step(command, 0.25)[1].error + 0.25 for command in commands])


def test_commands_are_sent_at_their_rate_and_arrive_late():
    """Check the command of each 20 ms, 15 ms later, and the start position before that."""
    actuator = servo(command_rate=50.0, command_delay=0.015, servo_rate=500.0)
    commands = np.arange(1.0, 101.0) / 100.0
    sent = commands[::10].repeat(10)
    # 15 ms end between two steps of 2 ms, so that the eighth step has the command.
    expected = np.array([*[0.25] * 8, *sent])[:100]
    np.testing.assert_allclose(arrivals(actuator, commands), expected, atol=1e-12)


def test_a_rate_that_is_no_divisor_of_the_steps_keeps_its_mean():
    commands = np.arange(3000.0)
    changes = np.flatnonzero(np.diff(arrivals(servo(command_rate=30.0), commands)))
    assert len(changes) == pytest.approx(30.0 * 6.0, abs=1)
    assert set(np.diff(changes)) == {16, 17}


def test_commands_are_taken_after_the_time_is_set_back():
    bench = Bench(servo())
    for _ in range(20):
        bench.step(0.3)
    bench.steps = 0
    assert bench.step(0.4)[1].error == pytest.approx(0.4)


def test_jitter_moves_each_arrival_and_repeats_with_its_key():
    actuator = servo(command_rate=50.0, command_delay=0.02, command_jitter=0.003, servo_rate=500.0)
    commands = (np.arange(20_000) // 10).astype(float)
    first = arrivals(actuator, commands)
    delays = np.array([np.argmax(first == number) - 10 * number for number in range(1, 1900)])
    # An arrival is seen at the next step, half a step later on average.
    assert delays.mean() * 0.002 == pytest.approx(0.021, abs=3e-4)
    assert delays.std() * 0.002 == pytest.approx(math.hypot(0.003, 0.002 / math.sqrt(12)), rel=0.06)
    np.testing.assert_array_equal(first, arrivals(actuator, commands))
    assert (first != arrivals(actuator, commands, noise_key=8.0)).any()


@pytest.mark.parametrize(
    "changes",
    [
        {"ambient_temperature": 90.0},
        {"ambient_temperature": -260.0},
        {"thermal_resistance_winding": 0.0},
    ],
)
def test_drawn_temperatures_that_a_motor_refuses_are_drawn_again(changes):
    motor = dataclasses.replace(MOTOR, max_temperature=80.0, thermal_resistance_winding=20.0)
    parameters = parameters_type(PwmServo)(*servo(motor=motor).parameter_values)
    rows = np.array([parameters, parameters._replace(**changes)])
    assert PwmServo.instability(rows, 0.002).tolist() == [0.0, math.inf]
    with pytest.raises(ValueError, match="GearMotor"):
        dataclasses.replace(motor, **changes)


def test_a_hot_servo_is_off():
    hot = dataclasses.replace(
        MOTOR,
        thermal_resistance_winding=20.0,
        thermal_time_constant_winding=1.0,
        max_temperature=60,
    )
    bench = Bench(servo(motor=hot, position_gain=5.0))
    rows = [bench.step(1.0)[1] for _ in range(2000)]
    off = np.array([row.temperature_saturated for row in rows])
    assert 0 < off.sum() < 2000
    assert max(row.temperature for row in rows) < 61.0
    assert all(row.duty == 0.0 for row in rows if row.temperature_saturated)


def growth(actuator, inertia):
    """Return by how much a small disturbance of a free hinge grows in 300 steps."""
    spec = hinge(0.002, inertia)
    model = codrl_mj.add_motors(spec, {"it": actuator}, allow_unstable=True).compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    data.qvel[0], sizes = 1e-6, []
    for _ in range(300):
        mujoco.mj_step(model, data)
        sizes.append(math.hypot(data.qvel[0], 100.0 * data.qpos[0]))
    return max(sizes[-30:]) / max(sizes[:30])


def test_an_unstable_servo_is_refused_at_its_actual_bound():
    """Find the largest derivative gain that is accepted; it decays, and 5 % more grows."""
    low, high, inertia = 0.01, 30.0, 5e-3

    def refused(gain):
        try:
            codrl_mj.add_motors(hinge(0.002, inertia), {"it": of(gain)}).compile()
        except UnstableError:
            return True
        return False

    def of(gain):
        return servo(position_gain=5.0, derivative_gain=gain, servo_rate=500.0, start_duty=0.02)

    while high / low > 1.01:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if refused(middle) else (middle, high)

    def quiet(gain):
        return dataclasses.replace(of(gain), loop=dataclasses.replace(of(gain).loop, start_duty=0))

    assert growth(quiet(low / 1.05), inertia) < 1.0 < growth(quiet(high * 1.05), inertia)


def test_the_message_of_an_unstable_servo_has_a_step_that_is_stable():
    actuator = servo(position_gain=400.0, servo_rate=500.0)
    with pytest.raises(UnstableError, match=r"loop\.position_gain \(now 400\)") as caught:
        codrl_mj.add_motors(hinge(0.02, 1e-2), {"it": actuator}).compile()
    proposed = re.search(r"shorten the step to ([\d.]+) s", str(caught.value))
    codrl_mj.add_motors(hinge(float(proposed[1]), 1e-2), {"it": actuator}).compile()


@pytest.mark.parametrize(
    ("loop", "message"),
    [
        ({"servo_rate": 700.0}, r"the nearest valid rate is 500 Hz"),
        ({"servo_rate": 333.0}, r"the nearest valid rate is 250 Hz"),
        ({"command_rate": 500.0, "command_delay": 0.02}, r"must be <= 0\.014 s, seven periods"),
        ({"start_duty": 0.5, "max_duty": 0.4}, r"must be <= max_duty = 0\.4"),
        ({"position_p": 32.0}, r"set firmware to one of feetech-sts"),
        (
            {"position_p": 32.0, "stiffness": 3.0, "firmware": "feetech-sts"},
            "two values of the same gain",
        ),
    ],
)
def test_raises_with_a_remedy(loop, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.add_motors(hinge(), {"it": servo(**loop)})
    with pytest.raises(ValueError, match="must be finite"):
        PwmServo(supply=Supply())


@pytest.mark.parametrize(
    ("name", "register"),
    [
        ("feetech-sts3215-7v4", 32.0),
        ("feetech-sts3215-12v", 32.0),
        ("dynamixel-xl430-w250", 640.0),
        ("dynamixel-xm430-w350", 800.0),
        ("dynamixel-xl330-m288", 400.0),
        ("dynamixel-mx-64", 32.0),
    ],
)
def test_a_named_motor_becomes_the_servo_as_delivered(name, register):
    actuator, drive = (
        resolve({"name": name, "family": "pwm_servo"}, None, "x"),
        resolve(name, None, "x"),
    )
    assert actuator.loop.register_p == pytest.approx(register, rel=1e-12)
    assert (actuator.motor, actuator.supply) == (drive.motor, drive.supply)
    assert display_label(actuator) == f"{name} pwm_servo"
    back = override_actuator(actuator, {"family": "drive"})
    assert (type(back), back.motor, display_label(back)) == (Drive, drive.motor, name)


def test_a_gain_is_a_register_a_stiffness_or_a_duty_cycle():
    base = {"name": "feetech-sts3215-7v4", "family": "pwm_servo"}
    half = resolve({**base, "loop": {"position_p": 16.0}}, None, "x")
    assert half.loop.position_gain == pytest.approx(16.0 * 0.166, rel=1e-12)
    assert resolve({**base, "loop": {"stiffness": 9.0}}, None, "x").stiffness == pytest.approx(9.0)
    assert resolve({**base, "loop": {"position_gain": 1.5}}, None, "x").loop.position_gain == 1.5
    # A gain that was a register can be changed to another one, and to another kind.
    assert override_actuator(half, {"loop": {"position_p": 64.0}}).loop.register_p == 64.0
    assert override_actuator(half, {"loop": {"position_gain": 2.0}}).loop.position_gain == 2.0
    weaker = half.replaced({"supply.voltage": 3.7})
    assert weaker.loop == half.loop
    assert weaker.stiffness == pytest.approx(0.5 * half.stiffness)


def test_the_law_of_dynamixel_x_is_the_published_one():
    """Check 1/128 of a PWM unit per count, where 885 units are the whole voltage."""
    counts = 4096.0 / (2.0 * math.pi)
    assert FIRMWARES["dynamixel-x"].gain_per_p == pytest.approx(counts / 128.0 / 885.0, rel=1e-12)


DELAYED = {
    "actuator": {
        "family": "pwm_servo",
        "name": "feetech-sts3215-12v",
        "loop": {"command_rate": 50.0, "command_jitter": 0.003},
    },
    "action": "position",
    "timestep": 0.01,
    "randomize": {
        "loop.command_delay": Uniform(0.0, 0.06),
        "loop.position_gain": Uniform(2.0, 6.0),
    },
}


def test_servos_in_a_batch_equal_single_ones_with_drawn_delays():
    both = [
        gymnasium.make_vec("codrl_mj/Pendulum-v0", 3, kind, **DELAYED)
        for kind in ("vector_entry_point", "sync")
    ]
    np.testing.assert_array_equal(*(envs.reset(seed=3)[0] for envs in both))
    for action in np.random.default_rng(0).uniform(-1, 1, size=(40, 3, 1)).astype(np.float32):
        ours, separate = (envs.step(action) for envs in both)
        np.testing.assert_array_equal(ours[0], separate[0])
        np.testing.assert_array_equal(ours[4]["error"], separate[4]["error"])


def test_each_reset_draws_another_delay():
    env = gymnasium.make("codrl_mj/Pendulum-v0", **DELAYED)
    late = set()
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        start = math.atan2(observation[1], observation[0])
        infos = [env.step(np.array([start + 0.2], np.float32))[4] for _ in range(3)]
        late.add(tuple(round(float(info["target"]), 6) == round(start + 0.2, 6) for info in infos))
    assert len(late) > 1
