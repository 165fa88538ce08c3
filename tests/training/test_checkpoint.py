"""A run with damaged files continues from intact ones, warns, and gives the same result."""

import contextlib
import dataclasses
import hashlib
import json
import pickle
import random
import resource
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from codrl_mj.cli import main
from codrl_mj.runs.files import atomic_write
from codrl_mj.training import TrainConfig, history, watcher
from codrl_mj.training.checkpoint import State, load_checkpoint, save_checkpoint
from tests.damage import Bomb, damage
from tests.training.interruptions import CASES, TERMINATE, differing, interrupt, outcome, resume

CONFIG = CASES["ppo, one optimiser"]


@pytest.fixture(autouse=True, scope="module")
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watcher, "REPORT_INTERVAL", 40)
        patch.setattr(TrainConfig, "evaluation_env", property(lambda config: config.env))
        patch.setattr(history, "save_learning_curve", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return outcome(resume(CONFIG, tmp_path_factory.mktemp("uninterrupted") / "run"))


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory):
    out = tmp_path_factory.mktemp("stopped") / "run"
    interrupt(CONFIG, out, 180, TERMINATE)
    assert [path.name[:17] for path in checkpoints(out)] == [
        "step-000000000128",
        "step-000000000192",
    ]
    return out


@pytest.fixture
def stopped(stopped_once, tmp_path):
    """Return a run that was stopped after 192 of 240 steps, with two checkpoints."""
    return shutil.copytree(stopped_once, tmp_path / "run")


def checkpoints(out):
    return sorted((out / "checkpoints").iterdir())


# -- what is damaged -------------------------------------------------------------------------------


def flip_a_bit(content):
    return content[:5000] + bytes([content[5000] ^ 1]) + content[5001:]


def last(change):
    """Return a function that changes the content of the last checkpoint."""
    return lambda out: checkpoints(out)[-1].write_bytes(change(checkpoints(out)[-1].read_bytes()))


def forged(content):
    """Return a function that replaces the last checkpoint by content with a valid digest only."""

    def replace(out):
        path = checkpoints(out)[-1]
        path.unlink()
        digest = hashlib.sha256(content).hexdigest()[:16]
        path.with_name(f"{path.name[:18]}{digest}.safetensors").write_bytes(content)

    return replace


def replace_by_another_runs(out):
    """Replace the checkpoints by intact ones of a run with another seed."""
    interrupt(dataclasses.replace(CONFIG, seed=4), out.parent / "other", 180, TERMINATE)
    shutil.rmtree(out / "checkpoints")
    shutil.copytree(out.parent / "other/checkpoints", out / "checkpoints")


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


def half_a_row(table):
    """Return a function that appends an incomplete row, as after a kill."""
    return lambda out: (out / table).write_text((out / table).read_text() + "7,1")


