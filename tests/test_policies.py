"""Policies as files: they predict what the model predicted, and nothing in them is executed."""

import json
import pickle
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file, save_file
from stable_baselines3 import A2C, DQN, PPO
from torch import nn

from codrl_mj.policies import load_policy, save_policy

WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"


class Spaces(gymnasium.Env):
    """An environment that consists of its spaces."""

    def __init__(self, observation_space, action_space):
        """Take the spaces."""
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed=None, options=None):  # noqa: ARG002 - Gymnasium's signature
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):  # noqa: ARG002 - Gymnasium's signature
        return self.observation_space.sample(), 0.0, False, False, {}


HIGH = np.array([4.8, np.inf, 0.4, np.inf], np.float32)
BOUNDED = spaces.Box(-HIGH, HIGH, dtype=np.float32)
DISCRETE = spaces.Discrete(3)
CONTINUOUS = spaces.Box(np.array([-2.0, -1.0], np.float32), np.array([2.0, 0.5], np.float32), dtype=np.float32)


def make_model(action_space=DISCRETE, observation_space=BOUNDED, kind=PPO, **policy_kwargs):
    torch.set_num_threads(1)
    policy_kwargs = {"net_arch": [8, 8], "activation_fn": nn.Tanh} | policy_kwargs
    env = Spaces(observation_space, action_space)
    batches = {"batch_size": 8} if kind is PPO else {}
    model = kind("MlpPolicy", env, n_steps=8, policy_kwargs=policy_kwargs, device="cpu", seed=3, **batches)
    with torch.no_grad():  # SB3's initial action layer is nearly zero: make its actions vary
        for parameter in model.policy.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    return model


@pytest.fixture
def folder(tmp_path):
    """A folder with a policy."""
    save_policy(make_model(), tmp_path)
    return tmp_path


def observations(count=200):
    return np.random.default_rng(0).normal(0.0, 2.0, (count, 4)).astype(np.float32)


def refused(folder, error=ValueError):
    """Loading `folder` raises `error` with one message, which it returns."""
    with pytest.raises(error) as caught:
        load_policy(folder)
    assert type(caught.value) is error
    return str(caught.value)


# -- round trip ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_space", [DISCRETE, CONTINUOUS], ids=["discrete", "continuous"])
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU])
@pytest.mark.parametrize("kind", [PPO, A2C])
def test_a_loaded_policy_predicts_and_samples_what_the_model_does(tmp_path, action_space, activation, kind):
    model = make_model(action_space, kind=kind, activation_fn=activation)
    save_policy(model, tmp_path)
    expected, _ = model.predict(observations(), deterministic=True)
    loaded = load_policy(tmp_path)
    assert len(np.unique(expected, axis=0)) > 1  # the comparison is not of one constant action
    for sample in (False, True):
        torch.manual_seed(5)
        first, _ = model.predict(observations(), deterministic=not sample)
        torch.manual_seed(5)
        second, _ = loaded.predict(observations(), deterministic=not sample)
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("net_arch", [[], [4], {"pi": [8, 4], "vf": [16]}], ids=str)
def test_any_network_shape_survives(tmp_path, net_arch):
    model = make_model(net_arch=net_arch)
    save_policy(model, tmp_path)
    loaded = load_policy(tmp_path)
    for name, tensor in model.policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


def test_the_spaces_survive(tmp_path):
    save_policy(make_model(CONTINUOUS), tmp_path)
    loaded = load_policy(tmp_path)
    assert loaded.observation_space == BOUNDED
    assert loaded.action_space == CONTINUOUS


def test_actions_outside_the_box_are_clipped_after_loading(tmp_path):
    save_policy(make_model(CONTINUOUS), tmp_path)
    actions, _ = load_policy(tmp_path).predict(100 * observations(), deterministic=True)
    assert np.all(actions >= CONTINUOUS.low)
    assert np.all(actions <= CONTINUOUS.high)


def test_the_weights_are_readable_by_plain_safetensors_and_the_description_by_plain_json(folder):
    assert json.loads((folder / DESCRIPTION).read_text())["algorithm"] == "PPO"
    shapes = {name: tuple(tensor.shape) for name, tensor in load_file(folder / WEIGHTS).items()}
    assert shapes["mlp_extractor.policy_net.0.weight"] == (8, 4)
    assert shapes["action_net.weight"] == (3, 8)
    assert sorted(path.name for path in folder.iterdir()) == [DESCRIPTION, WEIGHTS]


