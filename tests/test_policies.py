"""Policies as files: they predict like the model, and nothing in them is executed."""

import dataclasses
import hashlib
import json
import pickle
import random

import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load, load_file, save
from stable_baselines3.common.vec_env import DummyVecEnv

from codrl_mj.agents import AGENTS, PPOConfig
from codrl_mj.runs.policies import load_policy, load_sb3_zip, save_policy
from tests.agents.small import Sampled
from tests.damage import Bomb, damage

WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"


HIGH = np.array([4.8, np.inf, 0.4, np.inf], np.float32)
BOUNDED = spaces.Box(-HIGH, HIGH, dtype=np.float32)
DISCRETE = spaces.Discrete(3)
LIMITED = spaces.Box(-HIGH.clip(max=5), HIGH.clip(max=5), dtype=np.float32)
CONTINUOUS = spaces.Box(
    np.array([-2.0, -1.0], np.float32), np.array([2.0, 0.5], np.float32), dtype=np.float32
)


SMALL = PPOConfig(rollout_steps=8, batch_size=8, hidden=(8, 8))


def make_model(action_space=DISCRETE, observation_space=BOUNDED, agent=SMALL):
    torch.set_num_threads(1)
    model = agent.make_model(DummyVecEnv([lambda: Sampled(observation_space, action_space)]), 3)
    # With initial weights the actions hardly depend on the observations.
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    return model


@pytest.fixture
def folder(tmp_path):
    """Return a folder with a policy."""
    save_policy(make_model().policy, SMALL, tmp_path)
    return tmp_path


def observations(count=200):
    """Return many observations in the center of the space and a few far away."""
    near = np.random.default_rng(0).normal(0.0, 2.0, (count, 4)).astype(np.float32)
    return np.concatenate([near, 100 * near[:5]])


# -- round trip ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("agent", "action_space"),
    [
        (agent, space)
        for agent in (
            *(kind() for name, kind in AGENTS.items() if name not in ("ppo", "sarsa")),
            AGENTS["sarsa"](intervals=(4, 4, 4, 4)),
            *(dataclasses.replace(SMALL, hidden=hidden) for hidden in ((), (4,), (8, 4, 16))),
        )
        for space in (DISCRETE, CONTINUOUS)
        if isinstance(space, agent.action_spaces)
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_a_loaded_policy_equals_the_saved_one(tmp_path, agent, action_space):
    """It has the same spaces, predictions and samples, and acts within the bounds."""
    observation_space = LIMITED if agent.name == "sarsa" else BOUNDED  # Tiles need bounds.
    model = make_model(action_space, observation_space, agent)
    save_policy(model.policy, agent, tmp_path)
    loaded = load_policy(tmp_path)
    assert (loaded.observation_space, loaded.action_space) == (observation_space, action_space)
    expected, _ = model.predict(observations(), deterministic=True)
    assert len(np.unique(expected, axis=0)) > 1  # The actions differ.
    actions, _ = loaded.predict(observations(), deterministic=True)
    np.testing.assert_array_equal(actions, expected)
    assert all(action in action_space for action in actions)
    if agent.name in ("ppo", "sac"):  # These sample from torch's generator.
        torch.manual_seed(5)
        first, _ = model.predict(observations(), deterministic=False)
        torch.manual_seed(5)
        np.testing.assert_array_equal(loaded.predict(observations(), deterministic=False)[0], first)
        assert not np.array_equal(first, expected)


def test_safetensors_json_and_sha256sum_can_read_the_files(folder):
    assert sorted(path.name for path in folder.iterdir()) == [DESCRIPTION, WEIGHTS]
    described = json.loads((folder / DESCRIPTION).read_text())
    assert described["agent"]["name"] == "ppo"
    assert (
        described["weights_sha256"] == hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    )
    shapes = {name: tuple(tensor.shape) for name, tensor in load_file(folder / WEIGHTS).items()}
    assert shapes["mlp_extractor.policy_net.0.weight"] == (8, 4)
    assert shapes["action_net.weight"] == (3, 8)


def test_raises_before_writing_if_a_policy_cannot_be_described(tmp_path):
    with pytest.raises(ValueError, match="only Box and Discrete"):
        save_policy(make_model(spaces.MultiBinary(2)).policy, SMALL, tmp_path)
    assert list(tmp_path.iterdir()) == []


# -- damaged and foreign files ---------------------------------------------------------------------


def without_digests(content, **changes):
    """Return a description without digests, so that only its content can be wrong."""
    described = json.loads(content)
    entries = ("format", "agent", "observation_space", "action_space")
    described = {name: described[name] for name in entries} | changes
    return json.dumps(
        {name: value for name, value in described.items() if value != "left out"}
    ).encode()


def test_a_policy_without_digests_is_loaded(folder):
    (folder / DESCRIPTION).write_bytes(without_digests((folder / DESCRIPTION).read_bytes()))
    expected, _ = make_model().predict(observations(), deterministic=True)
    np.testing.assert_array_equal(
        load_policy(folder).predict(observations(), deterministic=True)[0], expected
    )


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_raises_if_a_file_is_missing(folder, name):
    (folder / name).unlink()
    with pytest.raises(FileNotFoundError, match=str(folder / name)):
        load_policy(folder)


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
        ("agent", "left out"),
        ("observation_space", {"type": "Discrete", "n": -2}),
        ("observation_space", {"type": "Box", "low": ["a"], "high": [1], "dtype": "float32"}),
        ("observation_space", {"type": "Box", "low": [0], "high": [1], "dtype": "no such type"}),
        ("observation_space", "left out"),
        ("action_space", {"type": "Discrete"}),
        ("action_space", 7),
        ("action_space", "left out"),
    ],
    ids=str,
)
def test_raises_if_a_description_has_a_wrong_field(folder, field, value):
    path = folder / DESCRIPTION
    path.write_bytes(without_digests(path.read_bytes(), **{field: value}))
    with pytest.raises(ValueError, match=f"{path} does not describe a policy"):
        load_policy(folder)


