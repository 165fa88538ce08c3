"""Run folders: reading incomplete and damaged ones, and comparing them."""

import datetime
import hashlib
import json
import os
from pathlib import Path

import pytest

from codrl_mj.actuators import (
    CurrentLoop,
    DCMotorActuator,
    Motor,
    mapping_of,
    override_actuator,
    resolve,
)
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.runs.files import write_json
from codrl_mj.runs.summaries import SORT_KEYS, compare, find_runs, read_run, sort_runs
from codrl_mj.tasks import named_actuator
from codrl_mj.training.config import TrainConfig
from codrl_mj.training.folder import load_config
from codrl_mj.viz.pages import report
from tests.training.interruptions import begin

PROGRESS = "steps,episodes,mean_return,steps_per_second,seconds\n"
UNITS = {"returns": "reward", "tracking_rms": "N*m", "peak_voltage": "V"}


GEARED = override_actuator(resolve("kraken-x60", None, "nobody"), {"motor": {"gear_ratio": 70.3}})
OWN = override_actuator(GEARED, {"motor": {"resistance": 0.5}})


def make_run(
    folder, actuator="weaker", *, seed=3, task="cartpole", finished=True, evaluated=True, **train
):
    """Write a run folder as trainings do."""
    motor = named_actuator(actuator, task) if isinstance(actuator, str) else actuator
    env = {"task": task, "actuator": mapping_of(motor), "disturbances": {"command_delay": 0.0}}
    agent = {"name": "ppo", "learning_rate": 1e-3, "hidden": [64, 64]}
    config = {"agent": agent, "seed": seed, "total_steps": 4000, "env": env} | train
    last = 4096 if finished else 2000
    write_json(folder / "config.json", {"train": config, "versions": {"torch": "2.13.0"}})
    (folder / "progress.csv").write_text(
        f"{PROGRESS}1000,9,20.5,500,2.5\n{last},12,90.25,500,4.5\n"
    )
    if finished:
        for policy_folder in (folder, folder / "best"):
            write_json(
                policy_folder / "policy.json",
                {"weights_sha256": hashlib.sha256(b"weights").hexdigest()},
            )
            (policy_folder / "policy.safetensors").write_bytes(b"weights")
        write_json(folder / "result.json", {"steps": 4096, "mean_return": 91.0, "seconds": 8.25})
    if evaluated:
        returns = {"mean": 400.0 + seed, "low": 380.0, "high": 420.0}
        measures = {"returns": returns, "tracking_rms": 0.1, "peak_voltage": None, "units": UNITS}
        write_json(folder / "evaluation.json", measures)
    return folder


def test_a_finished_run_has_its_configuration_and_results(tmp_path):
    folder = make_run(tmp_path / "mine")
    for index, file in enumerate(sorted(folder.iterdir())):
        os.utime(file, (0, 1_700_000_000 + index))
    run = read_run(folder)
    assert (run.name, run.state, run.problem) == ("mine", "finished", None)
    assert (run.task, run.agent, run.actuator, run.seed) == ("cartpole", "ppo", "weaker", 3)
    assert (run.steps, run.total_steps, run.seconds) == (4096, 4000, 8.25)
    assert (run.mean_return, run.evaluation_return) == (
        90.25,
        403.0,
    )  # From the last report, and from the evaluation.
    assert run.configuration["env.disturbances.command_delay"] == 0.0
    assert run.configuration["versions.torch"] == "2.13.0"
    mapping = json.loads(json.dumps(run.as_mapping()))
    assert (
        run.modified
        == 1_700_000_000 + index
        == datetime.datetime.fromisoformat(mapping["modified"]).timestamp()
    )
    assert mapping["evaluation_return"] == 403.0


@pytest.mark.parametrize(
    "rest", ["", "3000,1", "3000,15,9"], ids=["whole", "half a row", "most of a row"]
)
def test_an_unfinished_run_has_the_state_of_its_last_complete_report(tmp_path, rest):
    folder = make_run(tmp_path / "mine", finished=False, evaluated=False)
    with (folder / "progress.csv").open("a") as file:
        file.write(rest)
    run = read_run(folder)
    assert (run.state, run.steps, run.mean_return, run.seconds) == ("unfinished", 2000, 90.25, 4.5)
    assert run.evaluation_return is None


def test_the_time_of_a_run_without_seconds_follows_from_its_steps_per_second(tmp_path):
    folder = make_run(tmp_path / "mine", finished=False)
    (folder / "progress.csv").write_text(
        "steps,total_steps,mean_return,mean_length,steps_per_second\n3000,4000,nan,,750"
    )
    run = read_run(folder)
    assert (run.steps, run.mean_return, run.seconds) == (3000, None, 4.0)


