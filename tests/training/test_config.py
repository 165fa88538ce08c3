"""Training configurations: from Python, JSON and YAML; what is wrong in them is named."""

import dataclasses
import json
import math

import pytest

from codrl_mj.actuators import Actuator, CurrentLoop, Ideal, Motor
from codrl_mj.agents import AGENTS, PPOConfig
from codrl_mj.agents.presets import ELSEWHERE, PRESETS
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import differing
from codrl_mj.tasks import named_actuator
from codrl_mj.training import TrainConfig, load_config, read_config

ENV = EnvConfig("cartpole", "weaker")
TINY = TrainConfig(ENV, PPOConfig(hidden=(8, 8)), 1, 1000, num_envs=4)

# -- configuration ------------------------------------------------------------------------------------------

OWN = Actuator(Motor(inductance=0.07, arm_radius=0.3), CurrentLoop(kp=0.9, max_voltage=math.inf, substeps=3))


@pytest.mark.parametrize(
    "actuator",
    ["ideal", None, "paper", "weaker", "open_loop", OWN, {"motor": {"inductance": 0.2}, "controller": {"kp": 2}}],
    ids=["ideal", "None", "paper", "weaker", "open_loop", "Actuator", "mapping"],
)
def test_a_configuration_survives_json(tmp_path, actuator):
    ppo, env = PPOConfig(hidden=(4, 5, 6), gamma=1.0), EnvConfig("cartpole", actuator, "analytic", "semi-implicit", 3)
    config = TrainConfig(env, ppo, 7, 123, 2)
    assert isinstance(config.actuator, Actuator | Ideal)
    assert TrainConfig.from_mapping(json.loads(json.dumps(config.as_mapping()))) == config
    (tmp_path / "config.json").write_text(json.dumps({"train": config.as_mapping()}))
    assert load_config(tmp_path) == config


def test_a_name_a_mapping_and_an_actuator_mean_the_same():
    own = {"motor": {"arm_radius": 0.15}, "controller": {"kp": 0.2, "ki": 0.2}}
    over = {"name": "paper", "controller": {"kp": 0.2, "ki": 0.2, "kd": 0.0, "kff": 0.0}}
    forms = (own, over, named_actuator("weaker", "cartpole"))
    assert {TrainConfig(EnvConfig("cartpole", what)) for what in forms} == {TrainConfig(ENV)}
    assert EnvConfig("cartpole", "ideal") == EnvConfig("cartpole", None) != EnvConfig("cartpole", "paper")


@pytest.mark.parametrize(
    ("field", "value", "bound"),
    [
        ("seed", -1, "from 0 to 4294967295"),
        ("seed", 2**32, "from 0 to 4294967295"),
        ("seed", None, "from 0 to 4294967295"),
        ("seed", True, "from 0 to 4294967295"),
        ("total_steps", 0, ">= 1"),
        ("total_steps", math.nan, ">= 1"),
        ("total_steps", 1e5, ">= 1"),
        ("num_envs", 0, ">= 1"),
        ("num_envs", "8", ">= 1"),
        ("agent", {"gamma": 0.9}, "AgentConfig"),
        ("env", None, "EnvConfig"),
    ],
)
def test_a_bad_field_is_named_with_its_value_and_bound(field, value, bound):
    with pytest.raises(ValueError, match=field) as caught:
        TrainConfig(**{"env": ENV, field: value})
    assert f"{field} = {value!r}" in str(caught.value)
    assert bound in str(caught.value)


@pytest.mark.parametrize("value", [0, -1, 2.5, True])
def test_a_bad_time_limit_is_named(value):
    with pytest.raises(ValueError, match="max_episode_steps") as caught:
        EnvConfig("cartpole", max_episode_steps=value)
    assert ">= 1" in str(caught.value)


def test_unknown_tasks_and_actuators_are_named():
    with pytest.raises(ValueError, match="did you mean 'cartpole'"):
        EnvConfig("cartpoll")
    with pytest.raises(ValueError, match="did you mean 'weaker'"):
        EnvConfig("cartpole", "weakr")
    with pytest.raises(ValueError, match=r"did you mean motor\.inductance"):
        EnvConfig("cartpole", {"motor": {"inductanc": 1.0}})


@pytest.mark.parametrize(
    "content",
    [
        [],
        3,
        {"not": "a run"},
        {"train": None},
        {"train": {"task": "cartpole"}},
        {"train": TINY.as_mapping() | {"surplus": 1}},
        {"train": TINY.as_mapping() | {"task": ["cartpole"]}},
        {"train": TINY.as_mapping() | {"seed": "abc"}},
        {"train": TINY.as_mapping() | {"agent": {"name": "ppo", "hidden": [8], "surplus": 1}}},
        {"train": TINY.as_mapping() | {"agent": 5}},
        {"train": TINY.as_mapping() | {"env": "none"}},
        {"train": TINY.as_mapping() | {"actuator": {"motor": {"inductance": -1.0}}}},
    ],
    ids=range(12),
)
def test_a_damaged_run_configuration_is_named(tmp_path, content):
    (tmp_path / "config.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="not a run configuration") as caught:
        load_config(tmp_path)
    assert str(tmp_path / "config.json") in str(caught.value)


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no run configuration at") as caught:
        load_config(tmp_path)
    assert str(tmp_path / "config.json") in str(caught.value)


# -- presets and files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("agent", "task", "settings"),
    [
        (agent, task if task != ELSEWHERE else "InvertedPendulum-v5", name)
        for (agent, task), named in PRESETS.items()
        for name in named
    ],
)
def test_every_preset_is_a_configuration_that_survives_json(agent, task, settings):
    config = TrainConfig.preset(task, agent, settings)
    assert isinstance(config.agent, AGENTS[agent])
    assert TrainConfig.from_mapping(json.loads(json.dumps(config.as_mapping())), whole=True) == config
    assert TrainConfig.from_mapping({"task": task, "agent": agent, "settings": settings}) == config


