"""`make` and `make_vec` take whatever an environment is of, and make what its own face makes."""

import functools

import gymnasium as gym
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Lag
from codrl_mj.envs import ActuatedVectorEnv, SerialVectorEnv


def walked(env, seed=3, steps=5):
    """Observations of an episode's beginning."""
    found = [env.reset(seed=seed)[0]]
    env.action_space.seed(seed)
    found += [env.step(env.action_space.sample())[0] for _ in range(steps)]
    env.close()
    return np.array(found)


def pendulum(**options):
    return gym.make("Pendulum-v1", **options)


REACHER = {".*": "lag"}


@pytest.mark.parametrize(
    ("given", "same"),
    [
        (("pendulum", "weak"), lambda: gym.make("codrl_mj/Pendulum-v0", actuator="weak")),
        (("codrl_mj/Pendulum-v0",), lambda: gym.make("codrl_mj/Pendulum-v0")),
        (
            (codrl_mj.EnvConfig("pendulum", "weak"),),
            lambda: gym.make("codrl_mj/Pendulum-v0", actuator="weak"),
        ),
        (("InvertedPendulum-v5",), lambda: gym.make("InvertedPendulum-v5")),
        (("Reacher-v5", "lag"), lambda: codrl_mj.EnvConfig("Reacher-v5", REACHER).make()),
        (("Reacher-v5", REACHER), lambda: codrl_mj.make("Reacher-v5", Lag())),
        (
            (functools.partial(gym.make, "Reacher-v5"), "lag"),
            lambda: codrl_mj.make("Reacher-v5", "lag"),
        ),
    ],
    ids=["task", "id", "configuration", "without motors", "one for all", "by pattern", "function"],
)
def test_one_is_made_of_a_name_an_id_a_configuration_or_a_function(given, same):
    np.testing.assert_array_equal(walked(codrl_mj.make(*given)), walked(same()))


@pytest.mark.parametrize(
    ("given", "options", "kind"),
    [
        (("pendulum", 2, "weak"), {}, ActuatedVectorEnv),
        (("pendulum", 2, "weak"), {"max_episode_steps": 3}, ActuatedVectorEnv),
        ((codrl_mj.EnvConfig("pendulum", "weak", physics="analytic"), 2), {}, SerialVectorEnv),
        (("Reacher-v5", 2, "lag"), {}, SerialVectorEnv),
        (("Reacher-v5", 2, "default"), {}, SerialVectorEnv),
        ((functools.partial(gym.make, "Reacher-v5"), 2), {}, SerialVectorEnv),
    ],
    ids=["batch", "time limit", "configuration", "environments of others", "their own", "function"],
)
def test_many_are_as_one_by_one(given, options, kind):
    env, num_envs, *actuator = given
    envs = codrl_mj.make_vec(env, num_envs, *actuator, **options)
    assert isinstance(envs, kind)
    seen, _ = envs.reset(seed=7)
    envs.single_action_space.seed(0)
    actions = [
        np.stack([envs.single_action_space.sample() for _ in range(num_envs)]) for _ in range(3)
    ]
    for index in range(num_envs):
        alone = codrl_mj.make(env, *actuator, **options)
        np.testing.assert_array_equal(alone.reset(seed=7 + index)[0], seen[index])
        alone.close()
    for step, action in enumerate(actions):
        *_, truncated, _ = envs.step(action)
        assert truncated.all() == (options.get("max_episode_steps") == step + 1)
    envs.close()


@pytest.mark.parametrize("limit", [3, 1003], ids=["shorter", "longer"])
def test_a_time_limit_that_is_given_is_the_one_that_holds(limit):
    faces = (
        codrl_mj.make_vec("HalfCheetah-v5", 1, "lag", max_episode_steps=limit),
        codrl_mj.make_vec(codrl_mj.EnvConfig("HalfCheetah-v5", "lag"), 1, max_episode_steps=limit),
        codrl_mj.make_sb3_vec_env(
            "HalfCheetah-v5",
            1,
            actuator="lag",
            max_episode_steps=limit,
            render_mode="rgb_array",
            width=64,
            height=48,
        ),
    )
    for env in faces:
        env.reset()
        action = np.zeros((1, 6), np.float32)
        ended = [(env.step(action)[2 if env is faces[2] else 3]).any() for _ in range(limit)]
        assert ended == [False] * (limit - 1) + [True]
        if env is faces[2]:
            assert env.render().shape == (48, 64, 3)
        env.close()


@pytest.mark.parametrize("view", [{}, {"render_mode": "rgb_array"}], ids=["blind", "seen"])
def test_what_is_given_beside_a_configuration_is_set_over_it(view):
    config = codrl_mj.EnvConfig("pendulum", max_episode_steps=5)
    with codrl_mj.make(config, "weak", max_episode_steps=7, **view) as env:
        assert env.unwrapped.actuator == codrl_mj.EnvConfig("pendulum", "weak").actuator
        assert env.spec.max_episode_steps == 7
    envs = codrl_mj.make_vec(config, 2, "weak", max_episode_steps=7, **view)
    envs.reset()
    assert [envs.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(7)] == [False] * 6 + [
        True
    ]
    envs.close()


@pytest.mark.parametrize(
    "made", [codrl_mj.make, lambda env, *actuator: codrl_mj.make_vec(env, 1, *actuator)]
)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pendulm",), "did you mean 'pendulum'"),
        (("pendulum", "wek"), "wek"),
        (("pendulum", {"leg": "lag"}), "leg"),
        (("Reacher-v5", {"leg.*": "lag"}), "leg"),
        (("Reacher-v5", {}), r"actuator = \{\}: must be one for all, or what drives what"),
    ],
)
def test_what_is_unknown_is_named(made, arguments, message):
    with pytest.raises((ValueError, gym.error.Error), match=message):
        made(*arguments)
