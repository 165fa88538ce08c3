"""`make` and `make_vec` accept all kinds of environments, and equal their own constructors."""

import functools

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv

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
        (("Reacher-v5", "lag"), lambda: codrl_mj.EnvConfig("Reacher-v5", REACHER).build()),
        (("Reacher-v5", REACHER), lambda: codrl_mj.make("Reacher-v5", Lag())),
        (
            (functools.partial(gym.make, "Reacher-v5"), "lag"),
            lambda: codrl_mj.make("Reacher-v5", "lag"),
        ),
        (
            (lambda **options: gym.make("Reacher-v5", **options), "lag"),
            lambda: codrl_mj.make("Reacher-v5", "lag"),
        ),
    ],
    ids=[
        *("task", "id", "configuration", "without motors", "one for all", "by pattern"),
        *("function", "lambda"),
    ],
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


class Robot:
    """Class without an environment's interface."""


class HiddenRobot(gym.Env):
    """Environment that hides its model."""

    def __init__(self):
        """Build the model of an environment inside."""
        self.observation_space = self.action_space = gym.spaces.Box(-1.0, 1.0, (2,))
        self._inner = gym.make("Reacher-v5")


def needs_scale(scale):
    return gym.make("Reacher-v5", frame_skip=scale)


REACHER_ENV = gym.make("Reacher-v5")


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: None, "env = lambda: made None, must make a gymnasium.Env; return the env"),
        (lambda: ReacherEnv, r"must make a gymnasium.Env; return an instance, ReacherEnv\(\), or"),
        (lambda: Robot(), r"env = lambda: made .*; derive Robot from gymnasium.Env"),
        (Robot, "env = Robot: made .*; derive Robot from gymnasium.Env"),
        (lambda: pendulum, "must make a gymnasium.Env; pass that function itself"),
        (lambda: gym.make_vec("Reacher-v5", 1), "make several with codrl_mj.make_vec"),
        (lambda: mujoco.MjSpec(), "add motors to a MjSpec with codrl_mj.add_motors"),
        (lambda: codrl_mj.make("Reacher-v5", "lag"), "which has motors already; pass its name"),
        (lambda: codrl_mj.make("pendulum"), "which has motors already; pass its name"),
        (
            lambda: gym.make("Pendulum-v1"),
            "env = lambda: the environment has no MuJoCo model built",
        ),
        (lambda: REACHER_ENV, "that build such a model while they are made can get motors"),
        (HiddenRobot, "env = HiddenRobot: must have MuJoCo's model and data as attributes; name"),
        (needs_scale, r"env = needs_scale: cannot be called with the arguments \{\}: .*'scale'"),
        (REACHER_ENV, "or a function .*; pass a function instead"),
        (None, "env = None: must be a task's name, the id of an environment"),
    ],
)
def test_raises_if_a_function_makes_no_environment_with_a_model(env, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.make(env, "lag")


def test_raises_if_a_function_does_not_take_an_argument():
    with pytest.raises(ValueError, match=r"env = lambda: cannot be called .*'render_mode'"):
        codrl_mj.make(lambda: gym.make("Reacher-v5"), "lag", render_mode="rgb_array")
