"""Torque-speed line, against the expectations of Isaac Lab and mjlab for their DC motors."""

import math

import mujoco
import pytest

import codrl_mj
from codrl_mj.actuators import Inputs, TorqueSpeed, override_actuator, parameters_type

# Isaac Lab, source/isaaclab/test/actuators/test_dc_motor.py, test_dc_motor_clip, at
# saturation_effort 100, velocity_limit 50, effort_limit 60; mjlab, tests/test_dc_actuator.py, at
# saturation_effort 20, velocity_limit 30.
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


# The second and third quadrant mirror the others.
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("motor", "desired", "speed", "expected"), CASES)
def test_points_in_four_quadrants_equal_those_of_other_libraries(
    motor, desired, speed, expected, sign
):
    inputs = Inputs(sign * desired, 0.0, sign * speed, 0.0, 0.0)
    _, torque, signals = motor.advance(
        parameters_type(TorqueSpeed)(*motor.parameter_values), 0.01, (), inputs
    )
    assert torque == pytest.approx(sign * expected, rel=1e-12, abs=1e-12)
    assert signals.lower_limit <= torque <= signals.upper_limit
    assert signals.saturated == (torque != sign * desired)


LEG = """<mujoco><option timestep="1e-6"/><worldbody><body><joint name="knee" axis="0 1 0"/>
<geom size=".1" mass="5"/></body></worldbody><actuator><motor name="knee" joint="knee"/></actuator></mujoco>"""


@pytest.mark.parametrize("more", [{}, {"max_torque": 30.0}, {"max_torque": 10.0}])
@pytest.mark.parametrize("speed", [0.0, 6.0, 15.0, 29.0])
def test_a_torque_limit_in_mujoco_is_the_stall_torque_unless_specified(speed, more):
    """Compare with min(command, stall*(1 - w/w0), limit); the limit defaults to stall."""
    settings = {"family": "torque_speed", "stall_torque": 24.0, "no_load_speed": 30.0, **more}
    model = codrl_mj.add_motors(mujoco.MjSpec.from_string(LEG), {"knee": settings}).compile()
    data = mujoco.MjData(model)
    data.ctrl[0], data.qvel[0] = 20.0, speed
    mujoco.mj_step(model, data)
    expected = min(20.0, 24.0 * (1.0 - speed / 30.0), more.get("max_torque", 24.0))
    assert data.actuator_force[0] == pytest.approx(expected, rel=1e-12)


def test_a_stall_torque_above_the_default_is_not_limited():
    motor = override_actuator(TorqueSpeed(), {"stall_torque": 24.0})
    for command, expected in ((30.0, 24.0), (-30.0, -24.0)):
        numbers = parameters_type(TorqueSpeed)(*motor.parameter_values)
        assert motor.advance(numbers, 0.01, (), Inputs(command, 0.0, 0.0, 0.0, 0.0))[1] == expected
    assert math.isinf(motor.max_torque)
