"""The explicit computations of PPO equal those of Stable-Baselines3."""

import copy

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv

from codrl_mj import make_sb3_vec_env
from codrl_mj.agents import PPOConfig
from codrl_mj.agents.fast_ppo import FastPPO
from tests.agents.small import Sampled

CASES = {
    "discrete": ("CartPole", {"entropy_coefficient": 0.01, "target_kl": None}),
    "stopped": ("CartPole", {"target_kl": 0.003, "learning_rate": 0.01}),
    "continuous": (
        "Pendulum",
        {"entropy_coefficient": 0.01, "hidden": (16, 24), "activation": "relu"},
    ),
    "in units": (
        "Pendulum",
        {"unit_actions": True, "log_std_init": -0.5, "input_scale": (1.0, 1.0, 0.2)},
    ),
    "state-dependent": (
        "Pendulum",
        {
            "state_dependent_noise": True,
            "noise_steps": 4,
            "entropy_coefficient": 0.01,
            "hidden": (8, 8),
        },
    ),
}
FILLED = (
    "observations",
    "actions",
    "rewards",
    "episode_starts",
    "values",
    "log_probs",
    "advantages",
    "returns",
)


def pair(case):
    """Return our model with a rollout, and Stable-Baselines3's with the same weights."""
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


def collect(model):
    model.env.seed(1)
    model.set_logger(Logger(None, []))
    _, callback = model._setup_learn(0, ConvertCallback(lambda *_: True))
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)


def learn_alike(rollout, *models):
    """Return the results of an update of each model from the same rollout and minibatches."""
    for model in models:
        model.set_logger(Logger(None, []))
        model.rollout_buffer = copy.deepcopy(rollout)
        np.random.seed(3)
        model.train()
    return [dict(model.policy.state_dict()) for model in models]


@pytest.mark.parametrize("case", CASES)
def test_learns_what_stable_baselines3_learns_from_the_same_rollout(case):
    ours, theirs, _ = pair(case)
    collect(ours)
    start = copy.deepcopy(theirs.policy.state_dict())
    learnt, taught = learn_alike(ours.rollout_buffer, ours, theirs)
    assert ours._n_updates == theirs._n_updates
    torch.testing.assert_close(learnt, taught, rtol=0, atol=1e-5)
    assert max(float((taught[name] - start[name]).abs().max()) for name in taught) > 3e-3


class Replayed:
    """Replacement of a policy's `forward` with recorded actions and the policy's evaluations."""

    def __init__(self, policy, actions):
        """Take the actions (steps, envs, ...)."""
        self.policy, self.actions = policy, iter(actions)

    def __call__(self, observations):
        actions = torch.as_tensor(next(self.actions))
        flat = actions[:, 0] if isinstance(self.policy.action_space, spaces.Discrete) else actions
        values, log_prob, _ = self.policy.evaluate_actions(observations, flat)
        return flat, values, log_prob


@pytest.mark.parametrize("case", ["discrete", "in units", "state-dependent"])
def test_fills_the_buffer_as_stable_baselines3_does_for_the_same_actions(case):
    # Both have the same environments, which restart with the model's seed.
    ours, theirs, _ = pair(case)
    collect(ours)
    mine = ours.rollout_buffer
    theirs.policy.forward = Replayed(theirs.policy, mine.actions)
    collect(theirs)
    for name in FILLED:
        np.testing.assert_allclose(
            getattr(mine, name), getattr(theirs.rollout_buffer, name), rtol=1e-5, atol=1e-5
        )
    assert mine.episode_starts[1:].any()


