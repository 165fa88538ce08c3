"""The grid: each cell is computed once, whatever happens to other cells or to the grid."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.agents import PPOConfig
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.grid import (
    PolicyTest,
    cell_folder,
    failure_record,
    read_failure,
    run_tests,
    train_runs,
)
from codrl_mj.study.parallel import Workers, call_in_parallel
from codrl_mj.training import TrainConfig, finished, load_config

PPO = PPOConfig(rollout_steps=256, batch_size=64, epochs=1, hidden=(8,))
ENV = EnvConfig("cartpole", "weaker")
TINY = TrainConfig(ENV, PPO, 0, 512, num_envs=2, evaluation_episodes=2, checkpoint_interval=256)
UNSTABLE = EnvConfig("cartpole", DCMotorActuator(Motor(arm_radius=0.15), CurrentLoop(kp=100.0)))
IDEAL = EnvConfig("cartpole", "ideal")
CELLS = {f"seed {seed}": dataclasses.replace(TINY, seed=seed) for seed in range(3)}
ONE = Workers(jobs=1)


def train_cells(cells, root, workers=ONE, on_run=lambda _: None):
    """Train cells; return run folders by name and errors by run folder."""
    folders = {name: cell_folder(root, config) for name, config in cells.items()}
    return folders, train_runs(
        dict(zip(folders.values(), cells.values(), strict=True)), workers, on_run, tensorboard=False
    )


def weights(folder):
    return (folder / "policy.safetensors").read_bytes()


@pytest.fixture(scope="module")
def computed(tmp_path_factory):
    """Return a grid computed in two processes; one of its cells cannot be trained."""
    root = tmp_path_factory.mktemp("grid")
    reported = []
    cells = CELLS | {"unstable": dataclasses.replace(TINY, env=UNSTABLE)}
    runs, failures = train_cells(cells, root, Workers(jobs=2), reported.append)
    return root, runs, failures, reported


@pytest.mark.matrix
def test_a_cell_that_fails_is_recorded_and_does_not_stop_the_others(computed):
    root, runs, failures, reported = computed
    assert [name for name, run in runs.items() if finished(run)] == [*CELLS]
    assert sorted(reported) == sorted(runs.values())
    assert [*failures] == [runs["unstable"]]
    assert "spectral radius" in failures[runs["unstable"]]
    (file,) = (root / "failures").iterdir()
    assert file == failure_record(runs["unstable"])
    record = json.loads(file.read_text())
    assert record["error"] == failures[runs["unstable"]] == read_failure(runs["unstable"])
    assert "Traceback" in record["traceback"]
    assert record["train"]["env"]["actuator"]["controller"]["kp"] == 100.0
    assert read_failure(runs["seed 0"]) is None


@pytest.mark.matrix
def test_a_cell_is_a_run_folder_named_by_its_configuration(computed):
    root, runs, _, _ = computed
    for name, config in CELLS.items():
        assert runs[name] == cell_folder(root, config)
        assert load_config(runs[name]) == config
    changed = [
        dataclasses.replace(TINY, total_steps=513),
        dataclasses.replace(TINY, env=dataclasses.replace(ENV, options={"center_radius": 0.1})),
        dataclasses.replace(TINY, agent=dataclasses.replace(PPO, gamma=0.9)),
        dataclasses.replace(TINY, env=EnvConfig("cartpole", "paper")),
    ]
    assert len({cell_folder(root, config) for config in [TINY, *changed]}) == 5


@pytest.mark.matrix
def test_finished_cells_are_skipped(computed):
    root, runs, _, _ = computed
    before = {path: path.stat().st_mtime_ns for run in runs.values() for path in run.rglob("*")}
    reported = []
    assert train_cells(CELLS, root, on_run=reported.append)[1] == {}
    assert reported == [runs[name] for name in CELLS]
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_failure_record_is_deleted_when_the_cell_succeeds(tmp_path):
    folder = cell_folder(tmp_path, TINY)
    folder.write_text("a file in the way")
    assert "is not a folder" in train_runs({folder: TINY}, ONE)[folder]
    assert failure_record(folder).is_file()
    folder.unlink()
    assert train_runs({folder: TINY}, ONE) == {}
    assert finished(folder)
    assert list((tmp_path / "failures").iterdir()) == []


@pytest.mark.matrix
def test_ray_computes_the_same_results(computed, tmp_path):
    _, runs, _, _ = computed
    ray_runs, failures = train_cells(
        CELLS | {"unstable": dataclasses.replace(TINY, env=UNSTABLE)},
        tmp_path,
        Workers(jobs=2, backend="ray"),
    )
    assert set(failures) == {ray_runs["unstable"]}
    for name in CELLS:
        assert weights(ray_runs[name]) == weights(runs[name])


@pytest.mark.matrix
def test_a_killed_grid_continues(computed, tmp_path):
    _, runs, _, _ = computed
    code = """
import sys
from pathlib import Path
from tests.study.test_grid import CELLS, Workers, train_cells
train_cells(CELLS, Path(sys.argv[1]), Workers(jobs=2))
"""
    first = cell_folder(tmp_path, CELLS["seed 0"])
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=os.environ) as grid:
        while not (first / "checkpoints").exists():
            assert grid.poll() is None
            time.sleep(0.02)
        grid.send_signal(signal.SIGKILL)
    assert not all(finished(cell_folder(tmp_path, config)) for config in CELLS.values())
    resumed, failures = train_cells(CELLS, tmp_path)
    assert failures == {}
    for name in CELLS:
        assert weights(resumed[name]) == weights(runs[name])


@pytest.mark.matrix
def test_a_ctrl_c_lets_trainings_write_their_checkpoints(tmp_path):
    """Send SIGINT to the grid and all its processes, as a terminal does.

    One process is idle, and a cell has not started.
    """
    code = """
