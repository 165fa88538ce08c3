"""Invalid input gives one line with the reason and the remedy, and changes nothing."""

import json
import shutil
from pathlib import Path

import gymnasium
import pytest
from stable_baselines3 import PPO

from codrl_mj.cli import main
from codrl_mj.training import history, load_config

TINY = (
    "--total-steps 128 --num-envs 2 --agent.rollout-steps 64 --agent.batch-size 32 --agent.epochs 1"
    " --agent.hidden 8"
)
TINY += " --evaluation-episodes 1 --no-tensorboard"
POLICY = ("policy.json", "policy.safetensors")
TYPO, OTHER = "task: cartpole\ntotal_step: 5", "task: cartpole\nagent: {name: ppo}\nseed: 9"


@pytest.fixture(scope="module")
def source_folder(tmp_path_factory):
    """Return a folder with the files of the command lines: runs, a policy, files of others."""
    folder = tmp_path_factory.mktemp("source")
    do(f"train cartpole --agent ppo {TINY} --out {folder / 'run'}")
    for name in ("unfinished", "cut", "little", "unversioned"):
        shutil.copytree(folder / "run", folder / name)
        for file in ("result.json", *POLICY):
            (folder / name / file).unlink()
    (folder / "cut/config.json").write_text("{")
    (folder / "little/config.json").write_text('{"train": {"task": "cartpole"}}')
    edit(folder / "unversioned/config.json", versions=lambda _: 5)
    for name in ("alone", "empty"):
        (folder / name).mkdir()
    for name in POLICY:
        shutil.copy(folder / "run" / name, folder / "alone")
    PPO("MlpPolicy", gymnasium.make("CartPole-v1"), n_steps=8, batch_size=8).save(
        folder / "model.zip"
    )
    (folder / "typo.yaml").write_text(TYPO)
    (folder / "other.yaml").write_text(OTHER)
    return folder


@pytest.fixture(autouse=True)
def in_copied_folder(source_folder, tmp_path, monkeypatch):
    """Run the test in a copy of the folder."""
    monkeypatch.setattr(history, "save_learning_curve", lambda *_: None)
    monkeypatch.chdir(shutil.copytree(source_folder, tmp_path / "copy"))


def edit(config, **changes):
    content = json.loads(config.read_text())
    for name, change in changes.items():
        content[name] = change(content[name])
    # Without its digest, an edited file is not reported as damaged.
    del content["sha256"]
    config.write_text(json.dumps(content))


def files():
    return {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def do(line):
    assert main(line.split()) == 0


def error_of(capsys, *line):
    """Return the single line of error of bad input; nothing may be written."""
    before = files()
    capsys.readouterr()
    assert main([*line]) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert files() == before
    return error


@pytest.mark.parametrize("run", ["run", "unfinished"])
@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--seed 3", "seed: 0 and 3"),
        ("--agent.gamma 0.5 --num-envs 4", "agent.gamma: 0.99 and 0.5; num_envs: 2 and 4"),
        ("--actuator ideal", "env.actuator.motor.resistance: 1.0 and 'absent'"),
        ("--config other.yaml", "seed: 0 and 9"),
        ("--agent dqn", "{} is a training of ppo and continues unchanged"),
        ("--settings paper", "omit --agent and --settings"),
        ("--out elsewhere", "a run continues in its own folder, {}"),
    ],
)
def test_flags_that_contradict_a_run_raise(capsys, run, flags, expected):
    assert expected.format(run) in error_of(capsys, "train", "--resume", run, *flags.split())


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("train --resume empty", "no run configuration at empty/config.json"),
        ("train --resume nowhere", "no run configuration at nowhere/config.json"),
        (
            "train --resume cut",
            "cut/config.json is not a run configuration: it is truncated or not JSON",
        ),
        ("train --resume little", "little/config.json: not a run configuration: "),
        (
            "train --resume unversioned",
            "unversioned/config.json: not a run configuration: versions = 5",
        ),
        # Not a training.
        ("train pendulum --agent sarsa", "agents that can: ppo, ddpg, td3, sac"),
        ("train pendulum --agent dqn", "cannot act in the Box actions of pendulum"),
        ("train acrobot --agent ddpg", "agents that can: ppo, dqn, sarsa"),
        (
            "train cartpole --settings repaired",
            "settings = 'repaired': ppo on cartpole has no such settings; those on",
        ),
        (
            "train --config typo.yaml",
            "typo.yaml: unknown key total_step; did you mean total_steps?",
        ),
        ("train --config nowhere.yaml", "no configuration file at nowhere.yaml"),
        (
            "train --no-tensorboard pendulum",
            "name the task before the flags, as in codrl-mj train pendulum",
        ),
        # Not a command line.
        (
            "train cartpole --settings printed",
            "--settings printed: must be one of default, paper, repaired",
        ),
        ("train cartpole --agent pppo", "--agent pppo: did you mean 'ppo'?"),
        ("train cartpole --agent", "--agent needs a value"),
        ("train --config", "--config needs a value"),
        ("train --resume", "--resume needs a value"),
        (
            "train cartpole --agent.gama 0.9",
            "unknown flag --agent.gama: did you mean '--agent.gamma'?",
        ),
        ("train", "codrl-mj train needs TASK"),
        # No policy of this task or agent, or only one.
        ("evaluate unfinished", "unfinished is not finished"),
        (
            "evaluate unfinished",
            "codrl-mj train --resume unfinished, or use its best policy so far with --which best",
        ),
        ("evaluate run --task pendulum", "run was trained for cartpole"),
        ("evaluate run --agent dqn", "run was trained by ppo: omit --agent"),
        ("evaluate alone", "name it with --task"),
        ("evaluate alone --task pendulum", "observation_space: the policy was trained with Box"),
        ("evaluate alone --task cartpole --which best", "omit --which"),
        # A zip file may contain code, and is loaded only with --trust.
        ("evaluate model.zip --task cartpole --agent ppo", "Pass --trust if you are the author"),
        (
            "render model.zip --task cartpole --agent ppo --out film.gif",
            "Pass --trust if you are the author",
        ),
        ("evaluate nowhere.zip --task cartpole --agent ppo", "no model at nowhere.zip"),
        ("evaluate model.zip --agent ppo --trust", "name it with --task"),
        ("evaluate model.zip --task cartpole --trust", "name it with --agent"),
        ("evaluate model.zip --task cartpole --agent dqn --trust", "is not a model of dqn"),
        (
            "evaluate model.zip --task cartpole --agent sarsa --trust",
            "Stable-Baselines3 has no such agent",
        ),
        (
            "evaluate model.zip --task cartpole --which best",
            "not a run folder and has a single policy",
        ),
    ],
)
def test_impossible_commands_raise(capsys, line, expected):
    assert expected in error_of(capsys, *line.split())


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"code": lambda _: "0123456789abcdef"}, "the code of codrl_mj was 01234567, is "),
        ({"versions": lambda versions: versions | {"torch": "1.13"}}, "torch was 1.13, is 2."),
        ({"versions": lambda versions: versions | {"cython": "3"}}, "cython was 3, is absent"),
        (
            {
                "versions": lambda versions: {
                    name: versions[name] for name in versions if name != "numpy"
                }
            },
            "numpy was absent, is ",
        ),
    ],
    ids=["code", "version", "package gone", "package new"],
)
def test_other_software_raises_and_can_be_accepted(capsys, changes, expected):
    edit(Path("unfinished/config.json"), **changes)
    error = error_of(capsys, "train", "--resume", "unfinished")
    assert expected in error
    # The message has "was started" and a single difference.
    assert error.count(" was ") == 2
    assert "accept the change with --accept-changes" in error
    do("train --resume unfinished --accept-changes")
    assert Path("unfinished/result.json").exists()


