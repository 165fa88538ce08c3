"""Training configurations from Python, JSON and YAML; errors name the field."""

import dataclasses
import json
import math
import re

import pytest

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.agents import AGENTS, DDPGConfig, PPOConfig
from codrl_mj.agents.presets import OTHER_ENV, PRESETS
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import named_actuator
from codrl_mj.training import TrainConfig, load_config, read_config

ENV = EnvConfig("cartpole", "weaker")
TINY = TrainConfig(ENV, PPOConfig(hidden=(8, 8)), 1, 1000, num_envs=4)
OWN = DCMotorActuator(
    Motor(inductance=0.07, arm_radius=0.3), CurrentLoop(kp=0.9, max_voltage=math.inf, substeps=3)
)


@pytest.mark.parametrize(
    "actuator", ["ideal", None, "paper", OWN, {"motor": {"inductance": 0.2}}], ids=str
)
def test_a_configuration_survives_json_and_a_run_folder(tmp_path, actuator):
    ppo, env = (
        PPOConfig(hidden=(4, 5, 6), gamma=1.0),
        EnvConfig("cartpole", actuator, "analytic", "semi-implicit", 3),
    )
    config = TrainConfig(env, ppo, 7, 123, 2)
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"train": config.as_mapping(), "versions": {}}))
    assert load_config(tmp_path) == read_config(path) == config


@pytest.mark.parametrize(
    ("agent", "task", "settings"),
    [
        (agent, task if task != OTHER_ENV else "InvertedPendulum-v5", name)
        for (agent, task), named in PRESETS.items()
        for name in named
    ],
)
def test_every_preset_is_a_configuration_that_survives_json(agent, task, settings):
    config = TrainConfig.preset(task, agent, settings)
    assert isinstance(config.agent, AGENTS[agent])
    assert (
        TrainConfig.from_mapping(json.loads(json.dumps(config.as_mapping())), whole=True) == config
    )
    assert TrainConfig.from_mapping({"task": task, "agent": agent, "settings": settings}) == config


def test_name_mapping_and_actuator_give_the_same_configuration():
    fields = {"motor": {"arm_radius": 0.15}, "controller": {"kp": 0.2, "ki": 0.2}}
    over = {"name": "paper", "controller": {"kp": 0.2, "ki": 0.2, "kd": 0.0, "kff": 0.0}}
    forms = (fields, over, named_actuator("weaker", "cartpole"))
    assert {TrainConfig(EnvConfig("cartpole", actuator)) for actuator in forms} == {
        TrainConfig(ENV)
    }
    assert (
        EnvConfig("cartpole", "ideal")
        == EnvConfig("cartpole", None)
        != EnvConfig("cartpole", "paper")
    )


def test_a_file_sets_fields_of_its_preset(tmp_path):
    path = tmp_path / "train.yaml"
    path.write_text("task: cartpole")
    default = TrainConfig.preset("cartpole", "ppo")
    assert read_config(path) == default
    path.write_text("""
task: cartpole
agent: {name: ppo, gamma: 0.98, hidden: [32]}
actuator: {name: weaker, controller: {kp: 0.3}}
seed: 5
env:
  center_radius: 0.1
  disturbances: {command_delay: 0.02}
""")
    weaker = named_actuator("weaker", "cartpole").replaced({"controller.kp": 0.3})
    options, disturbances = {"center_radius": 0.1}, Disturbances(command_delay=0.02)
    env = EnvConfig("cartpole", weaker, options=options, disturbances=disturbances)
    agent = dataclasses.replace(default.agent, gamma=0.98, hidden=(32,))
    for seed, overriding in ((5, {}), (6, {"seed": 6})):
        expected = dataclasses.replace(default, env=env, agent=agent, seed=seed)
        assert read_config(path, **overriding) == expected


