"""Lines of the command line, and what is asked of all of them."""

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


def ran(line):
    assert main(line.split()) == 0


def read(name):
    return json.loads(Path(name).read_text())


def contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


def refused(capsys, line):
    """The one line that bad input costs; nothing is written."""
    before = contents(Path.cwd())
    assert main(line.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert contents(Path.cwd()) == before
    return error


def policy_alone(run):
    """Its policy in a folder `alone`, that says nothing of the run."""
    Path("alone").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(run / name, "alone")


def helped(capsys, *verb):
    """The help text as one line, without its frame."""
    with pytest.raises(SystemExit) as done:
        main([*verb, "--help"])
    assert done.value.code == 0
    return " ".join(capsys.readouterr().out.translate(str.maketrans("│╭╮╰╯─", "      ")).split())
