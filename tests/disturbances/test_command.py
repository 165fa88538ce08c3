"""Disturbances of the command: delay against interpolation, quantization, rate limit."""

import copy
import dataclasses
import functools

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codrl_mj.actuators import GearMotor, SampledLoop, Servo, ServoLoop, Supply
from codrl_mj.disturbances import Disturbances, limit_rate, quantize, whole_and_fraction
from codrl_mj.physics.disturber import Disturber

commands = st.lists(st.floats(-10, 10), min_size=1, max_size=30)


def _arrivals(disturbances, timestep, given_commands, limit=10.0):
    disturber = Disturber(disturbances, timestep, np.array([limit]), 1)
    return np.array(
        [disturber.disturb_commands(np.array([[command]]))[0][0, 0] for command in given_commands]
    )


@given(commands, st.floats(0.0, 0.2))
@settings(max_examples=60, deadline=None)
def test_a_delayed_command_is_interpolated(values, delay):
    timestep, count = 0.01, len(values)
    steps = np.arange(-40, count)
    # A remainder of 1e-9 of a step is rounded to zero.
    padded = np.concatenate([np.zeros(40), values])
    expected = np.interp(np.arange(count) - delay / timestep, steps, padded)
    arrived = _arrivals(Disturbances(command_delay=delay), timestep, values)
    np.testing.assert_allclose(arrived, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("delay", [0.02, 0.06, 0.3])
def test_whole_steps_shift_without_rounding(delay):
    values, steps = np.sin(np.arange(40.0)), round(delay / 0.02)
    arrived = _arrivals(Disturbances(command_delay=delay), 0.02, values)
    np.testing.assert_array_equal(arrived, np.concatenate([np.zeros(steps), values])[:40])
    assert whole_and_fraction(delay, 0.02) == (steps, 0.0)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
@pytest.mark.parametrize("actuator", ["ideal", "paper"])
def test_a_delay_equals_later_commands_without_delay(physics, actuator):
    arguments = {"physics": physics, "actuator": actuator}
    delayed = gymnasium.make(
        "codrl_mj/Pendulum-v0", disturbances={"command_delay": 0.1}, **arguments
    )
    plain = gymnasium.make("codrl_mj/Pendulum-v0", **arguments)
    delayed.reset(seed=0)
    plain.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-2, 2, (50, 1)).astype(np.float32)
    late = np.concatenate([np.zeros((2, 1), np.float32), actions])
    for action, earlier in zip(actions, late, strict=False):
        ours, theirs = delayed.step(action), plain.step(earlier)
        np.testing.assert_array_equal(delayed.unwrapped.state, plain.unwrapped.state)
        assert ours[4]["desired_force"] == action[0]
        assert ours[4]["actual_force"] == theirs[4]["actual_force"]
        assert ours[4]["reference_current"] == theirs[4]["reference_current"]


SERVO = Servo(
    GearMotor(rotor_inertia=0.0, gear_ratio=20.0),
    SampledLoop(20e3),
    Supply(48.0),
    ServoLoop(servo_rate=100.0, velocity_gain=3.0, position_gain=5.0),
)


@pytest.mark.parametrize("physics", ["mujoco", "analytic", "batch"])
@pytest.mark.parametrize("more", [{}, {"command_rate": 1e6}])
def test_the_initial_position_is_held_until_the_first_command(physics, more):
    """Compare with holding the position without a delay; again after a second reset."""
    arguments = {"actuator": SERVO, "action": "position", "timestep": 0.01}
    if physics == "batch":
        make = functools.partial(
            gymnasium.make_vec, num_envs=2, vectorization_mode="vector_entry_point"
        )
    else:
        make, arguments = gymnasium.make, {"physics": physics, **arguments}
    late = make("codrl_mj/Pendulum-v0", disturbances={"command_delay": 0.1, **more}, **arguments)
    plain = make("codrl_mj/Pendulum-v0", **arguments)
    for options in (None, {"x_init": 0.5, "y_init": 0.1}):
        late.reset(seed=4, options=options)
        plain.reset(seed=4, options=options)
        start = np.atleast_2d(late.unwrapped.state)[:, :1].astype(np.float32)
        rows = [start, start, *(start + 0.1 * np.sin(step) for step in range(6))]
        for action, earlier in zip(rows[2:], rows, strict=False):
            shape = late.action_space.shape
            ours, theirs = late.step(action.reshape(shape)), plain.step(earlier.reshape(shape))
            np.testing.assert_allclose(
                late.unwrapped.state, plain.unwrapped.state, rtol=0, atol=2e-6
            )
            np.testing.assert_allclose(ours[4]["current"], theirs[4]["current"], rtol=0, atol=2e-4)