def not_a_number(weights):
    tensors = load(weights)
    tensors["action_net.bias"][0] = torch.nan
    return save(tensors)


def wider(_):
    return save(make_model(agent=dataclasses.replace(SMALL, hidden=(16, 16))).policy.state_dict())


OTHER_FORMATS = ({}, [], 1, None, "codrl_mj policy 2", {"format": "codrl_mj policy 1"})


@pytest.mark.parametrize(
    ("digests", "name", "change", "words"),
    [
        *(
            (False, WEIGHTS, lambda old, keep=keep: old[:keep], "truncated or not a safe")
            for keep in (0, 4, 40, -1)
        ),
        (True, WEIGHTS, lambda old: old[:-1], "is truncated or damaged"),
        (True, WEIGHTS, wider, "do not belong together: its sha256 differs"),
        (False, WEIGHTS, wider, "do not belong together: "),
        (False, WEIGHTS, lambda _: save({"weight": torch.zeros(3)}), "do not belong together: "),
        (False, WEIGHTS, not_a_number, "holds weights that are not finite"),
        *(
            (True, DESCRIPTION, lambda old, keep=keep: old[:keep], "is truncated or not JSON")
            for keep in (0, 30, -3)
        ),
        *(
            (True, DESCRIPTION, lambda _, it=it: json.dumps(it).encode(), "codrl_mj policy 2")
            for it in OTHER_FORMATS
        ),
        (
            True,
            DESCRIPTION,
            lambda old: old.replace(b'"sha256"', b'"sha257"'),
            "unknown entries: sha257",
        ),
        (
            True,
            DESCRIPTION,
            lambda old: old.replace(b'"weights_sha256"', b'"sha257"'),
            "is not the policy description",
        ),
    ],
)
def test_raises_if_a_file_is_damaged_or_belongs_to_another_policy(
    folder, digests, name, change, words
):
    if not digests:
        (folder / DESCRIPTION).write_bytes(without_digests((folder / DESCRIPTION).read_bytes()))
    path = folder / name
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=rf"^{path}.*{words}"):
        load_policy(folder)


def content_of(policy):
    """Return all data of a policy as text and bytes."""
    weights = {name: tensor.numpy().tobytes() for name, tensor in policy.state_dict().items()}
    return weights, repr((policy.observation_space, policy.action_space)), repr(policy)


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_a_policy_with_damaged_bytes_is_refused_or_unchanged(folder, name):
    random_ = random.Random(0)
    path, expected = folder / name, content_of(load_policy(folder))
    whole, refusals = path.read_bytes(), 0
    for _ in range(150):
        path.write_bytes(damage(whole, random_))
        try:
            assert (
                content_of(load_policy(folder)) == expected
            )  # For example a space instead of a line break in the JSON.
        except ValueError as error:
            assert str(folder) in str(error)  # noqa: PT017 - most of them raise, not all
            refusals += 1
    assert refusals >= (100 if name == DESCRIPTION else 150)  # Every byte of the weights counts.


@pytest.mark.parametrize("name", [WEIGHTS, DESCRIPTION])
@pytest.mark.parametrize("through", [pickle.dump, torch.save], ids=["pickle", "torch"])
def test_a_pickle_instead_of_a_file_is_refused_and_not_executed(folder, name, through):
    with (folder / name).open("wb") as file:
        through(Bomb(folder / "executed"), file)
    if name == WEIGHTS:  # The digest does not matter.
        (folder / DESCRIPTION).write_bytes(without_digests((folder / DESCRIPTION).read_bytes()))
    with pytest.raises(ValueError, match=str(folder / name)):
        load_policy(folder)
    assert not (folder / "executed").exists()


def test_loading_never_unpickles(folder, monkeypatch):
    for module, name in (
        (pickle, "load"),
        (pickle, "loads"),
        (pickle, "Unpickler"),
        (torch, "load"),
    ):
        monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("something was unpickled"))
    load_policy(folder)


# -- Stable-Baselines3's own files -----------------------------------------------------------------


def test_a_zip_is_opened_only_with_trust_and_predicts_like_the_model(tmp_path):
    model, path, executed = make_model(), tmp_path / "model.zip", tmp_path / "executed"
    model.bomb = Bomb(executed)
    model.save(path)
    with pytest.raises(ValueError, match=r"executes their code\. Pass --trust"):
        load_sb3_zip(path, "ppo", trust=False)
    assert not executed.exists()
    policy = load_sb3_zip(path, "ppo", trust=True)
    expected, _ = model.predict(observations(), deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations(), deterministic=True)[0], expected)
    assert executed.exists()  # This is the danger that the flag guards.
