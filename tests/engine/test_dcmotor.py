"""MuJoCo's own `<dcmotor>` as an independent oracle for the winding, driven by a voltage.

It integrates the winding exactly over a step, with the speed held: i' = i_inf + (i - i_inf)*exp(-R*dt/L). Ours takes
Euler steps, which are the same map with L replaced by R*dt/(1 - exp(-R*dt/L)), and which converge to it at first order.
Only under Euler: RK4 advances the current of the `<dcmotor>` at every stage, and implicitfast takes the slope of its
torque over speed into the velocity update, whose effect vanishes with the step.
"""

import math

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from tests.engine.models import CURRENT, add_motor

pytestmark = pytest.mark.usefixtures("installed")

R, L, K = 2.0, 0.1, 0.5


def _spec(timestep, integrator):
    spec = mujoco.MjSpec.from_string("""
    <mujoco>
      <worldbody>
        <body>
          <joint name="hinge" axis="0 1 0"/>
          <inertial pos="0.1 0 -0.2" mass="0.5" diaginertia="0.05 0.05 0.05"/>
        </body>
      </worldbody>
    </mujoco>""")
    spec.option.timestep = timestep
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    return spec


def _native(timestep, integrator):
    spec = _spec(timestep, integrator)
    driver = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge")
    driver.set_to_dcmotor(
        motorconst=[K, K], resistance=R, inductance=[L, 0.0], ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
    )
    return spec.compile()


def _ours(timestep, integrator, inductance, substeps=1):
    """A motor whose terminal voltage is its control: feed-forward kT and nothing else."""
    spec = _spec(timestep, integrator)
    motor = Motor(resistance=R, inductance=inductance, torque_constant=K, back_emf_constant=K)
    loop = CurrentLoop(kp=0.0, kff=K, max_voltage=math.inf, bemf_compensation=False, substeps=substeps)
    add_motor(spec, "hinge", Actuator(motor, loop))
    return spec.compile()


def _run(model, duration):
    """Rows of position, velocity and current under random voltages, each held for 0.05 s."""
    data, rows = mujoco.MjData(model), []
    for voltage in np.random.default_rng(0).uniform(-4.0, 4.0, round(duration / 0.05)):
        data.ctrl[:] = voltage
        for _ in range(round(0.05 / model.opt.timestep)):
            mujoco.mj_step(model, data)
            current = data.act[0] if model.na == 1 else data.act[CURRENT]
            rows.append((data.qpos[0], data.qvel[0], current))
    return np.array(rows)


def _equivalent_inductance(timestep):
    return R * timestep / (1.0 - math.exp(-R * timestep / L))


@pytest.mark.parametrize("timestep", [0.001, 0.01, 0.05])  # the electrical time constant is 0.05 s
def test_the_winding_is_mujocos_own_at_the_inductance_that_makes_the_two_integrations_one(timestep):
    native = _run(_native(timestep, "Euler"), 3.0)
    ours = _run(_ours(timestep, "Euler", _equivalent_inductance(timestep)), 3.0)
    assert np.abs(native[:, 2]).max() > 0.5
    np.testing.assert_allclose(ours, native, rtol=0, atol=1e-11)


def test_under_implicitfast_the_two_converge_with_the_step():
    timesteps, errors = np.array([0.005, 0.0025, 0.00125, 0.000625]), []
    for timestep in timesteps:
        native = _run(_native(timestep, "implicitfast"), 1.0)[-1]
        errors.append(np.abs(_run(_ours(timestep, "implicitfast", _equivalent_inductance(timestep)), 1.0)[-1] - native))
    order = np.polyfit(np.log(timesteps), np.log(np.max(errors, axis=1)), 1)[0]
    assert order > 0.9


def test_the_winding_converges_to_mujocos_own_at_first_order_in_its_substeps():
    native = _run(_native(0.01, "Euler"), 0.5)[:, 2]
    counts = np.array([4, 8, 16, 32, 64])
    errors = [np.abs(_run(_ours(0.01, "Euler", L, count), 0.5)[:, 2] - native).max() for count in counts]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert order == pytest.approx(1.0, abs=0.1)
    assert errors[-1] < 2e-3
