"""Disturbances in every environment: alike in one and in many, on both physics, after a copy, and nothing when off."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import codrl_mj
from codrl_mj.envs.vector import ActuatedVectorEnv
from codrl_mj.tasks import TASKS
from tests.disturbances.everything import MOST, RUBBED, imperfect
from tests.matrix import but

WEAK = {"controller": {"kp": 1.0, "ki": 0.5, "max_voltage": 3.0}}
ALL = {"disturbances": MOST, "joint": RUBBED, "actuator": imperfect(WEAK)}
"""Everything at once; on the analytic physics without a joint's."""
two_tasks = pytest.mark.parametrize("task", but(["pendulum", "cartpole"], TASKS))
SIGNALS = ("desired_force", "actual_force", "current", "reference_current", "voltage", "saturated")


def _vector(task, num_envs=4, mode=AutoresetMode.NEXT_STEP, **arguments):
    arguments = {"max_episode_steps": 12, "observe_actuator": True, **ALL, **arguments}
    return ActuatedVectorEnv(num_envs, task, autoreset_mode=mode, **arguments)


def _single(task, **arguments):
    arguments = {"max_episode_steps": 12, "observe_actuator": True, **ALL, **arguments}
    return gymnasium.make(TASKS[task].env_id, disable_env_checker=True, **arguments)


def _plain(task, **arguments):
    return _single(task, **({"disturbances": None, "joint": None, "actuator": WEAK} | arguments))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@two_tasks
def test_many_are_as_one_bit_for_bit(task, mode, threads):
    ours = _vector(task, mode=mode, num_threads=threads)
    theirs = SyncVectorEnv([lambda: _single(task)] * 4, autoreset_mode=mode)
    np.testing.assert_array_equal(ours.reset(seed=7)[0], theirs.reset(seed=7)[0])
    ours.action_space.seed(0)
    for _ in range(30):
        actions = ours.action_space.sample()
        got, expected = ours.step(actions), theirs.step(actions)
        for mine, reference in zip(got[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(mine, reference)
        for name in {*SIGNALS} & {*expected[4]}:
            np.testing.assert_array_equal(got[4][name], expected[4][name])


@two_tasks
def test_both_physics_agree_with_everything_that_both_have(task):
    mujoco, analytic = (_single(task, joint=None, physics=physics) for physics in ("mujoco", "analytic"))
    np.testing.assert_array_equal(mujoco.reset(seed=1)[0], analytic.reset(seed=1)[0])
    mujoco.action_space.seed(0)
    for _ in range(12):
        action = mujoco.action_space.sample()
        ours, theirs = mujoco.step(action), analytic.step(action)
        np.testing.assert_allclose(mujoco.unwrapped.state, analytic.unwrapped.state, rtol=0, atol=1e-9)
        for name in SIGNALS:
            assert ours[4][name] == pytest.approx(theirs[4][name], abs=1e-9), name
        if ours[2]:
            break


@two_tasks
def test_copies_and_restored_snapshots_go_on_alike(task):
    env = _vector(task)
    env.reset(seed=2)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(30)]
    for action in actions[:7]:
        env.step(action)
    others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), _vector(task)]
    others[2].reset(seed=9)
    others[2].restore(env.snapshot())
    for action in actions[7:]:
        expected = env.step(action)
        for other in others:
            for mine, reference in zip(other.step(action)[:4], expected[:4], strict=True):
                np.testing.assert_array_equal(mine, reference)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_a_copy_of_a_single_environment_goes_on_alike(physics):
    env = _single("cartpole", joint=None, physics=physics)
    env.reset(seed=0)
    for action in (1, 0, 0):
        env.step(action)
    others = [copy.deepcopy(env.unwrapped), pickle.loads(pickle.dumps(env.unwrapped))]
    for action in (0, 1, 1, 0, 1):
        expected = env.step(action)
        for other in others:
            np.testing.assert_array_equal(other.step(action)[0], expected[0])


