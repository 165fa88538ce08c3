"""A log of a rig beside the simulation under its commands."""

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
    """Of a task a log of an episode of a policy with random weights, its contract, the environment and the episode."""

    @functools.cache
    def made(task):
        folder, env = tmp_path_factory.mktemp(task), EnvConfig(task)
        export(trained(task, TASKS[task])[0], env, TASKS[task], folder / "out", 1)
        (episode,) = run_episodes(OnnxPolicy(folder / "out"), env.make, 1, seed=3)
        contract = Contract.read(folder / "out")
        write_log(folder / "rig.csv", contract, episode)
        return folder / "rig.csv", contract, env, episode

    return made


@pytest.mark.parametrize("task", TASKS)
def test_a_rig_that_is_the_simulation_does_what_it_does(logged, task):
    log, _, env, episode = logged(task)
    found = compare(env, log)
    assert found.simulated.shape == episode.observation[:-1].shape
    np.testing.assert_array_equal(found.simulated[found.starts], found.logged[found.starts])
    np.testing.assert_allclose(found.simulated, found.logged, atol=2e-4)  # observations are float32
    assert (found.moved > 100.0 * found.errors).all()


def test_another_motor_is_seen_and_what_identifies_it_takes_the_difference_away(logged, tmp_path):
    (drive,) = FURUTA.actuators_by_name.values()
    real = drive.replaced({"motor.torque_constant": 0.03, "motor.viscous_friction": 3e-5})
    log, contract, *_ = logged("furuta")
    done = board_test(
        log.parent / "out", episodes=1, actuator=real
    )  # its loop knows the motor of the training alone
    write_log(tmp_path / "rig.csv", contract, done.on_board[0])
    as_trained, as_it_is = (
        compare(FURUTA, tmp_path / "rig.csv", actuator=one).errors for one in (None, real)
    )
    assert (as_trained > 20.0 * as_it_is).all()


def test_windows_begin_at_what_was_observed_and_the_motor_goes_on(logged):
    log, contract, env, episode = logged("furuta")
    found = compare(env, log, 0.2)
    assert found.starts.tolist() == list(range(0, len(episode.time), round(0.2 * contract.rate)))
    whole = compare(env, log, 1e3)
    assert whole.starts.tolist() == [0]
    np.testing.assert_allclose(whole.simulated, whole.logged, atol=1e-6)
    held = found.logged[np.repeat(found.starts, 10)[: len(found.time)]]
    np.testing.assert_allclose(found.moved, np.sqrt(((held - found.logged) ** 2).mean(axis=0)))


def test_a_log_has_what_the_motor_did(logged):
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


def test_from_the_command_line(logged, tmp_path, capsys):
    log, *_ = logged("furuta")
    line = ["identify", "compare", str(log.parent / "out"), str(log)]
    assert main([*line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in told] == [
        "cos_arm",
        "sin_arm",
        "cos_rod",
        "sin_rod",
        "arm_velocity",
        "rod_velocity",
    ]
    assert all(one["error"] < 0.01 * one["if_nothing_changed"] for one in told)
    line += ["--actuator", "ideal"]  # whose torque is what was asked for, as the rig's is soon
    assert main([*line, "--json"]) == 0
    for one, other in zip(json.loads(capsys.readouterr().out), told, strict=True):
        assert one["error"] < 0.2 * other["if_nothing_changed"]
    picture = tmp_path / "compared.png"
    assert main([*line, "--out", str(picture)]) == 0
    assert "arm_velocity" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_compared_is_said(logged, tmp_path, capsys):
    log, *_ = logged("furuta")
    for more, says in {
        (log, "--window", "0.01"): "window = 0.01 s: must be at least 0.04 s, two rows of the log",
        (log, "--out", tmp_path / "a.pdf"): "the suffix must be .png",
        (log, "--actuator", "weakest"): "weakest",
        (tmp_path / "none.csv",): "none.csv",
    }.items():
        assert main(["identify", "compare", *map(str, (log.parent / "out", *more))]) == 2
        assert says in capsys.readouterr().err
    with pytest.raises(ValueError, match="the policy knows none"):
        compare(EnvConfig("cartpole"), log)
    (drive,) = FURUTA.actuators_by_name.values()
    with pytest.raises(
        ValueError, match=r"as this motor gives it, is beyond the simulation's bound, \["
    ):
        compare(FURUTA, log, actuator=drive.replaced({"motor.torque_constant": 1e3}))


def test_identify_reads_what_a_board_logged(tmp_path):
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
    (episode,) = run_episodes(Slow(), env.make, 1, 3)
    write_log(tmp_path / "log.csv", Interface.between(env), episode)
    columns = 'time="time:s":s,torque="motor:N*m":N*m,position=unwrap(atan2("sin_angle:1","cos_angle:1"),2*pi)+pi:rad'
    log = read_log(tmp_path / "log.csv", columns)
    found = identify([log], rig="pendulum", known={"viscous_friction": 0.0})
    rotor = 20.0**2 * drive.motor.rotor_inertia
    for name, value in {"inertia": 1.0 / 3.0 + rotor, "mgl": 5.0}.items():
        assert found[name].status == "identified"
        assert found[name].value == pytest.approx(value, rel=0.05)
