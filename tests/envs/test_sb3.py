"""Agents, wrappers, attributes and refusals of the Stable-Baselines3 interface."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

import codrl_mj
from codrl_mj.envs import ActuatedEnv
from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.tasks import TASKS
from tests.conformance.episodes import random_actions


def batched(task, num_envs, **arguments):
    return codrl_mj.make_sb3_vec_env(TASKS[task].env_id, num_envs, **arguments)


def looped(task, num_envs, **arguments):
    make = TASKS[task].env_id
    return DummyVecEnv(
        [lambda: Monitor(gymnasium.make(make, disable_env_checker=True, **arguments))] * num_envs
    )


def sampled(env, steps, seed=0):
    """Return batches of actions within the bounds, as the algorithms of Stable-Baselines3 do."""
    generator = np.random.default_rng(seed)
    batches = [random_actions(env, generator) for _ in range(steps)]
    space = env.action_space
    return [
        batch if hasattr(space, "n") else np.clip(batch, space.low, space.high) for batch in batches
    ]


@pytest.mark.parametrize("task", ["pendulum", "cartpole"])
def test_ppo_has_the_same_weights_bit_for_bit(task):
    torch.set_num_threads(1)
    weights = []
    for make in (batched, looped):
        env = make(task, 3, actuator="weaker", max_episode_steps=20)
        env.seed(0)
        model = PPO("MlpPolicy", env, seed=0, n_steps=32, batch_size=48, n_epochs=2, device="cpu")
        model.learn(300)
        weights.append(model.policy.state_dict())
        assert model.ep_info_buffer
    for name, value in weights[0].items():
        assert torch.equal(value, weights[1][name]), name


def test_the_wrappers_of_stable_baselines_work_on_it():
    runs = []
    for make in (batched, looped):
        env = VecNormalize(
            VecMonitor(VecCheckNan(make("pendulum", 3, max_episode_steps=9), raise_exception=True))
        )
        env.seed(1)
        outputs = [env.reset()]
        returns = []
        for actions in sampled(batched("pendulum", 3), 40):
            observations, rewards, dones, infos = env.step(actions)
            outputs += [observations, rewards, dones.astype(float)]
            returns += [
                (info["episode"]["r"], info["episode"]["l"]) for info in infos if "episode" in info
            ]
        runs.append((outputs, returns))
    for values, expected in zip(runs[0][0], runs[1][0], strict=True):
        np.testing.assert_array_equal(values, expected)
    assert runs[0][1] == runs[1][1]
    assert len(runs[0][1]) == 12


def test_seeds_count_up_and_are_used_once():
    env = batched("cartpole", 3)
    assert list(env.seed(5)) == [5, 6, 7]
    pending = env.snapshot()
    first = env.reset()
    single = gymnasium.make(TASKS["cartpole"].env_id)
    for row in range(3):
        np.testing.assert_array_equal(first[row], single.reset(seed=5 + row)[0])
    second = env.reset()
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(second[2], single.reset()[0])
    # The snapshot has the seeds that no reset had used yet.
    env.restore(pending)
    np.testing.assert_array_equal(env.reset(), first)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_each_environment_has_its_own_attributes(physics):
    env = batched("pendulum", 2, physics=physics)
    env.reset()
    assert env.get_attr("g") == [10.0, 10.0]
    env.set_attr("g", 1.0)
    assert env.get_attr("g") == [1.0, 1.0]
    env.set_attr("state", np.array([0.1, 0.2] if physics == "analytic" else [[0.1, 0.2]] * 2))
    np.testing.assert_array_equal(env.get_attr("state"), [[0.1, 0.2]] * 2)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_options_apply_to_the_next_reset_whose_infos_have_the_drawn_values(physics):
    env = batched("cartpole", 2, physics=physics, randomize={"motor.resistance": "uniform(0.5, 2)"})
    env.set_options({"low": -1e-6, "high": 1e-6})
    assert np.abs(env.reset()).max() <= 1e-6
    resistances = [info["randomization"]["motor.resistance"] for info in env.reset_infos]
    np.testing.assert_array_equal(resistances, env.randomization["motor.resistance"])
    # The options are used once.
    assert np.abs(env.reset()).max() > 1e-6
    env.set_options([{"low": -0.1, "high": 0.1}, {}])
    with pytest.raises(ValueError, match="the environments share them: give one mapping"):
        env.reset()


def test_attributes_and_methods():
    env = batched("pendulum", 3)
    env.reset()
    assert env.signals is None
    assert env.get_attr("max_episode_steps") == [200] * 3
    assert env.get_attr("task", indices=[1]) == [TASKS["pendulum"]]
    assert env.get_attr("task", indices=2) == [TASKS["pendulum"]]
    env.set_attr("max_episode_steps", 2)
    actions = np.zeros((3, 1), np.float32)
    assert [env.step(actions)[2].tolist() for _ in range(2)] == [[False] * 3, [True] * 3]
    assert {name: values.shape for name, values in env.signals.items()}["current"] == (3,)
    with pytest.raises(ValueError, match="the environments share it"):
        env.set_attr("max_episode_steps", 9, indices=[0])
    with pytest.raises(AttributeError):
        env.get_attr("nothing")
    (snapshot,) = env.env_method("snapshot", indices=1)
    env.step(actions)
    env.env_method("restore", snapshot)
    np.testing.assert_array_equal(env.env.snapshot()["physics"], snapshot["physics"])
    assert len(env.env_method("snapshot")) == 3
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(gymnasium.wrappers.TimeLimit, indices=[0, 1]) == [False] * 2


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_rendering_shows_the_first_environment(physics):
    view = {"physics": physics, "render_mode": "rgb_array", "width": 64, "height": 48}
    env, single = batched("pendulum", 2, **view), ActuatedEnv("pendulum", **view)
    env.seed(0)
    env.reset()
    single.reset(seed=0)
    image = env.render()
    assert image.shape == (48, 64, 3)
    np.testing.assert_array_equal(image, single.render())
    images = env.get_images()
    np.testing.assert_array_equal(images[0], image)
    assert images[1] is None
    assert env.render_mode == "rgb_array"
    for each_env in (env, single):
        each_env.close()
    assert batched("pendulum", 2).render_mode is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env_id": "Pendulum-v1"}, "no MuJoCo model .* use this package's task 'pendulum'"),
        ({"num_envs": 0}, "num_envs = 0"),
        ({"num_envs": 0, "physics": "analytic"}, "num_envs = 0"),
        ({"physics": "newton"}, "unknown physics 'newton'"),
    ],
)
def test_raises_for_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.make_sb3_vec_env(**{"env_id": "pendulum", **arguments})


@pytest.mark.parametrize("name", ["codrl_mj/Pendulum-v0", "pendulum"])
def test_the_default_time_limit_is_the_registered_one(name):
    env = codrl_mj.make_sb3_vec_env(name, 2)
    assert isinstance(env, ActuatedVecEnv)
    assert env.num_envs == 2
    env.reset()
    dones = [env.step(np.zeros((2, 1), np.float32))[2].any() for _ in range(200)]
    assert dones == [False] * 199 + [True]
