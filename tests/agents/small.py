"""Agents that are small enough for training in a test, and their training."""

import gymnasium
import numpy as np
import torch

from codrl_mj.agents import DDPGConfig, DQNConfig, PPOConfig, SACConfig, TD3Config
from codrl_mj.envs.sb3 import make_sb3_vec_env
from codrl_mj.tasks import TASKS

_BUFFERED = {"learning_starts": 50, "batch_size": 16, "buffer_size": 1000}

SMALL = {
    "ppo": (PPOConfig(rollout_steps=64, batch_size=32, epochs=2, hidden=(8,)), "cartpole"),
    "ppo, apart": (
        PPOConfig(
            rollout_steps=64, batch_size=None, epochs=3, critic_learning_rate=1e-3, hidden=(8,)
        ),
        "pendulum",
    ),
    "ddpg": (
        DDPGConfig(
            actor_units=(8,), state_units=(4,), action_units=(4,), joint_units=(8,), **_BUFFERED
        ),
        "pendulum",
    ),
    "dqn": (DQNConfig(hidden=(8,), **_BUFFERED), "cartpole"),
    "td3": (TD3Config(hidden=(8,), **_BUFFERED), "mountain_car_continuous"),
    "sac": (
        SACConfig(hidden=(8,), state_dependent_noise=True, **_BUFFERED),
        "mountain_car_continuous",
    ),
}
"""Name -> (settings, task)."""


def make_envs(task, num_envs=1, **arguments):
    """Create environments of a task for Stable-Baselines3."""
    return make_sb3_vec_env(TASKS[task].env_id, num_envs, **arguments)


def make_model(config, task, seed=0, num_envs=1, **arguments):
    """Create an agent's model on a task."""
    torch.set_num_threads(1)
    return config.make_model(make_envs(task, num_envs, **arguments), seed)


def weights(module):
    """Return copies of a module's tensors by name."""
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def differing(before, after, by=0.0):
    """Return names of tensors with different bits, or with a difference above `by`."""
    return {name for name in before if (before[name] - after[name]).abs().max() > by}


class Sampled(gymnasium.Env):
    """Environment with random observations from a space, which accepts only its own actions."""

    def __init__(self, observation_space, action_space):
        """Take the spaces."""
        self.observation_space, self.action_space = observation_space, action_space
        observation_space.seed(0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return (
            self.observation_space.sample(),
            float(np.sum(action)),
            False,
            self.np_random.random() < 0.1,
            {},
        )
