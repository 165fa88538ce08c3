"""With the ideal actuator an environment equals Gymnasium's: starts, states, rewards, ends."""

import gymnasium as gym
import numpy as np
import pytest

from codrl_mj.tasks import TASKS
from tests.tasks.faces import actions, every_rebuilt, gymnasiums, ours, random_states


def compare(task, seed, choose, states_to, steps=None):
    """Run both environments with the same actions; return how Gymnasium's episode ended."""
    pair = ours(task, actuator="ideal"), gymnasiums(task)
    observations = [env.reset(seed=seed)[0] for env in pair]
    np.testing.assert_allclose(*observations, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(*(env.unwrapped.state for env in pair))
    rewards_to = 0 if isinstance(TASKS[task].action_space, gym.spaces.Discrete) else 100 * states_to
    for step in range(steps or pair[1].spec.max_episode_steps):
        action = choose(step, pair[1].unwrapped.state)
        (observation, reward, *ends, _), (_, expected, *expected_ends, _) = (
            env.step(action) for env in pair
        )
        assert observation in pair[0].observation_space
        np.testing.assert_allclose(*(env.unwrapped.state for env in pair), rtol=0, atol=states_to)
        assert reward == pytest.approx(expected, rel=0, abs=rewards_to)
        assert ends == expected_ends
        if any(ends):
            break
    return ends


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("task", "dtype", "states_to", "steps"),
    [
        ("pendulum", np.float64, 1e-9, None),
        # Gymnasium computes in float32 with such actions; passing near upright (unstable) magnifies
        # the 1e-8 of a step
        ("pendulum", np.float32, 1e-5, 100),
        ("pendulum", np.float32, 2e-4, None),
        ("acrobot", None, 1e-6, 100),  # chaotic
        ("mountain_car", None, 1e-9, None),
        (
            "mountain_car_continuous",
            np.float64,
            1e-5,
            None,
        ),  # Gymnasium rounds its state to float32
        ("mountain_car_continuous", np.float32, 1e-5, None),
    ],
)
def test_random_actions_to_the_end_of_the_episode(task, dtype, states_to, steps, seed):
    drawn = actions(task, seed, TASKS[task].max_episode_steps, dtype)
    ends = compare(task, seed, lambda step, _: drawn[step], states_to, steps)
    assert any(ends) or steps


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("task", "states_to"), [("mountain_car", 1e-9), ("mountain_car_continuous", 1e-5)]
)
def test_an_episode_that_reaches_the_goal(task, states_to, seed):
    def pump(step, state):
        push = 1 if state[1] >= 0 else -1
        return push + 1 if task == "mountain_car" else np.array([float(push)])

    assert compare(task, seed, pump, states_to) == [True, False]


@every_rebuilt
def test_reward_and_end_equal_gymnasiums_in_the_whole_state_space(task):
    pair, terminations = (ours(task, actuator="ideal").unwrapped, gymnasiums(task).unwrapped), []
    for env in pair:
        env.reset(seed=0)
    for state, action in zip(random_states(task, 0, 1000), actions(task, 0, 1000), strict=True):
        pair[0].physics.reset(state)
        pair[1].state, pair[1].steps_beyond_terminated = state, None
        (_, reward, terminated, *_), (_, expected, end, *_) = (env.step(action) for env in pair)
        assert terminated == end
        assert reward == pytest.approx(
            expected, rel=0, abs=1e-5 if task == "mountain_car_continuous" else 1e-9
        )
        terminations.append(terminated)
    assert task == "pendulum" or 0 < sum(terminations) < len(terminations)


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
def test_reset_options_give_gymnasiums_initial_states(task, options):
    env, reference = ours(task), gymnasiums(task)
    for seed in range(5):
        env.reset(seed=seed, options=options)
        reference.reset(seed=seed, options=options)
        np.testing.assert_array_equal(env.unwrapped.state, reference.unwrapped.state)


@pytest.mark.parametrize(
    ("task", "name"), [("pendulum", "x_init"), ("acrobot", "low"), ("mountain_car", "high")]
)
def test_reset_options_are_checked_as_gymnasium_checks_them(task, name):
    with pytest.raises(ValueError, match="could not be converted to a float"):
        ours(task).reset(options={name: "wide"})


@every_rebuilt
def test_every_task_is_registered_with_limits_and_spaces_of_the_environment_it_rebuilds(task):
    rebuilt, original = ours(task, actuator="ideal"), gymnasiums(task)
    assert rebuilt.spec.max_episode_steps == original.spec.max_episode_steps
    assert rebuilt.spec.reward_threshold == original.spec.reward_threshold
    assert rebuilt.action_space == original.action_space
    assert rebuilt.observation_space == original.observation_space
    render_fps = original.unwrapped.metadata["render_fps"]
    assert rebuilt.unwrapped.metadata["render_fps"] == render_fps
