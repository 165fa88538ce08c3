"""Tests of the comparison of a rig's log with the simulation under the same commands."""

import csv
import functools
import json

import numpy as np
import pytest

from codrl_mj.cli import main
from codrl_mj.deploy import Contract, OnnxPolicy, board_test, compare, export, write_log
from codrl_mj.deploy.contract import Interface
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import run_episodes
from codrl_mj.identify import identify, read_log
from codrl_mj.sizing import find_drive
from tests.deploy.test_export import trained

FURUTA = EnvConfig("furuta")
TASKS = {"furuta": "ppo", "acrobot": "dqn", "mountain_car_continuous": "td3"}


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """Return a function of a task that runs and logs an episode with random weights.

    It returns the log, the contract, the environment and the episode.
    """

    @functools.cache
    def run(task):
        folder, env = tmp_path_factory.mktemp(task), EnvConfig(task)
        export(trained(task, TASKS[task])[0], env, TASKS[task], folder / "out", 1)
        (episode,) = run_episodes(OnnxPolicy(folder / "out"), env.build, 1, seed=3)
        contract = Contract.read(folder / "out")
        write_log(folder / "rig.csv", contract, episode)
        return folder / "rig.csv", contract, env, episode

    return run


@pytest.mark.parametrize("task", TASKS)
def test_log_of_the_simulation_equals_the_simulation(logged, task):
    log, _, env, episode = logged(task)
    comparison = compare(env, log)
    assert comparison.simulated.shape == episode.observation[:-1].shape
    np.testing.assert_array_equal(
        comparison.simulated[comparison.starts], comparison.logged[comparison.starts]
    )
    # Observations are float32.
    np.testing.assert_allclose(comparison.simulated, comparison.logged, atol=2e-4)
    assert (comparison.baseline_errors > 100.0 * comparison.errors).all()


def test_real_motor_in_the_simulation_reduces_the_errors(logged, tmp_path):
    (drive,) = FURUTA.actuators_by_name.values()
    real = drive.replaced({"motor.torque_constant": 0.03, "motor.viscous_friction": 3e-5})
    log, contract, *_ = logged("furuta")
    # The loop in the C has the motor of the training.
    result = board_test(log.parent / "out", episodes=1, actuator=real)
    write_log(tmp_path / "rig.csv", contract, result.on_board[0])
    errors_as_trained, errors_of_real = (
        compare(FURUTA, tmp_path / "rig.csv", actuator=actuator).errors for actuator in (None, real)
    )
    assert (errors_as_trained > 20.0 * errors_of_real).all()


def test_windows_start_at_observed_states_and_keep_the_motor(logged):
    log, contract, env, episode = logged("furuta")
    comparison = compare(env, log, 0.2)
    assert comparison.starts.tolist() == list(
        range(0, len(episode.time), round(0.2 * contract.rate))
    )
    whole = compare(env, log, 1e3)
    assert whole.starts.tolist() == [0]
    np.testing.assert_allclose(whole.simulated, whole.logged, atol=1e-6)
    held = comparison.logged[np.repeat(comparison.starts, 10)[: len(comparison.time)]]
    np.testing.assert_allclose(
        comparison.baseline_errors, np.sqrt(((held - comparison.logged) ** 2).mean(axis=0))
    )


def test_log_has_the_measurements_of_the_motor(logged):
    log, contract, _, episode = logged("furuta")
    rows = [
        {name: float(value) for name, value in row.items()} for row in csv.DictReader(log.open())
    ]
    assert [row["motor_voltage:V"] for row in rows[1:]] == episode.signals["voltage"][:-1].tolist()
    assert rows[0]["motor_current:A"] == 0.0
    turned = np.array([row["motor_position:rad"] for row in rows])
    arm = np.unwrap(episode.state[:-1, 0])
    np.testing.assert_allclose(turned, arm - arm[0], atol=1e-4)
    assert 1.0 / contract.rate == pytest.approx(rows[1]["time:s"])


def test_compare_on_the_command_line(logged, tmp_path, capsys):
    log, *_ = logged("furuta")
    line = ["identify", "compare", str(log.parent / "out"), str(log)]
    assert main([*line, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == [
        "cos_arm",
        "sin_arm",
        "cos_rod",
        "sin_rod",
        "arm_velocity",
        "rod_velocity",
    ]
    assert all(row["error"] < 0.01 * row["if_nothing_changed"] for row in rows)
    # An ideal actuator has the commanded torque at once; the rig's follows it quickly.
    line += ["--actuator", "ideal"]
    assert main([*line, "--json"]) == 0
    for ideal_row, row in zip(json.loads(capsys.readouterr().out), rows, strict=True):
        assert ideal_row["error"] < 0.2 * row["if_nothing_changed"]
    picture = tmp_path / "compared.png"
    assert main([*line, "--out", str(picture)]) == 0
    assert "arm_velocity" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_bad_logs_and_options_are_errors(logged, tmp_path, capsys):
    log, *_ = logged("furuta")
    for arguments, message in {
        (log, "--window", "0.01"): "window = 0.01 s: must be at least 0.04 s, two rows of the log",
        (log, "--out", tmp_path / "a.pdf"): "the suffix must be .png",
        (log, "--actuator", "weakest"): "weakest",
        (tmp_path / "none.csv",): "none.csv",
    }.items():
        assert main(["identify", "compare", *map(str, (log.parent / "out", *arguments))]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(ValueError, match="unknown to the policy"):
        compare(EnvConfig("cartpole"), log)
    (drive,) = FURUTA.actuators_by_name.values()
    with pytest.raises(
        ValueError, match=r"converted to this motor, is beyond the simulation's bound, \["
    ):
        compare(FURUTA, log, actuator=drive.replaced({"motor.torque_constant": 1e3}))


def test_identify_reads_the_log_of_a_board(tmp_path):
    drive = find_drive("maxon-ec45-flat-50w").replaced(
        {"motor.gear_ratio": 20.0, "motor.coulomb_friction": 0.0}
    )
    env = EnvConfig("pendulum", actuator=drive, inner_steps=50)

    class Slow:
        random = np.random.default_rng(0)

        def predict(self, *_, **__):
            if self.random.random() < 0.2:
                self.held = self.random.uniform(-2.0, 2.0, (1, 1)).astype(np.float32)
            return self.held, None

    Slow.held = np.zeros((1, 1), np.float32)
    (episode,) = run_episodes(Slow(), env.build, 1, 3)
    write_log(tmp_path / "log.csv", Interface.from_env(env), episode)
    columns = (
        'time="time:s":s,torque="motor:N*m":N*m,'
        'position=unwrap(atan2("sin_angle:1","cos_angle:1"),2*pi)+pi:rad'
    )
    log = read_log(tmp_path / "log.csv", columns)
    result = identify([log], rig="pendulum", known={"viscous_friction": 0.0})
    rotor = 20.0**2 * drive.motor.rotor_inertia
    for name, value in {"inertia": 1.0 / 3.0 + rotor, "mgl": 5.0}.items():
        assert result[name].status == "identified"
        assert result[name].value == pytest.approx(value, rel=0.05)
