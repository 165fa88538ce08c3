"""A training from start to end: learning, repetition with a seed, and documented files."""

import contextlib
import csv
import dataclasses
import json
import math
import platform
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.agents import PPOConfig
from codrl_mj.agents.fast_ppo import FastPPO
from codrl_mj.agents.sarsa_algorithm import CompiledEpisodes
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import EVALUATION_SEED, TrainConfig, history, load_config, train, watcher
from codrl_mj.training.folder import locked
from codrl_mj.training.watcher import Watcher
from tests.training.interruptions import begin

TINY_PPO = PPOConfig(rollout_steps=256, batch_size=64, epochs=2, hidden=(8, 8))
ENV = EnvConfig("cartpole", "weaker", options={"center_radius": 0.1})
TINY = TrainConfig(ENV, TINY_PPO, 1, 500, num_envs=4, evaluation_episodes=5)
UNSTABLE = DCMotorActuator(Motor(arm_radius=0.15), CurrentLoop(kp=100.0))


def within(**changes):
    """Return the tiny training in another environment."""
    return dataclasses.replace(TINY, env=dataclasses.replace(ENV, **changes))


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Skip the picture, except in `run`."""
    monkeypatch.setattr(history, "save_learning_curve", lambda *_: None)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a tiny run, and its progress reports."""
    reports = []
    torch.set_num_threads(2)
    out = train(TINY, tmp_path_factory.mktemp("runs") / "a" / "run", reports.append)
    # Networks of this size are slower on two threads.
    assert torch.get_num_threads() == 1
    return out, reports


