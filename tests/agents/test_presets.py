"""Every agent has settings for every task that it can learn; `paper` has the paper's."""

import re

import pytest

from codrl_mj.agents import AGENTS
from codrl_mj.agents.presets import OTHER_ENV, PRESETS, SETTINGS, find_preset
from codrl_mj.tasks import TASKS, find_task
from codrl_mj.training import TrainConfig
from tests.tasks.faces import every_rebuilt

UNITS = ("actor_units", "state_units", "action_units", "joint_units")
DDPG = ("learning_rate", "critic_learning_rate", "gamma", "tau", *UNITS)
DQN = ("learning_rate", "gamma", "hidden")
PPO = (
    *DQN,
    "critic_learning_rate",
    "gae_lambda",
    "clip_range",
    "target_kl",
    "activation",
    "rollout_steps",
    "batch_size",
)
SARSA = (
    "tilings",
    "intervals",
    "step_size",
    "gamma",
    "epsilon",
    "epsilon_decay",
    "trace_decay",
    "initial_value",
)
# The paper's values (Experimental Results): episodes or steps, and values of the names above.
PRINTED = [
    (
        "ddpg",
        "pendulum",
        500,
        None,
        DDPG,
        (1e-3, 2e-3, 0.99, 0.005, (64, 64), (1,), (32,), (256, 256)),
    ),
    (
        "ddpg",
        "mountain_car_continuous",
        200,
        None,
        DDPG,
        (1e-3, 4e-5, 0.85, 0.45, (64, 64), (64,), (), (64,)),
    ),
    ("dqn", "acrobot", 500, None, DQN, (1e-3, 0.99, (64, 128))),
    (
        "ppo",
        "cartpole",
        None,
        60 * 4000,
        PPO,
        (3e-4, 0.99, (64, 64), 1e-3, 0.97, 0.2, 0.01, "tanh", 4000, None),
    ),
    ("sarsa", "mountain_car", 600, None, SARSA, (8, (8, 8), 0.0375, 1.0, 0.001, 1.0, 0.0, 0.0)),
]


@pytest.mark.parametrize(("agent", "task", "episodes", "steps", "names", "values"), PRINTED)
def test_the_papers_settings_are_as_printed(agent, task, episodes, steps, names, values):
    preset = find_preset(agent, task, "paper")
    assert (preset.total_episodes, preset.total_steps) == (episodes, steps)
    assert tuple(getattr(preset.agent, name) for name in names) == values


def test_the_papers_cart_pole_is_trained_near_the_centre_in_episodes_of_4000_steps():
    env = TrainConfig.preset("cartpole", "ppo", "paper").env
    assert (env.max_episode_steps, env.options.center_radius) == (4000, 0.1)


@every_rebuilt
@pytest.mark.parametrize("agent", ["ppo", "ddpg", "dqn", "td3", "sac"])
def test_an_agent_has_default_settings_for_a_task_exactly_if_it_can_act_in_it(agent, task):
    fits = isinstance(find_task(task).action_space, AGENTS[agent].action_spaces)
    assert ((agent, task) in PRESETS) == fits
    if fits:
        assert find_preset(agent, task).agent.name == agent


def test_furutas_small_torques_are_commanded_in_units():
    assert find_preset("ppo", "furuta").agent.unit_actions


def test_settings_have_known_names_and_one_budget():
    assert {task for _, task in PRESETS} == {*TASKS, OTHER_ENV}
    for (agent, _), named in PRESETS.items():
        assert {"default"} <= set(named) <= set(SETTINGS)
        for name, preset in named.items():
            assert isinstance(preset.agent, AGENTS[agent])
            assert (preset.total_steps is None) != (preset.total_episodes is None)
            assert preset.about or name == "default", "where it deviates from the paper"
            assert preset.num_envs == 1 or name in ("default", "fast")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("sac", "furuta"), "sac on furuta has no such settings; those on furuta are ppo: default"),
        (
            ("dqn", "acrobot", "repaired"),
            "settings = 'repaired': dqn on acrobot has no such settings",
        ),
        (("dqn", "acrobot", "repaired"), "dqn: default, paper"),
        (("dqn", "pendulum"), "dqn on pendulum has no such settings; "),
        (("dqn", "pendulum"), "ddpg: default, paper, repaired"),
        (
            ("ppo", "juggling", "paper"),
            "ppo on juggling has no such settings; those on juggling are none",
        ),
    ],
)
def test_unknown_settings_raise_and_name_the_available_ones(names, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        find_preset(*names)
