"""Tests that the exported rate is the rate of actions and not that of integration steps."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from dm_control import suite
from gymnasium import spaces

import codrl_mj
from codrl_mj.agents import SACConfig
from codrl_mj.deploy import Interface, export
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import TASKS
from tests.external_envs.models import V5, BareEnv

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")


class Repeating(gym.Wrapper):
    """A wrapper that repeats each action for a number of steps, from a list in turn."""

    def __init__(self, env, repeats):
        """Wrap an environment."""
        super().__init__(env)
        self.repeats, self.count = repeats, 0

    def step(self, action):
        for _ in range(self.repeats[self.count % len(self.repeats)]):
            result = self.env.step(action)
        self.count += 1
        return result


class OfDmControl(gym.Env):
    """A dm_control environment with Gymnasium's interface."""

    def __init__(self, domain, task):
        """Load the environment."""
        self.inner = suite.load(domain, task, task_kwargs={"random": 0})
        self.model, self.data = self.inner.physics.model.ptr, self.inner.physics.data.ptr
        spec = self.inner.action_spec()
        self.action_space = spaces.Box(spec.minimum, spec.maximum, dtype=np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.model.nq,), np.float64)

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        self.inner.reset()
        return self.data.qpos.copy(), {}

    def step(self, action):
        step = self.inner.step(action)
        return self.data.qpos.copy(), step.reward, False, False, {}


def repeated(*repeats):
    return Repeating(BareEnv(), repeats)


@pytest.fixture
def registered(request):
    """Register an environment that a function creates, and return its id."""
    gym.register("RateOfMine-v0", request.param, max_episode_steps=50)
    yield "RateOfMine-v0"
    gym.registry.pop("RateOfMine-v0")


@pytest.mark.parametrize("env_id", V5)
def test_rate_of_gymnasiums_environments(env_id):
    with gym.make(env_id) as env:
        assert Interface.from_env(EnvConfig(env_id)).rate == pytest.approx(
            1.0 / env.unwrapped.dt, rel=1e-9
        )


def test_rate_with_another_frame_skip():
    with gym.make("Hopper-v5", frame_skip=8) as env:
        assert env.unwrapped.dt == pytest.approx(0.016)
        rate = Interface.from_env(EnvConfig("Hopper-v5", options={"frame_skip": 8})).rate
    assert rate == pytest.approx(62.5, rel=1e-9)


@pytest.mark.parametrize("task", TASKS)
def test_rate_of_tasks(task):
    assert Interface.from_env(EnvConfig(task)).rate == pytest.approx(
        1.0 / TASKS[task].step_duration, rel=1e-12
    )


def test_rate_of_a_custom_env_source_and_a_custom_task():
    # The rig takes 10 steps of 2 ms.
    assert Interface.from_env(EnvConfig("tests.envs.rig:RIG")).rate == pytest.approx(50.0)
    assert Interface.from_env(EnvConfig("tests.own_project.arm:TASK")).rate == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("registered", "rate"),
    # The first environment has no `dt`, the second has a wrapper inside.
    [
        (BareEnv, 100.0),
        (functools.partial(repeated, 4), 25.0),
    ],
    indirect=["registered"],
)
def test_rate_of_functions_that_create_environments(registered, rate):
    assert Interface.from_env(EnvConfig(registered)).rate == pytest.approx(rate, rel=1e-9)


@pytest.mark.parametrize("registered", [functools.partial(repeated, 2, 3)], indirect=True)
def test_raises_if_steps_have_different_durations(registered):
    with pytest.raises(ValueError, match=r"first steps take \[0\.02, 0\.03.*must be equal"):
        Interface.from_env(EnvConfig(registered))


@pytest.mark.parametrize(
    "name", ["cartpole/swingup", "pendulum/swingup", "reacher/easy", "finger/spin", "walker/walk"]
)
def test_rate_of_dm_control_environments(name):
    """Check dm_control, whose physics splits an integration step into halves."""
    domain, task = name.split("/")
    inner = suite.load(domain, task)
    env = codrl_mj.make(
        functools.partial(OfDmControl, domain, task), {".*": "ideal"}, disable_env_checker=True
    )
    recorder = env.recorder
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))
    assert recorder.step_duration == pytest.approx(inner.control_timestep(), rel=1e-9)
    assert len(recorder.trace) == round(inner.control_timestep() / inner.physics.timestep())
    ours = codrl_mj.make_dm_control(name, {".*": "ideal"})
    assert ours.control_timestep() == inner.control_timestep()


def test_recorder_knows_the_step_duration_before_the_first_step():
    """Check the duration that a live view needs for the ranges of its settings and its pace."""
    env = codrl_mj.make("HalfCheetah-v5", {".*": "ideal"})
    assert env.recorder.step_duration == pytest.approx(0.05)
    env.close()


def test_rate_in_the_contract_and_the_c(tmp_path):
    env = EnvConfig("InvertedPendulum-v5", max_episode_steps=100)
    with env.build() as instance:
        policy = SACConfig(hidden=(8,)).make_policy(
            instance.observation_space, instance.action_space
        )
    contract = export(policy, env, "sac", tmp_path / "out", 1)
    # The environment takes 2 steps of 0.02 s.
    assert contract.rate == pytest.approx(25.0)
    assert contract.late["after"] == pytest.approx(0.06)
    header = (tmp_path / "out/controller.h").read_text()
    assert "#define CONTROLLER_POLICY_RATE 25.0f" in header
    assert "#define WIRE_LATE_AFTER 60000u" in (tmp_path / "out/wire.h").read_text()