BOMB = pickle.dumps(Bomb(Path("exploded")))
BACK, RESTART = "going back to the previous one", "there is no other: starting from the beginning"
# The damage, and the remedy in the warning of each checkpoint that cannot be used.
DAMAGES = {
    "truncated": (lambda out: cut(checkpoints(out)[-1]), [BACK]),
    "a bit flipped": (last(flip_a_bit), [BACK]),
    "emptied": (last(lambda _: b""), [BACK]),
    "a pickle": (last(lambda _: BOMB), [BACK]),
    "a pickle with the right digest": (forged(BOMB), [BACK]),
    "tensors with the right digest": (forged(save({"a": np.zeros(3)})), [BACK]),
    "another program's": (forged(save({"a": np.zeros(3)}, metadata={"format": "pt"})), [BACK]),
    "another run's": (replace_by_another_runs, [BACK, RESTART]),
    "all truncated": (lambda out: [*map(cut, checkpoints(out))], [BACK, RESTART]),
    "none left": (lambda out: shutil.rmtree(out / "checkpoints"), []),
    "half a report": (half_a_row("progress.csv"), []),
    "half an episode": (half_a_row("episodes.csv"), []),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_run_goes_back_to_an_intact_checkpoint_with_the_same_result(
    stopped, expected, monkeypatch, name
):
    monkeypatch.chdir(stopped.parent)
    harm, remedies = DAMAGES[name]
    harm(stopped)
    unusable = checkpoints(stopped)[::-1][: len(remedies)] if remedies else []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        resume(CONFIG, stopped)
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == len(remedies)
    for message, path, remedy in zip(messages, unusable, remedies, strict=True):
        assert message.startswith(f"checkpoint {path} cannot be used")
        assert message.endswith(remedy)
    assert differing(expected, outcome(stopped)) == []
    assert not Path("exploded").exists()


# -- which checkpoints are kept --------------------------------------------------------------------


def state_at(step, number=0):
    return State({"array": np.full(4, float(step))}, {"num_timesteps": step, "number": number})


@pytest.mark.parametrize(
    ("steps", "damaged", "remaining"),
    [
        ((10, 20, 30), None, [20, 30]),
        # The previous checkpoint, and the last one of its step.
        ((10, 20, 20, 20), None, [10, 20]),
        # The run went back to step 10.
        ((10, 20, 15), 20, [10, 15]),
    ],
)
def test_the_last_two_checkpoints_remain_and_the_last_written_is_loaded(
    tmp_path, steps, damaged, remaining
):
    assert load_checkpoint(tmp_path / "nowhere", "a run") is None
    for number, step in enumerate(steps):
        path = save_checkpoint(tmp_path, state_at(step, number), "a run")
        if step == damaged:
            cut(path)
    assert [int(path.name[5:17]) for path in sorted(tmp_path.iterdir())] == remaining
    loaded = load_checkpoint(tmp_path, "a run")
    assert loaded.facts == {"num_timesteps": steps[-1], "number": len(steps) - 1}
    assert loaded.arrays["array"].tolist() == [steps[-1]] * 4


def test_the_previous_checkpoint_is_loaded_after_any_damage(tmp_path):
    random_ = random.Random(0)
    for step in (10, 20):
        path = save_checkpoint(tmp_path, state_at(step), "a run")
    whole = path.read_bytes()
    for _ in range(150):
        path.write_bytes(damage(whole, random_))
        with pytest.warns(UserWarning, match=f"{path} cannot be used"):
            loaded = load_checkpoint(tmp_path, "a run")
        assert loaded.facts == {"num_timesteps": 10, "number": 0}
        assert loaded.arrays["array"].tolist() == [10.0] * 4


# -- what a killed process leaves ------------------------------------------------------------------


@pytest.fixture
def leave_temporary_file():
    """Leave a temporary file, as `atomic_write` does if the process is killed in its block."""
    entered = []

    def leave(path):
        entered.append(atomic_write(path))
        temporary = entered[-1].__enter__()
        temporary.write_bytes(b"half")
        return temporary

    return leave


def test_only_temporary_files_of_a_killed_process_are_deleted(stopped, leave_temporary_file):
    names = [
        "policy.json",
        "best/policy.safetensors",
        "result.json",
        "progress.csv",
        "learning_curve.png",
    ]
    names += [f"checkpoints/{checkpoints(stopped)[0].name}"]
    ours = [leave_temporary_file(stopped / name) for name in names]
    others = [leave_temporary_file(stopped / name) for name in ("notes.txt", "best/film.mp4")]
    others += [
        stopped / ".policy.json",
        stopped / ".policy-old.json",
        stopped / "checkpoints" / ".keep",
    ]
    for path in others:
        path.touch()
    assert all(path.exists() for path in ours)
    resume(CONFIG, stopped)
    assert [path for path in ours if path.exists()] == []
    assert [path for path in others if not path.exists()] == []


def test_a_training_starts_in_a_locked_but_empty_folder(tmp_path, expected, leave_temporary_file):
    """The process was killed between locking the folder and writing the configuration."""
    out = tmp_path / "run"
    out.mkdir()
    (out / ".lock").touch()
    leave_temporary_file(out / "config.json")
    resume(CONFIG, out)
    assert differing(expected, outcome(out)) == []


# -- a full disk -----------------------------------------------------------------------------------


@contextlib.contextmanager
def no_file_larger_than(size):
    """Let writes beyond a size fail within the block, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [8000, 1200, 120], ids=["checkpoint", "policy", "table"])
def test_a_full_disk_gives_one_line_and_the_run_continues_later(stopped, expected, capsys, size):
    line = ["train", "--resume", str(stopped), "--no-tensorboard"]
    before = {path.name: path.read_bytes() for path in checkpoints(stopped)}
    with no_file_larger_than(size):
        assert main(line) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith(f"codrl-mj: error: training in {stopped} was interrupted: ")
    assert "File too large" in error
    assert error.endswith(f"continue with codrl-mj train --resume {stopped}\n")
    assert {path.name: path.read_bytes() for path in checkpoints(stopped)} == before
    assert [path for path in stopped.rglob(".*") if path.name != ".lock"] == []
    assert main(line) == 0
    assert differing(expected, outcome(stopped)) == []


@pytest.mark.parametrize("best", [False, True])
def test_a_full_disk_before_a_checkpoint_names_the_remaining_files(tmp_path, capsys, best):
    """Either no policy fits on the disk, or the best policy does, but no checkpoint."""
    out, yaml = tmp_path / "run", tmp_path / "train.yaml"
    config = dataclasses.replace(CONFIG, checkpoint_interval=10**6) if best else CONFIG
    yaml.write_text(json.dumps(config.as_mapping()))
    with no_file_larger_than(8000 if best else 1200):
        assert main(["train", "--config", str(yaml), "--out", str(out), "--no-tensorboard"]) == 2
    error = capsys.readouterr().err
    assert "no checkpoint" in error
    assert ("best policy so far" in error) == best == out.exists()
