"""The commands of docs/tutorial_datasheet_to_board.md run, with a shorter training."""

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from codrl_mj import cli
from codrl_mj.cli import main
from codrl_mj.deploy.board import missing_tools

PAGE = (Path(__file__).parent.parent / "docs" / "tutorial_datasheet_to_board.md").read_text()
FILES = dict(re.findall(r"```(?:yaml|toml)\n# (\S+)\n(.*?)```", PAGE, re.DOTALL))
LINES = re.findall(r"^\$ (.*)$", PAGE, re.MULTILINE)
BOARD_COMMANDS = re.findall(r"^codrl-mj (.*)$", PAGE, re.MULTILINE)
"""Commands that need a board."""


@pytest.mark.parametrize(
    "command", [*(line for line in LINES if line.startswith("codrl-mj")), *BOARD_COMMANDS]
)
def test_the_commands_are_valid(command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)
    Path("motor").mkdir()
    Path("motor/actuator.yaml").write_text("name: my_motor.toml")
    parsed = []
    for verb in map(cli.find_verb, cli.VERBS):
        monkeypatch.setattr(verb, "run", lambda self: parsed.append(self) or 0)
    assert main(shlex.split(command.removeprefix("codrl-mj "))) == 0
    assert len(parsed) == 1


@pytest.mark.matrix
@pytest.mark.skipif(
    bool(missing_tools("host")), reason="NOT RUN: no C compiler: apt-get install gcc"
)
def test_all_commands_run(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)
    errors = []
    for line in LINES:
        if not line.startswith("codrl-mj"):
            process = subprocess.run(line, shell=True, check=True, capture_output=True, text=True)
            # The program prints the largest difference to the golden commands.
            assert float(process.stdout.split()[-1]) < 1e-6
            continue
        words = shlex.split(line)[1:]
        if "cortex-m4f" in words and missing_tools("cortex-m4f"):
            continue
        if words[0] == "train":
            words += ["--total-steps", "8192"]
        words = [
            "1" if before == "--episodes" else word
            for before, word in zip(["", *words], words, strict=False)
        ]
        compares = words[:2] == ["identify", "compare"]
        capsys.readouterr()
        assert main([*words, *["--json"] * compares]) == 0, line
        if compares:
            errors.append(
                {row["name"]: row["error"] for row in json.loads(capsys.readouterr().out)}
            )
    with_datasheet, identified = errors
    assert with_datasheet["arm_velocity"] > 2.0 * identified["arm_velocity"]
    assert main(["board", "check", "mine", "rig.csv"]) == 0
