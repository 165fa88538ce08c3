"""With the ideal actuator an environment is Gymnasium's: same starts, states, rewards and ends."""

import gymnasium as gym
import numpy as np
import pytest

from codrl_mj.tasks import TASKS
from tests.tasks.faces import NEW, actions, every_rebuilt, gymnasiums, ours

SEEDS = range(6)


def _episode(task, seed, choose, steps=None):
    """Both environments' states, rewards and ends, with the same actions, to the end of Gymnasium's episode.

    Returns:
        arrays (ours, Gymnasium's) of states (steps + 1, n), rewards (steps,), (terminated, truncated) (steps, 2)
    """
    pair = ours(task, actuator="ideal"), gymnasiums(task)
    observations = [env.reset(seed=seed)[0] for env in pair]
    np.testing.assert_allclose(*observations, rtol=0, atol=1e-7)
    states = [[np.array(env.unwrapped.state, dtype=np.float64)] for env in pair]
    rewards, ends = ([], []), ([], [])
    for step in range(steps or pair[1].spec.max_episode_steps):
        action = choose(step, states[1][-1])
        for index, env in enumerate(pair):
            observation, reward, terminated, truncated, _ = env.step(action)
            assert observation in env.observation_space
            states[index].append(np.array(env.unwrapped.state, dtype=np.float64))
            rewards[index].append(reward)
            ends[index].append((terminated, truncated))
        if any(ends[0][-1]) or any(ends[1][-1]):
            break
    return [tuple(map(np.array, both)) for both in (states, rewards, ends)]


def _compare(task, seed, choose, states_to, steps=None):
    states, rewards, ends = _episode(task, seed, choose, steps)
    np.testing.assert_array_equal(states[0][0], states[1][0])
    np.testing.assert_allclose(*states, rtol=0, atol=states_to)
    np.testing.assert_array_equal(*ends)
    if isinstance(TASKS[task].action_space, gym.spaces.Discrete):
        np.testing.assert_array_equal(*rewards)
    else:
        np.testing.assert_allclose(*rewards, rtol=0, atol=100 * states_to)
    return ends[0][-1]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("task", "dtype", "states_to", "steps"),
    [
        ("pendulum", np.float64, 1e-9, None),
        # Gymnasium computes in float32 with such actions; passing near upright (unstable) magnifies the 1e-8 of a step
        ("pendulum", np.float32, 1e-5, 100),
        ("pendulum", np.float32, 2e-4, None),
        ("acrobot", None, 1e-6, 100),  # chaotic
        ("mountain_car", None, 1e-9, None),
        ("mountain_car_continuous", np.float64, 1e-5, None),  # Gymnasium rounds its state to float32
        ("mountain_car_continuous", np.float32, 1e-5, None),
    ],
)
def test_random_actions_to_the_end_of_the_episode(task, dtype, states_to, steps, seed):
    drawn = actions(task, seed, TASKS[task].max_episode_steps, dtype)
    end = _compare(task, seed, lambda step, _: drawn[step], states_to, steps)
    assert end.any() or steps is not None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("task", "states_to"), [("mountain_car", 1e-9), ("mountain_car_continuous", 1e-5)])
def test_an_episode_that_reaches_the_goal(task, states_to, seed):
    def pump(step, state):
        push = 1 if state[1] >= 0 else -1
        return push + 1 if task == "mountain_car" else np.array([float(push)])

    end = _compare(task, seed, pump, states_to)
    np.testing.assert_array_equal(end, (True, False))


def test_acrobot_reaches_the_goal_with_gymnasium():
    """From a start near the goal, where chaos has no time to act."""
    pair = ours("acrobot", actuator="ideal"), gymnasiums("acrobot")
    start = np.array([0.4, 0.2, 5.5, 0.0])
    rewards = []
    for env in pair:
        env.reset(seed=0)
    pair[0].unwrapped.physics.reset(start)
    pair[1].unwrapped.state = start
    for _ in range(10):
        results = [env.step(2) for env in pair]
        rewards.append([result[1] for result in results])
        assert results[0][2] == results[1][2]
        if results[0][2]:
            break
    assert results[0][2]
    assert rewards[0] == [-1.0, -1.0]
    np.testing.assert_array_equal(*np.transpose(rewards))
    assert rewards[-1] == [0.0, 0.0]


@every_rebuilt
def test_spaces_and_limits_are_gymnasiums(task):
    env, reference = ours(task), gymnasiums(task)
    assert env.action_space == reference.action_space
    assert env.observation_space == reference.observation_space
    assert env.metadata["render_fps"] == reference.metadata["render_fps"]
    assert env.spec.max_episode_steps == reference.spec.max_episode_steps
    assert env.spec.reward_threshold == reference.spec.reward_threshold


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("pendulum", {"x_init": 0.5, "y_init": 0.2}),
        ("pendulum", {"y_init": 3}),
        ("acrobot", {"low": -1.0, "high": 2.0}),
        ("mountain_car", {"low": -0.7, "high": 0.5}),
        ("mountain_car_continuous", {"low": -0.55}),
    ],
)
def test_reset_options_draw_what_gymnasium_draws(task, options):
    env, reference = ours(task), gymnasiums(task)
    for seed in range(5):
        env.reset(seed=seed, options=options)
        reference.reset(seed=seed, options=options)
        np.testing.assert_array_equal(env.unwrapped.state, reference.unwrapped.state)


@pytest.mark.parametrize(("task", "name"), [("pendulum", "x_init"), ("acrobot", "low"), ("mountain_car", "high")])
def test_reset_options_are_checked_as_gymnasium_checks_them(task, name):
    with pytest.raises(ValueError, match="could not be converted to a float"):
        ours(task).reset(options={name: "wide"})


@pytest.mark.parametrize("task", NEW)
def test_the_goal_ends_every_episode_but_the_pendulums(task):
    reachable = {"acrobot": [np.pi, 0, 0, 0], "mountain_car": [0.5, 0.0], "mountain_car_continuous": [0.45, 0.0]}
    assert TASKS[task].terminated(np.array(reachable.get(task, [0.0, 0.0]))) == (task in reachable)
