"""The short programs in `scripts/` that use nothing but the public interface."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from codrl_mj.runs.summaries import read_run
from codrl_mj.training import load_config

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


def test_the_table_of_furuta(tmp_path):
    lines = run("furuta_table.py", "--seeds", 1, "--episodes", 1, "--total-steps", 512, "--out", tmp_path).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert len(lines) == 2 + 12
    for policy in ("ideal", "18V", "6V", "18V_6ms"):
        assert read_run(tmp_path / f"{policy}-0").state == "finished"
    for line in lines[2:]:
        for cell in line.split("|")[2:-1]:
            assert 0.0 <= float(cell.split()[0]) <= 250.0


def test_the_worked_examples(tmp_path):
    options = "--only", "servo arm", "--seeds", 1, "--steps", 0.01, "--runs", tmp_path / "runs", "--out", tmp_path
    printed = run("worked_examples.py", *options)
    rows = (tmp_path / "worked_examples.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 3  # an agent for each way to train, on each
    assert printed.splitlines()[-1].startswith("| servo arm | smaller |")
    assert {path.name for path in (tmp_path / "runs" / "servo_arm").glob("*-0")} == {"ideal-0", "chosen-0", "smaller-0"}
    again = run("worked_examples.py", *options)  # nothing is left to do
    assert again.splitlines()[-1] == printed.splitlines()[-1]


def test_from_a_bench_log_to_a_policy(tmp_path):
    printed = run("bench_to_policy.py", "--seeds", 1, "--total-steps", 300, "--out", tmp_path)
    numbers = r"(\w+): \S+ \[(\S+), (\S+)\] .*identified; real (\d\S+)"
    found = {name: tuple(map(float, rest)) for name, *rest in re.findall(numbers, printed)}
    assert {"resistance", "inductance", "back_emf_constant", "coulomb_friction", "rotor_inertia"} <= found.keys()
    assert all(low <= real <= high for low, high, real in found.values())
    config = load_config(tmp_path / "identified-0")
    assert len(config.env.randomize) >= 5
    assert printed.splitlines()[-1].startswith("| identified |")
