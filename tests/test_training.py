"""Training: it learns, a seed repeats, a run folder appears whole or not at all."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from codrl_mj import Actuator, CurrentLoop, Motor, named_actuator
from codrl_mj.agents import PPOConfig
from codrl_mj.env_config import EnvConfig
from codrl_mj.evaluation import RandomPolicy, make_env, run_episodes
from codrl_mj.policies import load_policy
from codrl_mj.training import TrainConfig, load_config, train

TINY_PPO = PPOConfig(rollout_steps=256, batch_size=64, epochs=2, hidden=(8, 8))
TINY = TrainConfig("cartpole", "weaker", TINY_PPO, 1, 1000, num_envs=4, env=EnvConfig(center_radius=0.1))
UNSTABLE = Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=100.0))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A tiny run, and the progress that it reported."""
    reports = []
    out = train(TINY, tmp_path_factory.mktemp("runs") / "a" / "run", reports.append)
    return out, reports


def same_weights(first, second):
    weights = [load_file(folder / "policy.safetensors") for folder in (first, second)]
    assert weights[0].keys() == weights[1].keys()
    return all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def mean_return(policy, actuator, episodes=20):
    return np.mean([e.total for e in run_episodes(policy, lambda: make_env("cartpole", actuator), episodes, seed=1000)])


# -- learning -----------------------------------------------------------------------------------------------


def test_ppo_learns_to_balance(tmp_path):
    ppo = PPOConfig(rollout_steps=1024, batch_size=128, learning_rate=3e-3, hidden=(32, 32))
    config = TrainConfig("cartpole", "ideal", ppo, seed=0, total_steps=16_000)
    out = train(config, tmp_path / "run")
    assert mean_return(RandomPolicy("cartpole"), "ideal") < 40
    assert mean_return(load_policy(out), "ideal") > 400


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(run, tmp_path):
    out, _ = run
    torch.manual_seed(99)  # what the process drew before does not matter
    np.random.seed(99)
    assert same_weights(out, train(TINY, tmp_path / "again"))
    assert not same_weights(out, train(dataclasses.replace(TINY, seed=2), tmp_path / "other"))


def test_the_actuator_and_the_task_option_reach_the_training(run, tmp_path):
    out, _ = run
    assert not same_weights(out, train(dataclasses.replace(TINY, actuator="ideal"), tmp_path / "ideal"))
    free = train(dataclasses.replace(TINY, env=EnvConfig()), tmp_path / "free")
    assert not same_weights(out, free)


def test_training_uses_one_thread_even_where_torch_had_more(tmp_path):
    torch.set_num_threads(2)
    train(TINY, tmp_path / "run")
    assert torch.get_num_threads() == 1


# -- the run folder -----------------------------------------------------------------------------------------


def test_the_run_folder_has_what_is_documented(run):
    out, _ = run
    names = ["config.json", "learning_curve.png", "policy.json", "policy.safetensors", "progress.csv"]
    assert sorted(path.name for path in out.iterdir()) == names
    with Image.open(out / "learning_curve.png") as image:
        assert image.size == (900, 525)
        assert len(image.convert("RGB").getcolors(100_000)) > 10  # something is drawn


def test_the_configuration_records_what_was_resolved_and_the_versions(run):
    out, _ = run
    content = json.loads((out / "config.json").read_text())
    assert content["train"]["actuator"]["controller"]["kp"] == 0.2
    assert content["train"]["actuator"]["motor"]["arm_radius"] == 0.15
    assert content["train"]["env"]["center_radius"] == 0.1
    assert content["train"]["ppo"]["rollout_steps"] == 256
    assert content["versions"]["numpy"] == np.__version__
    assert load_config(out) == TINY


def test_progress_is_reported_and_written_after_every_rollout(run):
    out, reports = run
    assert [report.steps for report in reports] == [256, 512, 768, 1024]  # 1000 rounded up to whole rollouts
    with (out / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["steps"]) for row in rows] == [256, 512, 768, 1024]
    assert {int(row["total_steps"]) for row in rows} == {1000}
    for report, row in zip(reports, rows, strict=True):
        assert float(row["mean_return"]) == report.mean_return
        assert 0 <= report.mean_return <= report.mean_length  # at most 1 a step, nothing beyond the radius
        assert 8 <= report.mean_length <= 100
        assert report.steps_per_second > 0


