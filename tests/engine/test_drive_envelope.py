"""What mjlab expects of its DC motors, of the drive on a hinge: stall, no load, line, corner, backward, a gear."""

import math

import mujoco
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply

# mjlab, tests/test_builtin_dcmotor_actuator.py: a motor by its nominal voltage, stall torque and no-load speed
VOLTAGE, STALL, NO_LOAD = 24.0, 2.0, 100.0
K = VOLTAGE / NO_LOAD
R = K * VOLTAGE / STALL
LIMIT = 0.25 * VOLTAGE / R
"""A drive's largest current [A]: a quarter of the stall current, and so of the stall torque."""


def delivered(demand, speed, most=math.inf, gear=1.0):
    """Torque [N*m] at a hinge whose speed [rad/s] a load of 1e12 kg*m^2 keeps, once the current is there."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[1e12] * 3)
    body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    motor = GearMotor(R, 1e-3, K, K, rotor_inertia=0.0, gear_ratio=gear)
    drive = Drive(motor, SampledLoop(20e3, max_current=most), Supply(VOLTAGE))
    model = codrl_mj.motorise(spec, {"hinge": drive}).compile()
    data = mujoco.MjData(model)
    data.ctrl[:], data.qvel[:] = demand, speed
    mujoco.mj_step(model, data, 50)
    return data.qfrc_actuator[0]


CASES = {  # name: demand, speed, largest current, expected
    "stall": (50.0, 0.0, math.inf, STALL),
    "no load": (50.0, NO_LOAD, math.inf, 0.0),
    "half way": (50.0, 0.5 * NO_LOAD, math.inf, 0.5 * STALL),
    "beyond no load": (50.0, 1.25 * NO_LOAD, math.inf, -0.25 * STALL),
    "driven backward, more than stall": (50.0, -0.5 * NO_LOAD, math.inf, 1.5 * STALL),
    "within the line": (0.3, 0.5 * NO_LOAD, math.inf, 0.3),
    "limit": (50.0, 0.0, LIMIT, 0.25 * STALL),
    "limit where it is driven backward": (50.0, -0.5 * NO_LOAD, LIMIT, 0.25 * STALL),
    "corner": (50.0, 0.75 * NO_LOAD, LIMIT, 0.25 * STALL),
    "past the corner": (50.0, 0.9 * NO_LOAD, LIMIT, 0.1 * STALL),
}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("case", CASES)
def test_the_torque_is_within_the_line_and_the_limit(case, sign):
    demand, speed, most, expected = CASES[case]
    assert delivered(sign * demand, sign * speed, most) == pytest.approx(sign * expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("gear", [0.5, 3.0, 50.0])
def test_a_gear_changes_the_limits_and_not_what_is_asked_for_within_them(gear):
    assert delivered(0.2, 0.3 * NO_LOAD / gear, gear=gear) == pytest.approx(0.2, rel=1e-6)
    assert delivered(1e4, 0.0, gear=gear) == pytest.approx(gear * STALL, rel=1e-6)
    assert delivered(1e4, 0.5 * NO_LOAD / gear, gear=gear) == pytest.approx(0.5 * gear * STALL, rel=1e-6)
