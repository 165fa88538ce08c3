"""The short programs in `scripts/` that use nothing but the public interface."""

import subprocess
import sys
from pathlib import Path

import pytest

from codrl_mj.runs.summaries import read_run

pytestmark = pytest.mark.matrix
SCRIPTS = Path(__file__).parent.parent / "scripts"


def run(name, *arguments):
    command = [sys.executable, str(SCRIPTS / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_training_and_its_rollouts(tmp_path):
    out, film = tmp_path / "run", tmp_path / "rollouts.gif"
    printed = run("train.py", "cartpole", "ppo", "lag", "--total-steps", 300, "--out", out)
    assert f"wrote {out}" in printed
    summary = read_run(out)
    assert (summary.state, summary.actuator) == ("finished", "lag")
    assert summary.steps >= 300  # whole rollouts
    assert f"wrote {film}" in run("render_rollouts.py", out, "ideal", "lag", "--out", film)
    assert film.read_bytes()[:3] == b"GIF"


def test_the_cross_validation():
    printed = run("cross_validate.py", "mountain_car", "--quick").splitlines()
    assert len(printed) > 20
    assert all(line.startswith("passed") for line in printed)
