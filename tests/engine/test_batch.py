"""Batches: bit for bit what a loop over single simulations gives, at any number of threads."""

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from codrl_mj.engine.families import HEAD
from tests.engine.models import CURRENT, FULL, cartpole, changed, controls, full_state, rotor

pytestmark = pytest.mark.usefixtures("installed")

SIMULATIONS, STEPS = 64, 60
INPUTS = np.stack([controls(STEPS, seed=seed, size=0.6) for seed in range(SIMULATIONS)], axis=1)


def _serial(models, forward=False):
    """Final position, velocity and motor state of each simulation, one after the other."""
    rows = []
    for sim, model in enumerate(models):
        data = mujoco.MjData(model)
        for step in range(STEPS):
            data.ctrl[:] = INPUTS[step, sim]
            mujoco.mj_step(model, data)
        rows.append(full_state(model, data))
    return np.array(rows)


def _batched(batch):
    """The same, in a batch."""
    ctrl = batch.bind("ctrl")
    for step in range(STEPS):
        ctrl[:] = INPUTS[step]
        batch.step()
    fields = [batch.bind(name).reshape(SIMULATIONS, -1) for name in ("time", "qpos", "qvel", "act")]
    return np.concatenate(fields, axis=1)


@pytest.mark.parametrize("nthread", [1, 2])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("build", [rotor, cartpole])
def test_a_batch_is_a_serial_loop_bit_for_bit(build, integrator, nthread):
    model = build(FULL, integrator=integrator)
    batched = _batched(Batch(model, nsim=SIMULATIONS, nthread=nthread))
    np.testing.assert_array_equal(batched, _serial([model] * SIMULATIONS))
    assert len(np.unique(batched[:, CURRENT - model.na])) == SIMULATIONS  # each its own current


@pytest.mark.parametrize("nthread", [1, 2])
def test_each_simulation_of_a_batch_may_have_its_own_motor(nthread):
    actuators = [
        changed(FULL, kp=kp, resistance=resistance, inductance=inductance)
        for kp, resistance, inductance in np.random.default_rng(0).uniform(0.5, 2.0, (SIMULATIONS, 3)) * (1, 1, 0.1)
    ]
    batch = Batch(rotor(), nsim=SIMULATIONS, nthread=nthread)
    batch.expand("actuator_user")[:, 0, HEAD:] = [actuator.numbers for actuator in actuators]
    np.testing.assert_array_equal(_batched(batch), _serial([rotor(actuator) for actuator in actuators]))


def test_a_simulation_taken_out_of_a_batch_continues_as_in_it():
    model = rotor(integrator="RK4")
    batch = Batch(model, nsim=SIMULATIONS, nthread=2)
    _batched(batch)
    data = batch.get_data(17)
    for step in range(STEPS):
        data.ctrl[:] = INPUTS[step, 17]
        mujoco.mj_step(model, data)
    np.testing.assert_array_equal(_batched(batch)[17], full_state(model, data))
