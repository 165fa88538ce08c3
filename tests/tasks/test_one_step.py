"""One MuJoCo step is one Gymnasium step, over random states and forces."""

import dataclasses

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, Plant
from codrl_mj.physics.compiled_task import compiled_constrain
from codrl_mj.tasks import TASKS
from tests.tasks.faces import NEW, SPEED_LIMITED, actions, desired_force, gymnasiums, random_states

COUNT = 2000


def _largest_error(task, inner_steps, states, forces):
    definition = TASKS[task]
    arguments = definition, [IDEAL], inner_steps, definition.integrators[0]
    simulated, analytic = MujocoPhysics(Plant(*arguments)), AnalyticPhysics(Plant(*arguments))
    largest = 0.0
    for state, force in zip(states, forces, strict=True):
        for physics in (simulated, analytic):
            physics.reset(state)
            physics.step(force)
        largest = max(largest, np.abs(simulated.state - analytic.state).max())
    return largest


def _forces(task, count):
    return np.random.default_rng(1).uniform(-1, 1, count) * TASKS[task].max_force


def test_any_torque_from_any_state_of_acrobot():
    """At full speed a step of 0.2 s magnifies rounding errors.

    The second link then turns by 5 rad, and RK4 reaches speeds of 3000 rad/s before they are clipped. With ten steps of
    0.02 s, 1e-12 holds everywhere (`test_inner_steps`).
    """
    states = random_states("acrobot", 0, COUNT)
    assert _largest_error("acrobot", 1, states, _forces("acrobot", COUNT)) <= 1e-10


@pytest.mark.parametrize("task", NEW)
def test_inner_steps(task):
    inner = max(TASKS[task].motor_inner_steps, 2)
    count = COUNT // inner
    assert _largest_error(task, inner, random_states(task, 2, count), _forces(task, count)) <= 1e-12


@pytest.mark.parametrize("task", ["pendulum", "acrobot", "mountain_car"])
def test_actions_of_an_untouched_environment(task):
    """Nothing but Gymnasium's own `step`: no driver of ours."""
    states = random_states(task, 3, COUNT)
    if task == "acrobot":
        states *= [1, 1, 0.75, 0.75]
    definition, reference = TASKS[task], gymnasiums(task).unwrapped
    physics = MujocoPhysics(Plant(definition, [IDEAL], 1, definition.integrators[0]))
    reference.reset(seed=0)
    for state, action in zip(states, actions(task, 4, COUNT), strict=True):
        physics.reset(state)
        physics.step(desired_force(task, action))
        reference.state = state
        reference.step(action)
        np.testing.assert_allclose(physics.state, reference.state, rtol=0, atol=1e-12)


def test_the_continuous_mountain_car_to_the_precision_that_gymnasium_keeps():
    task = "mountain_car_continuous"
    definition, reference = TASKS[task], gymnasiums(task).unwrapped
    physics = MujocoPhysics(Plant(definition, [IDEAL], 1, definition.integrators[0]))
    reference.reset(seed=0)
    for state, action in zip(random_states(task, 5, COUNT), actions(task, 6, COUNT), strict=True):
        physics.reset(state)
        physics.step(desired_force(task, action))
        reference.state = state
        reference.step(action)
        np.testing.assert_array_equal(physics.state.astype(np.float32), reference.state)


@pytest.mark.parametrize("task", NEW)
def test_the_random_states_reach_every_bound(task):
    """Guards the tests above: without `constrain` they must notice."""
    definition = TASKS[task]
    _, high = np.array(SPEED_LIMITED[task])
    assert (random_states(task, 0, 1000).max(axis=0) > 0.9 * high).all()
    unbounded = dataclasses.replace(definition, constrain=None)
    physics = MujocoPhysics(Plant(unbounded, [IDEAL], 1, definition.integrators[0]))
    analytic = AnalyticPhysics(Plant(definition, [IDEAL], 1, definition.integrators[0]))
    different = 0
    for state in random_states(task, 0, 1000):
        for one in (physics, analytic):
            one.reset(state)
            one.step(definition.max_force)
        different += np.abs(physics.state - analytic.state).max() > 1e-6
    assert different >= 20


@pytest.mark.parametrize("task", ["mountain_car", "mountain_car_continuous"])
@pytest.mark.parametrize("inner_steps", [1, 20])
@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ([-1.19, -0.07], [-1.2, 0.0]),  # inelastic
        ([0.59, 0.07], [0.6, None]),  # the right end stops the car, not its speedometer
    ],
)
def test_walls(task, inner_steps, state, expected):
    definition = TASKS[task]
    one = dataclasses.replace(definition, step_duration=definition.step_duration / inner_steps)
    physics = MujocoPhysics(Plant(one, [IDEAL], 1, "semi-implicit"))
    physics.reset(np.array(state))
    for _ in range(inner_steps):
        physics.step(np.sign(state[1]) * definition.max_force)
        if physics.state[0] == expected[0]:
            break
    assert physics.state[0] == expected[0]
    assert physics.state[1] == expected[1] or (expected[1] is None and physics.state[1] > 0)


@pytest.mark.parametrize("task", NEW)
def test_bounds_let_a_diverged_state_through(task):
    definition = TASKS[task]
    order = tuple(definition.qpos), tuple(definition.qvel)
    keep = compiled_constrain(definition.constrain, definition.state_names, *order)
    for entry in range(len(definition.state_names)):
        for value in (0.9e10, np.nan, np.inf, -np.inf, 1.01e10):
            state = np.zeros(len(definition.state_names))
            state[entry] = value
            qpos, qvel = state[list(definition.qpos)], state[list(definition.qvel)]
            keep(qpos, qvel, np.empty_like(state), 0.1)
            with np.errstate(invalid="ignore"):  # inf - inf
                plain = np.array(definition.constrain(state, 0.1))
            if value == 0.9e10:  # large, but a number that the engine takes
                np.testing.assert_array_equal(qpos, plain[list(definition.qpos)])
                np.testing.assert_array_equal(qvel, plain[list(definition.qvel)])
                continue
            assert np.isnan(qpos).all()  # compiled, nothing of it passes for a state
            assert np.isnan(qvel).all()
            if np.isnan(value):
                assert np.isnan(plain[entry])
