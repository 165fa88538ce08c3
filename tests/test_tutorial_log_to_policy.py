"""What docs/tutorial_log_to_policy.md tells a reader to type works as it stands, and finds the motor that it names."""

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
TRAINING = next(place for place, command in enumerate(COMMANDS) if command.startswith("train"))
SHORT = {"6000": "300", "20": "1"}
"""Numbers of steps and episodes -> those of the tests, whose machine has other things to do."""


def run(command, **short):
    words = shlex.split(command)
    for place in range(1, len(words)):
        if words[place - 1].startswith("--"):
            words[place] = short.get(words[place], words[place])
    assert main(words) == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_are_understood(command, monkeypatch, tmp_path):
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
    """A folder in which the page has been followed until the training; logs of 2 s."""
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, text in FILES.items():
            Path(name).write_text(text)
        for command in COMMANDS[:TRAINING]:
            run(command, **{"4": "2"})
        yield folder


@pytest.mark.matrix
def test_the_fit_finds_the_motor_of_the_bench(bench, monkeypatch):
    monkeypatch.chdir(bench)
    real = yaml.safe_load(FILES["real.yaml"])["motor"]
    found = {
        one["name"]: one for one in json.loads(Path("motor/result.json").read_text())["estimates"]
    }
    for name in ("resistance", "torque_constant", "back_emf_constant"):
        assert found[name]["low"] <= real[name] <= found[name]["high"]


@pytest.mark.matrix
def test_the_rest_of_it_runs(bench, monkeypatch):
    monkeypatch.chdir(bench)
    for command in COMMANDS[TRAINING:]:
        run(command, **SHORT)
    assert [command.split()[0] for command in COMMANDS[TRAINING:]] == [
        "train",
        "evaluate",
        "evaluate",
    ]
