"""What cannot be trained, continued or loaded costs one line that says why and what to do, and changes nothing."""

import json
import pickle
import shutil
from pathlib import Path

import pytest

from codrl_mj.cli import main
from codrl_mj.training import history, load_config

TINY = "--total-steps 128 --num-envs 2 --agent.rollout-steps 64 --agent.batch-size 32 --agent.epochs 1 --agent.hidden 8"
TINY += " --evaluation-episodes 1 --no-tensorboard"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(history, "save_learning_curve", lambda *_: None)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("trained") / "run"
    assert main(["train", "cartpole", "--agent", "ppo", *TINY.split(), "--out", str(out)]) == 0
    return out


@pytest.fixture
def finished(trained):
    """A finished run `run`."""
    shutil.copytree(trained, "run")
    return Path("run")


@pytest.fixture
def unfinished(finished):
    """The same before it was finished."""
    for name in ("result.json", "policy.json", "policy.safetensors"):
        (finished / name).unlink()
    return finished


def files():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def refused(capsys, line):
    """The one line that bad input costs; nothing is written."""
    before = files()
    capsys.readouterr()
    assert main(line.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert files() == before
    return error


# -- continuing ---------------------------------------------------------------------------------------------


def test_a_finished_run_is_left_alone(capsys, finished):
    before = files()
    assert main(["train", "--resume", "run"]) == 0
    assert "run is finished already" in capsys.readouterr().out
    assert files() == before


@pytest.mark.parametrize("state", ["finished", "unfinished"])
@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--seed 3", "seed: 0 and 3"),
        ("--agent.gamma 0.5 --num-envs 4", "agent.gamma: 0.99 and 0.5; num_envs: 2 and 4"),
        ("--actuator ideal", "env.actuator.motor.resistance: 1.0 and 'absent'"),
        ("--config other.yaml", "seed: 0 and 9"),
        ("--agent dqn", "run is a training of ppo and continues as it began"),
        ("--settings paper", "leave --agent and --settings out"),
        ("--out elsewhere", "a run continues in its own folder, run"),
    ],
)
def test_what_contradicts_the_run_is_named(capsys, request, state, flags, expected):
    request.getfixturevalue(state)
    Path("other.yaml").write_text("task: cartpole\nagent: {name: ppo}\nseed: 9")
    assert expected in refused(capsys, f"train --resume run {flags}")


def test_what_agrees_with_the_run_may_be_said(unfinished):
    assert (
        main(["train", "cartpole", "--resume", "run", "--agent", "ppo", *TINY.split(), "--config", "run/config.json"])
        == 0
    )


def test_a_folder_that_is_no_run_is_named(capsys):
    Path("empty").mkdir()
    for folder in ("empty", "nowhere"):
        assert f"no run configuration at {folder}/config.json" in refused(capsys, f"train --resume {folder}")


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"train": {"task": "cartpole"}}', "\x00\x00", None], ids=[*"012345"]
)
def test_a_damaged_configuration_is_named(capsys, unfinished, content):
    if content is None:  # all is well but for the versions
        content = json.loads((unfinished / "config.json").read_text()) | {"versions": 5}
        del content["sha256"]
        content = json.dumps(content)
    (unfinished / "config.json").write_text(content)
    assert "run/config.json" in refused(capsys, "train --resume run")


def edit(config, **changes):
    content = json.loads(config.read_text())
    for name, change in changes.items():
        content[name] = change(content[name])
    del content["sha256"]  # it is edited on purpose
    config.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"code": lambda _: "0123456789abcdef"}, "the code of codrl_mj was 01234567, is "),
        ({"versions": lambda there: there | {"torch": "1.13"}}, "torch was 1.13, is 2."),
        ({"versions": lambda there: there | {"cython": "3"}}, "cython was 3, is absent"),
        ({"versions": lambda there: {name: there[name] for name in there if name != "numpy"}}, "numpy was absent, is "),
    ],
    ids=["code", "version", "package gone", "package new"],
)
def test_other_software_is_named_and_can_be_accepted(capsys, unfinished, changes, expected):
    edit(unfinished / "config.json", **changes)
    error = refused(capsys, "train --resume run")
    assert expected in error
    assert error.count(" was ") == 2  # it "was started" with one other thing
    assert "accept it with --accept-changes" in error
    assert main(["train", "--resume", "run", "--accept-changes"]) == 0
    assert (unfinished / "result.json").exists()


# -- starting -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("train pendulum --agent sarsa", "agents that can: ppo, ddpg, td3, sac"),
        ("train pendulum --agent dqn", "cannot act in the Box actions of pendulum"),
        ("train acrobot --agent ddpg", "agents that can: ppo, dqn, sarsa"),
        ("train cartpole --settings repaired", "settings = 'repaired': ppo on cartpole has no such settings; those on"),
        ("train --config other.yaml", "other.yaml: unknown key total_step; did you mean total_steps?"),
        ("train --config nowhere.yaml", "no configuration file at nowhere.yaml"),
        ("train --no-tensorboard pendulum", "name the task before the flags, as in codrl-mj train pendulum"),
    ],
)
def test_what_cannot_be_started_is_named(capsys, line, expected):
    Path("other.yaml").write_text("task: cartpole\ntotal_step: 5")
    assert expected in refused(capsys, line)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("train cartpole --settings printed", "--settings printed: must be one of default, paper, repaired"),
        ("train cartpole --agent pppo", "--agent pppo: did you mean 'ppo'?"),
        ("train cartpole --agent", "--agent needs a value"),
        ("train --config", "--config needs a value"),
        ("train --resume", "--resume needs a value"),
        ("train cartpole --agent.gama 0.9", "unknown flag --agent.gama: did you mean '--agent.gamma'?"),
        ("train", "codrl-mj train needs TASK"),
    ],
)
def test_what_is_no_command_line_is_explained(capsys, line, expected):
    assert expected in refused(capsys, line)
    assert files() == {}


