"""The drive on a hinge, against the mean torque of MuJoCo's `<dcmotor>` and mjlab's envelope.

Against `<dcmotor>` the loop is off: a gain is so small that only the reference counts, u =
kp*(i_ref - i), kp = 1e-9 V/A. Over a step the winding's equation integrates to mean(i) = (u -
kE*omega)/R - L/(R*h)*(i_after - i_before), for any current within the step.
"""

import math

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply

R, L, K, KP = 2.0, 0.02, 0.5, 1e-9
HELD = 1e12
"""Inertia [kg*m^2] of a load that keeps its speed."""


def hinge(timestep, inertia=HELD):
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[inertia] * 3)
    body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
    actuator = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge")
    actuator.set_to_motor()
    return spec, actuator


def native(timestep, inertia=HELD):
    spec, actuator = hinge(timestep, inertia)
    voltage = int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
    actuator.set_to_dcmotor(motorconst=[K, K], resistance=R, inductance=[L, 0.0], ctrlspec=voltage)
    return spec.compile()


def ours(timestep, samples, inertia=HELD):
    loop = SampledLoop(samples / timestep, kp=KP, bemf_compensation=False)
    drive = Drive(GearMotor(R, L, K, K, rotor_inertia=0.0), loop, Supply(1e3))
    return codrl_mj.add_motors(hinge(timestep, inertia)[0], {"hinge": drive}).compile()


def run(model, voltages, speed, unit=1.0):
    """Return speed, force and first actuator state, (steps, 3), after steps with voltages [V]."""
    data, rows = mujoco.MjData(model), []
    data.qvel[:] = speed
    for voltage in voltages:
        data.ctrl[:] = unit * voltage
        mujoco.mj_step(model, data)
        rows.append((data.qvel[0], data.qfrc_actuator[0], data.act[0] if model.na == 1 else np.nan))
    return np.array(rows)


@pytest.mark.parametrize("samples", [1, 5])
@pytest.mark.parametrize("speed", [0.0, 8.0, -8.0, 30.0])
@pytest.mark.parametrize(
    "timestep", [0.0005, 0.005, 0.05]
)  # the electrical time constant is 0.01 s
def test_the_mean_torque_is_that_of_mujoco_s_current(timestep, speed, samples):
    """Check it at a constant speed, and its end value K*(V - K*omega)/R at a constant voltage."""
    voltages = np.concatenate(
        [np.random.default_rng(0).uniform(-12.0, 12.0, 200), np.full(400, 9.0)]
    )
    theirs = run(native(timestep), voltages, speed)
    current = np.append(0.0, theirs[:, 2])
    expected = K * ((voltages - K * speed) / R - L / (R * timestep) * np.diff(current))
    actual = run(ours(timestep, samples), voltages, speed, K / KP)[:, 1]
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8)
    assert actual[-1] == pytest.approx(K * (9.0 - K * speed) / R, rel=1e-6)
    assert theirs[-1, 1] == pytest.approx(actual[-1], rel=1e-6)


def test_a_free_hinge_accelerates_alike_as_the_step_shrinks():
    """The drive delivers the mean of a step, `<dcmotor>` its end, so they differ at first order."""
    timesteps, errors = np.array([4e-3, 2e-3, 1e-3, 5e-4]), []
    for timestep in timesteps:
        voltages = np.full(round(0.2 / timestep), 9.0)
        theirs, actual = (
            run(native(timestep, 0.01), voltages, 0.0),
            run(ours(timestep, 1, 0.01), voltages, 0.0, K / KP),
        )
        errors.append(np.abs(theirs - actual)[:, 0].max())
    assert np.polyfit(np.log(timesteps), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.15)
    assert run(ours(1e-3, 1, 0.01), np.full(2000, 9.0), 0.0, K / KP)[-1, 0] == pytest.approx(
        9.0 / K, rel=1e-6
    )


# mjlab, tests/test_builtin_dcmotor_actuator.py: a motor by its nominal voltage, stall torque and
# no-load speed
VOLTAGE, STALL, NO_LOAD = 24.0, 2.0, 100.0
LIMIT = 0.25 * STALL * NO_LOAD / VOLTAGE
"""A drive's largest current [A]: a quarter of the stall current, and so of the stall torque."""
# Name -> demand, speed, largest current, gear, expected torque.
CASES = {
    "stall": (50.0, 0.0, math.inf, 1.0, STALL),
    "no load": (50.0, NO_LOAD, math.inf, 1.0, 0.0),
    "half way": (50.0, 0.5 * NO_LOAD, math.inf, 1.0, 0.5 * STALL),
    "beyond no load": (50.0, 1.25 * NO_LOAD, math.inf, 1.0, -0.25 * STALL),
    "driven backward, more than stall": (50.0, -0.5 * NO_LOAD, math.inf, 1.0, 1.5 * STALL),
    "within the line": (0.3, 0.5 * NO_LOAD, math.inf, 1.0, 0.3),
    "limit": (50.0, 0.0, LIMIT, 1.0, 0.25 * STALL),
    "limit where it is driven backward": (50.0, -0.5 * NO_LOAD, LIMIT, 1.0, 0.25 * STALL),
    "corner": (50.0, 0.75 * NO_LOAD, LIMIT, 1.0, 0.25 * STALL),
    "past the corner": (50.0, 0.9 * NO_LOAD, LIMIT, 1.0, 0.1 * STALL),
    "within the line, through a gear": (0.2, 0.3 * NO_LOAD / 50.0, math.inf, 50.0, 0.2),
    "stall, through a gear": (1e4, 0.0, math.inf, 3.0, 3.0 * STALL),
    "half way, through a gear": (1e4, 0.5 * NO_LOAD / 0.5, math.inf, 0.5, 0.5 * 0.5 * STALL),
}


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("case", CASES)
def test_the_torque_is_within_the_line_and_the_limit(case, sign):
    demand, speed, max_current, gear, expected = CASES[case]
    constant = VOLTAGE / NO_LOAD
    motor = GearMotor(
        constant * VOLTAGE / STALL, 1e-3, constant, constant, rotor_inertia=0.0, gear_ratio=gear
    )
    drive = Drive(motor, SampledLoop(20e3, max_current=max_current), Supply(VOLTAGE))
    model = codrl_mj.add_motors(hinge(0.002)[0], {"hinge": drive}).compile()
    torque = run(model, [sign * demand] * 50, sign * speed)[-1, 1]
    assert torque == pytest.approx(sign * expected, rel=1e-6, abs=1e-9)
