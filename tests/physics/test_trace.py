"""The trace of the integration steps within an environment step."""

import numpy as np
import pytest

from codrl_mj.actuators import Actuator, CurrentLoop, Inputs, Motor, Supply, parameters_type
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, Plant, trace_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.tasks.faces import every_rebuilt

DESIRED, ACTUAL, CURRENT, REFERENCE, VOLTAGE, SATURATED, SPEED = range(7)

STEPS = 20


def _physics(kind, task, actuator="paper"):
    definition = TASKS[task]
    inner_steps = max(3, definition.motor_inner_steps)
    physics = kind(Plant(definition, [named_actuator(actuator, task)], inner_steps))
    physics.reset(np.full(len(definition.state_names), 0.05))
    return physics


def _traces(physics, seed=0):
    forces = np.random.default_rng(seed).uniform(-1, 1, STEPS) * physics.plant.task.max_force
    return forces, np.array([(physics.step(float(force)), physics.trace[:, 0].copy())[1] for force in forces])


@pytest.mark.parametrize("kind", [MujocoPhysics, AnalyticPhysics])
@every_rebuilt
def test_every_row_follows_from_the_row_before_by_the_loops_own_equations(kind, task):
    physics = _physics(kind, task)
    speed_at_start = 0.05
    forces, traces = _traces(physics)
    assert trace_names(physics.plant.family) == (
        *("desired_force", "actual_force", "current", "reference_current", "voltage", "saturated", "speed"),
    )
    actuator = named_actuator("paper", task)
    parameters = parameters_type(Actuator)(*actuator.numbers)
    arm, timestep = actuator.motor.arm_radius, physics.plant.task.step_duration / physics.plant.inner_steps
    loop, speed = Actuator.State(0.0, 0.0, 0.0), speed_at_start
    for force, trace in zip(forces, traces, strict=True):
        assert trace.shape == (physics.plant.inner_steps, 7)
        for row in trace:
            inputs = Inputs(force * arm, 0.0, speed / arm, 0.0, 0.0)
            loop, _, signals = actuator.advance(parameters, timestep, loop, inputs)
            assert row[DESIRED] == force
            np.testing.assert_allclose(row[[CURRENT, VOLTAGE]], [loop.current, signals.voltage], rtol=1e-9, atol=1e-9)
            assert row[REFERENCE] == signals.reference_current
            np.testing.assert_allclose(row[ACTUAL], actuator.motor.torque_constant * row[CURRENT] / arm, rtol=1e-12)
            loop, speed = loop._replace(current=row[CURRENT]), row[SPEED]


@pytest.mark.parametrize("actuator", ["ideal", "weak"])
@every_rebuilt
def test_the_last_row_is_what_the_engine_says_of_the_steps_end(task, actuator):
    physics = _physics(MujocoPhysics, task, actuator)
    for _ in range(STEPS):
        physics.step(0.5 * physics.plant.task.max_force)
        last, dof = physics.trace[-1, 0], physics.model.actuator("motor").trnid[0]
        assert last[DESIRED] == 0.5 * physics.plant.task.max_force
        np.testing.assert_allclose(last[ACTUAL], physics.data.qfrc_actuator[dof], rtol=1e-14)
        assert last[SPEED] == physics.data.qvel[dof]
        if actuator == "ideal":
            np.testing.assert_array_equal(last[CURRENT : SATURATED + 1], 0.0)
        else:
            np.testing.assert_array_equal(last[CURRENT : SATURATED + 1], physics.data.act[-5:-1])


@pytest.mark.parametrize("kind", [MujocoPhysics, AnalyticPhysics])
def test_the_integration_steps_are_marked_in_which_the_voltage_is_at_its_sagging_limit(kind):
    task, limit, supply_resistance = TASKS["cartpole"], 2.0, 0.8
    loop = CurrentLoop(kp=2.0, max_voltage=limit)
    actuator = Actuator(Motor(arm_radius=0.15), loop, Supply(resistance=supply_resistance))
    physics = kind(Plant(task, [actuator], 3, "euler"))
    _, traces = _traces(physics)
    rows = traces.reshape(-1, traces.shape[-1])
    before = np.append(0.0, rows[:-1, CURRENT])  # the supply sags by the current at the step's start
    available = limit - supply_resistance * np.abs(before)
    expected = np.abs(rows[:, VOLTAGE]) >= available * (1 - 1e-12)
    np.testing.assert_array_equal(rows[:, SATURATED].astype(bool), expected)
    assert 0 < expected.sum() < len(expected)
