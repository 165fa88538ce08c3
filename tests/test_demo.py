"""The demonstration runs from start to end, and does not repeat what is done."""

import subprocess
import sys
import time
from pathlib import Path

import imageio
import pytest

from codrl_mj.actuators import IDEAL
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import load_config

pytestmark = pytest.mark.matrix

DEMO = Path(__file__).parents[1] / "scripts" / "demo.py"
RUNS = ("ideal-seed4", "weaker-seed4")


def options(out, total_steps=2048):
    return ["--out", str(out), "--seed", "4", "--total-steps", str(total_steps), "--episodes", "2"]


def demonstrate(out):
    line = [sys.executable, str(DEMO), *options(out)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory):
    """The folder of a demonstration that was stopped while it trained and then run again, and what was printed."""
    out = tmp_path_factory.mktemp("demo") / "out"
    with subprocess.Popen([sys.executable, str(DEMO), *options(out)], stdout=subprocess.PIPE) as killed:
        while not (out / RUNS[1] / "progress.csv").exists():
            assert killed.poll() is None
            time.sleep(0.05)
        killed.kill()
        killed.communicate(timeout=20)  # its processes hold the pipe too: none outlives it
    return out, demonstrate(out)


def test_it_leaves_two_runs_and_a_film(demonstrated):
    out, _ = demonstrated
    assert {path.name for path in out.iterdir()} == {*RUNS, "side_by_side.mp4"}
    ideal, weaker = (load_config(out / run) for run in RUNS)
    assert ideal.actuator == IDEAL
    assert weaker.actuator.controller.kp == 0.2
    assert ideal.agent == weaker.agent
    assert ideal.seed == weaker.seed == 4
    for run in RUNS:
        load_policy(out / run)
        assert (out / run / "learning_curve.png").is_file()
    with imageio.get_reader(out / "side_by_side.mp4") as reader:
        assert reader.get_meta_data()["codec"] == "h264"
        width, height = reader.get_meta_data()["size"]
    assert width == 2 * 480
    assert height > 360


def test_it_prints_the_validation_and_all_four_results_and_where_to_look(demonstrated):
    out, text = demonstrated
    assert "FAILED" not in text
    assert text.count("passed") == 25
    for trained in ("ideal", "weaker"):
        for deployed in ("ideal", "weaker"):
            assert f"trained on {trained}, run on {deployed}" in text
        assert str(out / f"{trained}-seed4" / "learning_curve.png") in text.replace("\n", "")
    assert f"Open {out / 'side_by_side.mp4'}" in text


def test_a_second_run_reuses_the_trainings(demonstrated):
    out, _ = demonstrated
    weights = [out / run / "policy.safetensors" for run in RUNS]
    before = [path.stat().st_mtime_ns for path in weights]
    (out / "side_by_side.mp4").unlink()
    text = demonstrate(out)
    assert text.count("is trained already") == 2
    assert [path.stat().st_mtime_ns for path in weights] == before
    assert (out / "side_by_side.mp4").is_file()
