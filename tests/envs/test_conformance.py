"""Conformance of all tasks, physics and setups with Gymnasium's interface and environments."""

import unittest.mock
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics import PHYSICS
from codrl_mj.tasks import TASKS
from tests.envs.faces import SETUPS, arguments
from tests.matrix import matrix_params
from tests.tasks.faces import REBUILT, actions, every_rebuilt

every_physics = pytest.mark.parametrize("physics", PHYSICS)
every_setup = pytest.mark.parametrize("setup", SETUPS)


def make(task, setup, physics="mujoco", **options):
    """The environment as a user makes it, in Gymnasium's wrappers."""
    return gymnasium.make(
        TASKS[task].env_id, physics=physics, **arguments(task, setup, physics), **options
    )


class Blank(gymnasium.Env):
    """Environment with given spaces in which nothing happens; checkers only warn of its spaces."""

    def __init__(self, action_space, observation_space):  # noqa: D107
        self.action_space, self.observation_space = action_space, observation_space

    def _observation(self):
        bounds = self.observation_space.low, self.observation_space.high
        return np.clip(np.zeros(self.observation_space.shape, np.float32), *bounds)

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):  # noqa: ARG002
        return self._observation(), 0.0, False, False, {}


def _warnings_of(check, env, **options):
    """Return the warnings of a checker; its errors are raised."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(env, **options)
    return {str(warning.message) for warning in caught}


@every_rebuilt
@every_physics
@every_setup
@pytest.mark.parametrize(
    "check", [check_env, check_env_sb3], ids=["gymnasium", "stable_baselines3"]
)
def test_environment_checkers_warn_only_about_spaces(check, task, physics, setup):
    env = make(task, setup, physics).unwrapped
    space_warnings = _warnings_of(
        check, Blank(env.action_space, env.observation_space), skip_render_check=True
    )
    assert _warnings_of(check, env, skip_render_check=True) <= space_warnings


@pytest.mark.parametrize("task", matrix_params(["pendulum"], REBUILT))
def test_gymnasiums_checker_does_not_warn_about_rendering(task, monkeypatch):
    # pygame may not be installed.
    monkeypatch.setattr("codrl_mj.envs.single.DisplayWindow", unittest.mock.Mock())
    env = make(task, "force", render_mode="rgb_array", width=64, height=48)
    blank = Blank(env.action_space, env.observation_space)
    assert _warnings_of(check_env, env.unwrapped) <= _warnings_of(
        check_env, blank, skip_render_check=True
    )
    env.close()


@every_rebuilt
@every_physics
@every_setup
def test_steps_have_gymnasiums_types_and_observations_are_in_the_space(task, physics, setup):
    env, original = (
        make(task, setup, physics, max_episode_steps=12),
        gymnasium.make(TASKS[task].gymnasium_id),
    )
    if setup in ("ideal", "force"):
        assert env.action_space == original.action_space
        assert env.observation_space == original.observation_space
    env.action_space.seed(0)
    for seed in range(12):
        observation, info = env.reset(seed=seed)
        assert info.keys() == (
            {"randomization"} if "randomize" in arguments(task, setup, physics) else set()
        )
        ended = False
        while not ended:
            assert observation in env.observation_space
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert observation.dtype == np.float32
            assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
            assert {*info} == {
                *(
                    "desired_force",
                    "actual_force",
                    "current",
                    "reference_current",
                    "voltage",
                    "saturated",
                )
            }
            assert isinstance(info["saturated"], bool)
            if setup != "voltage":
                assert abs(info["desired_force"]) <= TASKS[task].max_force
            ended = terminated or truncated
        assert observation in env.observation_space


@every_rebuilt
@every_physics
def test_the_ideal_actuator_delivers_what_is_desired_and_a_motor_tracks_its_current(task, physics):
    ideal, with_motor = make(task, "ideal", physics), make(task, "force", physics)
    for env in (ideal, with_motor):
        env.reset(seed=0)
    for action in actions(task, 0, 10):
        info = ideal.step(action)[-1]
        assert info["actual_force"] == info["desired_force"]
        assert info["current"] == info["reference_current"] == info["voltage"] == 0.0
        assert not info["saturated"]
        info = with_motor.step(action)[-1]
        # The arm is 0.5, the torque constant 0.8.
        assert info["reference_current"] == pytest.approx(info["desired_force"] * 0.5 / 0.8)


@every_rebuilt
def test_mujoco_model_and_data_are_attributes_and_analytic_physics_raises(task):
    env = ActuatedEnv(task)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.data.time == pytest.approx(env.task.step_duration)
    assert env.model.opt.timestep == pytest.approx(
        env.task.step_duration / env.task.motor_inner_steps
    )
    np.testing.assert_array_equal(env.state[list(env.task.qpos)], env.data.qpos)
    np.testing.assert_array_equal(env.state[list(env.task.qvel)], env.data.qvel)
    with pytest.raises(AttributeError, match="AnalyticPhysics has no MuJoCo model or data"):
        _ = ActuatedEnv(task, physics="analytic").model


@every_rebuilt
def test_every_task_is_registered_with_the_limits_of_the_environment_it_rebuilds(task):
    ours, theirs = (gymnasium.spec(name) for name in (TASKS[task].env_id, TASKS[task].gymnasium_id))
    assert ours.max_episode_steps == theirs.max_episode_steps
    assert ours.reward_threshold == theirs.reward_threshold
    metadata = (gymnasium.make(spec).unwrapped.metadata for spec in (ours, theirs))
    assert next(metadata)["render_fps"] == next(metadata)["render_fps"]