def test_flags_win_over_the_file_and_leave_the_rest_of_it(tmp_path):
    Path("train.yaml").write_text(
        "task: cartpole\nseed: 5\nagent: {name: ppo, gamma: 0.9, learning_rate: 3e-4, rollout_steps: 64}\n"
        "actuator: {name: weaker, controller: {kp: 0.3}}\nenv: {center_radius: 0.2}"
    )
    flags = f"--config train.yaml --agent ppo --seed 6 --actuator.controller.ki 0.4 --env.inner-steps 2 {TINY}"
    assert main(["train", *flags.split(), "--out", "run"]) == 0
    config = load_config(Path("run"))
    assert (config.seed, config.agent.gamma, config.agent.learning_rate, config.agent.hidden) == (6, 0.9, 3e-4, (8,))
    assert (config.actuator.controller.kp, config.actuator.controller.ki, config.actuator.motor.arm_radius) == (
        0.3,
        0.4,
        0.15,
    )
    assert (config.env.options.center_radius, config.env.inner_steps) == (0.2, 2)


def test_the_task_is_found_behind_flags_and_beside_folders_of_its_name():
    line = "train --out pendulum --total-steps 10 pendulum --evaluation-episodes 1 --no-tensorboard"
    assert main([*line.split(), "--agent.learning-starts", "10"]) == 0
    config = load_config(Path("pendulum"))
    assert (config.task, config.agent.name) == ("pendulum", "ddpg")


# -- loading ------------------------------------------------------------------------------------------------


class Bomb:
    """Executes when it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


@pytest.fixture(scope="module")
def zip_of_sb3(tmp_path_factory):
    """A model that Stable-Baselines3 saved."""
    import gymnasium
    from stable_baselines3 import PPO

    path = tmp_path_factory.mktemp("sb3") / "model.zip"
    PPO("MlpPolicy", gymnasium.make("CartPole-v1"), n_steps=8, batch_size=8).save(path)
    return path


SHORT = {"evaluate": "--episodes 1", "render": "--out film.gif --width 160 --height 80"}


@pytest.mark.parametrize("verb", ["evaluate", "render"])
def test_a_zip_of_stable_baselines3_is_loaded_only_on_trust(capsys, zip_of_sb3, verb):
    line = f"{verb} {zip_of_sb3} --task cartpole --agent ppo {SHORT[verb]} --env.max-episode-steps 2"
    assert "Pass --trust if that author is you" in refused(capsys, line)
    assert main([*line.split(), "--trust"]) == 0


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--agent ppo --trust", "name its task with --task"),
        ("--task cartpole --trust", "name it with --agent"),
        ("--task cartpole --agent dqn --trust", "is not a model of dqn"),
        ("--task cartpole --agent sarsa --trust", "Stable-Baselines3 has no such agent"),
        ("--task cartpole --which best", "no run folder and holds one policy alone"),
    ],
)
def test_what_a_zip_does_not_say_is_asked_for(capsys, zip_of_sb3, flags, expected):
    assert expected in refused(capsys, f"evaluate {zip_of_sb3} {flags}")


def test_a_policy_alone_is_evaluated_once_its_task_is_named(capsys, trained):
    Path("alone").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(trained / name, "alone")
    assert "name its task with --task" in refused(capsys, "evaluate alone")
    assert "Unexpected observation shape" in refused(capsys, "evaluate alone --task pendulum")
    assert "leave --which out" in refused(capsys, "evaluate alone --task cartpole --which best")
    assert main(["evaluate", "alone", "--task", "cartpole", "--episodes", "3", "--out", "alone.json"]) == 0
    assert main(["evaluate", str(trained), "--episodes", "3", "--out", "run.json"]) == 0
    assert Path("alone.json").read_bytes() == Path("run.json").read_bytes()


def test_the_best_policy_of_a_run_is_asked_for_by_which(finished):
    for name in ("policy.json", "policy.safetensors"):
        (finished / name).write_bytes(b"")
    assert main(["evaluate", "run", "--which", "best", "--episodes", "1"]) == 0


def test_an_unfinished_run_has_only_a_best_policy(capsys, unfinished):
    error = refused(capsys, "evaluate run")
    assert "run is not finished" in error
    assert "codrl-mj train --resume run, or take its best one so far with --which best" in error
    assert main(["evaluate", "run", "--which", "best", "--episodes", "1"]) == 0


def test_a_task_that_the_run_was_not_trained_for_is_refused(capsys, finished):
    assert "run was trained for cartpole" in refused(capsys, "evaluate run --task pendulum")


def test_an_agent_that_did_not_train_the_run_is_refused(capsys, finished):
    assert "run was trained by ppo: leave --agent out" in refused(capsys, "evaluate run --agent dqn")


@pytest.mark.parametrize("which", ["last", "best"])
@pytest.mark.parametrize("name", ["policy.safetensors", "policy.json"])
def test_a_pickle_in_place_of_a_policy_is_not_executed(capsys, finished, which, name):
    place = finished if which == "last" else finished / "best"
    (place / name).write_bytes(pickle.dumps(Bomb()))
    assert str(place / name) in refused(capsys, f"evaluate run --which {which}")
    assert not Path("exploded").exists()
