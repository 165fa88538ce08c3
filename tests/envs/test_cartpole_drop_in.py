"""CartPole with the ideal actuator is a drop-in replacement for Gymnasium's CartPole-v1."""

import gymnasium
import numpy as np
import pytest

from codrl_mj import make_sb3_vec_env, suite
from codrl_mj.physics import PHYSICS

every_physics = pytest.mark.parametrize("physics", PHYSICS)


def pair(seed=0, **arguments):
    """Make this package's and Gymnasium's environment, both just reset."""
    gymnasium_arguments = {
        name: value for name, value in arguments.items() if name == "sutton_barto_reward"
    }
    ours = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", **arguments)
    theirs = gymnasium.make("CartPole-v1", **gymnasium_arguments)
    theirs.unwrapped.kinematics_integrator = arguments.get("integrator", "euler")
    np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
    np.testing.assert_array_equal(ours.unwrapped.state, theirs.unwrapped.state)
    return ours, theirs


@every_physics
@pytest.mark.parametrize(
    "options", [{}, {"sutton_barto_reward": True}, {"integrator": "semi-implicit"}]
)
def test_random_episodes_equal_gymnasiums(physics, options):
    for seed in range(20):
        ours, theirs = pair(seed, physics=physics, **options)
        terminated, count = False, 0
        for action in np.random.default_rng(seed).integers(0, 2, 500):
            outcome, expected = ours.step(action), theirs.step(action)
            np.testing.assert_allclose(
                ours.unwrapped.state, theirs.unwrapped.state, rtol=0, atol=1e-9
            )
            np.testing.assert_allclose(outcome[0], expected[0], rtol=0, atol=1e-6)
            assert outcome[1:4] == expected[1:4]
            count += 1
            if terminated := outcome[2]:
                break
        assert terminated
        assert 5 < count < 200
        # The next episode must draw the next initial state.
        np.testing.assert_array_equal(ours.reset()[0], theirs.reset()[0])


def test_an_episode_is_truncated_after_five_hundred_steps():
    """Use a policy that stabilizes each environment, so that rounding errors do not grow."""
    for env in pair():
        (x, x_dot, theta, theta_dot), _ = env.reset(seed=0)
        for step in range(1, 501):
            action = int(3 * theta + theta_dot + 0.1 * x + 0.3 * x_dot > 0)
            (x, x_dot, theta, theta_dot), *rest, _ = env.step(action)
            assert rest == [1.0, False, step == 500]


def test_terminations_are_at_gymnasiums_limits():
    ours, theirs = (env.unwrapped for env in pair())
    ends, angle = [], 12 * 2 * np.pi / 360
    for x in (-2.45, -2.39, 0.0, 2.39, 2.45):
        for theta in (-angle - 0.01, -angle + 0.01, 0.0, angle - 0.01, angle + 0.01):
            state = np.array([x, 0.0, theta, 0.0])
            ours.physics.reset(state)
            theirs.state, theirs.steps_beyond_terminated = state, None
            ends.append(ours.step(1)[2])
            assert theirs.step(1)[2] == ends[-1]
    assert 0 < sum(ends) < len(ends)


@every_physics
@pytest.mark.parametrize(
    "options", [{"low": -0.2, "high": 0.2}, {"low": 0.01, "high": 0.02}, {"high": 0.1}, None]
)
def test_reset_options_are_gymnasiums(physics, options):
    ours, theirs = pair(physics=physics)
    for seed in range(20):
        outcome, expected = (
            ours.reset(seed=seed, options=options),
            theirs.reset(seed=seed, options=options),
        )
        np.testing.assert_array_equal(outcome[0], expected[0])


@every_physics
@pytest.mark.parametrize("options", [{"low": 1.0, "high": -1.0}, {"low": "a"}])
def test_bad_reset_options_are_refused_as_by_gymnasium(physics, options):
    for env in pair(physics=physics):
        with pytest.raises(ValueError, match=r"bound|option"):
            env.reset(seed=0, options=options)


# -- rewards --------------------------------------------------------------------------------------


def test_sutton_and_bartos_reward_is_the_same_in_every_interface():
    arguments = {"actuator": "ideal", "sutton_barto_reward": True}
    vec_env = make_sb3_vec_env("codrl_mj/CartPole-v0", 3, **arguments)
    vec_env.seed(0)
    vec_env.reset()
    rewards, ended = np.array(
        [vec_env.step(np.ones(3, dtype=int))[1:3] for _ in range(40)]
    ).swapaxes(0, 1)
    np.testing.assert_array_equal(rewards, -ended)
    assert ended.any(axis=0).all()
    dm_environment = suite.load("cartpole", **arguments)
    dm_environment.reset()
    steps = [dm_environment.step(1)]
    while not steps[-1].last():
        steps.append(dm_environment.step(1))
    assert [step.reward for step in steps] == [0.0] * (len(steps) - 1) + [-1.0]


@every_physics
@pytest.mark.parametrize("x", [-0.2, -0.11, -0.09, 0.0, 0.09, 0.11, 0.2])
def test_there_is_no_reward_outside_the_center_radius_and_the_episode_continues(physics, x):
    for options, inside, outside in (
        ({}, 1.0, 1.0),
        ({"center_radius": 0.1}, 1.0, 0.0),
        ({"center_radius": 0.1, "sutton_barto_reward": True}, 0.0, -1.0),
    ):
        env = gymnasium.make("codrl_mj/CartPole-v0", physics=physics, **options)
        env.reset(seed=0)
        env.unwrapped.physics.reset(np.array([x, 0.0, 0.0, 0.0]))
        assert env.step(1)[1:3] == (inside if abs(x) < 0.1 else outside, False)