def test_dm_control_saves_commands_and_loads_with_the_state():
    suite = pytest.importorskip("codrl_mj.suite")
    arguments = {**ALL, "observe_actuator": True}
    env, other = (suite.load("pendulum", task_kwargs={"random": 5}, **arguments) for _ in range(2))
    gym = _single("pendulum", max_episode_steps=200)
    gym.reset(seed=5)
    env.reset()
    other.reset()
    actions = np.random.default_rng(0).uniform(-2, 2, (20, 1)).astype(np.float32)
    for action in actions[:9]:
        env.step(action)
    other.restore(env.snapshot())
    for action in actions[9:]:
        ours, theirs = env.step(action), other.step(action)
        for name, value in ours.observation.items():
            np.testing.assert_array_equal(theirs.observation[name], value)
    saved = env.snapshot()
    with pytest.raises(ValueError, match=r"snapshot\['disturbances'\] is of shape"):
        env.restore(saved | {"disturbances": saved["disturbances"][:-1]})


def test_stable_baselines_gets_them_too():
    pytest.importorskip("stable_baselines3")
    described = {**ALL, "disturbances": codrl_mj.Disturbances(**MOST), "joint": codrl_mj.Joint(**RUBBED)}
    envs = codrl_mj.make_sb3_vec_env("codrl_mj/Pendulum-v0", 3, observe_actuator=True, **described)
    reference = _vector("pendulum", 3, AutoresetMode.SAME_STEP, max_episode_steps=200)
    envs.seed(4)
    np.testing.assert_array_equal(envs.reset(), reference.reset(seed=4)[0])
    for value in (1.0, -2.0, 0.5):
        action = np.full((3, 1), value, np.float32)
        np.testing.assert_array_equal(envs.step(action)[0], reference.step(action)[0])


@two_tasks
def test_seeds_draw_the_same_initial_states_with_disturbances_and_without(task):
    disturbed, plain = _single(task), _plain(task)
    disturbed.reset(seed=11)
    plain.reset(seed=11)
    np.testing.assert_array_equal(disturbed.unwrapped.state, plain.unwrapped.state)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
@two_tasks
def test_off_is_bit_for_bit_as_without(task, physics):
    zero = {**WEAK, "controller": {**WEAK["controller"], "current_noise": 0.0, "current_bias": 0.0}, "supply": {}}
    off = _single(task, disturbances={}, joint={}, actuator=zero, physics=physics)
    plain = _plain(task, physics=physics)
    off.reset(seed=1)
    plain.reset(seed=1)
    off.action_space.seed(0)
    for _ in range(12):
        action = off.action_space.sample()
        ours, theirs = off.step(action), plain.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:] == theirs[1:]
    off.reset()
    plain.reset()  # nothing was drawn for a key in between
    np.testing.assert_array_equal(off.unwrapped.state, plain.unwrapped.state)
    if physics == "mujoco":
        assert off.unwrapped.physics._disturber.on is False


EACH = {name: {"disturbances": {name: MOST[name]}} for name in MOST if "pulse" not in name}
EACH["pulses"] = {"disturbances": {name: MOST[name] for name in MOST if "pulse" in name}}
EACH |= {f"joint {name}": {"joint": {name: 0.1}} for name in RUBBED}
EACH |= {
    name: {"actuator": {**WEAK, "controller": {**WEAK["controller"], name: size}}}
    for name, size in {"current_noise": 0.05, "current_bias": -0.02}.items()
}
EACH["supply"] = {"actuator": {**WEAK, "supply": {"resistance": 0.7}}}


@pytest.mark.parametrize("what", EACH)
def test_each_alone_changes_what_happens(what):
    disturbed, plain = _plain("pendulum", **EACH[what]), _plain("pendulum")
    disturbed.reset(seed=1)
    plain.reset(seed=1)
    for value in np.linspace(-1.7, 1.9, 12, dtype=np.float32):
        disturbed.step(np.array([value]))
        plain.step(np.array([value]))
    assert np.abs(disturbed.unwrapped.state - plain.unwrapped.state).max() > 1e-6


def test_drawn_motors_and_disturbances_go_together_bit_for_bit():
    randomize = {"motor.inductance": codrl_mj.Uniform(0.08, 0.12), "model.gravity": codrl_mj.Uniform(0.9, 1.1)}
    ours = _vector("acrobot", randomize=randomize)
    theirs = SyncVectorEnv([lambda: _single("acrobot", randomize=randomize)] * 4)
    np.testing.assert_array_equal(ours.reset(seed=7)[0], theirs.reset(seed=7)[0])
    for step in range(25):
        actions = np.arange(step, step + 4) % 3
        for mine, reference in zip(ours.step(actions)[:4], theirs.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(mine, reference)
