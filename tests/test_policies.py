"""Policies as files: they predict what the model predicted, and nothing in them is executed."""

import dataclasses
import hashlib
import json
import pickle
import random
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file, save_file
from stable_baselines3.common.vec_env import DummyVecEnv

from codrl_mj.agents import AGENTS, PPOConfig
from codrl_mj.runs.policies import load_policy, load_sb3_zip, save_policy
from tests.damage import damage

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


SMALL = PPOConfig(rollout_steps=8, batch_size=8, hidden=(8, 8))


def make_model(action_space=DISCRETE, observation_space=BOUNDED, agent=SMALL):
    torch.set_num_threads(1)
    model = agent.make_model(DummyVecEnv([lambda: Spaces(observation_space, action_space)]), 3)
    with torch.no_grad():  # initial weights hardly tell observations apart: make the actions vary
        for parameter in model.policy.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    return model


def save(model, folder, agent=SMALL):
    save_policy(model.policy, agent, folder)


@pytest.fixture
def folder(tmp_path):
    """A folder with a policy."""
    save(make_model(), tmp_path)
    return tmp_path


@pytest.fixture
def older(folder):
    """The same as it was before there were digests, so that nothing but its content can be wrong."""
    path = folder / DESCRIPTION
    kept = ("format", "agent", "observation_space", "action_space")
    path.write_text(json.dumps({name: json.loads(path.read_text())[name] for name in kept}))
    return folder


def observations(count=200):
    return np.random.default_rng(0).normal(0.0, 2.0, (count, 4)).astype(np.float32)


def refused(folder, error=ValueError):
    """Loading `folder` raises `error` with one message, which it returns."""
    with pytest.raises(error) as caught:
        load_policy(folder)
    assert type(caught.value) is error
    return str(caught.value)


# -- round trip ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "action_space"),
    [
        (name, space)
        for name, config in AGENTS.items()
        for space in (DISCRETE, CONTINUOUS)
        if isinstance(space, config.action_spaces)
    ],
    ids=str,
)
def test_a_loaded_policy_predicts_and_samples_what_the_model_does(tmp_path, name, action_space):
    limits = spaces.Box(-HIGH.clip(max=5), HIGH.clip(max=5), dtype=np.float32)  # tiles need bounds
    agent = AGENTS[name]() if name != "sarsa" else AGENTS[name](intervals=(4, 4, 4, 4))
    if name == "ppo":
        agent = SMALL
    model = make_model(action_space, limits, agent)
    save(model, tmp_path, agent)
    expected, _ = model.predict(observations(), deterministic=True)
    loaded = load_policy(tmp_path)
    assert len(np.unique(expected, axis=0)) > 1  # the comparison is not of one constant action
    np.testing.assert_array_equal(loaded.predict(observations(), deterministic=True)[0], expected)
    if name in ("ppo", "sac"):  # those that sample from torch's generator
        torch.manual_seed(5)
        first, _ = model.predict(observations(), deterministic=False)
        torch.manual_seed(5)
        second, _ = loaded.predict(observations(), deterministic=False)
        np.testing.assert_array_equal(first, second)
        assert not np.array_equal(first, expected)


@pytest.mark.parametrize("hidden", [(), (4,), (8, 4, 16)], ids=str)
def test_any_network_shape_survives(tmp_path, hidden):
    agent = dataclasses.replace(SMALL, hidden=hidden)
    model = make_model(agent=agent)
    save(model, tmp_path, agent)
    loaded = load_policy(tmp_path)
    for name, tensor in model.policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


def test_the_spaces_survive(tmp_path):
    save(make_model(CONTINUOUS), tmp_path)
    loaded = load_policy(tmp_path)
    assert loaded.observation_space == BOUNDED
    assert loaded.action_space == CONTINUOUS


def test_actions_outside_the_box_are_clipped_after_loading(tmp_path):
    save(make_model(CONTINUOUS), tmp_path)
    actions, _ = load_policy(tmp_path).predict(100 * observations(), deterministic=True)
    assert np.all(actions >= CONTINUOUS.low)
    assert np.all(actions <= CONTINUOUS.high)


def test_the_weights_are_readable_by_plain_safetensors_and_the_description_by_plain_json(folder):
    assert json.loads((folder / DESCRIPTION).read_text())["agent"]["name"] == "ppo"
    shapes = {name: tuple(tensor.shape) for name, tensor in load_file(folder / WEIGHTS).items()}
    assert shapes["mlp_extractor.policy_net.0.weight"] == (8, 4)
    assert shapes["action_net.weight"] == (3, 8)
    assert sorted(path.name for path in folder.iterdir()) == [DESCRIPTION, WEIGHTS]


def test_a_policy_that_cannot_be_described_is_refused_with_nothing_written(tmp_path):
    with pytest.raises(ValueError, match="only Box and Discrete"):
        save(make_model(spaces.MultiBinary(2)), tmp_path)
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


