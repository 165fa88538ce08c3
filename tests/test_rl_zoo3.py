"""rl-zoo3's command line trains, evaluates and films our environments with our settings."""

import os
import re
import subprocess
import sys

import imageio
import numpy as np
import pytest

from codrl_mj.tasks import PAPER_TASKS

pytestmark = pytest.mark.matrix

ALGORITHMS = ("ppo", "dqn", "ddpg", "td3", "sac")
ENV_ID = "codrl_mj/CartPole-v0"
EVERY_MODEL = """
import argparse
import importlib
import codrl_mj
from rl_zoo3.exp_manager import ExperimentManager
for algorithm in {algorithms}:
    module = f"codrl_mj.rl_zoo3.{{algorithm}}"
    for env_id, settings in importlib.import_module(module).hyperparams.items():
        steps = settings["n_timesteps"]
        arguments = argparse.Namespace()
        manager = ExperimentManager(arguments, algorithm, env_id, "logs", config=module, eval_freq=-1, device="cpu")
        model, saved = manager.setup_experiment()
        print("built", algorithm, env_id, type(model).__name__, manager.n_timesteps == steps, len(saved))
        model.env.close()
"""


def run(folder, *arguments):
    """Run Python in a folder, and return its output."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a folder in which rl-zoo3 has trained PPO in two processes, with scaling."""
    folder = tmp_path_factory.mktemp("zoo")
    # rl-zoo3 looks in this file for third-party environments.
    (folder / "custom_envs.py").write_text("import codrl_mj\n")
    command = (
        f"--algo ppo --env {ENV_ID} --conf-file codrl_mj.rl_zoo3.ppo --gym-packages codrl_mj"
        " --vec-env subproc"
    )
    options = (
        "--env-kwargs actuator:'weaker' center_radius:0.1 --hyperparams n_envs:2 normalize:True"
    )
    budget = "-n 1000 --eval-freq 500 --eval-episodes 2 --num-threads 1 --seed 0 --device cpu"
    run(folder, "-m", "rl_zoo3.train", *command.split(), *options.split(), *budget.split())
    return folder


def test_it_trains_in_processes_evaluates_and_keeps_the_scales(trained):
    (log,) = (trained / "logs" / "ppo").iterdir()
    assert log.name == "codrl_mj-CartPole-v0_1"
    for file in (
        "best_model.zip",
        "codrl_mj-CartPole-v0.zip",
        "codrl_mj-CartPole-v0/vecnormalize.pkl",
    ):
        assert (log / file).is_file()
    with np.load(log / "evaluations.npz") as evaluations:
        assert len(evaluations["timesteps"]) >= 2
        # A step away from the center has no reward.
        assert (evaluations["results"] <= evaluations["ep_lengths"]).all()
    assert "weaker" in (log / "codrl_mj-CartPole-v0" / "args.yml").read_text()


def test_it_runs_the_trained_agent(trained):
    command = (
        f"--algo ppo --env {ENV_ID} --gym-packages codrl_mj -f logs --no-render -n 300 --device cpu"
    )
    printed = run(trained, "-m", "rl_zoo3.enjoy", *command.split())
    # The pole cannot fall faster.
    assert float(re.search(r"Mean episode length: ([\d.]+)", printed)[1]) >= 8


def test_it_films_the_cart_and_the_pole(trained):
    run(
        trained,
        "-m",
        "rl_zoo3.record_video",
        *f"--algo ppo --env {ENV_ID} -f logs -n 40 -o films".split(),
    )
    (film,) = (trained / "films").glob("*.mp4")
    with imageio.get_reader(film) as reader:
        assert reader.get_meta_data()["fps"] == 50
        frames = np.stack(list(reader.iter_data())).astype(int)
    assert frames.shape[1:] == (480, 480, 3)
    assert len(frames) >= 40
    red, _, blue = np.moveaxis(frames, -1, 0)
    for name, coloured in {"cart": blue - red > 60, "pole": red - blue > 100}.items():
        shown = coloured.sum((1, 2))
        assert (shown > 100).all(), name
        assert (shown < 10_000).all(), name
    assert (frames[0] != frames[-1]).any()


def test_every_setting_that_we_ship_makes_a_model(tmp_path):
    printed = run(tmp_path, "-c", EVERY_MODEL.format(algorithms=ALGORITHMS))
    built = [line.split() for line in printed.splitlines() if line.startswith("built ")]
    assert all(
        kind.lower() == algorithm and has_steps == "True"
        for _, algorithm, _, kind, has_steps, _ in built
    )
    covered = {(algorithm, env_id) for _, algorithm, env_id, *_ in built}
    every = {registered.env_id for registered in PAPER_TASKS}
    continuous = {"codrl_mj/Pendulum-v0", "codrl_mj/MountainCarContinuous-v0"}
    assert covered == (
        {("ppo", env_id) for env_id in every}
        | {("dqn", env_id) for env_id in every - continuous}
        | {(algorithm, env_id) for algorithm in ("ddpg", "td3", "sac") for env_id in continuous}
    )
