"""Batches give the bits of a loop over single simulations, with any number of threads."""

import dataclasses

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from codrl_mj import engine
from codrl_mj.engine.families import USER_HEADER_SIZE
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
# Name of the family -> the motor of each simulation.
FAMILIES = {
    "current loops": LOOPS,
    "custom": [
        dataclasses.replace(SPRINGS[index % 3], arm_radius=0.4 + 0.01 * index)
        for index in range(24)
    ],
}


def inputs_of(model):
    return np.stack([controls(STEPS, model.nu, seed, 0.6) for seed in range(SIMULATIONS)], axis=1)


def serial(models):
    """Return the final state of each simulation, run one after the other."""
    rows = []
    for model, inputs in zip(models, np.moveaxis(inputs_of(models[0]), 1, 0), strict=True):
        data = mujoco.MjData(model)
        for data.ctrl[:] in inputs:
            mujoco.mj_step(model, data)
        rows.append(full_state(model, data))
    return np.array(rows)


def batched(batch, model):
    """Return the final state of each simulation, run in a batch."""
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
    states = batched(Batch(model, nsim=SIMULATIONS, nthread=nthread), model)
    np.testing.assert_array_equal(states, serial([model] * SIMULATIONS))
    # Each simulation has a different current.
    assert len(np.unique(states[:, CURRENT - model.na])) == SIMULATIONS


@pytest.mark.parametrize("nthread", [1, 2])
@pytest.mark.parametrize("name", FAMILIES)
def test_each_simulation_of_a_batch_may_have_its_own_motor(name, nthread):
    engine.load_family(Spring)
    motors, models = FAMILIES[name], [rotor(motor) for motor in FAMILIES[name]]
    batch = Batch(models[0], nsim=SIMULATIONS, nthread=nthread)
    batch.expand("actuator_user")[:, 0, USER_HEADER_SIZE:] = [
        motor.parameter_values for motor in motors
    ]
    batch.expand("actuator_gear")[:, 0, 0] = [1.0 / motor.arm_radius for motor in motors]
    np.testing.assert_array_equal(batched(batch, models[0]), serial(models))


def test_a_simulation_continues_outside_its_batch_as_inside():
    model = rotor(integrator="RK4")
    batch = Batch(model, nsim=SIMULATIONS, nthread=2)
    batched(batch, model)
    data = batch.get_data(17)
    for data.ctrl[:] in inputs_of(model)[:, 17]:
        mujoco.mj_step(model, data)
    np.testing.assert_array_equal(batched(batch, model)[17], full_state(model, data))
