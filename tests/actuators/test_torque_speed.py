"""The torque-speed line: against what Isaac Lab and mjlab expect of their DC motors."""

import pytest

from codrl_mj.actuators import Actuator, CurrentLoop, Inputs, Motor, TorqueSpeed, parameters_type


def _delivered(actuator, desired, speed):
    inputs = Inputs(desired, 0.0, speed, 0.0, 0.0)
    _, torque, signals = actuator.advance(parameters_type(TorqueSpeed)(*actuator.numbers), 0.01, (), inputs)
    assert signals.lower_limit <= torque <= signals.upper_limit
    assert signals.saturated == (torque != desired)
    return torque


# Isaac Lab, source/isaaclab/test/actuators/test_dc_motor.py, test_dc_motor_clip: (effort, velocity, clipped effort) at
# saturation_effort 100, velocity_limit 50, effort_limit 60. Points in the first and fourth quadrant; the second and
# third mirror them there too
ISAAC_LAB = [
    (30.0, 10.0, 30.0),
    (70.0, 10.0, 60.0),
    (80.0, 40.0, 20.0),
    (30.0, 40.0, 20.0),
    (-20.0, 90.0, -60.0),
    (-30.0, 10.0, -30.0),
    (-80.0, 110.0, -60.0),
    (-80.0, 50.0, -60.0),
    (-120.0, 90.0, -60.0),
    (-10.0, 70.0, -40.0),
]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("desired", "speed", "expected"), ISAAC_LAB)
def test_isaac_labs_points_in_four_quadrants(desired, speed, expected, sign):
    motor = TorqueSpeed(stall_torque=100.0, no_load_speed=50.0, max_torque=60.0)
    assert _delivered(motor, sign * desired, sign * speed) == pytest.approx(sign * expected, rel=1e-12)


# mjlab, tests/test_dc_actuator.py: saturation_effort 20, velocity_limit 30; (effort limit, velocity, demand, expected)
MJLAB = {
    "stall": (20.0, 0.0, 200.0, 20.0),
    "no load": (20.0, 30.0, 200.0, 0.0),
    "half way": (20.0, 15.0, 200.0, 10.0),
    "limit": (5.0, 0.0, 200.0, 5.0),
    "backward": (20.0, -15.0, -200.0, -10.0),
    "corner": (10.0, 15.0, 200.0, 10.0),
}


@pytest.mark.parametrize("case", MJLAB)
def test_mjlabs_closed_forms(case):
    limit, speed, desired, expected = MJLAB[case]
    motor = TorqueSpeed(stall_torque=20.0, no_load_speed=30.0, max_torque=limit)
    assert _delivered(motor, desired, speed) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("speed", [-300.0, -100.0, 0.0, 50.0, 200.0, 350.0])
@pytest.mark.parametrize("desired", [-1e3, 1e3])
def test_the_line_is_that_of_a_saturated_current_loop_at_rest(speed, desired):
    motor = Motor(resistance=1.5, torque_constant=0.06, back_emf_constant=0.06)
    loop = Actuator(motor, CurrentLoop(kp=1e9, max_voltage=24.0))
    parameters, state = parameters_type(Actuator)(*loop.numbers), Actuator.State(0.0, 0.0, 0.0)
    for _ in range(3000):
        state, torque, _ = loop.advance(parameters, 0.01, state, Inputs(desired, 0.0, speed, 0.0, 0.0))
    line = TorqueSpeed(stall_torque=0.06 * 24.0 / 1.5, no_load_speed=24.0 / 0.06, max_torque=1e3)
    assert _delivered(line, desired, speed) == pytest.approx(torque, rel=1e-9)
