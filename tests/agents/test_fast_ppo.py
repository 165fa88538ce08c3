"""PPO's arithmetic written out, against Stable-Baselines3's own."""

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


def collect(model):
    model.env.seed(1)
    model.set_logger(Logger(None, []))
    _, callback = model._setup_learn(0, ConvertCallback(lambda *_: True))
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)


def learn_alike(rollout, *models):
    """What each has learned by an update from the same rollout, in the same minibatches."""
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
    """Stands in for a policy's `forward`: acts as in a rollout, values and judges as the policy does."""

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
    ours, theirs, _ = pair(
        case
    )  # their environments are the same object, and begin anew with the model's seed
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
    """Means and deviations of 20 000 actions in one state, against the policy's own distribution."""
    ours, _, envs = pair(case)
    torch.manual_seed(0)
    count = 20_000
    observation = envs.reset()[:1]
    with torch.no_grad():
        acted = ours._networks.act(ours._features(np.repeat(observation, count, axis=0)))
        draws = ours._exploration.draws(1, count, ours._networks.outputs)
        actions = ours._exploration.actions(*acted, draws[0]).double().numpy()
        wanted = ours.policy.get_distribution(torch.as_tensor(observation)).distribution
    mean = float(wanted.probs[0, 1] if case == "discrete" else wanted.mean)
    deviation = (mean * (1 - mean)) ** 0.5 if case == "discrete" else float(wanted.stddev)
    assert actions.mean() == pytest.approx(mean, abs=4 * deviation / count**0.5)
    assert actions.std() == pytest.approx(deviation, rel=0.03)


def test_state_dependent_noise_lasts_for_its_steps():
    """Drawn every four steps: the noise is one linear function of the hidden units until then."""
    explores = pair("state-dependent")[0]._exploration
    assert explores.draws(64, 4, 1).shape == (16, 4, 8, 1)


@pytest.mark.parametrize("case", ["discrete", "state-dependent"])
def test_a_saved_model_goes_on_in_stable_baselines3_and_theirs_here(case, tmp_path):
    """Weights and Adam's moments are in the file: the next update is the same."""
    ours, theirs, envs = pair(case)
    collect(ours)
    rollout = ours.rollout_buffer
    for saved, reader in ((ours, PPO), (ours, FastPPO), (theirs, FastPPO)):
        learn_alike(rollout, saved)
        saved.save(tmp_path / "model")
        read = reader.load(tmp_path / "model", env=envs, device="cpu")
        torch.testing.assert_close(*learn_alike(rollout, read, saved), rtol=0, atol=1e-5)


def test_moments_of_other_networks_are_refused():
    ours, _, _ = pair("discrete")
    other, _, _ = pair("state-dependent")
    with pytest.raises(
        ValueError, match=r"12 parameters are optimised: must be 13|13 .* must be 12"
    ):
        ours.policy.optimizer.load_state_dict(other.policy.optimizer.state_dict())


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


def test_a_copy_that_would_not_learn_says_so():
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
def test_what_it_would_learn_wrongly_is_refused(name, observations, settings):
    with pytest.raises(ValueError, match=name):
        FastPPO(
            ActorCriticPolicy,
            spaced(observations, box(1)),
            n_steps=16,
            batch_size=16,
            device="cpu",
            **settings,
        )
