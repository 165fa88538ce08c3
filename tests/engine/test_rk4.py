"""RK4: the motor advances once a step and its force is held over the four stages."""

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from codrl_mj.tasks import TASKS
from tests.engine.models import CURRENT, FULL, cartpole, changed, controls
from tests.reference import MotorSimulation, cartpole_rk4

pytestmark = pytest.mark.usefixtures("installed")

STEPS = 500
# hanging: there the cart-pole does not amplify rounding errors
HANGING = [(0.1, 0.2, np.pi - 0.3, 0.4), (-0.5, 0.0, np.pi + 0.2, -1.0), (0.0, -1.0, np.pi, 2.0)]
ACTUATORS = [TASKS["cartpole"].paper[0], FULL]


def _by_hand(actuator, state, forces):
    """States and currents of the hand-written integration."""
    motor, states, currents = MotorSimulation(actuator), [], []
    for desired in forces:
        state = cartpole_rk4(state, motor.step(0.02, desired, state[1]), 0.02)
        states.append(state)
        currents.append(motor.current)
    return np.array(states), np.array(currents)


def _set(data, state):
    data.qpos[:], data.qvel[:] = state[::2], state[1::2]


def _forces(seed):
    return controls(STEPS, seed=seed, size=10.0)[:, 0]


@pytest.mark.parametrize("actuator", ACTUATORS)
@pytest.mark.parametrize("seed", range(3))
def test_rk4_is_the_hand_written_integration_with_the_motor_advanced_once_a_step(actuator, seed):
    actuator = changed(actuator, max_voltage=24.0)
    model = cartpole(actuator, integrator="RK4")
    data = mujoco.MjData(model)
    _set(data, HANGING[seed])
    states, currents = _by_hand(actuator, HANGING[seed], _forces(seed))
    for force, state, current in zip(_forces(seed), states, currents, strict=True):
        data.ctrl[0] = force * actuator.motor.arm_radius
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos, state[::2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(data.qvel, state[1::2], rtol=0, atol=1e-11)
        assert data.act[CURRENT] == pytest.approx(current, abs=1e-11)


def test_rk4_in_a_batch_is_the_hand_written_integration():
    actuator = TASKS["cartpole"].paper[0]
    batch = Batch(cartpole(actuator, integrator="RK4"), nsim=len(HANGING), nthread=2)
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    expected = []
    for sim, state in enumerate(HANGING):
        qpos[sim], qvel[sim] = state[::2], state[1::2]
        expected.append(_by_hand(actuator, state, _forces(sim))[0])
    for step, forces in enumerate(zip(*map(_forces, range(len(HANGING))), strict=True)):
        ctrl[:, 0] = np.array(forces) * actuator.motor.arm_radius
        batch.step()
        wanted = np.array([states[step] for states in expected])
        np.testing.assert_allclose(qpos, wanted[:, ::2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(qvel, wanted[:, 1::2], rtol=0, atol=1e-11)


def test_rk4_goes_on_as_the_hand_written_integration_after_every_state_was_moved_to_fresh_data():
    actuator = TASKS["cartpole"].paper[0]
    model = cartpole(actuator, integrator="RK4")
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    saved = np.empty(mujoco.mj_stateSize(model, spec))
    data = mujoco.MjData(model)
    _set(data, HANGING[0])
    states, _ = _by_hand(actuator, HANGING[0], _forces(0))
    for force, state in zip(_forces(0)[:200], states, strict=False):
        mujoco.mj_getState(model, data, saved, spec)
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, saved, spec)
        data.ctrl[0] = force * actuator.motor.arm_radius
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos, state[::2], rtol=0, atol=1e-12)


def test_the_oracle_has_order_four():
    """The hand-written integration, without a motor, converges as RK4 must."""
    start, errors = (0.0, 0.5, np.pi - 1.0, 0.0), []

    def integrate(steps):
        state = start
        for _ in range(steps):
            state = cartpole_rk4(state, 3.0, 1.0 / steps)
        return np.array(state)

    exact = integrate(1280)
    errors = [np.abs(integrate(steps) - exact).max() for steps in (20, 40, 80)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 4.0, atol=0.15)