@pytest.mark.parametrize("case", ["discrete", "in units", "state-dependent"])
def test_explores_with_the_probabilities_of_its_policy(case):
    """Compare mean and deviation of 20 000 actions in a state with the policy's distribution."""
    ours, _, envs = pair(case)
    torch.manual_seed(0)
    count = 20_000
    observation = envs.reset()[:1]
    with torch.no_grad():
        layers = ours._networks.act(ours._features(np.repeat(observation, count, axis=0)))
        noise = ours._exploration.draw_noise(1, count, ours._networks.outputs)
        actions = ours._exploration.actions(*layers, noise[0]).double().numpy()
        distribution = ours.policy.get_distribution(torch.as_tensor(observation)).distribution
    mean = float(distribution.probs[0, 1] if case == "discrete" else distribution.mean)
    deviation = (mean * (1 - mean)) ** 0.5 if case == "discrete" else float(distribution.stddev)
    assert actions.mean() == pytest.approx(mean, abs=4 * deviation / count**0.5)
    assert actions.std() == pytest.approx(deviation, rel=0.03)


def test_state_dependent_noise_lasts_for_its_steps():
    """For four steps the noise is the same linear function of the hidden units."""
    explores = pair("state-dependent")[0]._exploration
    assert explores.draw_noise(64, 4, 1).shape == (16, 4, 8, 1)


@pytest.mark.parametrize("case", ["discrete", "state-dependent"])
def test_saved_models_continue_in_stable_baselines3_and_the_reverse(case, tmp_path):
    """The file has weights and Adam's moments, so the next update is the same."""
    ours, theirs, envs = pair(case)
    collect(ours)
    rollout = ours.rollout_buffer
    for saved, reader in ((ours, PPO), (ours, FastPPO), (theirs, FastPPO)):
        learn_alike(rollout, saved)
        saved.save(tmp_path / "model")
        read = reader.load(tmp_path / "model", env=envs, device="cpu")
        torch.testing.assert_close(*learn_alike(rollout, read, saved), rtol=0, atol=1e-5)


def test_moments_of_other_networks_raise():
    ours, _, _ = pair("discrete")
    different, _, _ = pair("state-dependent")
    with pytest.raises(
        ValueError, match=r"12 parameters are optimized: must be 13|13 .* must be 12"
    ):
        ours.policy.optimizer.load_state_dict(different.policy.optimizer.state_dict())


def box(*shape, dtype=np.float32):
    return spaces.Box(-1, 1, shape, dtype)


PICTURES = spaces.Box(0, 255, (36, 36, 3), np.uint8)


def spaced(observations, actions):
    return DummyVecEnv([lambda: Sampled(observations, actions)] * 2)


def small(observations, actions):
    config = PPOConfig(rollout_steps=32, batch_size=16, epochs=2, hidden=(8,))
    return config.make_model(spaced(observations, actions), 0)


@pytest.mark.parametrize(
    ("observations", "actions"),
    [
        (box(3, dtype=np.float64), box(2, dtype=np.float64)),
        (box(2, 3), box(2, 3)),
        (spaces.Discrete(4), spaces.Discrete(3)),
    ],
    ids=["float64", "of several dimensions", "discrete"],
)
def test_learns_in_spaces_that_stable_baselines3_learns_in(observations, actions):
    model = small(observations, actions)
    before = copy.deepcopy(model.policy.state_dict())
    model.learn(64)
    assert all((tensor != before[name]).any() for name, tensor in model.policy.state_dict().items())


def test_learning_with_a_deep_copy_raises():
    model = copy.deepcopy(small(box(3), box(1)))
    with pytest.raises(RuntimeError, match="save and load"):
        model.learn(64)


@pytest.mark.parametrize(
    ("name", "observations", "settings"),
    [
        ("observation_space", spaces.Dict(a=box(3)), {}),
        ("clip_range_vf", box(3), {"clip_range_vf": 0.2}),
        ("hidden layers", box(3), {"policy_kwargs": {"net_arch": {"pi": [8], "vf": [4]}}}),
        ("hidden layers", box(3), {"policy_kwargs": {"activation_fn": torch.nn.ELU}}),
        (
            "extractor must not learn",
            PICTURES,
            {"policy_kwargs": {"features_extractor_class": NatureCNN}},
        ),
    ],
)
def test_unsupported_settings_raise(name, observations, settings):
    with pytest.raises(ValueError, match=name):
        FastPPO(
            ActorCriticPolicy,
            spaced(observations, box(1)),
            n_steps=16,
            batch_size=16,
            device="cpu",
            **settings,
        )
