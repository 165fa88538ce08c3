"""Settings know their bounds, survive JSON, and name themselves when they are wrong."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj.agents import (
    AGENTS,
    DDPGConfig,
    DQNConfig,
    PPOConfig,
    SACConfig,
    TD3Config,
    agent_from_mapping,
    check_fits,
    find_agent,
)
from codrl_mj.agents.presets import PRESETS
from codrl_mj.envs.config import EnvConfig
from tests.agents.small import make_model

BUFFERED = (DDPGConfig, DQNConfig, TD3Config, SACConfig)
CONTINUOUS = (DDPGConfig, TD3Config, SACConfig)
DEEP = (PPOConfig, *BUFFERED)

# field -> (agents, least, whether it is allowed, most, whether it is allowed)
INTERVALS = {
    "learning_rate": (DEEP, 0, False, 1, True),
    "gamma": (DEEP, 0, False, 1, True),
    "critic_learning_rate": ((PPOConfig, *CONTINUOUS), 0, False, 1, True),
    "gae_lambda": ((PPOConfig,), 0, True, 1, True),
    "clip_range": ((PPOConfig,), 0, False, math.inf, False),
    "entropy_coefficient": ((PPOConfig, SACConfig), 0, True, math.inf, False),
    "target_kl": ((PPOConfig,), 0, False, math.inf, False),
    "tau": (BUFFERED, 0, False, 1, True),
    "noise_sigma": (CONTINUOUS, 0, True, math.inf, False),
    "target_noise": ((TD3Config,), 0, True, math.inf, False),
    "exploration_start": ((DQNConfig,), 0, True, 1, True),
    "exploration_end": ((DQNConfig,), 0, True, 1, True),
    "exploration_decay": ((DQNConfig,), 0, False, 1, True),
    "exploration_fraction": ((DQNConfig,), 0, False, 1, True),
}
COUNTS = {  # field -> (agents, least)
    "rollout_steps": ((PPOConfig,), 2),
    "batch_size": ((PPOConfig,), 2),
    "epochs": ((PPOConfig,), 1),
    "critic_epochs": ((PPOConfig,), 1),
    "noise_steps": ((PPOConfig,), 1),
    "buffer_size": (BUFFERED, 1),
    "learning_starts": (BUFFERED, 0),
    "train_every": (BUFFERED, 1),
    "gradient_steps": (BUFFERED, 1),
    "target_every": ((DQNConfig,), 1),
    "policy_delay": ((TD3Config,), 1),
}
TUPLES = {
    "hidden": (PPOConfig, DQNConfig, TD3Config, SACConfig),
    "actor_units": (DDPGConfig,),
    "state_units": (DDPGConfig,),
    "action_units": (DDPGConfig,),
    "joint_units": (DDPGConfig,),
}
OPTIONAL = {
    "critic_learning_rate": (PPOConfig, *CONTINUOUS),
    "batch_size": (PPOConfig,),
    "critic_epochs": (PPOConfig,),
    "target_kl": (PPOConfig,),
    "noise_steps": (PPOConfig,),
    "train_every": BUFFERED,
    "gradient_steps": BUFFERED,
    "exploration_decay": (DQNConfig,),
    "entropy_coefficient": (SACConfig,),
    "input_scale": DEEP,
}


@given(field=st.sampled_from(sorted(INTERVALS)), value=st.floats(-3, 3) | st.sampled_from([0, 1, math.inf, math.nan]))
def test_a_number_is_taken_exactly_within_its_bounds(field, value):
    agents, low, with_low, high, with_high = INTERVALS[field]
    inside = low < value < high or (with_low and value == low) or (with_high and value == high)
    for agent in agents:
        if inside:
            assert getattr(agent(**{field: value}), field) == value
        else:
            with pytest.raises(ValueError, match=rf"^{agent.__name__}\.{field} = .*: must be a finite number"):
                agent(**{field: value})


@pytest.mark.parametrize("field", COUNTS)
def test_a_count_is_a_whole_number_from_its_least_on(field):
    agents, least = COUNTS[field]
    for agent in agents:
        assert getattr(agent(**{field: least}), field) == least
        for bad in (least - 1, float(least), True, "2"):
            with pytest.raises(ValueError, match=rf"{agent.__name__}\.{field} = .*: must be an integer >= {least}"):
                agent(**{field: bad})


@pytest.mark.parametrize("field", TUPLES)
def test_units_are_whole_numbers_from_1_on(field):
    for agent in TUPLES[field]:
        assert getattr(agent(**{field: [3, 5]}), field) == (3, 5)
        for bad in ((0,), (2.0,), 64, (True,)):
            with pytest.raises(ValueError, match=rf"{agent.__name__}\.{field} = .*: must be a tuple of integers >= 1"):
                agent(**{field: bad})


@pytest.mark.parametrize("bad", [(0.0,), (-1.0,), (math.nan,), (math.inf,), 1.0, ("2",)])
def test_factors_on_observations_are_positive_and_finite(bad):
    for agent in DEEP:
        with pytest.raises(
            ValueError, match=rf"{agent.__name__}\.input_scale = .*: must be a tuple of finite numbers > 0"
        ):
            agent(input_scale=bad)


def test_only_optional_settings_can_be_none():
    for agent in DEEP:
        for field in (*INTERVALS, *COUNTS, *TUPLES, "input_scale"):
            if not hasattr(agent(), field):
                continue
            if agent in OPTIONAL.get(field, ()):
                assert getattr(agent(**{field: None}), field) is None
            else:
                with pytest.raises(ValueError, match=rf"{field} = None"):
                    agent(**{field: None})


def test_a_word_is_one_of_those_known():
    with pytest.raises(ValueError, match=r"PPOConfig\.activation = 'elu': must be one of tanh, relu"):
        PPOConfig(activation="elu")
    with pytest.raises(ValueError, match=r"SACConfig\.state_dependent_noise = 1: must be true or false"):
        SACConfig(state_dependent_noise=1)


@pytest.mark.parametrize("agent", CONTINUOUS)
def test_noise_that_would_grow_without_bound_is_refused(agent):
    """X' = (1 - theta * dt) * x + ... is stable for |1 - theta * dt| < 1."""
    agent(noise_theta=1.99, noise_dt=1.0)
    with pytest.raises(ValueError, match=rf"{agent.__name__}\.noise_theta = 4.0: .*must be < 2, and noise_dt = 0.5"):
        agent(noise_theta=4.0, noise_dt=0.5)


