"""Programs in `scripts/`: short ones, the demonstration, the benchmark and the soak test."""

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import imageio
import numpy as np
import pytest

import benchmark
import benchmark_training
import simulator_speed
import worked_examples
from codrl_mj.actuators import IDEAL
from codrl_mj.runs.policies import load_policy
from codrl_mj.runs.summaries import read_run
from codrl_mj.study import read_csv
from codrl_mj.training import load_config

pytestmark = pytest.mark.matrix
SCRIPTS = Path(__file__).parent.parent / "scripts"


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def command(name, *arguments):
    return [sys.executable, str(SCRIPTS / name), *map(str, arguments)]


def run(name, *arguments, status=0):
    """Return the output of a program, or its errors if another status is expected."""
    result = subprocess.run(command(name, *arguments), capture_output=True, text=True, timeout=300)
    assert result.returncode == status, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr if status else result.stdout


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
    lines = run(
        "furuta_table.py", "--seeds", 1, "--episodes", 1, "--total-steps", 512, "--out", tmp_path
    ).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert len(lines) == 2 + 12
    for policy in ("ideal", "18V", "6V", "18V_6ms"):
        assert read_run(tmp_path / f"{policy}-0").state == "finished"
    for line in lines[2:]:
        for cell in line.split("|")[2:-1]:
            assert 0.0 <= float(cell.split()[0]) <= 250.0


def test_the_worked_examples(tmp_path):
    options = (
        "--only",
        "servo arm",
        "--seeds",
        1,
        "--steps",
        0.01,
        "--runs",
        tmp_path / "runs",
        "--out",
        tmp_path,
    )
    printed = run("worked_examples.py", *options)
    rows = (tmp_path / "worked_examples.csv").read_text().splitlines()
    assert len(rows) == 1 + 3 * 3  # an agent for each way to train, on each
    assert printed.splitlines()[-1].startswith("| servo arm | smaller |")
    assert {path.name for path in (tmp_path / "runs" / "servo_arm").glob("*-0")} == {
        "ideal-0",
        "chosen-0",
        "smaller-0",
    }
    again = run("worked_examples.py", *options)  # nothing is left to do
    assert again.splitlines()[-1] == printed.splitlines()[-1]


def test_the_page_of_the_worked_examples_follows_from_their_rows(tmp_path):
    for name in ("worked_examples.csv", "worked_examples.md"):
        shutil.copy(SCRIPTS.parent / "docs" / name, tmp_path)
    page = tmp_path / "worked_examples.md"
    published = page.read_text()
    page.write_text(published.partition(worked_examples.WRITTEN)[0])
    run("worked_examples.py", "--only-page", "--out", tmp_path)
    assert page.read_text() == published
    returns = {
        through: [
            float(row["return"])
            for row in read_csv(tmp_path / "worked_examples.csv")
            if (row["environment"], row["trained through"], row["tested on"])
            == ("double pendulum", through, "ideal")
        ]
        for through in ("ideal", "chosen")
    }
    first, falling, third = returns["chosen"]
    assert (
        f"On ideal forces, two of these policies return {first:.0f} and {third:.0f}, where ideal-trained"
        f" ones return {sum(returns['ideal']) / 3:.0f}, and one falls ({falling:.0f})."
        in " ".join(published.split())
    )


def test_the_page_of_training_speed_follows_from_its_rows():
    written = f"{benchmark_training.table()}\n{benchmark_training.LIMITS}"
    page = benchmark_training.PAGE.read_text()
    assert page.partition(benchmark_training.WRITTEN)[2] == f"\n\n{written}"
    assert "5.8 (9 of 10)" in written


def test_the_tables_of_other_simulators_follow_from_their_rows(tmp_path):
    page = shutil.copy(simulator_speed.PAGE, tmp_path)
    simulator_speed.write_tables(page=Path(page))
    assert Path(page).read_text() == simulator_speed.PAGE.read_text()
    ratios = {
        (row["group"].split(",")[-1].strip(), row["member"]): float(row["median"])
        for row in read_csv(simulator_speed.ROWS)
    }
    assert len(ratios) == len(read_csv(simulator_speed.ROWS))
    assert ratios["the same in all worlds", "Warp, double"] < 1.5
    assert ratios["three numbers drawn per drive", "Warp, double"] < 2.2
    assert ratios["256 worlds", "six motors, double"] < 1.15


def test_the_interval_of_a_median():
    values = np.random.default_rng(0).permutation(25).astype(float)
    assert simulator_speed.median_interval(values) == (12.0, 7.0, 17.0)
    draws = np.random.default_rng(1).exponential(size=(2000, 25))
    intervals = [simulator_speed.median_interval(row) for row in draws]
    inside = np.mean([low <= np.log(2.0) <= high for _, low, high in intervals])
    assert 0.94 < inside < 0.98


def test_from_a_bench_log_to_a_policy(tmp_path):
    printed = run("bench_to_policy.py", "--seeds", 1, "--total-steps", 300, "--out", tmp_path)
    numbers = r"(\w+): \S+ \[(\S+), (\S+)\] .*identified; real (\d\S+)"
    intervals = {name: tuple(map(float, values)) for name, *values in re.findall(numbers, printed)}
    assert {
        "resistance",
        "inductance",
        "back_emf_constant",
        "coulomb_friction",
        "rotor_inertia",
    } <= intervals.keys()
    assert all(low <= real <= high for low, high, real in intervals.values())
    config = load_config(tmp_path / "identified-0")
    assert len(config.env.randomize) >= 5
    assert printed.splitlines()[-1].startswith("| identified |")


