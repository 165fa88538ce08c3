"""Run folders and trajectories of an earlier version, whose files are beside: they load, and play as they did."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from codrl_mj import Supply, named_actuator
from codrl_mj.cli import main
from codrl_mj.disturbances import OFF, Joint
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate, load_episode
from codrl_mj.runs.policies import load_policy
from codrl_mj.runs.summaries import compare, find_runs
from codrl_mj.training import EVALUATION_SEED, load_config

RUNS = Path(__file__).parent / "fixtures" / "earlier"


def test_what_they_say_is_understood():
    cartpole, pendulum = (load_config(RUNS / name).env for name in ("cartpole", "pendulum"))
    assert cartpole == EnvConfig("cartpole", "paper", options={"center_radius": 0.1})
    noisy = {"name": "paper", "controller": {"current_noise": 0.1}, "supply": {"resistance": 0.2}}
    assert pendulum == EnvConfig("pendulum", noisy, observe_actuator=True, joint=Joint(damping=0.05))
    assert pendulum.actuator.supply == Supply(resistance=0.2)
    assert pendulum.disturbances == OFF


@pytest.mark.parametrize("name", ["cartpole", "pendulum"])
def test_their_policies_do_what_they_did_then(name):
    """To the last bit, noise of the sensor included: what the earlier version measured is beside them."""
    run = RUNS / name
    assert "sha256" not in (run / "policy.json").read_text()
    now = evaluate(load_policy(run), load_config(run).evaluation_env, 2, EVALUATION_SEED).as_mapping()
    then = json.loads((run / "evaluation.json").read_text())
    then["units"], now["units"] = None, None  # there are more measures now
    assert {
        key: value for key, value in json.loads(json.dumps(now)).items() if key in then and key != "conditions"
    } == {key: value for key, value in then.items() if key != "conditions"}


def test_they_are_listed_and_compared():
    runs = find_runs(RUNS)
    assert [(run.task, run.actuator, run.state) for run in runs] == [
        ("cartpole", "paper", "finished"),
        ("pendulum", "custom", "finished"),
    ]
    assert compare(runs).configuration["env.options.center_radius"] == (0.1, None)


def test_they_are_evaluated_filmed_and_not_continued(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(RUNS / "pendulum", "run")
    assert main(["evaluate", "run", "--episodes", "1", "--env.joint.damping", "0.05"]) == 0
    film = ["--out", "film.gif", "--width", "160", "--height", "120", "--env.max-episode-steps", "2"]
    assert main(["render", "run", *film]) == 0
    for name in ("result.json", "policy.json", "policy.safetensors"):
        (Path("run") / name).unlink()
    assert main(["train", "--resume", "run"]) == 2
    assert "run was started with other software" in capsys.readouterr().err


def test_their_trajectories_are_read():
    episode = load_episode(RUNS / "cartpole.npz")
    assert (len(episode.time), episode.inner_steps, episode.total) == (5, 1, 5.0)
    assert episode.actuator == named_actuator("weaker", "cartpole")
    motor = episode.actuator.motor
    force = motor.torque_constant * episode.trace["current"] / motor.arm_radius
    np.testing.assert_allclose(episode.trace["actual_force"], force, rtol=1e-12)
    np.testing.assert_array_equal(episode.signals["current"], episode.trace["current"])