@pytest.mark.parametrize(("agent", "task", "settings"), [(*pair, name) for pair, of in PRESETS.items() for name in of])
def test_settings_survive_json(agent, task, settings):
    config = PRESETS[agent, task][settings].agent
    assert agent_from_mapping(json.loads(json.dumps(config.as_mapping()))) == config


def test_an_unknown_setting_or_agent_is_named():
    with pytest.raises(ValueError, match=r"^unknown key agent\.momentum; known: .*learning_rate"):
        agent_from_mapping({"name": "dqn", "momentum": 1})
    with pytest.raises(ValueError, match=r"^unknown agent 'reinforce': Known: ppo, ddpg, dqn"):
        find_agent("reinforce")
    with pytest.raises(ValueError, match=rf"^agent '{__name__}:json': .* is no subclass of codrl_mj's AgentConfig"):
        find_agent(f"{__name__}:json")
    with pytest.raises(ValueError, match=r"^unknown agent 'None'"):
        agent_from_mapping({"gamma": 0.9})


@pytest.mark.parametrize(
    ("agent", "task", "kind"),
    [
        ("dqn", "pendulum", "Box"),
        ("ddpg", "acrobot", "Discrete"),
        ("sac", "cartpole", "Discrete"),
        ("td3", "mountain_car", "Discrete"),
    ],
)
def test_an_agent_that_cannot_act_in_a_task_is_refused_with_those_that_can(agent, task, kind):
    with pytest.raises(ValueError, match=rf"agent = '{agent}': cannot act in the {kind} actions of {task}") as refusal:
        check_fits(agent, EnvConfig(task))
    named = str(refusal.value).rpartition(": ")[2].split(", ")
    assert "ppo" in named
    assert agent not in named
    for name in set(AGENTS) & set(named):
        check_fits(name, EnvConfig(task))


def test_settings_that_do_not_go_with_the_environments_are_refused():
    with pytest.raises(ValueError, match=r"PPOConfig\.rollout_steps = 100: must be a multiple of num_envs = 3"):
        make_model(PPOConfig(rollout_steps=100, batch_size=10), "cartpole", num_envs=3)
    with pytest.raises(ValueError, match=r"PPOConfig\.rollout_steps = 100: must be a multiple of batch_size = 30"):
        make_model(PPOConfig(rollout_steps=100, batch_size=30), "cartpole")
    with pytest.raises(ValueError, match=r"DQNConfig\.train_every = None: .*needs num_envs = 1, not 2"):
        make_model(DQNConfig(train_every=None), "cartpole", num_envs=2)
    with pytest.raises(ValueError, match=r"input_scale = \(1, 1, 1\): must have at most 2 factors"):
        make_model(DQNConfig(input_scale=(1, 1, 1)), "mountain_car")
