"""A training that was interrupted, however and how often, comes to the very result of one that was not."""

import functools
from pathlib import Path

import pytest

from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.runs.files import write_json
from codrl_mj.runs.summaries import read_run
from codrl_mj.training import (
    RunInUseError,
    TrainConfig,
    TrainingStoppedError,
    finished,
    history,
    watcher,
)
from tests.matrix import but
from tests.training.interruptions import (
    CASES,
    INTERRUPT,
    TERMINATE,
    Crash,
    after,
    crash,
    differing,
    interrupt,
    kill_test,
    outcome,
    resume,
)

RESUMED = ["ppo, one optimiser", "ddpg, several environments", "sarsa, traces"]
"""One case of every kind of agent."""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Reports as often as checkpoints, evaluations of short episodes, and no picture at the end."""
    monkeypatch.setattr(TrainConfig, "evaluation_env", property(lambda config: config.env))
    monkeypatch.setattr(watcher, "REPORT_INTERVAL", 40)
    monkeypatch.setattr(history, "save_learning_curve", lambda *_: None)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """What the cases come to, each trained once."""

    @functools.cache
    def train_once(name):
        return outcome(resume(CASES[name], tmp_path_factory.mktemp("uninterrupted") / "run"))

    return train_once


@pytest.mark.parametrize("name", but(RESUMED, CASES))
def test_a_run_of_interruptions_changes_nothing(tmp_path, uninterrupted, name):
    config, out = CASES[name], tmp_path / "run"
    interrupt(config, out, 1, TERMINATE)  # before the first checkpoint
    interrupt(config, out, 70, crash)  # past a checkpoint
    interrupt(config, out, 1, INTERRUPT)
    interrupt(config, out, 1, TERMINATE)  # twice in a row
    interrupt(config, out, 40, INTERRUPT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            history, "save_learning_curve", crash
        )  # after the last checkpoint, before result.json
        with pytest.raises(Crash):
            resume(config, out)
    assert not finished(out)
    resume(config, out)
    assert differing(uninterrupted(name), outcome(out)) == []


FINAL = (
    "policy.safetensors",
    "policy.json",
    "evaluation.json",
    "learning_curve.png",
    "result.json",
)
"""What a training writes when it has learned, in this order."""


@pytest.mark.parametrize("last", FINAL)
def test_between_the_final_files_a_run_is_not_finished_for_anybody(
    tmp_path, uninterrupted, monkeypatch, last
):
    name, out = "ppo, one optimiser", tmp_path / "run"
    replace, written = Path.replace, []

    def crash_behind(path, target):
        replace(path, target)
        if target.parent == out and kill_test.saved_steps(out) >= CASES[name].total_steps:
            written.append(target.name)
            if target.name == last:
                raise Crash

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", crash_behind)
        patch.setattr(
            history, "save_learning_curve", lambda path, *_: write_json(path, "no picture")
        )
        with pytest.raises(Crash):
            resume(CASES[name], out)
    assert tuple(written) == FINAL[: len(written)]
    done = last == FINAL[-1]
    assert (read_run(out).state, finished(out)) == ("finished" if done else "unfinished", done)
    resume(CASES[name], out)
    assert (read_run(out).state, finished(out)) == ("finished", True)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_a_signal_before_the_first_step_leaves_a_run_that_starts(
    tmp_path, uninterrupted, monkeypatch
):
    name, out = "ppo, one optimiser", tmp_path / "run"
    with monkeypatch.context() as patch:
        reset = ActuatedVecEnv.reset
        patch.setattr(ActuatedVecEnv, "reset", lambda env: (reset(env), TERMINATE())[0])
        with pytest.raises(TrainingStoppedError, match=r"stopped after 0 steps: .* train --resume"):
            resume(CASES[name], out)
    assert not (out / "checkpoints").exists()
    resume(CASES[name], out)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_a_signal_in_the_last_but_one_step_stops_and_one_in_the_last_comes_too_late(
    tmp_path, uninterrupted
):
    name, out = "dqn, epsilon by episodes", tmp_path / "run"
    assert "stopped after 239 steps" in interrupt(CASES[name], out, 239, TERMINATE)
    with after(1, TERMINATE):
        resume(CASES[name], out)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_while_one_trains_in_a_folder_another_is_refused(tmp_path, uninterrupted):
    name, out = "ppo, one optimiser", tmp_path / "run"

    def train_too():
        with pytest.raises(RunInUseError, match="another process is training in it"):
            resume(CASES[name], out)

    with after(70, train_too):
        resume(CASES[name], out)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_the_second_ctrl_c_stops_at_once(tmp_path):
    with pytest.raises(KeyboardInterrupt), after(70, lambda: (INTERRUPT(), INTERRUPT())):
        resume(CASES["ppo, one optimiser"], tmp_path / "run")
