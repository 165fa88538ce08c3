"""The commands of docs/tutorial_log_to_policy.md run as printed, and identify the motor."""

import json
import re
import shlex
from pathlib import Path

import pytest
import yaml

from codrl_mj import cli
from codrl_mj.cli import main

PAGE = (Path(__file__).parent.parent / "docs" / "tutorial_log_to_policy.md").read_text()
FILES = dict(re.findall(r"```yaml\n# (\S+)\n(.*?)```", PAGE, re.DOTALL))
COMMANDS = re.findall(r"^\$ codrl-mj (.*)$", PAGE, re.MULTILINE)
TRAINING = next(index for index, command in enumerate(COMMANDS) if command.startswith("train"))
SHORT = {"6000": "300", "20": "1"}
"""Numbers of steps and episodes -> smaller numbers, which make the tests fast."""


def run(command, **short):
    """Run a command with smaller numbers as values of its flags."""
    words = shlex.split(command)
    for index in range(1, len(words)):
        if words[index - 1].startswith("--"):
            words[index] = short.get(words[index], words[index])
    assert main(words) == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_are_valid(command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("motor").mkdir()
    for name, text in (FILES | {"motor/actuator.yaml": FILES["real.yaml"]}).items():
        Path(name).write_text(text)
    parsed = []
    for verb in map(cli.find_verb, cli.VERBS):
        monkeypatch.setattr(verb, "run", lambda self: parsed.append(self) or 0)
    assert main(shlex.split(command)) == 0
    assert len(parsed) == 1


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Run the commands before the training with logs of 2 s, and yield the folder."""
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, text in FILES.items():
            Path(name).write_text(text)
        for command in COMMANDS[:TRAINING]:
            run(command, **{"4": "2"})
        yield folder


@pytest.mark.matrix
def test_the_fit_identifies_the_motor(bench, monkeypatch):
    monkeypatch.chdir(bench)
    real = yaml.safe_load(FILES["real.yaml"])["motor"]
    estimates = {
        estimate["name"]: estimate
        for estimate in json.loads(Path("motor/result.json").read_text())["estimates"]
    }
    for name in ("resistance", "torque_constant", "back_emf_constant"):
        assert estimates[name]["low"] <= real[name] <= estimates[name]["high"]


@pytest.mark.matrix
def test_the_training_and_the_evaluations_run(bench, monkeypatch):
    monkeypatch.chdir(bench)
    for command in COMMANDS[TRAINING:]:
        run(command, **SHORT)
    assert [command.split()[0] for command in COMMANDS[TRAINING:]] == [
        "train",
        "evaluate",
        "evaluate",
    ]
