"""A training that was interrupted, however and how often, comes to the very result of one that was not."""

import functools

import pytest

from codrl_mj.training import TrainConfig, curve, finished, watcher
from tests.training.interruptions import (
    CASES,
    INTERRUPT,
    TERMINATE,
    Crash,
    crash,
    differing,
    interrupt,
    outcome,
    resume,
)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Reports as often as checkpoints, evaluations of short episodes, and no picture at the end."""
    monkeypatch.setattr(TrainConfig, "evaluation_env", property(lambda config: config.env))
    monkeypatch.setattr(watcher, "REPORT_INTERVAL", 40)
    monkeypatch.setattr(curve, "draw_learning_curve", lambda *_: None)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """What the cases come to, each trained once."""

    @functools.cache
    def train_once(name):
        return outcome(resume(CASES[name], tmp_path_factory.mktemp("uninterrupted") / "run"))

    return train_once


@pytest.mark.parametrize("name", CASES)
def test_a_run_of_interruptions_changes_nothing(tmp_path, uninterrupted, name):
    config, out = CASES[name], tmp_path / "run"
    interrupt(config, out, 1, TERMINATE)  # before the first checkpoint
    interrupt(config, out, 70, crash)  # past a checkpoint
    interrupt(config, out, 1, INTERRUPT)
    interrupt(config, out, 1, TERMINATE)  # twice in a row
    interrupt(config, out, 40, INTERRUPT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curve, "draw_learning_curve", crash)  # after the last checkpoint, before result.json
        with pytest.raises(Crash):
            resume(config, out)
    assert not finished(out)
    resume(config, out)
    assert differing(uninterrupted(name), outcome(out)) == []
