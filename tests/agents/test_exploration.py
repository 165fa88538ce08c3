"""Exploration: noise equals its recursion, epsilon its definition."""

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from codrl_mj.agents import DDPGConfig, DQNConfig, SACConfig, TD3Config
from tests.agents.small import make_model


@pytest.mark.parametrize(
    ("agent", "sigma", "theta", "dt"),
    [
        (DDPGConfig, 0.5, 0.15, 1.0),
        (TD3Config, 0.3, 1.0, 1.0),
        (SACConfig, 0.2, 3.0, 0.1),
        (DDPGConfig, 0.4, 1.5, 1.0),
    ],
)
def test_the_noise_follows_its_recursion(agent, sigma, theta, dt):
    """X' = (1 - theta dt) x + sigma sqrt(dt) N(0, 1), from 0, with the numbers that it draws."""
    noise = make_model(
        agent(noise_sigma=sigma, noise_theta=theta, noise_dt=dt), "pendulum"
    ).action_noise
    # The noise draws from this generator.
    np.random.seed(1)
    drawn = np.array([noise()[0] for _ in range(200)], dtype=float)
    np.random.seed(1)
    before = np.append(0.0, drawn[:-1])
    expected = (1 - theta * dt) * before + sigma * np.sqrt(dt) * np.random.normal(size=200)
    # The noise is stored in float32.
    np.testing.assert_allclose(drawn, expected, rtol=0, atol=1e-6)


def test_the_noise_starts_at_zero_in_every_episode_and_can_be_left_out():
    model = make_model(
        DDPGConfig(noise_sigma=0.5, learning_starts=10**6), "pendulum", max_episode_steps=10
    )
    model.learn(15)
    assert model.action_noise.noise_prev != 0
    model.learn(5, reset_num_timesteps=False)
    assert model.action_noise.noise_prev == 0
    assert make_model(TD3Config(noise_sigma=0), "pendulum").action_noise is None


class Epsilons(BaseCallback):
    """Callback that records episode and epsilon at every step."""

    def _on_training_start(self):
        self.seen = []

    def _on_step(self):
        self.seen.append((self.model._episode_num, self.model.exploration_rate))
        return True


def epsilons(steps, max_episode_steps=None, **settings):
    watched = Epsilons()
    make_model(
        DQNConfig(hidden=(4,), **settings), "mountain_car", max_episode_steps=max_episode_steps
    ).learn(steps, watched)
    return watched.seen


def test_epsilon_is_multiplied_by_its_factor_down_to_its_minimum():
    settings = {"exploration_start": 0.8, "exploration_decay": 0.5, "exploration_end": 0.1}
    recorded = epsilons(25, 5, **settings)
    assert set(recorded) == {(0, 0.8), (1, 0.4), (2, 0.2), (3, 0.1), (4, 0.1)}


def test_epsilon_falls_linearly_over_its_share_of_the_steps():
    settings = {"exploration_decay": None, "exploration_fraction": 0.5, "exploration_end": 0.2}
    rates = [rate for _, rate in epsilons(100, exploration_start=1.0, **settings)]
    assert rates[26] == pytest.approx(1 - 0.8 * 0.26 / 0.5)
    assert rates[51:] == pytest.approx([0.2] * 49)