def test_the_saved_policy_plays(run):
    out, _ = run
    assert 8 <= mean_return(load_policy(out), "weaker", episodes=3) <= 500


# -- configuration ------------------------------------------------------------------------------------------

OWN = Actuator(Motor(inductance=0.07, arm_radius=0.3), CurrentLoop(kp=0.9, max_voltage=math.inf, substeps=3))


@pytest.mark.parametrize(
    "actuator",
    ["ideal", None, "paper", "weaker", "open_loop", OWN, {"motor": {"inductance": 0.2}, "controller": {"kp": 2}}],
    ids=["ideal", "None", "paper", "weaker", "open_loop", "Actuator", "mapping"],
)
def test_a_configuration_survives_json(tmp_path, actuator):
    ppo, env = PPOConfig(hidden=(4, 5, 6), gamma=1.0), EnvConfig("analytic", "semi-implicit", 3)
    config = TrainConfig("cartpole", actuator, ppo, 7, 123, 2, env)
    assert config.actuator is None or isinstance(config.actuator, Actuator)
    assert TrainConfig.from_mapping(json.loads(json.dumps(config.as_mapping()))) == config
    (tmp_path / "config.json").write_text(json.dumps({"train": config.as_mapping()}))
    assert load_config(tmp_path) == config


def test_a_name_a_mapping_and_an_actuator_mean_the_same():
    own = {"motor": {"arm_radius": 0.15}, "controller": {"kp": 0.2, "ki": 0.2}}
    configs = {TrainConfig("cartpole", what) for what in ("weaker", named_actuator("weaker", "cartpole"))}
    assert configs == {TrainConfig("cartpole", own)}
    assert TrainConfig("cartpole", "ideal") == TrainConfig("cartpole", None) != TrainConfig("cartpole", "paper")


@pytest.mark.parametrize(
    ("field", "value", "bound"),
    [
        ("seed", -1, "from 0 to 4294967295"),
        ("seed", 2**32, "from 0 to 4294967295"),
        ("seed", None, "from 0 to 4294967295"),
        ("seed", True, "from 0 to 4294967295"),
        ("total_steps", 0, ">= 1"),
        ("total_steps", math.nan, ">= 1"),
        ("total_steps", 1e5, ">= 1"),
        ("num_envs", 0, ">= 1"),
        ("num_envs", "8", ">= 1"),
        ("ppo", {"gamma": 0.9}, "PPOConfig"),
        ("env", None, "EnvConfig"),
    ],
)
def test_a_bad_field_is_named_with_its_value_and_bound(field, value, bound):
    with pytest.raises(ValueError, match=field) as caught:
        TrainConfig("cartpole", **{field: value})
    assert f"{field} = {value!r}" in str(caught.value)
    assert bound in str(caught.value)


@pytest.mark.parametrize(
    ("field", "bound", "values"),
    [
        ("learning_rate", "> 0", [0.0, -1e-3, math.nan, math.inf, "1e-3", True]),
        ("rollout_steps", ">= 2", [1, 0, -8, 2.5, math.nan, None]),
        ("batch_size", ">= 2", [1, 64.0]),
        ("epochs", ">= 1", [0, 1.5, math.inf]),
        ("gamma", "in (0, 1]", [0.0, 1.0001, -0.5, math.nan]),
        ("gae_lambda", "in [0, 1]", [-0.01, 1.01, math.nan]),
        ("clip_range", "> 0", [0.0, -0.2, math.nan]),
        ("entropy_coefficient", ">= 0", [-0.01, math.nan, math.inf]),
        ("target_kl", "> 0", [0.0, -1.0, math.nan]),
        ("hidden", ">= 1", [(0,), (64, -1), (64, 0.5), [64], "64"]),
    ],
)
def test_a_bad_ppo_field_is_named_with_its_value_and_bound(field, bound, values):
    for value in values:
        with pytest.raises(ValueError, match=field) as caught:
            PPOConfig(**{field: value})
        assert f"PPOConfig.{field} = {value!r}" in str(caught.value)
        assert bound in str(caught.value)


@pytest.mark.parametrize("field", ["gamma", "gae_lambda"])
def test_the_ends_of_closed_intervals_are_allowed(field):
    assert getattr(PPOConfig(**{field: 1.0}), field) == 1.0


