"""Settings are accepted within their bounds, and errors name the setting."""

import math
import re

import pytest

from codrl_mj.agents import (
    AGENTS,
    DDPGConfig,
    DQNConfig,
    PPOConfig,
    SACConfig,
    SARSAConfig,
    TD3Config,
    agent_from_mapping,
    check_fits,
    find_agent,
)
from codrl_mj.envs.config import EnvConfig
from tests.agents.small import make_model

BUFFERED = (DDPGConfig, DQNConfig, TD3Config, SACConfig)
CONTINUOUS = (DDPGConfig, TD3Config, SACConfig)
DEEP = (PPOConfig, *BUFFERED)
EVERY = (*DEEP, SARSAConfig)


def beyond(value, way):
    return math.nextafter(value, way)


# Accepted values, refused values, and the words of the message.
NO = (math.nan, math.inf, -math.inf, -3.0)
SHARE = (beyond(0, 1), 0.5, 1), (0, beyond(1, 2), *NO), "a finite number > 0 and <= 1"
PART = (0, 0.5, 1), (beyond(0, -1), beyond(1, 2), *NO), "a finite number >= 0 and <= 1"
ABOVE_0 = (beyond(0, 1), 3), (0, *NO), "a finite number > 0"
FROM_0 = (0, 3), (beyond(0, -1), *NO), "a finite number >= 0"
COUNTS = [
    ((bound,), (bound - 1, float(bound), True, "2"), f"an integer >= {bound}") for bound in range(3)
]
UNITS = ((3, 5),), ((0,), (2.0,), 64, (True,)), "a tuple of integers >= 1"
FACTORS = (
    ((0.5, 3.0),),
    ((0.0,), (-1.0,), (math.nan,), (math.inf,), 1.0, ("2",)),
    "a tuple of finite numbers > 0",
)

# Field -> (agents, values, agents that accept None as well).
FIELDS = {
    "learning_rate": (DEEP, SHARE, ()),
    "gamma": (EVERY, SHARE, ()),
    "critic_learning_rate": ((PPOConfig, *CONTINUOUS), SHARE, (PPOConfig, *CONTINUOUS)),
    "gae_lambda": ((PPOConfig,), PART, ()),
    "clip_range": ((PPOConfig,), ABOVE_0, ()),
    "entropy_coefficient": ((PPOConfig, SACConfig), FROM_0, (SACConfig,)),
    "target_kl": ((PPOConfig,), ABOVE_0, (PPOConfig,)),
    "tau": (BUFFERED, SHARE, ()),
    "noise_sigma": (CONTINUOUS, FROM_0, ()),
    "target_noise": ((TD3Config,), FROM_0, ()),
    "exploration_start": ((DQNConfig,), PART, ()),
    "exploration_end": ((DQNConfig,), PART, ()),
    "exploration_decay": ((DQNConfig,), SHARE, (DQNConfig,)),
    "exploration_fraction": ((DQNConfig,), SHARE, ()),
    "step_size": ((SARSAConfig,), ABOVE_0, ()),
    "epsilon": ((SARSAConfig,), PART, ()),
    "rollout_steps": ((PPOConfig,), COUNTS[2], ()),
    "batch_size": ((PPOConfig,), COUNTS[2], (PPOConfig,)),
    "epochs": ((PPOConfig,), COUNTS[1], ()),
    "critic_epochs": ((PPOConfig,), COUNTS[1], (PPOConfig,)),
    "noise_steps": ((PPOConfig,), COUNTS[1], (PPOConfig,)),
    "buffer_size": (BUFFERED, COUNTS[1], ()),
    "learning_starts": (BUFFERED, COUNTS[0], ()),
    "train_every": (BUFFERED, COUNTS[1], BUFFERED),
    "gradient_steps": (BUFFERED, COUNTS[1], BUFFERED),
    "target_every": ((DQNConfig,), COUNTS[1], ()),
    "policy_delay": ((TD3Config,), COUNTS[1], ()),
    "hidden": ((PPOConfig, DQNConfig, TD3Config, SACConfig), UNITS, ()),
    "actor_units": ((DDPGConfig,), UNITS, ()),
    "state_units": ((DDPGConfig,), UNITS, ()),
    "action_units": ((DDPGConfig,), UNITS, ()),
    "joint_units": ((DDPGConfig,), UNITS, ()),
    "intervals": ((SARSAConfig,), UNITS, ()),
    "input_scale": (DEEP, FACTORS, DEEP),
    "activation": ((PPOConfig,), (("tanh", "relu"), ("elu",), "one of tanh, relu"), ()),
    "state_dependent_noise": ((SACConfig,), ((True, False), (1,), "true or false"), ()),
}


