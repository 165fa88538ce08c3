"""Damaged files in a run folder: the run goes back to what is intact, says so, and comes to the same result."""

import dataclasses
import hashlib
import json
import pickle
import random
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from codrl_mj.cli import main
from codrl_mj.runs.files import writing
from codrl_mj.training import TrainConfig, history, watcher
from codrl_mj.training.checkpoint import State, load_checkpoint, save_checkpoint
from tests.damage import damage
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
    assert [path.name[:17] for path in checkpoints(out)] == ["step-000000000128", "step-000000000192"]
    return out


@pytest.fixture
def stopped(stopped_once, tmp_path):
    """A run that was stopped after 192 of 240 steps, with two checkpoints."""
    return shutil.copytree(stopped_once, tmp_path / "run")


def checkpoints(out):
    return sorted((out / "checkpoints").iterdir())


class Bomb:
    """Executes when it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def replace_by_a_pickle(path):
    path.write_bytes(pickle.dumps(Bomb()))


def forge(content, path):
    """Replace a checkpoint by what has the right digest in its name, and nothing else."""
    path.with_name(f"{path.name[:18]}{hashlib.sha256(content).hexdigest()[:16]}.safetensors").write_bytes(content)
    path.unlink()


def replace_by_another_runs(path):
    """A checkpoint that is intact, of a run with another seed, at the same step."""
    other = path.parents[2] / "other"
    interrupt(dataclasses.replace(CONFIG, seed=4), other, 180, TERMINATE)
    (last,) = (other for other in checkpoints(other) if other.name[:17] == path.name[:17])
    path.unlink()
    shutil.copy(last, path.parent)


DAMAGES = {
    "truncated": truncate,
    "a bit flipped": flip_a_bit,
    "emptied": lambda path: path.write_bytes(b""),
    "a pickle": replace_by_a_pickle,
    "a pickle with the right digest": lambda path: forge(pickle.dumps(Bomb()), path),
    "tensors with the right digest": lambda path: forge(save({"a": np.zeros(3)}), path),
    "another run's": replace_by_another_runs,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_the_one_before_taken(tmp_path, stopped, expected, monkeypatch, damage):
    monkeypatch.chdir(tmp_path)
    DAMAGES[damage](checkpoints(stopped)[-1])
    last = checkpoints(stopped)[-1]
    with pytest.warns(UserWarning, match="going back to the one before") as caught:
        resume(CONFIG, stopped)
    assert [str(warning.message).startswith(f"checkpoint {last} cannot be used") for warning in caught] == [True]
    assert differing(expected, outcome(stopped)) == []
    assert not Path("exploded").exists()


def test_where_all_are_damaged_the_run_starts_anew(stopped, expected):
    for path in checkpoints(stopped):
        truncate(path)
    with pytest.warns(UserWarning, match="cannot be used") as caught:
        resume(CONFIG, stopped)
    messages = [str(warning.message) for warning in caught]
    assert ["starting anew" in message for message in messages] == [False, True]
    assert differing(expected, outcome(stopped)) == []


def test_without_any_the_run_starts_anew(stopped, expected):
    shutil.rmtree(stopped / "checkpoints")
    resume(CONFIG, stopped)
    assert differing(expected, outcome(stopped)) == []


# -- which checkpoints are kept -----------------------------------------------------------------------------


def state_at(step):
    return State({"array": np.full(4, float(step))}, {"num_timesteps": step})


def steps_kept(folder):
    return [int(path.name[5:17]) for path in sorted(folder.iterdir())]


def test_the_last_two_are_kept_and_the_last_is_loaded(tmp_path):
    assert load_checkpoint(tmp_path / "nowhere", "a run") is None
    for step in (10, 20, 30):
        save_checkpoint(tmp_path, state_at(step), "a run")
    assert steps_kept(tmp_path) == [20, 30]
    loaded = load_checkpoint(tmp_path, "a run")
    assert loaded.facts == {"num_timesteps": 30}
    assert loaded.arrays["array"].tolist() == [30.0] * 4


def test_a_damaged_one_of_a_later_step_is_not_kept_in_place_of_an_intact_one(tmp_path):
    for step in (10, 20):
        save_checkpoint(tmp_path, state_at(step), "a run")
    truncate(sorted(tmp_path.iterdir())[-1])
    save_checkpoint(tmp_path, state_at(15), "a run")  # of the run that fell back to 10
    assert steps_kept(tmp_path) == [10, 15]


def test_however_a_few_bytes_are_damaged_the_one_before_is_loaded_whole(tmp_path):
    random_ = random.Random(0)
    for step in (10, 20):
        last = save_checkpoint(tmp_path, state_at(step), "a run")
    whole = last.read_bytes()
    for _ in range(150):
        last.write_bytes(damage(whole, random_))
        with pytest.warns(UserWarning, match=f"{last} cannot be used"):
            loaded = load_checkpoint(tmp_path, "a run")
        assert loaded.facts == {"num_timesteps": 10}
        assert loaded.arrays["array"].tolist() == [10.0] * 4


def test_of_one_step_the_last_written_is_kept_beside_the_one_before(tmp_path):
    save_checkpoint(tmp_path, state_at(10), "a run")
    for seconds in (1.0, 2.0, 3.0):
        state = State({}, {"num_timesteps": 20, "seconds": seconds})
        save_checkpoint(tmp_path, state, "a run")
    assert steps_kept(tmp_path) == [10, 20]
    assert load_checkpoint(tmp_path, "a run").facts["seconds"] == 3.0


# -- other files --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["progress.csv", "episodes.csv"])
def test_a_half_written_row_is_repaired(stopped, expected, table):
    with (stopped / table).open("a") as file:
        file.write("7,1")  # what was flushed of a row when the process was killed
    resume(CONFIG, stopped)
    assert differing(expected, outcome(stopped)) == []


@pytest.fixture
def leave_half_written():
    """Leaves what `writing` leaves if the process is killed within its block, whose end is not reached."""
    entered = []

    def leave(path):
        entered.append(writing(path))
        temporary = entered[-1].__enter__()
        temporary.write_bytes(b"half")
        return temporary

    return leave


def test_what_a_killed_process_left_half_written_goes_and_nothing_else(stopped, leave_half_written):
    names = ["policy.json", "best/policy.safetensors", "result.json", "progress.csv", "learning_curve.png"]
    names += [f"checkpoints/{checkpoints(stopped)[0].name}"]
    ours = [leave_half_written(stopped / name) for name in names]
    others = [leave_half_written(stopped / name) for name in ("notes.txt", "best/film.mp4")]
    others += [stopped / ".policy.json", stopped / ".policy-old.json", stopped / "checkpoints" / ".keep"]
    for path in others:
        path.touch()
    assert all(path.exists() for path in ours)
    resume(CONFIG, stopped)
    assert [path for path in ours if path.exists()] == []
    assert [path for path in others if not path.exists()] == []


def test_a_folder_in_which_nothing_was_begun_yet_is_started(tmp_path, expected, leave_half_written):
    """Who was to train in it was killed between taking it and writing the configuration."""
    out = tmp_path / "run"
    out.mkdir()
    (out / ".lock").touch()
    leave_half_written(out / "config.json")
    resume(CONFIG, out)
    assert differing(expected, outcome(out)) == []


# -- a full disk --------------------------------------------------------------------------------------------


def no_file_larger_than(size):
    """Every write beyond that fails, as it does on a full disk, for the rest of the block."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@pytest.fixture