def read_csv(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def read(path):
    return json.loads(path.read_text())


# -- the run folder --------------------------------------------------------------------------------


def test_the_run_folder_has_the_best_policy_and_a_picture(run):
    out, _ = run
    assert {path.name for path in (out / "best").iterdir()} == {
        "evaluation.json",
        "policy.json",
        "policy.safetensors",
    }
    with Image.open(out / "learning_curve.png") as image:
        assert image.size == (900, 525)
        # The picture is not empty.
        assert len(image.convert("RGB").getcolors(100_000)) > 10


def test_the_configuration_records_resolved_values_and_versions(run):
    content = read(run[0] / "config.json")
    assert load_config(run[0]) == TINY
    assert content["train"] == json.loads(json.dumps(TINY.as_mapping()))
    assert content["train"]["env"]["actuator"]["controller"]["kp"] == 0.2
    versions = content["versions"]
    assert (versions["numpy"], versions["python"]) == (np.__version__, platform.python_version())
    assert len(content["code"]) == 64


def test_progress_is_written_after_rollouts_and_every_episode_is_in_the_table(
    run,
):
    out, (report,) = run
    assert report.steps == 512  # 500 rounded up to whole rollouts
    (row,) = read_csv(out / "progress.csv")
    assert {name: float(value) for name, value in row.items()} == dataclasses.asdict(report)
    assert (
        8 <= report.mean_return < report.mean_length <= 100
    )  # at most 1 a step, nothing beyond the radius
    assert (
        min(report.torque_error, report.steps_per_second, report.seconds) > 0
    )  # the actuator is not ideal
    episodes = read_csv(out / "episodes.csv")
    assert [int(row["episode"]) for row in episodes] == list(range(1, report.episodes + 1))
    steps = [int(row["steps"]) for row in episodes]
    assert steps == sorted(steps)
    assert steps[-1] <= report.steps
    assert report.mean_return == pytest.approx(
        np.mean([float(row["return"]) for row in episodes[-100:]]), rel=1e-12
    )
    lengths = sum(int(row["length"]) for row in episodes)
    assert (
        report.steps - TINY.num_envs * 500 < lengths <= report.steps
    )  # the rest is in episodes that go on


def test_the_result_and_the_evaluation_agree_with_an_evaluation_of_the_saved_policy(run):
    out, (report,) = run
    result = read(out / "result.json")
    expected = evaluate(
        load_policy(out), EnvConfig("cartpole", "weaker"), episodes=5, seed=EVALUATION_SEED
    ).returns.mean
    assert (
        read(out / "evaluation.json")["returns"]["mean"] == expected == result["evaluation_return"]
    )
    assert (result["steps"], result["episodes"]) == (report.steps, report.episodes)
    assert result["best"] == {"return": expected, "steps": 512}  # the only evaluation


def test_another_seed_gives_another_policy(run, tmp_path):
    different = train(dataclasses.replace(TINY, seed=2), tmp_path / "other")
    assert (different / "policy.safetensors").read_bytes() != (
        run[0] / "policy.safetensors"
    ).read_bytes()


def test_a_report_has_only_the_evaluation_of_its_step(tmp_path, monkeypatch):
    monkeypatch.setattr(watcher, "REPORT_INTERVAL", 1250)
    config = dataclasses.replace(
        TINY, total_steps=2500, evaluation_interval=1000, evaluation_episodes=2
    )
    rows = read_csv(train(config, tmp_path / "run") / "progress.csv")
    evaluated = {int(row["steps"]): math.isfinite(float(row["evaluation_return"])) for row in rows}
    assert evaluated == {
        1024: True,
        1280: False,
        2048: True,
        2560: True,
    }  # 1280: the report alone; 2560: the end


def test_the_best_policy_is_saved_if_a_later_one_is_worse(tmp_path):
    # With this learning rate, returns rise and fall.
    ppo = dataclasses.replace(TINY_PPO, learning_rate=0.05)
    config = dataclasses.replace(
        TINY, agent=ppo, total_steps=3000, evaluation_interval=256, evaluation_episodes=5
    )
    out = train(config, tmp_path / "run")
    evaluations = [float(row["evaluation_return"]) for row in read_csv(out / "progress.csv")]
    result = read(out / "result.json")
    assert result["best"]["return"] >= max(evaluations) > result["evaluation_return"]
    best = evaluate(
        load_policy(out / "best"), EnvConfig("cartpole", "weaker"), episodes=5, seed=EVALUATION_SEED
    )
    assert best.returns.mean == result["best"]["return"]


def test_tensorboard_gets_returns_and_losses(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    out, (report,) = run
    events = EventAccumulator(str(out / "tensorboard"))
    events.Reload()
    (scalar,) = events.Scalars("run/mean_return")
    assert scalar.step == report.steps
    assert scalar.value == pytest.approx(report.mean_return, rel=1e-6)
    assert "train/value_loss" in events.Tags()["scalars"]


def test_without_tensorboard_no_events_are_written(tmp_path, monkeypatch):
    monkeypatch.setenv(
        "SB3_LOGDIR", str(tmp_path / "theirs")
    )  # where Stable-Baselines3 would make a folder
    assert not (train(TINY, tmp_path / "run", tensorboard=False) / "tensorboard").exists()
    monkeypatch.setattr(
        "stable_baselines3.common.logger.SummaryWriter", None
    )  # as if it were not installed
    assert (train(TINY, tmp_path / "other") / "result.json").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"run", "other"}


def test_weights_and_biases_gets_the_configuration(tmp_path, monkeypatch):
    calls = []

    @contextlib.contextmanager
    def init(**arguments):
        calls.append(arguments)
        yield

    fake = ModuleType("wandb")
    fake.init, fake.__spec__ = init, ModuleSpec("wandb", None)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    train(TINY, tmp_path / "run", wandb="motors")
    (call,) = calls
    assert (call["project"], call["name"], call["config"]) == ("motors", "run", TINY.as_mapping())
    monkeypatch.delitem(sys.modules, "wandb")
    with pytest.raises(ValueError, match="pip install wandb"):
        train(TINY, tmp_path / "other", wandb="motors")
    assert not (tmp_path / "other").exists()


def test_episodes_can_be_counted_instead_of_steps(tmp_path):
    config = dataclasses.replace(TINY, total_steps=None, total_episodes=20, num_envs=1)
    out = train(config, tmp_path / "run")
    assert len(read_csv(out / "episodes.csv")) == 20
    assert read(out / "result.json")["episodes"] == 20


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "has_config"),
    [
        (["precious.txt"], False),
        (["tensorboard/mine"], False),
        (["best/policy.json"], False),
        (["policy.json"], False),
        *(
            (["notes.txt", name], False)
            for name in ("config.json", ".lock", "best", "tensorboard/events")
        ),
        # A training may start in a folder with only a configuration, but not with other files.
        *(([name], True) for name in ("precious.txt", "best/policy.json", "policy.json")),
    ],
)
def test_a_folder_with_other_files_raises_and_is_not_changed(tmp_path, names, has_config):
    out = tmp_path / "run"
    for name in names:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("mine")
    if has_config:
        begin(tmp_path / "new", TINY)
        (tmp_path / "new/config.json").rename(out / "config.json")
    before = {path: path.is_dir() or path.read_bytes() for path in out.rglob("*")}
    with pytest.raises(FileExistsError, match=f"{out} exists already"):
        train(TINY, out)
    assert {path: path.is_dir() or path.read_bytes() for path in out.rglob("*")} == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": within(actuator=UNSTABLE).env}, "spectral radius"),
        ({"agent": dataclasses.replace(TINY_PPO, rollout_steps=258)}, "multiple of num_envs = 4"),
        ({"agent": dataclasses.replace(TINY_PPO, batch_size=96)}, "multiple of batch_size = 96"),
        ({"env": within(integrator="rk4").env}, "integrator = 'rk4'"),
        ({"env": within(inner_steps=0).env}, "inner_steps = 0"),
        ({"env": within(physics="newton").env}, "unknown physics 'newton'"),
    ],
)
def test_an_impossible_training_raises_before_it_writes(tmp_path, changes, message):
    config = dataclasses.replace(TINY, **changes)
    with pytest.raises(ValueError, match=message):
        train(config, tmp_path / "runs" / "run")
    assert list(tmp_path.iterdir()) == []


