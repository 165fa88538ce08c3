"""MuJoCo's own `<dcmotor>` as an oracle for the drive's winding and for its mean torque, with the loop off.

The loop is off where a gain is so small that only the reference counts: u = kp*(i_ref - i), kp = 1e-9 V/A. Over a step
the winding's equation integrates to mean(i) = (u - kE*omega)/R - L/(R*h)*(i_after - i_before), whatever happens within.
"""

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply

R, L, K = 2.0, 0.02, 0.5
KP = 1e-9


def hinge(timestep, inertia):
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[inertia] * 3)
    body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
    return spec, spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge")


def native(timestep, inertia):
    spec, actuator = hinge(timestep, inertia)
    voltage = int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
    actuator.set_to_dcmotor(motorconst=[K, K], resistance=R, inductance=[L, 0.0], ctrlspec=voltage)
    return spec.compile()


def ours(timestep, inertia, samples):
    spec, actuator = hinge(timestep, inertia)
    actuator.set_to_motor()
    motor = GearMotor(R, L, K, K, rotor_inertia=0.0)
    loop = SampledLoop(samples / timestep, kp=KP, bemf_compensation=False)
    return codrl_mj.motorise(spec, {"hinge": Drive(motor, loop, Supply(1e3))}).compile()


def run(model, voltages, speed, unit=1.0):
    """Speed, force and the first state of the actuator after each step under voltages [V]; shape (steps, 3)."""
    data, rows = mujoco.MjData(model), []
    data.qvel[:] = speed
    for voltage in voltages:
        data.ctrl[:] = unit * voltage
        mujoco.mj_step(model, data)
        rows.append((data.qvel[0], data.qfrc_actuator[0], data.act[0] if model.na == 1 else np.nan))
    return np.array(rows)


@pytest.mark.parametrize("samples", [1, 5])
@pytest.mark.parametrize("speed", [0.0, 8.0, -8.0, 30.0])
@pytest.mark.parametrize("timestep", [0.0005, 0.005, 0.05])  # the electrical time constant is 0.01 s
def test_the_mean_torque_is_that_of_mujoco_s_current(timestep, speed, samples):
    """At a speed that a load of 1e12 kg*m^2 keeps; then a voltage that stays, which ends at K*(V - K*omega)/R."""
    voltages = np.concatenate([np.random.default_rng(0).uniform(-12.0, 12.0, 200), np.full(400, 9.0)])
    theirs = run(native(timestep, 1e12), voltages, speed)
    current = np.append(0.0, theirs[:, 2])
    expected = K * ((voltages - K * speed) / R - L / (R * timestep) * np.diff(current))
    found = run(ours(timestep, 1e12, samples), voltages, speed, K / KP)[:, 1]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)
    assert found[-1] == pytest.approx(K * (9.0 - K * speed) / R, rel=1e-6)
    assert theirs[-1, 1] == pytest.approx(found[-1], rel=1e-6)


def test_a_free_hinge_comes_up_to_the_same_speed_on_the_same_way_as_the_step_shrinks():
    """The one delivers the mean of a step, the other its end: the ways differ at first order."""
    timesteps, errors = np.array([4e-3, 2e-3, 1e-3, 5e-4]), []
    for timestep in timesteps:
        voltages = np.full(round(0.2 / timestep), 9.0)
        speeds = (
            run(native(timestep, 0.01), voltages, 0.0)[:, 0],
            run(ours(timestep, 0.01, 1), voltages, 0.0, K / KP)[:, 0],
        )
        errors.append(np.abs(speeds[0] - speeds[1]).max())
    assert np.polyfit(np.log(timesteps), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.15)
    long = run(ours(1e-3, 0.01, 1), np.full(2000, 9.0), 0.0, K / KP)[-1, 0]
    assert long == pytest.approx(9.0 / K, rel=1e-6)
