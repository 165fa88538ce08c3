"""What every environment keeps: over every task, physics and actuator."""

import copy
import functools
import pickle
import unittest.mock
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from codrl_mj.actuators import NAMED
from codrl_mj.physics import PHYSICS
from codrl_mj.tasks import TASKS
from tests.matrix import but
from tests.reference import MotorSimulation
from tests.tasks.faces import REBUILT, every_rebuilt

INFO_KEYS = {"desired_force", "actual_force", "current", "reference_current", "voltage", "saturated"}
every_physics = pytest.mark.parametrize("physics", PHYSICS)
every_actuator = pytest.mark.parametrize("actuator", NAMED)


def make(task, actuator="default", physics="mujoco", **options):
    """The environment as a user makes it, in Gymnasium's wrappers."""
    return gymnasium.make(TASKS[task].env_id, actuator=actuator, physics=physics, **options)


def sampled_actions(env, steps, seed=0):
    """Random actions of the environment's space."""
    space = copy.deepcopy(env.action_space)
    space.seed(seed)
    return [space.sample() for _ in range(steps)]


def rows(env, actions):
    """Everything that the steps return, flattened: observation, reward, ends and info."""
    found = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        found.append(np.concatenate([observation, [reward, terminated, truncated], list(map(float, info.values()))]))
    return np.array(found)


def test_every_task_is_registered_with_the_limits_of_the_environment_it_rebuilds():
    for task in (task for task in TASKS.values() if task.gymnasium_id):
        ours, theirs = gymnasium.spec(task.env_id), gymnasium.spec(task.gymnasium_id)
        assert ours.max_episode_steps == theirs.max_episode_steps
        assert ours.reward_threshold == theirs.reward_threshold


def _complaints(check, env, **options):
    """The warnings of a checker; an error of it is an error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(env, **options)
    return {str(warning.message) for warning in caught}


@functools.cache
def _inherited(check, task):
    """What a checker says of Gymnasium's own environment: ours has the same spaces, which it may not like."""
    return _complaints(check, gymnasium.make(TASKS[task].gymnasium_id).unwrapped, skip_render_check=True)


@every_rebuilt
@every_physics
@every_actuator
@pytest.mark.parametrize("check", [check_env, check_env_sb3], ids=["gymnasium", "stable_baselines3"])
def test_the_checkers_have_no_complaint(check, task, physics, actuator):
    env = make(task, actuator, physics).unwrapped
    assert _complaints(check, env, skip_render_check=True) <= _inherited(check, task)


@pytest.mark.parametrize("task", but(["pendulum"], REBUILT))
def test_gymnasiums_checker_has_no_complaint_about_rendering(task, monkeypatch):
    monkeypatch.setattr("codrl_mj.envs.single.Window", unittest.mock.Mock())  # pygame may not be there
    env = make(task, render_mode="rgb_array", width=64, height=48)
    assert _complaints(check_env, env.unwrapped) <= _inherited(check_env, task)
    env.close()


@every_rebuilt
@every_physics
@every_actuator
def test_spaces_are_gymnasiums_and_hold_every_observation(task, physics, actuator):
    env, original = make(task, actuator, physics), gymnasium.make(TASKS[task].gymnasium_id)
    assert env.action_space == original.action_space
    assert env.observation_space == original.observation_space
    observation, info = env.reset(seed=0)
    assert info == {}
    for action in sampled_actions(env, 100):
        assert env.observation_space.contains(observation), observation
        assert observation.dtype == np.float32
        observation, reward, terminated, truncated, info = env.step(action)
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert info.keys() == INFO_KEYS
        assert isinstance(info["saturated"], bool)
        assert abs(info["desired_force"]) <= TASKS[task].max_force
        if terminated or truncated:
            assert env.observation_space.contains(observation), observation
            observation, _ = env.reset()


@every_rebuilt
@every_physics
def test_the_ideal_actuator_delivers_what_is_desired_and_a_motor_what_its_current_gives(task, physics):
    env = make(task, "ideal", physics)
    env.reset(seed=0)
    for action in sampled_actions(env, 10):
        info = env.step(action)[-1]
        assert info["actual_force"] == info["desired_force"]
        assert info["current"] == info["reference_current"] == info["voltage"] == 0.0
        assert not info["saturated"]
    env = make(task, "default", physics)
    motor = env.unwrapped.actuator.motor
    env.reset(seed=0)
    for action in sampled_actions(env, 10):
        info = env.step(action)[-1]
        assert info["actual_force"] == pytest.approx(motor.torque_constant * info["current"] / motor.arm_radius)
        wanted = info["desired_force"] * motor.arm_radius / motor.torque_constant
        assert info["reference_current"] == pytest.approx(wanted)


