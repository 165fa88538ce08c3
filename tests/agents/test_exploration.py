"""Exploration: noise against its closed form, epsilon against its definition."""

import math

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from codrl_mj.agents import DDPGConfig, DQNConfig, SACConfig, TD3Config
from tests.agents.small import make_model

SAMPLES = 100_000


@pytest.mark.parametrize(
    ("agent", "sigma", "theta", "dt"),
    [(DDPGConfig, 0.5, 0.15, 1.0), (TD3Config, 0.3, 1.0, 1.0), (SACConfig, 0.2, 3.0, 0.1), (DDPGConfig, 0.4, 1.5, 1.0)],
)
def test_the_noise_has_the_variance_and_the_memory_of_its_recursion(agent, sigma, theta, dt):
    """With x' = a x + s N(0, 1), a = 1 - theta dt, s = sigma sqrt(dt): variance s²/(1 - a²), correlation a^k.

    The tolerances are five standard errors: of a variance over n correlated samples sqrt(2 / n (1 + a²) / (1 - a²)) of
    it, of a correlation at most sqrt((1 + a²) / (1 - a²) / n) (Bartlett).
    """
    model = make_model(agent(noise_sigma=sigma, noise_theta=theta, noise_dt=dt), "pendulum")
    np.random.seed(1)  # the generator that the noise draws from
    noise = model.action_noise
    drawn = np.array([noise()[0] for _ in range(SAMPLES)], dtype=float)
    a = 1 - theta * dt
    memory = (1 + a**2) / (1 - a**2)
    variance = sigma**2 * dt / (1 - a**2)
    assert drawn.var() == pytest.approx(variance, rel=5 * math.sqrt(2 * memory / SAMPLES))
    for lag in (1, 3):
        correlation = (drawn[lag:] * drawn[:-lag]).mean() / drawn.var()
        assert correlation == pytest.approx(a**lag, abs=5 * math.sqrt(memory / SAMPLES))


def test_the_noise_starts_at_zero_in_every_episode_and_can_be_left_out():
    model = make_model(DDPGConfig(noise_sigma=0.5, learning_starts=10**6), "pendulum", max_episode_steps=10)
    model.learn(15)
    assert model.action_noise.noise_prev != 0
    model.learn(5, reset_num_timesteps=False)
    assert model.action_noise.noise_prev == 0
    assert make_model(TD3Config(noise_sigma=0), "pendulum").action_noise is None


class Epsilons(BaseCallback):
    """Epsilon at every step, by episode."""

    def _on_training_start(self):
        self.seen = {}

    def _on_step(self):
        self.seen.setdefault(self.model._episode_num, set()).add(self.model.exploration_rate)
        return True


def test_epsilon_shrinks_by_its_factor_with_every_episode_down_to_its_end():
    config = DQNConfig(hidden=(4,), exploration_start=0.8, exploration_decay=0.5, exploration_end=0.1)
    watched = Epsilons()
    make_model(config, "mountain_car", max_episode_steps=5).learn(25, callback=watched)
    assert watched.seen == {0: {0.8}, 1: {0.4}, 2: {0.2}, 3: {0.1}, 4: {0.1}}


def test_epsilon_falls_linearly_over_its_share_of_the_steps():
    config = DQNConfig(
        hidden=(4,), exploration_start=1.0, exploration_end=0.2, exploration_decay=None, exploration_fraction=0.5
    )
    model = make_model(config, "mountain_car")
    rates = []

    class Rates(BaseCallback):
        def _on_step(self):
            rates.append(self.model.exploration_rate)
            return True

    model.learn(100, callback=Rates())
    assert rates[26] == pytest.approx(1 - 0.8 * 0.26 / 0.5)
    assert rates[51:] == pytest.approx([0.2] * 49)
