"""Environments stepped one by one as one: what Gymnasium's loop gives, and what the batched environment offers."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

import codrl_mj
from codrl_mj import Uniform
from codrl_mj.envs import ActuatedEnv, SerialVectorEnv
from codrl_mj.tasks import TASKS, named_actuator
from tests.envs.snapshots import everything
from tests.envs.vectors import assert_equal_episodes, assert_same, batched, looped, random_actions
from tests.tasks.faces import every_rebuilt


@every_rebuilt
def test_on_mujoco_it_is_the_batched_environment(task):
    arguments = everything(task, "mujoco") | {"max_episode_steps": 11}
    theirs = SerialVectorEnv(4, task, **arguments)
    ends = assert_equal_episodes(batched(task, 4, "SameStep", **arguments), theirs, 60)
    assert ends.sum() > 12


@every_rebuilt
def test_signals_and_draws_are_those_of_the_batched_environment(task):
    arguments = everything(task, "mujoco") | {"max_episode_steps": 7}
    ours, theirs = SerialVectorEnv(3, task, **arguments), batched(task, 3, "SameStep", **arguments).unwrapped
    assert ours.signals is None
    assert_same(ours.randomization, theirs.randomization)  # nothing yet: NaN
    ours.reset(seed=2)
    theirs.reset(seed=2)
    for index, actions in enumerate(random_actions(ours, np.random.default_rng(index)) for index in range(20)):
        if index == 5:  # afterwards not all episodes end in the same step
            mask = np.array([True, False, False])
            ours.reset(options={"reset_mask": mask})
            theirs.reset(options={"reset_mask": mask})
        ours.step(actions)
        theirs.step(actions)
        assert_same(ours.signals, theirs.signals, f"step {index}")
        assert_same(ours.randomization, theirs.randomization, f"step {index}")


@every_rebuilt
def test_on_the_analytic_physics_it_is_gymnasiums_loop(task):
    arguments = everything(task, "analytic") | {"max_episode_steps": 11}
    ours, theirs = SerialVectorEnv(3, task, **arguments), looped(task, 3, "SameStep", **arguments)
    generator = np.random.default_rng(0)
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    for index in range(24):
        actions = random_actions(ours, generator)
        assert_same(ours.step(actions), theirs.step(actions), f"step {index}")
    for mine, his in zip(ours.np_random, theirs.np_random, strict=True):
        assert mine.random() == his.random()


def test_without_a_time_limit_episodes_do_not_end():
    env = SerialVectorEnv(2, "pendulum", physics="analytic")
    env.reset(seed=0)
    ended = [env.step(np.zeros((2, 1), np.float32))[3].any() for _ in range(250)]
    assert ended == [False] * 250
    assert env.task is TASKS["pendulum"]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_alike(duplicate):
    env = SerialVectorEnv(3, "acrobot", physics="analytic", max_episode_steps=6)
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    env.step(random_actions(env, generator))
    twin = duplicate(env)
    for _ in range(15):
        actions = random_actions(env, generator)
        assert_same(twin.step(actions), env.step(actions))


def test_a_snapshot_goes_into_environments_that_were_never_reset():
    envs = [codrl_mj.make_vec("pendulum", 2, render_mode="rgb_array") for _ in range(2)]
    envs[0].reset(seed=0)
    actions = random_actions(envs[0], np.random.default_rng(0))
    envs[0].step(actions)
    envs[1].restore(envs[0].snapshot())
    assert_same(envs[1].step(actions), envs[0].step(actions))


def test_each_can_have_an_actuator_of_its_own():
    actuators = [named_actuator(name, "cartpole") for name in ("paper", "weak", "weaker")]
    env = SerialVectorEnv(3, "cartpole", actuators, physics="analytic", randomize={"motor.resistance": Uniform(1, 2)})
    env.reset(seed=3)
    env.step(np.array([1, 1, 1]))
    drawn = env.randomization["motor.resistance"]
    assert len(set(drawn)) == 3
    for row, actuator in enumerate(actuators):
        single = ActuatedEnv("cartpole", actuator, "analytic", randomize={"motor.resistance": Uniform(1, 2)})
        assert single.reset(seed=3 + row)[1]["randomization"]["motor.resistance"] == drawn[row]
        assert single.step(1)[4]["current"] == env.signals["current"][row]


def test_rendering_shows_the_first_environment():
    vec_env = codrl_mj.make_sb3_vec_env(
        "codrl_mj/Pendulum-v0", 2, physics="analytic", render_mode="rgb_array", width=64, height=48
    )
    vec_env.seed(0)
    vec_env.reset()
    single = ActuatedEnv("pendulum", physics="analytic", render_mode="rgb_array", width=64, height=48)
    single.reset(seed=0)
    np.testing.assert_array_equal(vec_env.render(), single.render())
    single.close()
    vec_env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs = 0: must be an integer >= 1"),
        ({"num_envs": 2.0}, "num_envs = 2.0: must be an integer >= 1"),
        ({"max_episode_steps": 0}, "max_episode_steps = 0: must be an integer >= 1"),
        ({"physics": "newton"}, "unknown physics 'newton'"),
        ({"actuator": [named_actuator("weak", "pendulum")] * 3}, "actuator: 3 actuators for 2 environments"),
        ({"center_radius": 1.0}, "unknown option 'center_radius' of pendulum"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        SerialVectorEnv(**{"num_envs": 2, "task": "pendulum"} | arguments)


def test_it_is_gymnasiums_own_vector_environment():
    env = SerialVectorEnv(2, "cartpole", physics="analytic")
    assert isinstance(env, gymnasium.vector.SyncVectorEnv)
    assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP
