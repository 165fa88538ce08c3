"""What memory does not hold is refused by its numbers, before anything is computed or written."""

import dataclasses

import numpy as np
import pytest

from codrl_mj import fields
from codrl_mj.agents import AGENTS
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy, check_episodes, run_episodes
from codrl_mj.identify.plan import plan
from codrl_mj.identify.synthetic import Excitation, Sampler, simulate
from codrl_mj.sizing import find_drive
from codrl_mj.sizing.loop import step_responses

MOTOR = "maxon-ec45-flat-50w"


@pytest.fixture
def small(monkeypatch):
    """A machine with a gigabyte of free memory."""
    monkeypatch.setattr(fields, "free_memory", lambda: 10**9)


def test_the_free_memory_is_that_of_the_system():
    free = fields.free_memory()
    assert free is None or 10**7 < free < 10**14


def test_what_fits_is_not_refused(small):
    fields.check_memory(0.99e9, "a thing", "remedy")
    with pytest.raises(
        ValueError, match=r"^a thing: about 1.01 GB of memory, of which 1 are free; remedy$"
    ):
        fields.check_memory(1.01e9, "a thing", "remedy")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        # 20 kHz is the drive's rate, 5 kHz that of the rows
        (
            "--duration 1e5",
            "100,000 s are 2,000,000,000 samples of the drive and 500,000,000 rows: about",
        ),
        ("--rate 1e9", "4 s are 80,000 samples of the drive and 4,000,000,000 rows: about"),
    ],
)
@pytest.mark.usefixtures("small")
def test_a_simulated_log_is_refused_before_it_begins(tmp_path, monkeypatch, capsys, line, says):
    monkeypatch.chdir(tmp_path)
    assert main(["identify", "simulate", MOTOR, "--out", "day.csv", *line.split()]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert "shorten the duration (--duration)" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("small")
def test_sizes_are_refused_from_python_too():
    drive = find_drive(MOTOR)
    with pytest.raises(ValueError, match="2,000,000,000 samples"):
        simulate(drive, Excitation("prbs", 6.0, 1e5))
    with pytest.raises(ValueError, match="4,000,000,000 rows"):
        simulate(drive, Excitation("prbs", 6.0, 4.0), sampler=Sampler(1e9))
    with pytest.raises(ValueError, match="200,000,000 samples of the drive and 200,000,000 rows"):
        plan(drive, duration=1e4)
    fast = dataclasses.replace(
        drive, controller=dataclasses.replace(drive.controller, sample_rate=1e12)
    )
    with pytest.raises(
        ValueError, match=r"sample_rate = 1e\+12: 120,000,000,000 samples of a step: .*; lower it"
    ):
        step_responses(fast)


@pytest.mark.usefixtures("small")
def test_episodes_side_by_side_are_refused():
    env = EnvConfig("cartpole")
    with pytest.raises(
        ValueError,
        match=r"episodes = 1,000,000, which run side by side: about 100 GB .*; run fewer",
    ):
        run_episodes(RandomPolicy("cartpole"), env.make, 1_000_000)
    with pytest.raises(ValueError, match="evaluation_episodes = 0: must be >= 1"):
        check_episodes(0, "evaluation_episodes")
    check_episodes(100)


def test_an_episode_that_does_not_end_stops_before_memory_does(monkeypatch):
    """It is asked again while it grows: here there is nothing left after 10,000 steps of it."""
    monkeypatch.setattr("codrl_mj.evaluation.episodes._STEPS_BETWEEN_CHECKS", 50)
    free = iter([10**12, *[0] * 10])
    monkeypatch.setattr(fields, "free_memory", lambda: next(free))
    env = EnvConfig("pendulum", max_episode_steps=10**9)
    with pytest.raises(
        ValueError, match=r"an episode of 50 steps, which does not end: .*; lower max_episode_steps"
    ):
        run_episodes(RandomPolicy("pendulum"), env.make, 1)


@pytest.mark.parametrize(
    ("agent", "sizes", "says"),
    [
        # of pendulum: 3 numbers seen and 1 done, 4 bytes each; a replayed step is seen before and
        # after
        (
            "ppo",
            {"rollout_steps": 10**9, "batch_size": 1000},
            r"rollout_steps = 1,000,000,000: about 16 GB",
        ),
        ("sac", {"buffer_size": 10**9}, r"buffer_size = 1,000,000,000: about 28 GB"),
    ],
)
@pytest.mark.usefixtures("small")
def test_buffers_of_agents_are_refused(agent, sizes, says):
    space = EnvConfig("pendulum").make()
    many = type("Many", (), {"num_envs": 1, "observation_space": space.observation_space})()
    many.action_space = space.action_space
    assert np.prod(space.observation_space.shape) == 3
    with pytest.raises(ValueError, match=says):
        AGENTS[agent](**sizes).make_model(many, 0)
