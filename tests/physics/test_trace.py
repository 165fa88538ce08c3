"""The trace of the integration steps within an environment step."""

import numpy as np
import pytest

from codrl_mj.disturbances import Disturbances
from codrl_mj.motor import Actuator, CurrentLoop, Motor, advance, named_actuator, to_vector
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics
from codrl_mj.physics.base import (
    TRACE_ACTUAL_FORCE,
    TRACE_CURRENT,
    TRACE_DESIRED_FORCE,
    TRACE_SATURATED,
    TRACE_SPEED,
    TRACE_VOLTAGE,
)
from codrl_mj.tasks import TASKS

STEPS = 20


def _physics(kind, task, actuator="paper", **more):
    definition = TASKS[task]
    motor = None if actuator == "ideal" else named_actuator(actuator, task)
    inner_steps = max(3, definition.motor_inner_steps)
    physics = kind(definition, motor, inner_steps, definition.integrators[0], **more)
    physics.reset(np.full(len(definition.state_names), 0.05))
    return physics


def _traces(physics, seed=0):
    forces = np.random.default_rng(seed).uniform(-1, 1, STEPS) * physics.task.max_force
    return forces, np.array([(physics.step(float(force)), physics.trace.copy())[1] for force in forces])


@pytest.mark.parametrize("kind", [MujocoPhysics, AnalyticPhysics])
@pytest.mark.parametrize("task", TASKS)
def test_every_row_follows_from_the_row_before_by_the_loops_own_equations(kind, task):
    physics = _physics(kind, task)
    speed_at_start = 0.05
    forces, traces = _traces(physics)
    actuator, vector = physics.actuator, to_vector(physics.actuator)
    arm, timestep = actuator.motor.arm_radius, physics.task.step_duration / physics.inner_steps
    loop, speed = (0.0, 0.0, 0.0), speed_at_start
    for force, trace in zip(forces, traces, strict=True):
        assert trace.shape == (physics.inner_steps, 6)
        for row in trace:
            *loop, voltage = advance(vector, timestep, *loop, force * arm, speed / arm)
            assert row[TRACE_DESIRED_FORCE] == force
            np.testing.assert_allclose(row[[TRACE_CURRENT, TRACE_VOLTAGE]], [loop[0], voltage], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(
                row[TRACE_ACTUAL_FORCE], actuator.motor.torque_constant * row[TRACE_CURRENT] / arm, rtol=1e-12
            )
            loop, speed = (row[TRACE_CURRENT], *loop[1:]), row[TRACE_SPEED]


@pytest.mark.parametrize("actuator", ["ideal", "weak"])
@pytest.mark.parametrize("task", TASKS)
def test_the_last_row_is_what_the_step_says_of_its_end(task, actuator):
    physics = _physics(MujocoPhysics, task, actuator)
    for _ in range(STEPS):
        signals, last = physics.step(0.5 * physics.task.max_force), physics.trace[-1]
        assert (signals.desired_force, signals.actual_force, signals.current, signals.voltage) == tuple(last[:4])
        assert last[TRACE_SATURATED] == signals.saturated
        assert last[TRACE_SPEED] == physics.data.qvel[physics.model.actuator("motor").trnid[0]]


@pytest.mark.parametrize("task", TASKS)
def test_both_physics_leave_the_same_trace(task):
    disturbances = Disturbances(command_delay=physics_step(task) * 1.5, command_rate=20.0)
    pair = [_physics(kind, task, disturbances=disturbances) for kind in (MujocoPhysics, AnalyticPhysics)]
    (forces, ours), (_, theirs) = (_traces(physics) for physics in pair)
    np.testing.assert_allclose(ours[:8], theirs[:8], rtol=0, atol=1e-9)
    delayed = ours[:, :, TRACE_DESIRED_FORCE]
    assert not (delayed == forces[:, np.newaxis]).all(), "the command arrives as it was given"


def physics_step(task):
    """The integration step [s] of the physics above."""
    definition = TASKS[task]
    return definition.step_duration / max(3, definition.motor_inner_steps)


@pytest.mark.parametrize("kind", [MujocoPhysics, AnalyticPhysics])
def test_the_integration_steps_are_marked_in_which_the_voltage_is_at_its_sagging_limit(kind):
    task, limit, supply_resistance = TASKS["cartpole"], 2.0, 0.8
    actuator = Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=2.0, max_voltage=limit))
    disturbances = Disturbances(supply_resistance=supply_resistance)
    physics = kind(task, actuator, 3, "euler", disturbances=disturbances)
    _, traces = _traces(physics)
    rows = traces.reshape(-1, traces.shape[-1])
    before = np.append(0.0, rows[:-1, TRACE_CURRENT])  # the supply sags by the current at the step's start
    available = limit - supply_resistance * np.abs(before)
    expected = np.abs(rows[:, TRACE_VOLTAGE]) >= available * (1 - 1e-12)
    np.testing.assert_array_equal(rows[:, TRACE_SATURATED].astype(bool), expected)
    assert 0 < expected.sum() < len(expected)