@pytest.mark.parametrize(
    ("actuator", "task", "name"),
    [
        ("ideal", "cartpole", "ideal"),
        ("paper", "acrobot", "paper"),
        ("open_loop", "pendulum", "open_loop"),
        (
            named_actuator("paper", "cartpole"),
            "pendulum",
            "custom",
        ),  # Named, but not for this task.
        (DCMotorActuator(Motor(resistance=7.0)), "pendulum", "custom"),
        (DCMotorActuator(Motor(), CurrentLoop(max_voltage=float("inf"))), "pendulum", "custom"),
        (GEARED, "cartpole", "kraken-x60"),  # Recognized by its numbers, with any gear.
        (OWN, "cartpole", "drive"),
    ],
)
def test_the_actuator_has_its_name_for_the_task(tmp_path, actuator, task, name):
    assert read_run(make_run(tmp_path / "mine", actuator, task=task)).actuator == name


def test_motors_keep_the_labels_of_the_run(tmp_path):
    patterns = {"a": "kraken-x60", "b": {"label": "drawer", **OWN.as_mapping()}, "c": None}
    config, folder = TrainConfig(EnvConfig("HalfCheetah-v5", patterns)), tmp_path / "told"
    begin(folder, config)
    run = read_run(folder)
    assert (
        run.actuator
        == load_config(folder).env.actuator_label
        == config.env.actuator_label
        == "kraken-x60, drawer, ideal"
    )
    sentence = " ".join(report._sentence(run).split())
    assert "PPO on HalfCheetah-v5 through the actuators kraken-x60, drawer, ideal" in sentence
    assert "labels" not in str(config.as_mapping()) + str(run.configuration)


@pytest.mark.parametrize("actuator", [{"motor": {"colour": 3}}, 7, [["weaker"]]])
def test_an_unreadable_actuator_is_called_custom(tmp_path, actuator):
    env = {"task": "cartpole", "actuator": actuator}
    assert read_run(make_run(tmp_path / "mine", env=env)).actuator == "custom"


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("config.json", b"{", "config.json is not a run configuration: it is truncated"),
        ("config.json", b"[1]", "not a JSON object"),
        ("config.json", b"{}", "it has no 'train'"),
        ("config.json", b'{"train": 4}', "it has no 'train'"),
        ("config.json", b"\xff\xfe", "not JSON"),
        ("config.json", b"[" * 100_000, "recursion"),
        ("result.json", b'{"steps": 1', "result.json is not a result of a run"),
        (
            "evaluation.json",
            b"3",
            "evaluation.json is not a policy evaluation: it is not a JSON object",
        ),
        ("progress.csv", b"\xff\xfe\x00", "progress.csv"),
        ("progress.csv", b"a,b\n1,2\n", "progress.csv has no column 'steps'"),
        ("policy.safetensors", None, "policy.safetensors is missing"),
        (
            "policy.safetensors",
            b"new",
            "policy.safetensors is truncated or damaged, or it and policy.json do not",
        ),
        ("policy.json", b'{"format"', "policy.json is not a policy description: it is truncated"),
        ("best/policy.safetensors", b"weig", "best/policy.safetensors is truncated or damaged"),
        (
            "progress.csv",
            PROGRESS.encode() + b"1000,9,20.5,500,2.5\n",
            "progress.csv ends at step 1000 of 4096",
        ),
    ],
)
def test_a_damaged_run_is_listed_with_its_problem(tmp_path, file, content, problem):
    make_run(tmp_path / "fine")
    folder = make_run(tmp_path / "hurt")
    (folder / file).unlink() if content is None else (folder / file).write_bytes(content)
    intact, hurt = find_runs(tmp_path)
    assert intact.state == "finished"
    assert hurt.state == "damaged"
    assert problem in hurt.problem
    assert (hurt.seed == 3) == (file != "config.json")
    json.dumps(hurt.as_mapping())


@pytest.mark.parametrize(
    "content",
    [
        {"train": {}},
        {
            "train": {
                "seed": "x",
                "task": 3,
                "agent": "ppo",
                "total_steps": None,
                "actuator": "weak",
                "env": 1,
            }
        },
        {"train": {"agent": {}, "actuator": None}, "versions": 1},
    ],
)
def test_an_almost_empty_configuration_is_not_damage(tmp_path, content):
    (tmp_path / "config.json").write_text(json.dumps(content))
    (run,) = find_runs(tmp_path)
    assert (run.state, run.seed, run.task, run.steps) == ("unfinished", None, None, None)
    for key in SORT_KEYS:
        assert sort_runs([run, run], key) == [run, run]
    compare([run, run])