import dataclasses, sys
from pathlib import Path
from codrl_mj.study.grid import train_runs
from codrl_mj.training import TrainingStoppedError
from tests.study.test_grid import TINY, Workers
long = dataclasses.replace(TINY, total_steps=10**7, checkpoint_interval=10**6)
root = Path(sys.argv[1])
runs = {root / str(seed): dataclasses.replace(long, seed=seed) for seed in range(int(sys.argv[2]))}
try:
    train_runs(runs | {root / "short": TINY}, Workers(jobs=2))
except TrainingStoppedError as stopped:
    print(stopped)
    sys.exit(128 + stopped.signal_number)
"""
    for count in (1, 3):
        root = tmp_path / str(count)
        line = [sys.executable, "-c", code, str(root), str(count)]
        with subprocess.Popen(
            line, start_new_session=True, stdout=subprocess.PIPE, text=True
        ) as grid:
            expected = ["0/progress.csv", "short/result.json" if count == 1 else "1/progress.csv"]
            while not all(
                (root / file).exists() and "\n" in (root / file).read_text().strip()
                for file in expected
            ):
                assert grid.poll() is None
                time.sleep(0.05)
            os.killpg(grid.pid, signal.SIGINT)
            text, _ = grid.communicate(timeout=60)
        assert (grid.returncode, text) == (
            130,
            "stopped: the same command continues from the last checkpoints\n",
        )
        for run in ("0", "1")[:count]:
            assert list((root / run / "checkpoints").iterdir())
        assert not (root / "2").exists()


def test_an_exception_in_a_call_is_raised():
    with pytest.raises(ZeroDivisionError):
        list(call_in_parallel(divmod, [(1, 1), (1, 0)], Workers(jobs=2)))


@pytest.mark.matrix
def test_deployments_are_evaluated_once(computed):
    _, runs, _, _ = computed
    policy_tests = {
        name: PolicyTest(runs["seed 0"], EnvConfig("cartpole", name), episodes=3, seed=7)
        for name in ("paper", "ideal")
    }
    run_tests(policy_tests, ONE)
    for deployment in policy_tests.values():
        expected = evaluate(load_policy(runs["seed 0"]), deployment.env, episodes=3, seed=7)
        assert json.loads(deployment.record.read_text())["returns"] == expected.returns._asdict()
    before = {
        deployment.record: deployment.record.stat().st_mtime_ns
        for deployment in policy_tests.values()
    }
    assert len(before) == 2
    run_tests(policy_tests, ONE)
    assert {record: record.stat().st_mtime_ns for record in before} == before
    other_env = PolicyTest(
        runs["seed 0"], EnvConfig("cartpole", max_episode_steps=5), episodes=3, seed=7
    )
    run_tests({"short": other_env}, ONE)
    assert json.loads(other_env.record.read_text())["length"]["mean"] == 5.0


@pytest.mark.matrix
def test_a_deployment_that_fails_is_recorded_and_does_not_stop_the_others(computed):
    root, runs, _, _ = computed
    good, bad = (PolicyTest(runs["seed 1"], env, episodes=2, seed=3) for env in (IDEAL, UNSTABLE))
    reported = []
    run_tests({"bad": bad, "good": good}, ONE, reported.append)
    assert (bad.record.is_file(), good.record.is_file()) == (False, True)
    assert sorted(reported) == ["bad", "good"]
    assert failure_record(bad).parent == root / "failures"
    record = json.loads(failure_record(bad).read_text())
    assert "spectral radius" in record["error"]
    assert read_failure(bad) == record["error"]
    assert "Traceback" in record["traceback"]
    assert (record["test"], record["run"]) == ("bad", runs["seed 1"].name)
    assert read_failure(good) is None
    assert read_failure(runs["seed 1"]) is None


@pytest.mark.matrix
def test_a_failure_record_of_a_deployment_is_deleted_when_it_succeeds(computed):
    _, runs, _, _ = computed
    deployment, policy = (
        PolicyTest(runs["seed 2"], IDEAL, episodes=2),
        runs["seed 2"] / "policy.json",
    )
    content = policy.read_text()
    policy.write_text("{")
    try:
        run_tests({"cell": deployment}, ONE)
    finally:
        policy.write_text(content)
    assert "policy.json" in read_failure(deployment)
    run_tests({"cell": deployment}, ONE)
    assert deployment.record.is_file()
    assert read_failure(deployment) is None


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("backend", "slurm", "must be one of local, ray"),
        ("jobs", 0, ">= 1, or -1"),
        ("jobs", 2.5, ">= 1, or -1"),
    ],
)
def test_raises_if_the_workers_are_invalid(field, value, expected):
    with pytest.raises(ValueError, match=field) as caught:
        Workers(**{field: value})
    assert f"{field} = {value!r}" in str(caught.value)
    assert expected in str(caught.value)


def test_raises_if_ray_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install 'codrl-mj\[ray\]'"):
        train_runs({tmp_path: TINY}, Workers(backend="ray"))