# -- what is done ----------------------------------------------------------------------------------


def test_a_finished_run_is_not_changed(capsys):
    before = files()
    do("train --resume run")
    assert "run is already finished" in capsys.readouterr().out
    assert files() == before


@pytest.mark.parametrize(
    "line",
    [
        # it agrees
        f"train cartpole --resume unfinished --agent ppo {TINY} --config unfinished/config.json",
        "evaluate unfinished --which best --episodes 1",
        (
            "evaluate model.zip --task cartpole --agent ppo --trust --episodes 1"
            " --env.max-episode-steps 2"
        ),
        (
            "render model.zip --task cartpole --agent ppo --trust --env.max-episode-steps 2 --width"
            " 160 --height 80 --out film.gif"
        ),
    ],
)
def test_minimal_input_is_accepted(line):
    do(line)


def test_a_separate_policy_equals_that_of_its_run_and_the_best_one_differs():
    do("evaluate alone --task cartpole --episodes 3 --out alone.json")
    do("evaluate run --episodes 3 --out run.json")
    assert Path("alone.json").read_bytes() == Path("run.json").read_bytes()
    for name in POLICY:
        Path("run", name).write_bytes(b"")
    do("evaluate run --which best --episodes 1")


def test_flags_override_the_files_values_only():
    Path("train.yaml").write_text(
        "task: cartpole\nseed: 5\nagent: {name: ppo, gamma: 0.9, learning_rate: 3e-4,"
        " rollout_steps: 64}\nactuator: {name: weaker, controller: {kp: 0.3}}\nenv: {center_radius:"
        " 0.2}"
    )
    flags = "--agent ppo --seed 6 --actuator.controller.ki 0.4 --env.inner-steps 2"
    do(f"train --config train.yaml {flags} {TINY} --out new")
    config = load_config(Path("new"))
    agent, loop, arm = config.agent, config.actuator.controller, config.actuator.motor.arm_radius
    assert (config.seed, agent.gamma, agent.learning_rate, agent.hidden) == (6, 0.9, 3e-4, (8,))
    assert (loop.kp, loop.ki, arm) == (0.3, 0.4, 0.15)
    assert (config.env.options.center_radius, config.env.inner_steps) == (0.2, 2)


def test_the_task_is_found_after_flags_and_beside_a_folder_of_its_name():
    flags = "--evaluation-episodes 1 --no-tensorboard --agent.learning-starts 10"
    do(f"train --out pendulum --total-steps 10 pendulum {flags}")
    config = load_config(Path("pendulum"))
    assert (config.task, config.agent.name) == ("pendulum", "ddpg")