def test_runs_are_found_at_any_depth_except_in_runs_and_hidden_folders(tmp_path):
    make_run(tmp_path / "b")
    make_run(tmp_path / "deep" / "er" / "a")
    make_run(tmp_path / "b" / "inner")
    make_run(tmp_path / ".being-written")
    (tmp_path / "empty").mkdir()
    assert [run.name for run in find_runs(tmp_path)] == ["b", "deep/er/a"]
    assert [run.name for run in find_runs(tmp_path / "b")] == ["b"]
    assert find_runs(tmp_path / "empty") == []
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        find_runs(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"no run at .*empty"):
        read_run(tmp_path / "empty")


def test_runs_are_sorted_by_any_key_with_missing_values_last(tmp_path):
    make_run(tmp_path / "a", "weaker", seed=1)
    make_run(tmp_path / "b", "ideal", seed=2)
    make_run(
        tmp_path / "c", "paper", finished=False, evaluated=False
    )  # Its last training return is 90.25.
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "config.json").write_text("{")
    runs = find_runs(tmp_path)
    order = lambda key: "".join(run.name for run in sort_runs(runs[::-1], key))  # noqa: E731
    assert order("name") == "abcd"
    assert order("return") == "bacd"
    assert order("actuator") == "bcad"
    assert order("state") == "dbac"  # Damaged, finished, unfinished; ties keep their order.
    assert order("steps")[-2:] == "cd"
    with pytest.raises(ValueError, match=r"sort = 'size': must be one of name, task"):
        sort_runs(runs, "size")


def test_a_comparison_has_differing_settings_and_all_results(tmp_path):
    weak = DCMotorActuator(Motor(arm_radius=0.15), CurrentLoop(kp=0.2, ki=0.3))
    runs = [
        read_run(make_run(tmp_path / "a", "weaker", seed=1)),
        read_run(make_run(tmp_path / "b", weak, seed=2, num_envs=8)),
        read_run(
            make_run(tmp_path / "c", weak, seed=2, num_envs=8, evaluated=False, finished=False)
        ),
    ]
    comparison = compare(runs)
    assert comparison.names == ("a", "b", "c")
    assert comparison.configuration == {
        "seed": (1, 2, 2),
        "env.actuator": ("weaker", "custom", "custom"),
        "env.actuator.controller.ki": (0.2, 0.3, 0.3),
        "num_envs": (None, 8, 8),
    }
    assert comparison.results["state"] == ("finished", "finished", "unfinished")
    assert comparison.results["steps"] == (4096, 4096, 2000)
    assert comparison.results["evaluation.tracking_rms"] == (0.1, 0.1, None)
    assert [values and values["mean"] for values in comparison.results["evaluation.returns"]] == [
        401.0,
        402.0,
        None,
    ]
    assert "evaluation.peak_voltage" not in comparison.results  # None of them has it.
    json.dumps(vars(comparison))
    assert comparison.units == {
        "seconds": "s",
        "mean_return": "reward",
        "evaluation.returns": "reward",
        "evaluation.tracking_rms": "N*m",
    }
    with pytest.raises(ValueError, match="two or more"):
        compare(runs[:1])


def test_fields_of_actuators_are_not_compared_with_an_ideal_one(tmp_path):
    runs = [read_run(make_run(tmp_path / name, name)) for name in ("ideal", "weaker")]
    assert compare(runs).configuration == {"env.actuator": ("ideal", "weaker")}


# -- codrl-mj runs ---------------------------------------------------------------------------------


def test_the_verb_lists_runs_in_the_requested_order(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(Path("low"), seed=1)
    make_run(Path("high"), seed=50)
    make_run(Path("hurt")).joinpath("evaluation.json").write_text("{")
    assert main(["runs", ".", "--sort", "return", "--out", "list.json"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 110
    rows = [line.split()[0] for line in text.splitlines() if "cartpole" in line]
    assert rows == ["high", "low", "hurt"]
    assert "450.0" in text
    assert "hurt: damaged" in text
    assert [run["name"] for run in json.loads(Path("list.json").read_text())["runs"]] == rows


def test_the_verb_compares_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(Path("a"), "ideal", seed=1)
    make_run(Path("b"), "weaker", seed=50)
    assert main(["runs", "--compare", "a", "b", "--out", "both.json"]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    returns = "evaluation.returns reward 401 [380, 420] 450 [380, 420]"
    assert {"seed 1 50", "env.actuator ideal weaker", returns} <= set(lines)
    comparison = json.loads(Path("both.json").read_text())
    assert (comparison["names"], comparison["configuration"]["seed"]) == (["a", "b"], [1, 50])
    assert comparison["units"]["evaluation.tracking_rms"] == "N*m"
    for names, refusal in ((("a", "nothing"), "no run at nothing"), (("a",), "two or more")):
        assert main(["runs", "--compare", *names]) == 2
        assert refusal in capsys.readouterr().err
