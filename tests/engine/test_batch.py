"""Batches: bit for bit what a loop over single simulations gives, at any number of threads."""

import dataclasses

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from codrl_mj import engine
from codrl_mj.engine.families import HEAD
from tests.engine.models import CURRENT, FULL, cartpole, changed, controls, full_state, rotor
from tests.engine.test_families import SPRINGS, Spring
from tests.engine.test_several_actuators import model_of_several

pytestmark = pytest.mark.usefixtures("installed")

SIMULATIONS, STEPS = 24, 60
DRAWS = np.random.default_rng(0).uniform(0.5, 2.0, (SIMULATIONS, 3)) * (1, 1, 0.1)
LOOPS = [
    changed(FULL, kp=kp, resistance=resistance, inductance=inductance)
    for kp, resistance, inductance in DRAWS
]
FAMILIES = {  # name: the motor of each simulation
    "current loops": LOOPS,
    "somebody's": [
        dataclasses.replace(SPRINGS[index % 3], arm_radius=0.4 + 0.01 * index)
        for index in range(24)
    ],
}


def inputs_of(model):
    return np.stack([controls(STEPS, model.nu, seed, 0.6) for seed in range(SIMULATIONS)], axis=1)


def serial(models):
    """The final state of each simulation, one after the other."""
    rows = []
    for model, inputs in zip(models, np.moveaxis(inputs_of(models[0]), 1, 0), strict=True):
        data = mujoco.MjData(model)
        for data.ctrl[:] in inputs:
            mujoco.mj_step(model, data)
        rows.append(full_state(model, data))
    return np.array(rows)


def batched(batch, model):
    """The same, in a batch."""
    ctrl = batch.bind("ctrl").reshape(SIMULATIONS, -1)
    for ctrl[:] in inputs_of(model):
        batch.step()
    return np.concatenate(
        [batch.bind(name).reshape(SIMULATIONS, -1) for name in ("time", "qpos", "qvel", "act")], 1
    )


@pytest.mark.parametrize("nthread", [1, 2])
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("build", [cartpole, model_of_several])
def test_a_batch_is_a_serial_loop_bit_for_bit(build, integrator, nthread):
    model = build(FULL, integrator=integrator)
    found = batched(Batch(model, nsim=SIMULATIONS, nthread=nthread), model)
    np.testing.assert_array_equal(found, serial([model] * SIMULATIONS))
    assert len(np.unique(found[:, CURRENT - model.na])) == SIMULATIONS  # each its own current


@pytest.mark.parametrize("nthread", [1, 2])
@pytest.mark.parametrize("name", FAMILIES)
def test_each_simulation_of_a_batch_may_have_its_own_motor(name, nthread):
    engine.load_family(Spring)
    motors, models = FAMILIES[name], [rotor(one) for one in FAMILIES[name]]
    batch = Batch(models[0], nsim=SIMULATIONS, nthread=nthread)
    batch.expand("actuator_user")[:, 0, HEAD:] = [one.parameter_values for one in motors]
    batch.expand("actuator_gear")[:, 0, 0] = [1.0 / one.arm_radius for one in motors]
    np.testing.assert_array_equal(batched(batch, models[0]), serial(models))


def test_a_simulation_taken_out_of_a_batch_continues_as_in_it():
    model = rotor(integrator="RK4")
    batch = Batch(model, nsim=SIMULATIONS, nthread=2)
    batched(batch, model)
    data = batch.get_data(17)
    for data.ctrl[:] in inputs_of(model)[:, 17]:
        mujoco.mj_step(model, data)
    np.testing.assert_array_equal(batched(batch, model)[17], full_state(model, data))