@every_rebuilt
@every_physics
def test_the_motor_starts_at_rest_in_every_episode(task, physics):
    env = make(task, "weak", physics)
    actions = sampled_actions(env, 20)
    env.reset(seed=5)
    first = rows(env, actions)
    env.reset(seed=5)
    np.testing.assert_array_equal(rows(env, actions), first)
    # the first step's current is the reference's from zero
    env.reset(seed=5)
    setup, state = env.unwrapped, env.unwrapped.state
    info = env.step(actions[0])[-1]
    if setup.task.motor_inner_steps == 1:
        motor = MotorSimulation(setup.actuator)
        speed = dict(zip(setup.task.state_names, state, strict=True))
        actuated = {"pendulum": "theta_dot [rad/s]", "cartpole": "x_dot [m/s]"}[task]
        motor.step(setup.task.step_duration, info["desired_force"], speed[actuated])
        assert info["current"] == pytest.approx(motor.current, rel=1e-12)


@every_rebuilt
@every_physics
def test_a_seed_repeats_and_another_differs(task, physics):
    actions = sampled_actions(make(task), 30)
    runs = []
    for seed in (3, 3, 4):
        env = make(task, "default", physics)
        observation, _ = env.reset(seed=seed)
        runs.append((observation, rows(env, actions)))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    assert np.any(runs[0][0] != runs[2][0])


@every_rebuilt
@every_physics
@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"]
)
def test_a_copy_made_mid_episode_continues_bit_for_bit_motor_included(task, physics, duplicate):
    env = make(task, "weak", physics)
    env.reset(seed=1)
    actions = sampled_actions(env, 30)
    rows(env, actions[:10])
    twin = duplicate(env)
    rest = rows(env, actions[10:])
    np.testing.assert_array_equal(rows(twin, actions[10:]), rest)
    # they are apart, and share the random generator's future but not the generator
    env.reset()
    np.testing.assert_array_equal(env.unwrapped.state, (twin.reset(), twin.unwrapped.state)[1])


@every_rebuilt
@every_physics
def test_what_is_returned_never_aliases_what_goes_on(task, physics):
    env, control = make(task, "weak", physics), make(task, "weak", physics)
    actions = sampled_actions(env, 30)
    expected_first, _ = control.reset(seed=2)
    observation, _ = env.reset(seed=2)
    kept = observation.copy()
    expected, found = [], []
    for action in actions:
        expected.append(rows(control, [action])[0])
        vandalised = env.unwrapped.state
        vandalised[:] = 1e3
        observation[:] = 1e3
        before = copy.deepcopy(action)
        step = env.step(action)
        np.testing.assert_array_equal(action, before)
        observation = step[0]
        found.append(np.concatenate([observation, [step[1], step[2], step[3]], list(map(float, step[4].values()))]))
    np.testing.assert_array_equal(kept, expected_first)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("task", but(REBUILT, TASKS))
def test_observations_of_different_steps_are_different_arrays(task):
    env = make(task)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second = env.step(env.action_space.sample())[0]
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, kept)


@every_rebuilt
@every_actuator
def test_both_physics_tell_the_same_story(task, actuator):
    """Over the first steps, before chaos: same observations, rewards, ends, forces and currents."""
    one, two = make(task, actuator, "mujoco"), make(task, actuator, "analytic")
    actions = sampled_actions(one, 15)
    np.testing.assert_array_equal(one.reset(seed=7)[0], two.reset(seed=7)[0])
    np.testing.assert_allclose(rows(one, actions), rows(two, actions), rtol=1e-6, atol=1e-6)


@every_rebuilt
def test_mujoco_model_and_data_are_at_hand_and_analytic_physics_says_it_has_none(task):
    env = make(task).unwrapped
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.data.time == pytest.approx(env.task.step_duration)
    assert env.model.opt.timestep == pytest.approx(env.task.step_duration / env.task.motor_inner_steps)
    np.testing.assert_array_equal(env.state[list(env.task.qpos)], env.data.qpos)
    np.testing.assert_array_equal(env.state[list(env.task.qvel)], env.data.qvel)
    with pytest.raises(AttributeError, match="AnalyticPhysics has no MuJoCo model or data"):
        _ = make(task, physics="analytic").unwrapped.model
