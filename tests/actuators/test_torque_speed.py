"""The torque-speed line: against what Isaac Lab and mjlab expect of their DC motors."""

import pytest

from codrl_mj.actuators import Inputs, TorqueSpeed, parameters_type

# Isaac Lab, source/isaaclab/test/actuators/test_dc_motor.py, test_dc_motor_clip, at saturation_effort 100,
# velocity_limit 50, effort_limit 60; mjlab, tests/test_dc_actuator.py, at saturation_effort 20, velocity_limit 30
ISAAC, MJLAB = TorqueSpeed(100.0, 50.0, 60.0), TorqueSpeed(20.0, 30.0, 20.0)
CASES = [  # motor, desired, speed, delivered, in the first and fourth quadrant
    (ISAAC, 30.0, 10.0, 30.0),
    (ISAAC, 70.0, 10.0, 60.0),
    (ISAAC, 80.0, 40.0, 20.0),
    (ISAAC, 30.0, 40.0, 20.0),
    (ISAAC, -20.0, 90.0, -60.0),
    (ISAAC, -30.0, 10.0, -30.0),
    (ISAAC, -80.0, 110.0, -60.0),
    (ISAAC, -80.0, 50.0, -60.0),
    (ISAAC, -120.0, 90.0, -60.0),
    (ISAAC, -10.0, 70.0, -40.0),
    (MJLAB, 200.0, 0.0, 20.0),
    (MJLAB, 200.0, 30.0, 0.0),
    (MJLAB, 200.0, 15.0, 10.0),
    (TorqueSpeed(20.0, 30.0, 5.0), 200.0, 0.0, 5.0),
    (MJLAB, -200.0, -15.0, -10.0),
    (TorqueSpeed(20.0, 30.0, 10.0), 200.0, 15.0, 10.0),
]


@pytest.mark.parametrize("sign", [1.0, -1.0])  # the second and third quadrant mirror the others
@pytest.mark.parametrize(("motor", "desired", "speed", "expected"), CASES)
def test_points_in_four_quadrants_are_those_of_others(motor, desired, speed, expected, sign):
    inputs = Inputs(sign * desired, 0.0, sign * speed, 0.0, 0.0)
    _, torque, signals = motor.advance(parameters_type(TorqueSpeed)(*motor.numbers), 0.01, (), inputs)
    assert torque == pytest.approx(sign * expected, rel=1e-12, abs=1e-12)
    assert signals.lower_limit <= torque <= signals.upper_limit
    assert signals.saturated == (torque != sign * desired)