def test_the_velocity_is_zero_until_the_first_command():
    servo = dataclasses.replace(
        SERVO, loop=ServoLoop("velocity", servo_rate=100.0, velocity_gain=3.0)
    )
    env = gymnasium.make(
        "codrl_mj/Pendulum-v0",
        actuator=servo,
        action="velocity",
        timestep=0.01,
        disturbances={"command_delay": 0.1},
    )
    env.reset(seed=4)
    assert (env.unwrapped.physics.memory == 0.0).all()


def test_a_snapshot_contains_delayed_positions():
    arguments = {
        "actuator": SERVO,
        "action": "position",
        "timestep": 0.01,
        "disturbances": {"command_delay": 0.1},
    }
    env, second = (gymnasium.make("codrl_mj/Pendulum-v0", **arguments).unwrapped for _ in range(2))
    env.reset(seed=4)
    second.reset(seed=5)
    second.restore(env.snapshot())
    copied = copy.deepcopy(env)
    for _ in range(3):
        states = [env_.step(np.array([0.3], np.float32))[0] for env_ in (env, second, copied)]
        np.testing.assert_array_equal(states[0], states[1])
        np.testing.assert_array_equal(states[0], states[2])


def test_the_delay_counts_integration_steps():
    env = gymnasium.make(
        "codrl_mj/MountainCar-v0",
        actuator="ideal",
        inner_steps=20,
        disturbances={"command_delay": 0.5},
    )
    half = gymnasium.make("codrl_mj/MountainCar-v0", actuator="ideal", inner_steps=20)
    env.reset(seed=1)
    half.reset(seed=1)
    env.step(2)
    physics = half.unwrapped.physics
    for index in range(20):
        physics.data.ctrl[0] = float(index >= 10)
        mujoco.mj_step(physics.model, physics.data)
    np.testing.assert_array_equal(env.unwrapped.state, half.unwrapped.state)


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 10), st.floats(0.1, 2e3))
def test_a_quantized_command_is_the_nearest_multiple_within_the_limit(command, quantum, limit):
    value = quantize(command, quantum, limit)
    clipped = np.clip(command, -limit, limit)
    assert abs(value) <= limit
    if abs(value) < limit:
        assert value / quantum == pytest.approx(round(value / quantum), abs=1e-6)
        assert abs(value - command) <= quantum / 2 * (1 + 1e-9) + 1e-12 * abs(command)
    else:
        assert abs(clipped - value) <= quantum
    assert quantize(np.array([-command]), quantum, limit)[0] == -value


def test_ties_are_rounded_to_the_even_multiple():
    np.testing.assert_array_equal(
        quantize(np.array([0.25, 0.75, -0.25, 1.25]), 0.5, 9.0), [0.0, 1.0, 0.0, 1.0]
    )


@given(commands, st.floats(1e-3, 5))
def test_a_rate_limited_command_approaches_its_target_within_the_rate(values, change):
    last = 0.0
    for target in values:
        value = limit_rate(np.array([target]), np.array([last]), change)[0]
        assert abs(value - last) <= change * (1 + 1e-12) + 1e-12
        if abs(target - last) <= change:
            assert value == pytest.approx(target, abs=1e-12)
        else:
            assert value == last + np.sign(target - last) * change
        last = value


def test_the_order_is_delay_quantization_rate_limit():
    arrived = _arrivals(
        Disturbances(command_delay=0.01, command_quantum=1.0, command_rate=30.0),
        0.02,
        [1.4, 1.4, 4.0],
    )
    # Interpolated: 0.7, 1.4, 2.7; quantized: 1, 1, 3; limited to 0.6 per step.
    np.testing.assert_allclose(arrived, [0.6, 1.0, 1.6], rtol=1e-12)


def test_each_actuator_of_a_simulation_has_its_own_limit():
    disturbances = Disturbances(command_delay=0.013, command_quantum=0.3, command_rate=100.0)
    limits = np.array([10.0, 2.0, 0.5])
    values = np.random.default_rng(0).uniform(-10, 10, (30, 5, 3))
    disturber = Disturber(disturbances, 0.01, limits, 5)
    together = np.array([disturber.disturb_commands(rows)[0] for rows in values])
    for simulation in range(5):
        for actuator, limit in enumerate(limits):
            separate = _arrivals(disturbances, 0.01, values[:, simulation, actuator], limit)
            np.testing.assert_array_equal(together[:, simulation, actuator], separate)
