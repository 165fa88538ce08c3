"""The commands and examples of docs/training.md work, and the files that it names exist."""

import contextlib
import re
import shlex
from pathlib import Path

import pytest

from codrl_mj import cli
from codrl_mj.envs.config import EnvConfig
from codrl_mj.training import TrainConfig, read_config
from tests.training.interruptions import begin, kill_test

PAGE = (Path(__file__).parents[2] / "docs" / "training.md").read_text()


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Create the files that the page mentions, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    Path("car.yaml").write_text(block)
    begin(Path("runs/mine"), TrainConfig(EnvConfig("cartpole")))


@pytest.mark.parametrize(
    "command", re.findall(r"^\$ codrl-mj (.*)$|`codrl-mj ([a-z]+ [^`A-Z]*)`", PAGE, re.MULTILINE)
)
def test_the_pages_commands_are_valid(command, monkeypatch):
    parsed = []
    for verb in cli.VERBS:
        monkeypatch.setattr(cli.find_verb(verb), "run", lambda self: parsed.append(self) or 0)
    line = shlex.split(command[0] or command[1])
    if "--help" in line:
        with pytest.raises(SystemExit, match="0"):
            cli.main(line)
    else:
        with contextlib.suppress(SystemExit):
            assert cli.main(line) == 0
        assert len(parsed) == 1


def test_the_pages_configuration_has_the_documented_values():
    config = read_config(Path("car.yaml"))
    assert (config.task, config.agent.name, config.seed) == ("mountain_car_continuous", "ddpg", 7)
    assert (config.agent.learning_rate, config.actuator.controller.kp) == (5e-4, 3.0)
    assert config.env.observe_actuator
    assert config.env.randomize == ("motor.inductance=uniform(0.05, 0.15)",)


def test_the_python_example_runs_and_leaves_the_files_of_the_table():
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(block, "training.md", "exec"), {})
    rows = re.findall(
        r"^\| (`.*?) \| .* \| .* \|$", PAGE.partition("## Configurations")[0], re.MULTILINE
    )
    named = {name.rstrip("/") for row in rows for name in re.findall(r"`(.*?)`", row)}
    assert named == {
        path.name for path in Path("runs/sarsa").iterdir() if not path.name.startswith(".")
    }


def test_the_pages_nondeterministic_columns_are_those_of_the_tests():
    for column in kill_test.TIME_COLUMNS:
        assert f"`{column}`" in PAGE