def test_a_policy_that_cannot_be_described_is_refused_with_nothing_written(tmp_path):
    env = Spaces(BOUNDED, DISCRETE)
    with pytest.raises(ValueError, match="DQNPolicy"):
        save_policy(DQN("MlpPolicy", env, buffer_size=10, device="cpu"), tmp_path)
    with pytest.raises(ValueError, match="ELU"):
        save_policy(make_model(activation_fn=nn.ELU), tmp_path)
    with pytest.raises(ValueError, match="only Box and Discrete"):
        save_policy(make_model(spaces.MultiBinary(2)), tmp_path)
    assert list(tmp_path.iterdir()) == []


# -- damaged and foreign files ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    assert str(folder / name) in refused(folder, FileNotFoundError)


def test_a_missing_folder_is_named(tmp_path):
    assert str(tmp_path / "no run") in refused(tmp_path / "no run", FileNotFoundError)


@pytest.mark.parametrize("keep", [0, 4, 40, -1])
def test_truncated_weights_are_named(folder, keep):
    path = folder / WEIGHTS
    path.write_bytes(path.read_bytes()[:keep])
    message = refused(folder)
    assert str(path) in message
    assert "truncated" in message


@pytest.mark.parametrize("keep", [0, 30, -3])
def test_a_truncated_description_is_named(folder, keep):
    path = folder / DESCRIPTION
    path.write_text(path.read_text()[:keep])
    message = refused(folder)
    assert str(path) in message
    assert "truncated" in message


@pytest.mark.parametrize("content", [{}, [], 1, None, "codrl_mj policy 1", {"format": "codrl_mj policy 0"}], ids=str)
def test_json_of_another_format_is_named(folder, content):
    (folder / DESCRIPTION).write_text(json.dumps(content))
    message = refused(folder)
    assert str(folder / DESCRIPTION) in message
    assert "codrl_mj policy 1" in message


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("activation", "Threshold"),
        ("activation", None),
        ("activation", ["Tanh"]),
        ("net_arch", "wide"),
        ("net_arch", [-1]),
        ("net_arch", [0.5]),
        ("net_arch", None),
        ("observation_space", {"type": "Discrete", "n": -2}),
        ("observation_space", {"type": "Box", "low": ["a"], "high": [1], "dtype": "float32"}),
        ("observation_space", {"type": "Box", "low": [0], "high": [1], "dtype": "no such type"}),
        ("action_space", {"type": "Discrete"}),
        ("action_space", 7),
    ],
    ids=str,
)
def test_a_description_with_a_wrong_field_is_named(folder, field, value):
    path = folder / DESCRIPTION
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    assert DESCRIPTION in refused(folder)


@pytest.mark.parametrize("field", ["net_arch", "activation", "observation_space", "action_space"])
def test_a_description_without_a_field_is_named(folder, field):
    path = folder / DESCRIPTION
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != field}))
    assert str(path) in refused(folder)


def test_weights_with_other_names_are_named(folder):
    save_file({"weight": torch.zeros(3)}, folder / WEIGHTS)
    assert str(folder / WEIGHTS) in refused(folder)


def test_weights_of_another_shape_are_named(folder):
    other = make_model(net_arch=[16, 16])
    save_policy(other, folder / "other")
    (folder / "other" / WEIGHTS).replace(folder / WEIGHTS)
    message = refused(folder)
    assert str(folder / WEIGHTS) in message
    assert "do not belong together" in message


def test_weights_that_are_not_numbers_are_named(folder):
    tensors = load_file(folder / WEIGHTS)
    tensors["action_net.bias"][0] = torch.nan
    save_file(tensors, folder / WEIGHTS)
    assert str(folder / WEIGHTS) in refused(folder)


class Executed:
    """Unpickling it creates a file."""

    def __init__(self, marker):
        """Remember the file to create."""
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


@pytest.mark.parametrize("replaced", [WEIGHTS, DESCRIPTION])
@pytest.mark.parametrize("through", [pickle.dump, torch.save], ids=["pickle", "torch"])
def test_a_pickle_in_place_of_a_file_is_refused_and_not_executed(folder, replaced, through):
    marker, bomb = folder / "executed", folder / "bomb"
    with bomb.open("wb") as file:
        through(Executed(marker), file)
    if through is pickle.dump:  # the bomb works: whoever unpickles it leaves the marker
        pickle.loads(bomb.read_bytes())
        assert marker.exists()
        marker.unlink()
    bomb.replace(folder / replaced)
    assert str(folder / replaced) in refused(folder)
    assert not marker.exists()


def test_loading_never_calls_unpickling_code(folder, monkeypatch):
    def forbidden(*_, **__):
        raise AssertionError("something was unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, forbidden)
    monkeypatch.setattr(torch, "load", forbidden)
    load_policy(folder)