@pytest.mark.parametrize("field", FIELDS)
def test_a_setting_is_accepted_exactly_within_its_bounds(field):
    agents, (accepted, refused, words), optional = FIELDS[field]
    for agent in agents:
        nothing = (None,)
        for value in (*accepted, *(nothing if agent in optional else ())):
            # JSON has lists instead of tuples.
            argument = list(value) if isinstance(value, tuple) else value
            assert getattr(agent(**{field: argument}), field) == value
        for value in (*refused, *(() if agent in optional else nothing)):
            message = (
                rf"^{agent.__name__}\.{field} = {re.escape(repr(value))}: must be"
                rf" {re.escape(words)}"
            )
            with pytest.raises(ValueError, match=message):
                agent(**{field: value})


NOISE = {"noise_theta": 4.0, "noise_dt": 0.5}
APART = {"unit_actions": True, "state_dependent_noise": True}
UNSTABLE = "noise_theta = 4.0: noise_theta * noise_dt must be < 2, and noise_dt = 0.5"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        # x' = (1 - theta * dt) * x + ... is stable for |1 - theta * dt| < 1
        *(
            (lambda agent=agent: agent(**NOISE), f"{agent.__name__}.{UNSTABLE}")
            for agent in CONTINUOUS
        ),
        (
            lambda: PPOConfig(**APART),
            "unit_actions = True: must be False with state_dependent_noise",
        ),
        # with the environments
        (
            lambda: make_model(PPOConfig(rollout_steps=100, batch_size=10), "cartpole", num_envs=3),
            "PPOConfig.rollout_steps = 100: must be a multiple of num_envs = 3",
        ),
        (
            lambda: make_model(PPOConfig(rollout_steps=100, batch_size=30), "cartpole"),
            "PPOConfig.rollout_steps = 100: must be a multiple of batch_size = 30",
        ),
        (
            lambda: make_model(DQNConfig(train_every=None), "cartpole", num_envs=2),
            "needs num_envs = 1, not 2",
        ),
        (
            lambda: make_model(PPOConfig(unit_actions=True), "cartpole"),
            "must be False for discrete actions",
        ),
        (
            lambda: make_model(DQNConfig(input_scale=(1, 1, 1)), "mountain_car"),
            "must have at most 2 factors",
        ),
        # names
        (
            lambda: agent_from_mapping({"name": "dqn", "momentum": 1}),
            "unknown key agent.momentum; known: ",
        ),
        (lambda: agent_from_mapping({"gamma": 0.9}), "unknown agent 'None'"),
        (lambda: find_agent("reinforce"), "unknown agent 'reinforce': Known: ppo, ddpg, dqn"),
        (lambda: find_agent(f"{__name__}:re"), "is not a subclass of codrl_mj's AgentConfig"),
    ],
)
def test_contradictory_settings_raise(make, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make()


@pytest.mark.parametrize("agent", CONTINUOUS)
def test_stable_noise_is_accepted(agent):
    assert agent(noise_theta=1.99, noise_dt=1.0).noise_theta == 1.99


@pytest.mark.parametrize(
    ("agent", "task", "kind"),
    [
        ("dqn", "pendulum", "Box"),
        ("ddpg", "acrobot", "Discrete"),
        ("sac", "cartpole", "Discrete"),
        ("td3", "mountain_car", "Discrete"),
    ],
)
def test_an_agent_that_cannot_act_in_a_task_raises_and_names_those_that_can(agent, task, kind):
    with pytest.raises(
        ValueError, match=rf"agent = '{agent}': cannot act in the {kind} actions of {task}"
    ) as refusal:
        check_fits(agent, EnvConfig(task))
    named = set(str(refusal.value).rpartition(": ")[2].split(", ")) & set(AGENTS)
    assert "ppo" in named
    assert agent not in named
    for name in named:
        check_fits(name, EnvConfig(task))
