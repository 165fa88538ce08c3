"""The benchmark and the soak run, and say what they found."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.matrix import but

SCRIPTS = Path(__file__).parent.parent / "scripts"


def _run(script, *arguments, folder):
    command = [sys.executable, str(SCRIPTS / script), *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("group", "least", "own"),
    but(
        [("engine: pendulum", 4, 0)],
        [("vector: mountain_car_continuous", 3, 2), ("single: pendulum", 3, 2), ("engine: pendulum", 4, 0)],
    ),
)
@pytest.mark.matrix
def test_a_group_of_the_benchmark_is_measured_against_its_first_member(group, least, own, tmp_path):
    out = tmp_path / "bench.json"
    finished = _run("benchmark.py", "--duration", 0.02, "--turns", 2, "--only", group, "--out", out, folder=tmp_path)
    assert finished.returncode == 0, finished.stderr
    content = json.loads(out.read_text())
    assert content["results"].keys() == {group}
    members = content["results"][group]
    assert len(members) >= least
    assert sum(name.startswith("ours") for name in members) == own
    assert next(iter(members.values()))["ratio"] == [1.0, 1.0, 1.0]
    for name, numbers in members.items():
        for median, lowest, highest in numbers.values():
            assert 0 < lowest <= median <= highest, name
    # what is not installed is skipped, and named
    for library in ("envpool", "electric_motor"):
        here = any(library.split("_")[-1] in name.lower() for name in members)
        wanted = group.startswith({"envpool": "vector", "electric_motor": "single"}[library])
        assert not wanted or here or f"skipped: {library}" in finished.stdout


@pytest.mark.matrix
def test_a_short_soak_finds_nothing_wrong_on_one_and_two_threads(tmp_path):
    finished = _run("soak.py", "--task", "cartpole", "--num-envs", 64, "--steps", 6400, folder=tmp_path)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    assert "FAIL" not in finished.stdout
    assert finished.stdout.count("ok  ") == 5


@pytest.mark.parametrize(
    ("script", "arguments", "message"),
    [
        ("benchmark.py", ("--turns", 0), "--turns 0: must be >= 1"),
        ("soak.py", ("--steps", 0), "--steps 0: must be >= 1"),
    ],
)
@pytest.mark.matrix
def test_bad_arguments_are_refused(script, arguments, message, tmp_path):
    finished = _run(script, *arguments, folder=tmp_path)
    assert finished.returncode == 2
    assert message in finished.stderr
