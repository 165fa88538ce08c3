"""`make` and `make_vec` accept all kinds of environments, and equal their own constructors."""

import functools

import gymnasium as gym
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Lag
from codrl_mj.envs import ActuatedVectorEnv, SerialVectorEnv


def observations_of(env, seed=3, steps=5):
    """Return the observations of an episode's first steps."""
    observations = [env.reset(seed=seed)[0]]
    env.action_space.seed(seed)
    observations += [env.step(env.action_space.sample())[0] for _ in range(steps)]
    env.close()
    return np.array(observations)


def pendulum(**options):
    return gym.make("Pendulum-v1", **options)


REACHER = {".*": "lag"}


@pytest.mark.parametrize(
    ("arguments", "make_expected"),
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
def test_make_accepts_a_name_an_id_a_configuration_and_a_function(arguments, make_expected):
    np.testing.assert_array_equal(
        observations_of(codrl_mj.make(*arguments)), observations_of(make_expected())
    )


@pytest.mark.parametrize(
    ("arguments", "options", "kind"),
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
def test_vector_environments_equal_single_ones(arguments, options, kind):
    env, num_envs, *actuator = arguments
    envs = codrl_mj.make_vec(env, num_envs, *actuator, **options)
    assert isinstance(envs, kind)
    observations, _ = envs.reset(seed=7)
    envs.single_action_space.seed(0)
    actions = [
        np.stack([envs.single_action_space.sample() for _ in range(num_envs)]) for _ in range(3)
    ]
    for index in range(num_envs):
        single = codrl_mj.make(env, *actuator, **options)
        np.testing.assert_array_equal(single.reset(seed=7 + index)[0], observations[index])
        single.close()
    for step, action in enumerate(actions):
        *_, truncated, _ = envs.step(action)
        assert truncated.all() == (options.get("max_episode_steps") == step + 1)
    envs.close()


@pytest.mark.parametrize("limit", [3, 1003], ids=["shorter", "longer"])
def test_a_given_time_limit_applies(limit):
    vector_envs = (
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
    for env in vector_envs:
        env.reset()
        action = np.zeros((1, 6), np.float32)
        ended = [(env.step(action)[2 if env is vector_envs[2] else 3]).any() for _ in range(limit)]
        assert ended == [False] * (limit - 1) + [True]
        if env is vector_envs[2]:
            assert env.render().shape == (48, 64, 3)
        env.close()


@pytest.mark.parametrize("view", [{}, {"render_mode": "rgb_array"}], ids=["blind", "seen"])
def test_arguments_replace_fields_of_a_configuration(view):
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
    "factory", [codrl_mj.make, lambda env, *actuator: codrl_mj.make_vec(env, 1, *actuator)]
)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("pendulm",), "did you mean 'pendulum'"),
        (("pendulum", "wek"), "wek"),
        (("pendulum", {"leg": "lag"}), "leg"),
        (("Reacher-v5", {"leg.*": "lag"}), "leg"),
        (
            ("Reacher-v5", {}),
            r"actuator = \{\}: must be one actuator for all motors, or a mapping of pat",
        ),
    ],
)
def test_raises_and_names_what_is_unknown(factory, arguments, message):
    with pytest.raises((ValueError, gym.error.Error), match=message):
        factory(*arguments)