# -- what is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"seed": -1}, "seed = -1: must be an integer from 0 to 4294967295"),
        ({"seed": 2**32}, "seed = 4294967296: must be an integer from 0 to 4294967295"),
        ({"seed": None}, "seed = None: must be an integer from 0 to 4294967295"),
        ({"seed": True}, "seed = True: must be an integer from 0 to 4294967295"),
        ({"total_steps": 0}, "total_steps = 0: must be an integer >= 1"),
        ({"total_steps": math.nan}, "total_steps = nan: must be an integer >= 1"),
        ({"total_steps": 1e5}, "total_steps = 100000.0: must be an integer >= 1"),
        (
            {"total_steps": None},
            "total_steps = None: must be an integer >= 1 unless total_episodes is set",
        ),
        ({"num_envs": 0}, "num_envs = 0: must be an integer >= 1"),
        ({"num_envs": "8"}, "num_envs = '8': must be an integer >= 1"),
        ({"agent": {"gamma": 0.9}}, "agent = {'gamma': 0.9}: must be a AgentConfig"),
        ({"env": None}, "env = None: must be a EnvConfig"),
        (
            {"env": EnvConfig("acrobot"), "agent": DDPGConfig()},
            (
                "agent = 'ddpg': cannot act in the Discrete actions of acrobot; agents that can:"
                " ppo, dqn"
            ),
        ),
    ],
)
def test_an_invalid_field_raises_with_its_value_and_bound(fields, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        TrainConfig(**{"env": ENV} | fields)


def test_the_budget_may_be_episodes():
    assert TrainConfig(ENV, total_steps=None, total_episodes=3).total_episodes == 3


@pytest.mark.parametrize(
    "content",
    [
        [],
        3,
        {"not": "a run"},
        {"train": None},
        {"train": {"task": "cartpole"}},
        *(
            {"train": TINY.as_mapping() | change}
            for change in (
                {"surplus": 1},
                {"task": ["cartpole"]},
                {"seed": "abc"},
                {"agent": {"name": "ppo", "hidden": [8], "surplus": 1}},
                {"agent": 5},
                {"env": "none"},
                {"actuator": {"motor": {"inductance": -1.0}}},
            )
        ),
    ],
    ids=range(12),
)
def test_a_damaged_run_configuration_raises(tmp_path, content):
    path = tmp_path / "config.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"{path}: not a run configuration"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("task: cartpole\ntotal_step: 5", "unknown key total_step; did you mean total_steps?"),
        (
            "task: cartpole\nagent: {name: ppo, gama: 0.9}",
            "unknown key agent.gama; did you mean agent.gamma?",
        ),
        (
            "task: cartpole\nenv: {center_radios: 0.1}",
            "unknown key env.center_radios; did you mean env.center_radius?",
        ),
        (
            "task: cartpole\nenv: {disturbances: {comand_delay: 1}}",
            "did you mean disturbances.command_delay?",
        ),
        ("task: cartpole\nactuator: {controler: {kp: 1}}", "did you mean controller?"),
        (
            "task: cartpole\nactuator: {name: weaker, controller: {kq: 1}}",
            "unknown actuator field controller.kq",
        ),
        (
            "task: cartpole\nactuator: {name: ideal, controller: {kp: 1}}",
            "ideal actuator has no motor",
        ),
        ("task: cartpole\nagent: {gamma: 0.9}", "must be an agent's name"),
        ("task: cartpole\nagent: pppo", "unknown agent 'pppo': did you mean 'ppo'"),
        ("task: cartpole\nagent: {name: ppo, gamma: 1.5}", "PPOConfig.gamma = 1.5"),
        ("task: cartpole\nsettings: printed", "settings = 'printed'"),
        ("task: cartpole\nenv: 5", "env = 5: must be a mapping"),
        ("seed: 5", "it has no task"),
        ("task: cartpol", "did you mean 'cartpole'"),
        ("- task", "is not a mapping"),
        ("task: [", "while parsing"),
        ("task: !!python/object/apply:os.system ['true']", "could not determine a constructor"),
    ],
)
def test_errors_in_a_file_are_named(tmp_path, text, expected):
    path = tmp_path / "train.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"(?s)^{path}: .*{re.escape(expected)}"):
        read_config(path)