@pytest.mark.parametrize("value", [0, -1, 2.5, True])
def test_a_bad_time_limit_is_named(value):
    with pytest.raises(ValueError, match="max_episode_steps") as caught:
        EnvConfig(max_episode_steps=value)
    assert ">= 1" in str(caught.value)


def test_unknown_tasks_and_actuators_are_named():
    with pytest.raises(ValueError, match="did you mean 'cartpole'"):
        TrainConfig("cartpoll")
    with pytest.raises(ValueError, match="did you mean 'weaker'"):
        TrainConfig("cartpole", "weakr")
    with pytest.raises(ValueError, match=r"did you mean motor\.inductance"):
        TrainConfig("cartpole", {"motor": {"inductanc": 1.0}})


@pytest.mark.parametrize(
    "content",
    [
        [],
        3,
        {"not": "a run"},
        {"train": None},
        {"train": {"task": "cartpole"}},
        {"train": TINY.as_mapping() | {"surplus": 1}},
        {"train": TINY.as_mapping() | {"task": ["cartpole"]}},
        {"train": TINY.as_mapping() | {"seed": "abc"}},
        {"train": TINY.as_mapping() | {"ppo": {"hidden": [8], "surplus": 1}}},
        {"train": TINY.as_mapping() | {"ppo": 5}},
        {"train": TINY.as_mapping() | {"env": "none"}},
        {"train": TINY.as_mapping() | {"actuator": {"motor": {"inductance": -1.0}}}},
    ],
    ids=range(12),
)
def test_a_damaged_run_configuration_is_named(tmp_path, content):
    (tmp_path / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="not a run configuration") as caught:
        load_config(tmp_path)
    assert str(tmp_path / "config.json") in str(caught.value)


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no run configuration at") as caught:
        load_config(tmp_path)
    assert str(tmp_path / "config.json") in str(caught.value)


# -- refusals -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("holds", ["a file", "nothing"])
def test_an_existing_folder_is_refused_and_untouched(tmp_path, holds):
    out = tmp_path / "run"
    out.mkdir()
    if holds == "a file":
        (out / "precious.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="exists already") as caught:
        train(TINY, out)
    assert str(out) in str(caught.value)
    assert [path.read_text() for path in out.iterdir()] == (["mine"] if holds == "a file" else [])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actuator": UNSTABLE}, "spectral radius"),
        ({"ppo": dataclasses.replace(TINY_PPO, rollout_steps=258)}, "multiple of num_envs = 4"),
        ({"ppo": dataclasses.replace(TINY_PPO, batch_size=96)}, "multiple of batch_size = 96"),
        ({"env": EnvConfig(integrator="rk4")}, "integrator = 'rk4'"),
        ({"env": EnvConfig(inner_steps=0)}, "inner_steps = 0"),
        ({"env": EnvConfig(center_radius=-1.0)}, "center_radius = -1.0"),
        ({"env": EnvConfig(physics="newton")}, "physics = 'newton'"),
        ({"task": "pendulum", "actuator": None}, "center_radius"),
    ],
)
def test_what_cannot_be_trained_is_refused_with_nothing_written(tmp_path, changes, message):
    config = dataclasses.replace(TINY, **changes)
    with pytest.raises(ValueError, match=message):
        train(config, tmp_path / "runs" / "run")
    assert list(tmp_path.iterdir()) == []


def test_an_unstable_actuator_can_be_trained_on_when_allowed(tmp_path):
    config = dataclasses.replace(TINY, actuator=UNSTABLE, env=EnvConfig(allow_unstable=True, inner_steps=1))
    assert (train(config, tmp_path / "run") / "policy.safetensors").is_file()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_a_training_that_is_stopped_leaves_no_folder_and_can_be_repeated(tmp_path, error):
    def stop(progress):
        if progress.steps >= 512:
            raise error

    with pytest.raises(error):
        train(TINY, tmp_path / "run", stop)
    assert list(tmp_path.iterdir()) == []
    train(TINY, tmp_path / "run")


def test_a_disk_that_fills_up_at_the_end_leaves_no_folder(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("codrl_mj.training.save_policy", full)
    with pytest.raises(OSError, match="No space left"):
        train(TINY, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_named_before_training(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="file"):
        train(TINY, tmp_path / "file" / "run", lambda _: pytest.fail("it trained"))
    assert (tmp_path / "file").read_text() == "in the way"