@pytest.mark.parametrize("content", [{}, [], 1, None, "codrl_mj policy 2", {"format": "codrl_mj policy 1"}], ids=str)
def test_json_of_another_format_is_named(folder, content):
    (folder / DESCRIPTION).write_text(json.dumps(content))
    message = refused(folder)
    assert str(folder / DESCRIPTION) in message
    assert "codrl_mj policy 2" in message


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("agent", "ppo"),
        ("agent", {"name": "pppo"}),
        ("agent", {"name": "ppo", "hidden": [-1]}),
        ("agent", {"name": "ppo", "hidden": "wide"}),
        ("agent", {"name": "ppo", "surplus": 1}),
        ("agent", {"name": ["ppo"]}),
        ("agent", None),
        ("observation_space", {"type": "Discrete", "n": -2}),
        ("observation_space", {"type": "Box", "low": ["a"], "high": [1], "dtype": "float32"}),
        ("observation_space", {"type": "Box", "low": [0], "high": [1], "dtype": "no such type"}),
        ("action_space", {"type": "Discrete"}),
        ("action_space", 7),
    ],
    ids=str,
)
def test_a_description_with_a_wrong_field_is_named(older, field, value):
    path = older / DESCRIPTION
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    assert f"{DESCRIPTION} does not describe a policy" in refused(older)


@pytest.mark.parametrize("field", ["agent", "observation_space", "action_space"])
def test_a_description_without_a_field_is_named(older, field):
    path = older / DESCRIPTION
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != field}))
    assert f"{path} does not describe a policy" in refused(older)


def test_weights_with_other_names_are_named(older):
    save_file({"weight": torch.zeros(3)}, older / WEIGHTS)
    assert f"{older / WEIGHTS} and {DESCRIPTION} do not belong together" in refused(older)


@pytest.mark.parametrize("digests", [True, False])
def test_weights_of_another_shape_are_named(request, folder, digests):
    if not digests:
        request.getfixturevalue("older")
    wider = dataclasses.replace(SMALL, hidden=(16, 16))
    save(make_model(agent=wider), folder / "other", wider)
    (folder / "other" / WEIGHTS).replace(folder / WEIGHTS)
    message = refused(folder)
    assert str(folder / WEIGHTS) in message
    assert "do not belong together" in message
    assert ("sha256" in message) == digests


def test_weights_that_are_not_numbers_are_named(older):
    tensors = load_file(older / WEIGHTS)
    tensors["action_net.bias"][0] = torch.nan
    save_file(tensors, older / WEIGHTS)
    assert f"{older / WEIGHTS} holds weights that are not finite" in refused(older)


def test_a_policy_from_before_there_were_digests_is_loaded(older):
    expected, _ = make_model().predict(observations(), deterministic=True)
    np.testing.assert_array_equal(load_policy(older).predict(observations(), deterministic=True)[0], expected)


def test_the_digest_of_the_weights_is_the_one_that_sha256sum_prints(folder):
    described = json.loads((folder / DESCRIPTION).read_text())
    assert described["weights_sha256"] == hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()


def content_of(policy):
    """All that a policy is, as text and bytes."""
    weights = {name: tensor.numpy().tobytes() for name, tensor in policy.state_dict().items()}
    return weights, repr((policy.observation_space, policy.action_space)), repr(policy)


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_a_policy_damaged_in_a_few_bytes_is_refused_or_is_what_it_was(folder, name):
    random_ = random.Random(0)
    path, expected = folder / name, content_of(load_policy(folder))
    whole, refusals = path.read_bytes(), 0
    for _ in range(150):
        damaged = damage(whole, random_)
        path.write_bytes(damaged)
        try:
            assert content_of(load_policy(folder)) == expected  # such as a space for a line break in the JSON
        except ValueError as error:
            assert str(folder) in str(error)  # noqa: PT017 - most of them raise, not all
            refusals += 1
    assert refusals >= 100
    assert name == DESCRIPTION or refusals == 150  # of the weights every byte counts


@pytest.mark.parametrize("entry", ["sha256", "weights_sha256"])
def test_a_digest_whose_name_is_damaged_is_noticed(folder, entry):
    path = folder / DESCRIPTION
    path.write_text(path.read_text().replace(f'"{entry}"', '"sha257"'))
    assert str(path) in refused(folder)


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


# -- Stable-Baselines3's own files --------------------------------------------------------------------------


@pytest.fixture
def zipped(tmp_path):
    """A model as Stable-Baselines3 saves it, with an object in it that executes something when it is unpickled."""
    model = make_model()
    model.bomb = Executed(tmp_path / "executed")
    model.save(tmp_path / "model.zip")
    return tmp_path / "model.zip", model


def test_a_zip_is_not_opened_without_trust(zipped):
    path, _ = zipped
    with pytest.raises(ValueError, match=r"executes whatever its author put there\. Pass --trust"):
        load_sb3_zip(path, "ppo", trust=False)
    assert not (path.parent / "executed").exists()


def test_a_trusted_zip_predicts_what_the_model_does_and_shows_why_trust_is_needed(zipped):
    path, model = zipped
    expected, _ = model.predict(observations(), deterministic=True)
    policy = load_sb3_zip(path, "ppo", trust=True)
    np.testing.assert_array_equal(policy.predict(observations(), deterministic=True)[0], expected)
    assert (path.parent / "executed").exists()  # this is what the flag is about


@pytest.mark.parametrize(("agent", "message"), [("sarsa", "has no such agent"), ("dqn", "not a model of dqn")])
def test_a_zip_of_another_agent_is_refused(zipped, agent, message):
    with pytest.raises(ValueError, match=message):
        load_sb3_zip(zipped[0], agent, trust=True)


def test_a_missing_zip_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no model at .*model\.zip"):
        load_sb3_zip(tmp_path / "model.zip", "ppo", trust=False)
