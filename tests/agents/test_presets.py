"""Every agent has settings for every task it can do, and the paper's are the paper's."""

import pytest

from codrl_mj.agents import AGENTS
from codrl_mj.agents.presets import PRESETS, SETTINGS, find_preset
from codrl_mj.tasks import find_task
from codrl_mj.training import TrainConfig
from tests.tasks.faces import every_rebuilt

# what the paper prints for its deep agents (Experimental Results)
PRINTED = {
    ("ddpg", "pendulum"): {
        "learning_rate": 0.001,
        "critic_learning_rate": 0.002,
        "gamma": 0.99,
        "tau": 0.005,
        "actor_units": (64, 64),
        "state_units": (1,),
        "action_units": (32,),
        "joint_units": (256, 256),
        "episodes": 500,
    },
    ("ddpg", "mountain_car_continuous"): {
        "learning_rate": 1e-3,
        "critic_learning_rate": 4e-5,
        "gamma": 0.85,
        "tau": 0.45,
        "actor_units": (64, 64),
        "state_units": (64,),
        "action_units": (),
        "joint_units": (64,),
        "episodes": 200,
    },
    ("dqn", "acrobot"): {"learning_rate": 1e-3, "gamma": 0.99, "hidden": (64, 128), "episodes": 500},
    ("ppo", "cartpole"): {
        "learning_rate": 3e-4,
        "critic_learning_rate": 1e-3,
        "gamma": 0.99,
        "gae_lambda": 0.97,
        "clip_range": 0.2,
        "target_kl": 0.01,
        "hidden": (64, 64),
        "activation": "tanh",
        "rollout_steps": 4000,
        "batch_size": None,
        "steps": 60 * 4000,
    },
}


@every_rebuilt
@pytest.mark.parametrize("agent", ["ppo", "ddpg", "dqn", "td3", "sac"])
def test_an_agent_has_default_settings_for_a_task_exactly_if_it_can_act_in_it(agent, task):
    fits = isinstance(find_task(task).action_space, AGENTS[agent].action_spaces)
    assert ((agent, task) in PRESETS) == fits
    if fits:
        assert find_preset(agent, task).agent.name == agent


def test_furuta_has_settings_for_ppo_and_says_so():
    assert find_preset("ppo", "furuta").agent.unit_actions
    with pytest.raises(ValueError, match="sac on furuta has no such settings; those on furuta are ppo: default"):
        find_preset("sac", "furuta")


def test_settings_have_the_names_that_are_known_and_one_budget():
    for (agent, _), named in PRESETS.items():
        assert "default" in named
        assert set(named) <= set(SETTINGS)
        for preset in named.values():
            assert isinstance(preset.agent, AGENTS[agent])
            assert (preset.total_steps is None) != (preset.total_episodes is None)
        for name in set(named) - {"default"}:
            assert named[name].about, "where it deviates from the paper"
            assert named[name].num_envs == 1 or name == "fast"


@pytest.mark.parametrize(("agent", "task"), PRINTED)
def test_the_papers_settings_are_those_printed(agent, task):
    preset = find_preset(agent, task, "paper")
    printed = dict(PRINTED[agent, task])
    assert preset.total_episodes == printed.pop("episodes", None)
    assert preset.total_steps == printed.pop("steps", None)
    assert {name: getattr(preset.agent, name) for name in printed} == printed


def test_the_papers_cart_pole_is_trained_near_the_centre_in_episodes_of_4000_steps():
    env = TrainConfig.preset("cartpole", "ppo", "paper").env
    assert (env.max_episode_steps, env.options.center_radius) == (4000, 0.1)


def test_unknown_settings_are_answered_with_those_that_exist():
    with pytest.raises(ValueError, match=r"^settings = 'repaired': dqn on acrobot has no such settings") as refusal:
        find_preset("dqn", "acrobot", "repaired")
    assert "dqn: default, paper" in str(refusal.value)
    with pytest.raises(ValueError, match=r"dqn on pendulum has no such settings; .*ddpg: default, paper, repaired"):
        find_preset("dqn", "pendulum")
    with pytest.raises(ValueError, match="ppo on juggling has no such settings; those on juggling are none"):
        find_preset("ppo", "juggling", "paper")