def test_an_early_failure_does_not_block_the_next_training(tmp_path, monkeypatch):
    out, existing = tmp_path / "runs" / "run", tmp_path / "existing"
    existing.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(Watcher, "_on_step", lambda _: 1 / 0)
        for path in (out, existing):
            with pytest.raises(ZeroDivisionError):
                train(TINY, path)
    assert (out.parent.exists(), list(existing.iterdir())) == (False, [])  # what was there stays
    assert read(train(TINY, out) / "result.json")["steps"] == 512


def test_weights_that_are_not_finite_raise_and_are_not_saved(tmp_path, monkeypatch):
    learn = FastPPO.train

    def diverging(model):
        learn(model)
        if model.num_timesteps >= 512:
            next(iter(model.policy.parameters())).data[:] = torch.nan

    monkeypatch.setattr(FastPPO, "train", diverging)
    often = dataclasses.replace(TINY, total_steps=1000, checkpoint_interval=256)
    message = (
        r"weights of ppo are not finite at step 512: .* Lower agent\.learning_rate ="
        r" 0\.001, or"
    )
    with pytest.raises(FloatingPointError, match=message):
        train(often, tmp_path / "run")
    assert [path.name[:17] for path in (tmp_path / "run" / "checkpoints").iterdir()] == [
        "step-000000000256"
    ]


@pytest.mark.parametrize("line", ["train cartpole --out run", "train --resume run"])
def test_a_locked_folder_raises_before_anything_is_created(tmp_path, monkeypatch, capsys, line):
    monkeypatch.chdir(tmp_path)
    begin(tmp_path / "run", TrainConfig.preset("cartpole", "ppo"))
    monkeypatch.setattr(PPOConfig, "make_model", lambda *_: pytest.fail("it was made"))
    with locked(tmp_path / "run"):
        assert main(line.split()) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "another process is training in it; wait for it" in shown.err


def test_a_folder_that_cannot_be_created_raises_before_training(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="file"):
        train(TINY, tmp_path / "file" / "run", lambda _: pytest.fail("it trained"))
    assert (tmp_path / "file").read_text() == "in the way"


def test_the_torque_error_of_compiled_episodes_has_all_steps(tmp_path, monkeypatch):
    config = TrainConfig.preset("mountain_car", "sarsa", total_episodes=6, evaluation_episodes=1)
    errors = []
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(CompiledEpisodes, "can_run", lambda _: False)
        out = train(config, tmp_path / str(compiled))
        errors.append([float(row["torque_error"]) for row in read_csv(out / "progress.csv")])
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
    assert errors[0][0] > 0.1
    drawn = dataclasses.replace(
        config.env, randomize={"motor.arm_radius": "choice(2.0)"}
    )  # whose is it?
    out = train(dataclasses.replace(config, env=drawn, total_episodes=1), tmp_path / "drawn")
    assert all(row["torque_error"] == "nan" for row in read_csv(out / "progress.csv"))
