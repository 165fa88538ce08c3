"""With RK4 the motor advances once a step, and its force is held over the four stages."""

import mujoco
import numpy as np
import pytest

from codrl_mj.tasks import TASKS
from tests.engine.models import CURRENT, FULL, cartpole, changed, controls, full_state
from tests.reference import MotorSimulation, cartpole_rk4

pytestmark = pytest.mark.usefixtures("installed")

STEPS = 500
# hanging: there the cart-pole does not amplify rounding errors
HANGING = [(0.1, 0.2, np.pi - 0.3, 0.4), (-0.5, 0.0, np.pi + 0.2, -1.0), (0.0, -1.0, np.pi, 2.0)]


@pytest.mark.parametrize(
    "moved", [False, True], ids=["on", "moved to fresh data before every step"]
)
@pytest.mark.parametrize("actuator", [TASKS["cartpole"].paper[0], changed(FULL, max_voltage=24.0)])
@pytest.mark.parametrize("seed", range(3))
def test_rk4_equals_a_manual_integration_that_advances_the_motor_once_a_step(actuator, seed, moved):
    model, motor, state = (
        cartpole(actuator, integrator="RK4"),
        MotorSimulation(actuator),
        HANGING[seed],
    )
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state[::2], state[1::2]
    for force in controls(STEPS, seed=seed, size=10.0)[:, 0]:
        if moved:
            saved, data = full_state(model, data), mujoco.MjData(model)
            mujoco.mj_setState(model, data, saved, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        data.ctrl[0] = force * actuator.motor.arm_radius
        mujoco.mj_step(model, data)
        state = cartpole_rk4(state, motor.step(0.02, force, state[1]), 0.02)
        np.testing.assert_allclose(data.qpos, state[::2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(data.qvel, state[1::2], rtol=0, atol=1e-11)
        assert data.act[CURRENT] == pytest.approx(motor.current, abs=1e-11)
