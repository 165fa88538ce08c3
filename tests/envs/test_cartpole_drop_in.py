"""CartPole with the ideal actuator is a drop-in for Gymnasium's CartPole-v1."""

import gymnasium
import numpy as np
import pytest

from codrl_mj import make_sb3_vec_env, suite
from codrl_mj.physics import PHYSICS

SEEDS = range(20)


@pytest.fixture(params=PHYSICS)
def pair(request):
    return gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", physics=request.param), gymnasium.make(
        "CartPole-v1"
    )


def _compare(pair, actions):
    """Step both until they end; returns the number of steps and how it ended."""
    ours, theirs = pair
    for count, action in enumerate(actions, start=1):
        found, expected = ours.step(action), theirs.step(action)
        np.testing.assert_allclose(ours.unwrapped.state, theirs.unwrapped.state, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=1e-6)
        assert found[0].dtype == expected[0].dtype
        assert found[1:4] == expected[1:4]
        if found[2] or found[3]:
            return count, found[2], found[3]
    return len(actions), False, False


@pytest.mark.parametrize("seed", SEEDS)
def test_random_episodes_are_gymnasiums(pair, seed):
    ours, theirs = pair
    np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
    np.testing.assert_array_equal(ours.unwrapped.state, theirs.unwrapped.state)
    actions = np.random.default_rng(seed).integers(0, 2, 500)
    count, terminated, _ = _compare(pair, actions)
    assert terminated
    assert 5 < count < 200
    # and the next episode draws the next initial state
    np.testing.assert_array_equal(ours.reset()[0], theirs.reset()[0])


def test_an_episode_is_truncated_after_five_hundred_steps():
    """A policy that each environment closes by itself, so that rounding errors do not grow."""
    for env in (gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal"), gymnasium.make("CartPole-v1")):
        (x, x_dot, theta, theta_dot), _ = env.reset(seed=0)
        total = 0.0
        for step in range(1, 501):
            action = int(3 * theta + theta_dot + 0.1 * x + 0.3 * x_dot > 0)
            (x, x_dot, theta, theta_dot), reward, terminated, truncated, _ = env.step(action)
            total += reward
            assert not terminated
            assert truncated == (step == 500)
        assert total == 500.0


@pytest.mark.parametrize("physics", PHYSICS)
def test_sutton_and_bartos_reward_is_gymnasiums(physics):
    theirs = gymnasium.make("CartPole-v1", sutton_barto_reward=True)
    ours = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", physics=physics, sutton_barto_reward=True)
    for env in (ours, theirs):
        env.reset(seed=5)
    count, terminated, _ = _compare((ours, theirs), [1] * 500)  # rewards included
    assert terminated
    assert count > 5


def test_sutton_and_bartos_reward_is_the_same_in_every_face():
    arguments = {"actuator": "ideal", "sutton_barto_reward": True}
    many = make_sb3_vec_env("codrl_mj/CartPole-v0", 3, **arguments)
    many.seed(0)
    many.reset()
    rewards, ended = np.array([many.step(np.ones(3, dtype=int))[1:3] for _ in range(40)]).swapaxes(0, 1)
    np.testing.assert_array_equal(rewards, -ended)
    assert ended.any(axis=0).all()
    theirs = suite.load("cartpole", **arguments)
    theirs.reset()
    steps = [theirs.step(1)]
    while not steps[-1].last():
        steps.append(theirs.step(1))
    assert [step.reward for step in steps] == [0.0] * (len(steps) - 1) + [-1.0]


def test_a_step_outside_the_radius_counts_as_a_failure():
    env = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", sutton_barto_reward=True, center_radius=0.1)
    env.reset(seed=0)
    env.unwrapped.state = [0.0, 2.0, 0.0, 0.0]  # 0.04 m a step
    assert [env.step(step % 2)[1] for step in range(4)] == [0.0, 0.0, -1.0, -1.0]


@pytest.mark.parametrize("options", [{"low": -0.2, "high": 0.2}, {"low": 0.01, "high": 0.02}, {"high": 0.1}, None])
def test_reset_options_are_gymnasiums(pair, options):
    ours, theirs = pair
    for seed in SEEDS:
        found, expected = ours.reset(seed=seed, options=options), theirs.reset(seed=seed, options=options)
        np.testing.assert_array_equal(found[0], expected[0])


@pytest.mark.parametrize("options", [{"low": 1.0, "high": -1.0}, {"low": "a"}])
def test_bad_reset_options_are_refused_as_by_gymnasium(pair, options):
    for env in pair:
        with pytest.raises(ValueError, match=r"bound|option"):
            env.reset(seed=0, options=options)


def test_the_semi_implicit_integrator_is_gymnasiums():
    ours = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", integrator="semi-implicit")
    theirs = gymnasium.make("CartPole-v1")
    theirs.unwrapped.kinematics_integrator = "semi-implicit"
    ours.reset(seed=3)
    theirs.reset(seed=3)
    assert _compare((ours, theirs), np.random.default_rng(3).integers(0, 2, 500))[1]


def test_terminations_are_at_gymnasiums_limits():
    ours, theirs = (
        gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal").unwrapped,
        gymnasium.make("CartPole-v1").unwrapped,
    )
    ours.reset(seed=0)
    theirs.reset(seed=0)
    ends = []
    angle = 12 * 2 * np.pi / 360
    for x in (-2.45, -2.39, 0.0, 2.39, 2.45):
        for theta in (-angle - 0.01, -angle + 0.01, 0.0, angle - 0.01, angle + 0.01):
            state = np.array([x, 0.0, theta, 0.0])
            ours.physics.reset(state)
            theirs.state, theirs.steps_beyond_terminated = state, None
            found, expected = ours.step(1), theirs.step(1)
            assert found[2] == expected[2]
            ends.append(found[2])
    assert 0 < sum(ends) < len(ends)


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("x", [-0.2, -0.11, -0.09, 0.0, 0.09, 0.11, 0.2])
def test_nothing_is_earned_outside_the_centre_radius_and_the_episode_goes_on(physics, x):
    env = gymnasium.make("codrl_mj/CartPole-v0", physics=physics, center_radius=0.1)
    env.reset(seed=0)
    env.unwrapped.physics.reset(np.array([x, 0.0, 0.0, 0.0]))
    _, reward, terminated, _, _ = env.step(1)
    assert reward == (1.0 if abs(x) < 0.1 else 0.0)
    assert not terminated


def test_without_a_centre_radius_every_step_earns_one():
    env = gymnasium.make("codrl_mj/CartPole-v0")
    env.reset(seed=0)
    env.unwrapped.physics.reset(np.array([2.0, 0.0, 0.0, 0.0]))
    assert env.step(1)[1] == 1.0
