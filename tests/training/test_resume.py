"""A training gives the same result with any interruptions as without them."""

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
from tests.matrix import matrix_params
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
"""Names of a case for each kind of agent."""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Make reports as frequent as checkpoints, evaluations short, and skip the picture."""
    monkeypatch.setattr(TrainConfig, "evaluation_env", property(lambda config: config.env))
    monkeypatch.setattr(watcher, "REPORT_INTERVAL", 40)
    monkeypatch.setattr(history, "save_learning_curve", lambda *_: None)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Return the results of the cases, each trained once."""

    @functools.cache
    def train_once(name):
        return outcome(resume(CASES[name], tmp_path_factory.mktemp("uninterrupted") / "run"))

    return train_once


@pytest.mark.parametrize("name", matrix_params(RESUMED, CASES))
def test_interruptions_do_not_change_the_result(tmp_path, uninterrupted, name):
    config, out = CASES[name], tmp_path / "run"
    # Before the first checkpoint, then after one.
    interrupt(config, out, 1, TERMINATE)
    interrupt(config, out, 70, crash)
    interrupt(config, out, 1, INTERRUPT)
    # Two interruptions without a step between them.
    interrupt(config, out, 1, TERMINATE)
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
"""Files that a training writes at its end, in this order."""


@pytest.mark.parametrize("last", FINAL)
def test_a_run_is_unfinished_until_its_last_file(tmp_path, uninterrupted, monkeypatch, last):
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
    is_finished = last == FINAL[-1]
    assert (read_run(out).state, finished(out)) == (
        "finished" if is_finished else "unfinished",
        is_finished,
    )
    resume(CASES[name], out)
    assert (read_run(out).state, finished(out)) == ("finished", True)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_a_run_starts_after_a_signal_before_its_first_step(tmp_path, uninterrupted, monkeypatch):
    name, out = "ppo, one optimiser", tmp_path / "run"
    with monkeypatch.context() as patch:
        reset = ActuatedVecEnv.reset
        patch.setattr(ActuatedVecEnv, "reset", lambda env: (reset(env), TERMINATE())[0])
        with pytest.raises(TrainingStoppedError, match=r"stopped after 0 steps: .* train --resume"):
            resume(CASES[name], out)
    assert not (out / "checkpoints").exists()
    resume(CASES[name], out)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_a_signal_stops_the_training_until_its_last_step(tmp_path, uninterrupted):
    name, out = "dqn, epsilon by episodes", tmp_path / "run"
    assert "stopped after 239 steps" in interrupt(CASES[name], out, 239, TERMINATE)
    with after(1, TERMINATE):
        resume(CASES[name], out)
    assert differing(uninterrupted(name), outcome(out)) == []


def test_a_second_training_in_a_folder_raises(tmp_path, uninterrupted):
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
