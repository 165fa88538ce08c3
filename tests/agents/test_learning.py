"""Every agent learns: a few seconds of training beat a return that no untrained policy reaches.

Untrained and random policies balance the cart-pole for 9 to 60 steps, get about -1200 on the
pendulum, where -150 is as good as it gets, and leave the car in its valley for all of its 200
steps. The settings are made for speed; each clears its bar with room on seeds 0 to 2.
"""

import numpy as np
import pytest

from codrl_mj.agents import DDPGConfig, DQNConfig, PPOConfig, SACConfig, SARSAConfig, TD3Config
from tests.agents.small import make_envs, make_model
from tests.matrix import matrix_params

_FAST = {"learning_rate": 3e-3, "gamma": 0.95, "tau": 0.02, "train_every": None}
_REPLAY = {"batch_size": 64, "learning_starts": 200}
_NOISE = {"noise_sigma": 0.3, "noise_theta": 1.0, "noise_dt": 1.0}

_DDPG_NET = {"state_units": (), "action_units": (), "joint_units": (64, 64)}
_DQN = {
    "hidden": (64, 64),
    "gamma": 0.95,
    "tau": 0.05,
    "target_every": 8,
    "train_every": 8,
    "gradient_steps": 4,
}
_EPSILON = {"exploration_decay": None, "exploration_fraction": 0.4, "exploration_end": 0.04}

# Agent -> (settings, task, environments, steps, minimum return).
LEARNERS = {
    "ppo": (PPOConfig(rollout_steps=1024, batch_size=128, epochs=8), "cartpole", 8, 10_240, 130),
    "ppo, actor and critic apart": (
        PPOConfig(
            rollout_steps=1024,
            batch_size=None,
            epochs=20,
            learning_rate=3e-3,
            critic_learning_rate=3e-3,
        ),
        *("cartpole", 8, 10_240, 130),
    ),
    "dqn": (
        DQNConfig(batch_size=128, learning_starts=500, **_DQN, **_EPSILON),
        "cartpole",
        1,
        6000,
        90,
    ),
    "ddpg": (DDPGConfig(**_DDPG_NET, **_REPLAY, **_FAST, **_NOISE), "pendulum", 1, 2400, -500),
    "td3": (TD3Config(policy_delay=1, **_REPLAY, **_FAST, **_NOISE), "pendulum", 1, 2000, -500),
    "sac": (SACConfig(**_REPLAY, **_FAST), "pendulum", 1, 2000, -500),
    "sarsa": (SARSAConfig(), "mountain_car", 1, 70_000, -160),
}


def mean_return(policy, task, episodes=20):
    """Return the mean return of parallel episodes with the policy's most likely actions."""
    envs = make_envs(task, episodes)
    envs.seed(1000)
    observations, returns = envs.reset(), {}
    while len(returns) < episodes:
        observations, _, ended, infos = envs.step(
            policy.predict(observations, deterministic=True)[0]
        )
        for row in np.flatnonzero(ended).tolist():
            returns.setdefault(row, infos[row]["episode"]["r"])
    return np.mean(list(returns.values()))


@pytest.mark.parametrize("agent", matrix_params([], LEARNERS))
def test_an_agent_learns(agent):
    config, task, num_envs, steps, min_return = LEARNERS[agent]
    model = make_model(config, task, seed=2, num_envs=num_envs)
    assert mean_return(model.policy, task) < min_return, "an untrained policy must not pass"
    model.learn(steps)
    assert mean_return(model.policy, task) > min_return
