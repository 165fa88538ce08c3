"""Valid actions, their desired forces, and the cost of these forces."""

import itertools

import numpy as np
import pytest

from codrl_mj.tasks import TASKS
from tests.tasks.faces import ours

LIMITS = {"pendulum": 2.0, "mountain_car_continuous": 1.0}
LEVELS = {"cartpole": [-10, 10], "acrobot": [-1, 0, 1], "mountain_car": [-1, 0, 1]}
BEYOND = [[-np.inf], [-3.0], [-0.5], [0.25], [3.0]]
GIVEN = [
    # Task, actions, and their desired forces: levels, or the action within the limits.
    *((task, np.arange(len(levels)), levels) for task, levels in LEVELS.items()),
    *(
        (task, np.array(BEYOND, dtype), [-limit, -limit, -0.5, 0.25, limit])
        for (task, limit), dtype in itertools.product(LIMITS.items(), (np.float32, np.float64))
    ),
]
NOT_CONTINUOUS = [
    np.array([np.nan]),
    np.array(0.5),
    np.zeros(2),
    np.zeros((1, 1)),
    np.array([1]),
    np.array(["1"]),
]
NONE = [
    *itertools.product(LIMITS, ["Box"], [*NOT_CONTINUOUS, 0.5, None]),
    *itertools.product(LEVELS, ["Discrete"], [-1, 3, 0.5, None, np.array([0])]),
]


@pytest.mark.parametrize(("task", "actions", "expected"), GIVEN)
def test_an_action_has_a_desired_force(task, actions, expected):
    env = ours(task, actuator="ideal")
    forces = env.unwrapped.setup.commands.forces(actions)
    np.testing.assert_array_equal(forces, expected)
    assert forces.dtype == np.float64
    env.reset(seed=0)
    assert [env.step(action)[4]["desired_force"] for action in actions] == expected


@pytest.mark.parametrize(("task", "space", "action"), NONE)
def test_an_invalid_action_raises_and_changes_nothing(task, space, action):
    env = ours(task)
    env.reset(seed=0)
    state = env.unwrapped.state
    with pytest.raises(ValueError, match=rf"^action = .*: not in {space}"):
        env.step(action)
    np.testing.assert_array_equal(env.unwrapped.state, state)


@pytest.mark.parametrize(
    ("task", "weight"), [("pendulum", 0.001), ("mountain_car_continuous", 0.1)]
)
def test_the_reward_has_the_cost_of_the_delivered_force(task, weight):
    definition, env = TASKS[task], ours(task, actuator="weaker")
    env.reset(seed=0)
    for _ in range(3):
        before = env.unwrapped.state
        _, reward, _, _, info = env.step(np.array([LIMITS[task]]))
        rest = definition.reward(before, 0.0, env.unwrapped.state, definition.options())
        assert reward == pytest.approx(rest - weight * info["actual_force"] ** 2, rel=1e-12)
        assert abs(info["actual_force"] - LIMITS[task]) > 1e-3


@pytest.mark.parametrize("task", TASKS)
def test_functions_give_the_same_for_batches_and_single_states(task):
    definition, generator = TASKS[task], np.random.default_rng(0)
    before, after = generator.uniform(-1, 1, (2, 7, len(definition.state_names)))
    forces = generator.uniform(-1, 1, 7)

    def returned(before, force, after):
        reward = definition.reward(before, force, after, definition.options())
        return np.stack(definition.observation(after)), definition.terminated(after), reward

    for batch, *rows in zip(
        returned(before.T, forces, after.T), *map(returned, before, forces, after), strict=True
    ):
        each = np.broadcast_to(np.transpose(batch), np.shape(rows))
        np.testing.assert_allclose(each, rows, rtol=1e-15, atol=0)
