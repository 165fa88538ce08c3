"""Requests beyond the free memory raise with their sizes before anything is computed or written."""

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
    """Simulate a machine with 1 GB of free memory."""
    monkeypatch.setattr(fields, "free_memory", lambda: 10**9)


def test_the_free_memory_is_read_from_the_system():
    free = fields.free_memory()
    assert free is None or 10**7 < free < 10**14


def test_raises_only_beyond_the_free_memory(small):
    fields.check_memory(0.99e9, "a thing", "remedy")
    with pytest.raises(
        ValueError,
        match=r"^a thing: needs about 1.01 GB of memory, but only 1 GB are free; remedy$",
    ):
        fields.check_memory(1.01e9, "a thing", "remedy")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        # The drive's rate is 20 kHz, that of the rows 5 kHz.
        (
            "--duration 1e5",
            "100,000 s are 2,000,000,000 samples of the drive and 500,000,000 rows: needs about",
        ),
        ("--rate 1e9", "4 s are 80,000 samples of the drive and 4,000,000,000 rows: needs about"),
    ],
)
@pytest.mark.usefixtures("small")
def test_raises_before_a_large_log_is_simulated(tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    assert main(["identify", "simulate", MOTOR, "--out", "day.csv", *line.split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "shorten the duration (--duration)" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("small")
def test_python_calls_raise_too():
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
def test_raises_for_too_many_parallel_episodes():
    env = EnvConfig("cartpole")
    with pytest.raises(
        ValueError,
        match=r"episodes = 1,000,000, which run side by side: needs about 100 GB .*; run fewer",
    ):
        run_episodes(RandomPolicy("cartpole"), env.build, 1_000_000)
    with pytest.raises(ValueError, match="evaluation_episodes = 0: must be >= 1"):
        check_episodes(0, "evaluation_episodes")
    check_episodes(100)


def test_an_endless_episode_stops_before_the_memory_is_full(monkeypatch):
    """Simulate memory that is full after 10,000 steps; it is checked as the episode grows."""
    monkeypatch.setattr("codrl_mj.evaluation.episodes._STEPS_BETWEEN_CHECKS", 50)
    free = iter([10**12, *[0] * 10])
    monkeypatch.setattr(fields, "free_memory", lambda: next(free))
    env = EnvConfig("pendulum", max_episode_steps=10**9)
    with pytest.raises(
        ValueError, match=r"an episode of 50 steps, which does not end: .*; lower max_episode_steps"
    ):
        run_episodes(RandomPolicy("pendulum"), env.build, 1)


@pytest.mark.parametrize(
    ("agent", "sizes", "message"),
    [
        # A step of pendulum has 3 observed and 1 commanded numbers of 4 bytes; replay buffers store
        # the observations before and after it.
        (
            "ppo",
            {"rollout_steps": 10**9, "batch_size": 1000},
            r"rollout_steps = 1,000,000,000: needs about 16 GB",
        ),
        ("sac", {"buffer_size": 10**9}, r"buffer_size = 1,000,000,000: needs about 28 GB"),
    ],
)
@pytest.mark.usefixtures("small")
def test_raises_if_agents_buffers_are_too_large(agent, sizes, message):
    space = EnvConfig("pendulum").build()
    many = type("Many", (), {"num_envs": 1, "observation_space": space.observation_space})()
    many.action_space = space.action_space
    assert np.prod(space.observation_space.shape) == 3
    with pytest.raises(ValueError, match=message):
        AGENTS[agent](**sizes).make_model(many, 0)