def test_a_file_sets_fields_over_the_settings_that_it_names(tmp_path):
    (tmp_path / "train.yaml").write_text("""
task: cartpole
agent: {name: ppo, gamma: 0.98, hidden: [32]}
actuator: {name: weaker, controller: {kp: 0.3}}
seed: 5
env:
  center_radius: 0.1
  disturbances: {command_delay: 0.02}
""")
    config = read_config(tmp_path / "train.yaml")
    default = TrainConfig.preset("cartpole", "ppo")
    weaker = named_actuator("weaker", "cartpole")
    assert config == dataclasses.replace(
        default,
        env=EnvConfig(
            "cartpole",
            dataclasses.replace(weaker, controller=dataclasses.replace(weaker.controller, kp=0.3)),
            options={"center_radius": 0.1},
            disturbances=Disturbances(command_delay=0.02),
        ),
        agent=dataclasses.replace(default.agent, gamma=0.98, hidden=(32,)),
        seed=5,
    )
    assert read_config(tmp_path / "train.yaml", seed=6) == dataclasses.replace(config, seed=6)


def test_a_file_that_names_only_the_task_is_the_papers_agent_with_our_settings(tmp_path):
    (tmp_path / "train.yaml").write_text("task: cartpole")
    assert read_config(tmp_path / "train.yaml") == TrainConfig.preset("cartpole", "ppo")


def test_a_runs_configuration_is_a_configuration_file(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"train": TINY.as_mapping(), "versions": {}}))
    assert read_config(tmp_path / "config.json") == TINY


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("task: cartpole\ntotal_step: 5", "unknown key total_step; did you mean total_steps?"),
        ("task: cartpole\nagent: {name: ppo, gama: 0.9}", "unknown key agent.gama; did you mean agent.gamma?"),
        ("task: cartpole\nenv: {center_radios: 0.1}", "unknown key env.center_radios; did you mean env.center_radius?"),
        ("task: cartpole\nenv: {disturbances: {comand_delay: 1}}", "did you mean disturbances.command_delay?"),
        ("task: cartpole\nactuator: {controler: {kp: 1}}", "did you mean controller?"),
        ("task: cartpole\nactuator: {name: weaker, controller: {kq: 1}}", "unknown actuator field controller.kq"),
        ("task: cartpole\nactuator: {name: ideal, controller: {kp: 1}}", "ideal actuator has no motor"),
        ("task: cartpole\nagent: {gamma: 0.9}", "must be an agent's name"),
        ("task: cartpole\nagent: pppo", "unknown agent 'pppo': did you mean 'ppo'"),
        ("task: cartpole\nagent: {name: ppo, gamma: 1.5}", "PPOConfig.gamma = 1.5"),
        ("task: cartpole\nsettings: printed", "settings = 'printed'"),
        ("task: cartpole\nenv: 5", "env = 5: must be a mapping"),
        ("seed: 5", "it has no task"),
        ("task: cartpol", "did you mean 'cartpole'"),
        ("- task", "is no mapping"),
        ("task: [", "while parsing"),
        ("task: !!python/object/apply:os.system ['true']", "could not determine a constructor"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path, text, expected):
    path = tmp_path / "train.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match="train") as caught:
        read_config(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert expected in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no configuration file at .*train\.yaml"):
        read_config(tmp_path / "train.yaml")


def test_an_agent_that_cannot_act_in_the_task_is_refused_and_those_that_can_are_named():
    with pytest.raises(ValueError, match=r"agent = 'dqn': cannot act in the Box actions of pendulum.*ppo.*ddpg"):
        TrainConfig.preset("pendulum", "dqn")
    with pytest.raises(ValueError, match=r"agent = 'ddpg': cannot act in the Discrete actions of acrobot.*ppo.*dqn"):
        TrainConfig(EnvConfig("acrobot"), AGENTS["ddpg"]())


def test_a_budget_is_needed():
    with pytest.raises(ValueError, match=r"total_steps = None: .* or total_episodes"):
        TrainConfig(ENV, total_steps=None)
    assert TrainConfig(ENV, total_steps=None, total_episodes=3).total_episodes == 3


def test_differences_are_named_field_by_field():
    other = dataclasses.replace(
        TINY, seed=2, agent=PPOConfig(hidden=(8, 8), gamma=0.5), env=EnvConfig("cartpole", "ideal")
    )
    found = differing(TINY.as_mapping(), other.as_mapping())
    assert found["seed"] == (1, 2)
    assert found["agent.gamma"] == (0.99, 0.5)
    assert found["env.actuator.motor.inductance"] == (0.1, "absent")
    assert differing(TINY.as_mapping(), dataclasses.replace(TINY).as_mapping()) == {}
