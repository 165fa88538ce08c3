"""What counts as an action, and the force that it asks for."""

import numpy as np
import pytest

from codrl_mj.tasks import TASKS
from tests.tasks.faces import ours

LIMITS = {"pendulum": 2.0, "mountain_car_continuous": 1.0}
LEVELS = {"cartpole": [-10, 10], "acrobot": [-1, 0, 1], "mountain_car": [-1, 0, 1]}


@pytest.mark.parametrize("task", LEVELS)
def test_discrete_actions_choose_a_force(task):
    actions = np.arange(len(LEVELS[task]))
    env = ours(task, actuator="ideal")
    forces = env.unwrapped.setup.commands.forces(actions)
    np.testing.assert_array_equal(forces, LEVELS[task])
    assert forces.dtype == np.float64
    env.reset(seed=0)
    for action in actions:
        assert env.step(action)[4]["desired_force"] == LEVELS[task][action]


@pytest.mark.parametrize("task", LIMITS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_continuous_actions_saturate(task, dtype):
    limit = LIMITS[task]
    given = np.array([[-np.inf], [-3.0], [-0.5], [0.25], [limit], [3.0]], dtype=dtype)
    expected = [-limit, -limit, -0.5, 0.25, limit, limit]
    env = ours(task, actuator="ideal")
    forces = env.unwrapped.setup.commands.forces(given)
    np.testing.assert_array_equal(forces, expected)
    assert forces.dtype == np.float64
    env.reset(seed=0)
    for action, force in zip(given, expected, strict=True):
        assert env.step(action)[4]["desired_force"] == force


@pytest.mark.parametrize("task", LIMITS)
@pytest.mark.parametrize(
    "action",
    [np.array([np.nan]), np.array(0.5), np.zeros(2), np.zeros((1, 1)), np.array([1]), np.array(["1"]), 0.5, None],
)
def test_what_is_no_continuous_action(task, action):
    env = ours(task)
    env.reset(seed=0)
    state = env.unwrapped.state
    with pytest.raises(ValueError, match=r"^action = .*: not in Box"):
        env.step(action)
    np.testing.assert_array_equal(env.unwrapped.state, state)


@pytest.mark.parametrize("task", LEVELS)
@pytest.mark.parametrize("action", [-1, 3, 0.5, None, np.array([0])])
def test_what_is_no_discrete_action(task, action):
    env = ours(task)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^action = .*: not in Discrete"):
        env.step(action)


@pytest.mark.parametrize("task", LIMITS)
def test_the_reward_charges_the_force_that_was_delivered(task):
    definition = TASKS[task]
    weight = {"pendulum": 0.001, "mountain_car_continuous": 0.1}[task]
    env = ours(task, actuator="weaker")
    env.reset(seed=0)
    action = np.array([LIMITS[task]])
    for _ in range(3):
        before = env.unwrapped.state
        _, reward, _, _, info = env.step(action)
        rest = definition.reward(before, 0.0, env.unwrapped.state, definition.options())
        assert reward == pytest.approx(rest - weight * info["actual_force"] ** 2, rel=1e-12)
        assert abs(info["actual_force"] - LIMITS[task]) > 1e-3


@pytest.mark.parametrize("task", TASKS)
def test_a_batch_of_states_is_many_single_states(task):
    definition = TASKS[task]
    generator = np.random.default_rng(0)
    before, after = generator.uniform(-1, 1, (2, 7, len(definition.state_names)))
    forces, options = generator.uniform(-1, 1, 7), definition.options()
    together = (
        np.stack(definition.observation(after.T), axis=1),
        np.broadcast_to(definition.terminated(after.T), 7),
        np.broadcast_to(definition.reward(before.T, forces, after.T, options), 7),
    )
    for index in range(7):
        alone = (
            definition.observation(after[index]),
            definition.terminated(after[index]),
            definition.reward(before[index], forces[index], after[index], options),
        )
        for batch, single in zip(together, alone, strict=True):
            np.testing.assert_allclose(batch[index], single, rtol=1e-15, atol=0)
