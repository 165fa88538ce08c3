"""Bounds within a step: walls, and diverged states that must stay visible."""

import dataclasses

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationConfig
from codrl_mj.physics.compiled_task import compiled_constrain
from codrl_mj.tasks import TASKS
from tests.tasks.faces import NEW, WITH_HILL, random_states


@pytest.mark.parametrize("task", NEW)
def test_a_step_from_beyond_all_bounds_equals_gymnasiums(task):
    definition = TASKS[task]
    arguments = definition, [IDEAL], 1, definition.integrators[0]
    pair = (
        MujocoPhysics(SimulationConfig(*arguments)),
        AnalyticPhysics(SimulationConfig(*arguments)),
    )
    forces = np.random.default_rng(1).uniform(-1, 1, 1000) * definition.max_force
    for state, force in zip(random_states(task, 0, 1000), forces, strict=True):
        for physics in pair:
            physics.reset(state)
            physics.step(force)
        np.testing.assert_allclose(*(physics.state for physics in pair), rtol=0, atol=1e-10)


@pytest.mark.parametrize("task", WITH_HILL)
@pytest.mark.parametrize("inner_steps", [1, 20])
@pytest.mark.parametrize(
    ("state", "wall", "stops"),
    [
        # The left wall is inelastic.
        ([-1.19, -0.07], -1.2, True),
        # The right end stops the car, but its speed stays.
        ([0.59, 0.07], 0.6, False),
    ],
)
def test_walls(task, inner_steps, state, wall, stops):
    definition = TASKS[task]
    short_task = dataclasses.replace(
        definition, step_duration=definition.step_duration / inner_steps
    )
    physics = MujocoPhysics(SimulationConfig(short_task, [IDEAL], 1, "semi-implicit"))
    physics.reset(np.array(state))
    for _ in range(inner_steps):
        physics.step(np.sign(state[1]) * definition.max_force)
        if physics.state[0] == wall:
            break
    assert physics.state[0] == wall
    assert physics.state[1] == 0.0 if stops else physics.state[1] > 0.0


@pytest.mark.parametrize("value", [0.9e10, np.nan, np.inf, -np.inf, 1.01e10])
@pytest.mark.parametrize("task", NEW)
def test_bounds_do_not_hide_a_diverged_state(task, value):
    """The compiled bounds turn it into NaN; 0.9e10 is large, but the engine accepts it."""
    definition = TASKS[task]
    order = tuple(definition.qpos), tuple(definition.qvel)
    keep = compiled_constrain(definition.constrain, definition.state_names, *order)
    for state in np.where(np.eye(len(definition.state_names)), value, 0.0):
        bounded = state[list(definition.qpos)], state[list(definition.qvel)]
        keep(*bounded, np.empty_like(state), 0.1)
        # The difference inf - inf is invalid.
        with np.errstate(invalid="ignore"):
            plain = np.array(definition.constrain(state, 0.1))
        for part, entries in zip(bounded, order, strict=True):
            expected = plain[list(entries)] if value == 0.9e10 else np.full(len(entries), np.nan)
            np.testing.assert_array_equal(part, expected)
        assert np.isnan(plain[np.isnan(state)]).all()