RUNS = ("ideal-seed4", "weaker-seed4")


DEMO = "demo.py", "--seed", 4, "--total-steps", 2048, "--episodes", 2, "--out"


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory):
    """Return folder and output of a demonstration that was killed in training and run again."""
    out = tmp_path_factory.mktemp("demo") / "out"
    with subprocess.Popen(command(*DEMO, out), stdout=subprocess.PIPE) as killed:
        while not (out / RUNS[1] / "progress.csv").exists():
            assert killed.poll() is None
            time.sleep(0.05)
        killed.kill()
        # The child processes hold the pipe too, so that this waits for all of them.
        killed.communicate(timeout=20)
    return out, run(*DEMO, out)


def test_the_demonstration_leaves_two_runs_and_a_film(demonstrated):
    out, _ = demonstrated
    assert {path.name for path in out.iterdir()} == {*RUNS, "side_by_side.mp4"}
    ideal, weaker = (load_config(out / name) for name in RUNS)
    assert ideal.actuator == IDEAL
    assert weaker.actuator.controller.kp == 0.2
    assert ideal.agent == weaker.agent
    assert ideal.seed == weaker.seed == 4
    for name in RUNS:
        load_policy(out / name)
        assert (out / name / "learning_curve.png").is_file()
    with imageio.get_reader(out / "side_by_side.mp4") as reader:
        assert reader.get_meta_data()["codec"] == "h264"
        width, height = reader.get_meta_data()["size"]
    assert width == 2 * 480
    assert height > 360


def test_the_demonstration_prints_the_validation_the_four_results_and_its_files(
    demonstrated,
):
    out, text = demonstrated
    assert "FAILED" not in text
    assert text.count("passed") == 25
    for trained in ("ideal", "weaker"):
        for deployed in ("ideal", "weaker"):
            assert f"trained on {trained}, run on {deployed}" in text
        assert str(out / f"{trained}-seed4" / "learning_curve.png") in text.replace("\n", "")
    assert f"Open {out / 'side_by_side.mp4'}" in text


def test_a_second_demonstration_reuses_the_trainings(demonstrated):
    out, _ = demonstrated
    weights = [out / name / "policy.safetensors" for name in RUNS]
    before = [path.stat().st_mtime_ns for path in weights]
    (out / "side_by_side.mp4").unlink()
    text = run(*DEMO, out)
    assert text.count("is trained already") == 2
    assert [path.stat().st_mtime_ns for path in weights] == before
    assert (out / "side_by_side.mp4").is_file()


@pytest.mark.parametrize(
    ("group", "min_members", "num_ours"),
    [
        ("vector: mountain_car_continuous", 3, 2),
        ("single: pendulum", 3, 2),
        ("engine: pendulum", 4, 0),
    ],
)
def test_a_group_of_the_benchmark_is_measured_against_its_first_member(
    group, min_members, num_ours, tmp_path
):
    out = tmp_path / "bench.json"
    printed = run("benchmark.py", "--duration", 0.02, "--turns", 2, "--only", group, "--out", out)
    content = json.loads(out.read_text())
    assert content["results"].keys() == {group}
    members = content["results"][group]
    assert len(members) >= min_members
    assert sum(name.startswith("ours") for name in members) == num_ours
    assert next(iter(members.values()))["ratio"] == [1.0, 1.0, 1.0]
    for name, numbers in members.items():
        for median, lowest, highest in numbers.values():
            assert 0 < lowest <= median <= highest, name
    # Libraries that are not installed are skipped, and named in the output.
    for library in ("envpool", "electric_motor"):
        is_installed = any(library.split("_")[-1] in name.lower() for name in members)
        is_expected = group.startswith({"envpool": "vector", "electric_motor": "single"}[library])
        assert not is_expected or is_installed or f"skipped: {library}" in printed


def test_a_short_soak_test_passes_on_one_and_two_threads():
    printed = run("soak.py", "--task", "cartpole", "--num-envs", 64, "--steps", 6400)
    assert "FAIL" not in printed
    assert printed.count("ok  ") == 5


@pytest.mark.parametrize(("script", "flag"), [("benchmark.py", "--turns"), ("soak.py", "--steps")])
def test_bad_arguments_are_refused(script, flag):
    assert f"{flag} 0: must be >= 1" in run(script, flag, 0, status=2)


def test_new_measurements_replace_the_old_ones(tmp_path):
    def group(ours):
        return {"Gymnasium's": {"steps_per_second": [5e4] * 3, "ratio": [1.0] * 3}, "ours": ours}

    rows, page = tmp_path / "speed.csv", tmp_path / "speed.md"
    page.write_text(f"# Mine\n\n{benchmark.WRITTEN}old")
    first = group({"steps_per_second": [1e5, 9e4, 2e5], "ratio": [2.0, 1.8, 4.0]})
    benchmark.publish({"single: pendulum": first, "chains": first}, rows, page)
    second = group({"steps_per_second": [1.5e5] * 3, "ratio": [3.0, 2.5, 3.5]})
    benchmark.publish({"single: pendulum": second}, rows, page)
    rows_read = [tuple(row.values()) for row in read_csv(rows)]
    assert ("single: pendulum", "ours", "150000", "3.000", "2.500", "3.500") in rows_read
    assert ("chains", "ours", "100000", "2.000", "1.800", "4.000") in rows_read
    assert len(rows_read) == 4
    before, _, tables = page.read_text().partition(benchmark.WRITTEN)
    assert before == "# Mine\n\n"
    assert "| ours | 150,000 | 3.00 |" in tables
    assert "old" not in tables
