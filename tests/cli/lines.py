"""Helpers that run command lines and check their output."""

import json
import shutil
from pathlib import Path

import pytest

from codrl_mj.cli import main

TINY = (
    "--total-steps 500 --num-envs 2 --agent ppo "
    "--agent.rollout-steps 256 --agent.batch-size 64 --agent.epochs 1 --agent.hidden 8"
)
SMALL_FILM = "--width 200 --height 120 --env.max-episode-steps 2"


def run_ok(line):
    assert main(line.split()) == 0


def read_json(name):
    return json.loads(Path(name).read_text())


def folder_contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


def assert_refused(capsys, line):
    """Check that a line is refused with one line of error and writes nothing; return the error."""
    before = folder_contents(Path.cwd())
    assert main(line.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert folder_contents(Path.cwd()) == before
    return error


def copy_policy_only(run):
    """Copy the policy of a run to a folder `alone`, without the run's configuration."""
    Path("alone").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(run / name, "alone")


def help_text(capsys, *verb):
    """Return the help text of a verb as one line, without its frame."""
    with pytest.raises(SystemExit) as exit_info:
        main([*verb, "--help"])
    assert exit_info.value.code == 0
    return " ".join(capsys.readouterr().out.translate(str.maketrans("│╭╮╰╯─", "      ")).split())