def limits():
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [8000, 1200, 120], ids=["checkpoint", "policy", "table"])
def test_where_nothing_can_be_written_the_error_is_one_line_and_the_run_goes_on_later(
    stopped, expected, capsys, limits, size
):
    before = {path.name: path.read_bytes() for path in checkpoints(stopped)}
    no_file_larger_than(size)
    status = main(["train", "--resume", str(stopped), "--no-tensorboard"])
    no_file_larger_than(resource.RLIM_INFINITY)
    error = capsys.readouterr().err
    assert (status, error.count("\n")) == (2, 1)
    assert error.startswith(f"codrl-mj: error: training in {stopped} was broken off: ")
    assert "File too large" in error
    assert error.endswith(f"continue with codrl-mj train --resume {stopped}\n")
    assert {path.name: path.read_bytes() for path in checkpoints(stopped)} == before
    assert [path for path in stopped.rglob(".*") if path.name != ".lock"] == []
    assert main(["train", "--resume", str(stopped), "--no-tensorboard"]) == 0
    assert differing(expected, outcome(stopped)) == []


@pytest.mark.parametrize("best", [False, True])
def test_where_nothing_can_be_written_before_a_checkpoint_it_says_what_there_is(tmp_path, capsys, limits, best):
    """No policy fits into so much; or the best policy does, and no checkpoint."""
    out = tmp_path / "run"
    rarely = dataclasses.replace(CONFIG, checkpoint_interval=10**6)
    yaml = tmp_path / "train.yaml"
    yaml.write_text(json.dumps((rarely if best else CONFIG).as_mapping()))
    no_file_larger_than(8000 if best else 1200)
    assert main(["train", "--config", str(yaml), "--out", str(out), "--no-tensorboard"]) == 2
    no_file_larger_than(resource.RLIM_INFINITY)
    error = capsys.readouterr().err
    assert "no checkpoint" in error
    assert ("its best policy so far" in error) == best == out.exists()
