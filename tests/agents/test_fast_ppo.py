"""PPO's arithmetic written out, against Stable-Baselines3's own."""

import copy

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from codrl_mj import make_sb3_vec_env
from codrl_mj.agents import PPOConfig

CASES = {
    "discrete": ("CartPole", {"entropy_coefficient": 0.01, "target_kl": None}),
    "stopped": ("CartPole", {"target_kl": 0.003, "learning_rate": 0.01}),
    "continuous": ("Pendulum", {"entropy_coefficient": 0.01, "hidden": (16, 24), "activation": "relu"}),
    "in units": ("Pendulum", {"unit_actions": True, "log_std_init": -0.5, "input_scale": (1.0, 1.0, 0.2)}),
    "state-dependent": (
        "Pendulum",
        {"state_dependent_noise": True, "noise_steps": 4, "entropy_coefficient": 0.01, "hidden": (8, 8)},
    ),
}


class Nothing(BaseCallback):
    """Watches nothing."""

    def _on_step(self) -> bool:
        return True


def pair(case):
    """A model of ours with a rollout, and Stable-Baselines3's own of the same settings and weights."""
    task, settings = CASES[case]
    envs = make_sb3_vec_env(f"codrl_mj/{task}-v0", 4, max_episode_steps=20)
    config = PPOConfig(rollout_steps=256, batch_size=64, epochs=3, **settings)
    ours = config.make_model(envs, 1)
    theirs = PPO(
        config._policy_class(),
        envs,
        n_steps=64,
        batch_size=64,
        n_epochs=3,
        gae_lambda=config.gae_lambda,
        ent_coef=config.entropy_coefficient,
        target_kl=config.target_kl,
        learning_rate=config.learning_rate,
        use_sde=config.state_dependent_noise,
        sde_sample_freq=config.noise_steps or -1,
        policy_kwargs=config._network(),
        seed=1,
        device="cpu",
    )
    for name, tensor in theirs.policy.state_dict().items():
        torch.testing.assert_close(ours.policy.state_dict()[name], tensor, rtol=0, atol=0)
    return ours, theirs, envs


def collect(model, envs):
    model.set_logger(Logger(None, []))
    _, callback = model._setup_learn(0, Nothing())
    assert model.collect_rollouts(envs, callback, model.rollout_buffer, model.n_steps)


@pytest.mark.parametrize("case", CASES)
def test_learns_what_stable_baselines3_learns_from_the_same_rollout(case):
    ours, theirs, envs = pair(case)
    collect(ours, envs)
    theirs.rollout_buffer = copy.deepcopy(ours.rollout_buffer)
    theirs.set_logger(Logger(None, []))
    for model in (ours, theirs):
        np.random.seed(3)
        model.train()
    assert ours._n_updates == theirs._n_updates
    moved = 0.0
    start = pair(case)[0].policy.state_dict()
    for name, tensor in theirs.policy.state_dict().items():
        torch.testing.assert_close(ours.policy.state_dict()[name], tensor, rtol=0, atol=1e-5, msg=lambda m: f"{name}: {m}")
        moved = max(moved, float((tensor - start[name]).abs().max()))
    assert moved > 3e-3
