"""A custom env source can do all that tasks and Gymnasium's environments can."""

import json

import gymnasium as gym
import numpy as np
import pytest

import codrl_mj
from codrl_mj import EnvConfig
from codrl_mj.__main__ import main
from codrl_mj.envs.config import find_source, is_source_name
from codrl_mj.external_envs.sources import ExternalEnvSource
from codrl_mj.training import TrainConfig
from codrl_mj.viz.view.session import Session
from tests.envs.rig import RIG, RigEnv

NAME, MOTOR = "tests.envs.rig:RIG", "maxon-re65"
QUICK = (
    "--agent sac --total-steps 60 --agent.learning-starts 20 --num-envs 1 --evaluation-episodes 1"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("rig") / "run"
    assert main(["train", NAME, "--actuator", "ideal", *QUICK.split(), "--out", str(out)]) == 0
    return out


def test_a_configuration_survives_json_and_makes_environments():
    config = EnvConfig(
        NAME,
        {"drive": MOTOR},
        randomize={"motor.resistance": "uniform(0.1, 0.2)", "model.gravity": "uniform(0.9, 1.1)"},
        disturbances={"command_delay": 0.02},
        options={"target": 0.5},
    )
    assert find_source(NAME) is config.source is RIG
    assert EnvConfig.from_mapping(json.loads(json.dumps(config.as_mapping()))) == config
    with config.build() as env:
        _, info = env.reset(seed=1)
        assert 0.1 <= info["randomization"]["motor.resistance"] <= 0.2
        # The command of the first step is delayed by one step.
        env.step(np.ones(1))
        *_, info = env.step(np.ones(1))
        assert info["current"] != 0.0
    assert TrainConfig.preset(NAME, "sac", actuator="lag").env.actuator_label == "lag"


class Broken(ExternalEnvSource):
    def make(self, *_, **__):
        return 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: EnvConfig(NAME, integrator="rk4"),
            "integrator = 'rk4': rig has no such field: leave it out",
        ),
        (lambda: EnvConfig("tests.envs.rig:rk4_of_nobody"), "rk4_of_nobody"),
        (
            lambda: EnvConfig("tests.envs.rig:XML"),
            "codrl_mj.Task, a codrl_mj.EnvSource, or a function or class that makes an environment",
        ),
        (
            lambda: EnvConfig("codrl_mj.external_envs.sources:ExternalEnvSource"),
            r"^ExternalEnvSource: must be an instance of it: ExternalEnvSource\(...\)",
        ),
        (
            lambda: EnvConfig(Broken(None, RigEnv)),
            "Broken: must have a `name`, the text that messages use",
        ),
        (
            lambda: codrl_mj.make(RigEnv(), {".*": "lag"}),
            "pass a function instead of an environment, such as lambda: gymnasium.make",
        ),
        (
            lambda: EnvConfig(RigEnv).as_mapping(),
            "must be a name to be written to a file: .* name the function as module:NAME",
        ),
        (
            lambda: EnvConfig(Broken("rig", RigEnv)).build(),
            "rig: its `make` returned 3: must be a gymnasium.Env",
        ),
    ],
)
def test_raises_for_objects_that_are_no_source_and_for_unsupported_fields(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_an_existing_folder_is_no_source_unless_it_has_the_name_of_a_task(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["pendulum", "swing-v2", "runs/swing-v2", "tests.envs.rig:RIG"]
    assert [is_source_name(name) for name in names] == [True] * 4
    for name in names[:3]:
        (tmp_path / name).mkdir(parents=True)
    assert [is_source_name(name) for name in names] == [True, False, False, True]
    assert not is_source_name("swing")


def test_a_task_stands_for_its_name():
    task = find_source("pendulum").task
    assert EnvConfig(task, "weak") == EnvConfig("pendulum", "weak")
    assert codrl_mj.make(task, "weak").spec.id == task.env_id


def test_a_function_that_is_named_can_be_stored_and_trained_on():
    config = EnvConfig("tests.envs.rig:RigEnv", "lag", max_episode_steps=9)
    stored = json.loads(json.dumps(config.as_mapping()))
    assert stored["task"] == "tests.envs.rig:RigEnv"
    assert EnvConfig.from_mapping(stored) == config
    assert TrainConfig.preset("tests.envs.rig:RigEnv", "sac", env={"max_episode_steps": 9})


def test_evaluation_keeps_the_time_limit_if_the_source_has_none(monkeypatch):
    config = TrainConfig.preset(
        NAME, "sac", env={"max_episode_steps": 9, "options": {"target": 0.5}}
    )
    assert config.evaluation_env.time_limit == RIG.time_limit
    monkeypatch.setattr(RIG, "time_limit", None)
    assert config.evaluation_env.time_limit == 9


def test_an_error_inside_an_environment_is_not_blamed_on_options_that_were_not_set():
    gym.register("Broken-v0", lambda **_: len(5), max_episode_steps=5)
    try:
        with pytest.raises(
            ValueError, match=r"^Broken-v0: object of type 'int' has no len"
        ) as error_info:
            EnvConfig("Broken-v0").build()
        assert isinstance(error_info.value.__cause__, TypeError)
    finally:
        gym.registry.pop("Broken-v0")


def test_a_long_text_in_the_options_is_not_taken_for_a_file():
    assert EnvConfig(NAME, options={"target": "x" * 9000}).code == EnvConfig(NAME).code


def test_ideal_motors_change_nothing():
    original, with_motors = RigEnv(), EnvConfig(NAME).build()
    np.testing.assert_array_equal(original.reset(seed=3)[0], with_motors.reset(seed=3)[0])
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 1)):
        np.testing.assert_array_equal(original.step(action)[0], with_motors.step(action)[0])


@pytest.mark.parametrize(
    "line",
    [
        "evaluate {run} --trust --episodes 2",
        f"evaluate {{run}} --trust --actuator {MOTOR} --episodes 1",
        f"render {NAME} --actuators dr.*=lag --env.max-episode-steps 10 --out {{run}}/random.mp4",
        "runs {runs}",
        "render {run} --trust --env.max-episode-steps 10 --out {run}/film.mp4",
        "replay {run} --trust --out {run}/replay.html",
        "report {run} --trust --no-film --out {run}/report.html",
        "motor choose {run} --trust",
        "train --resume {run} --trust",
    ],
)
def test_every_verb_accepts_a_custom_source(run, line):
    assert main(line.format(run=run, runs=run.parent).split()) == 0


def test_a_live_session_runs_a_custom_source():
    session = Session(EnvConfig(NAME, {"drive": MOTOR}), {})
    session.set_actuator("drive", ("motor", "resistance"), 0.3)
    assert session.problem is None
    assert session.step()
    assert session.config.actuators_by_name["drive"].motor.resistance == 0.3


def test_make_accepts_options_of_sources_and_tasks_that_are_loaded_by_name():
    with codrl_mj.make(
        NAME, "lag", render_mode="rgb_array", max_episode_steps=7, target=0.5
    ) as env:
        assert (env.render_mode, env.unwrapped._target) == ("rgb_array", 0.5)
        env.reset(seed=0)
        assert [env.step(np.zeros(1))[3] for _ in range(7)] == [False] * 6 + [True]
    with codrl_mj.make(
        "codrl_mj.tasks.cartpole:TASK", "lag", center_radius=0.1, max_episode_steps=9
    ) as env:
        assert env.unwrapped.setup.config.options.center_radius == 0.1
        assert env.spec.max_episode_steps == 9


@pytest.mark.parametrize(
    "assign", [lambda fields: fields, lambda fields: {"slider": fields}], ids=["all", "by name"]
)
def test_make_accepts_actuator_fields_for_a_third_party_environment(assign):
    with codrl_mj.make(
        "InvertedPendulum-v5", assign({"family": "lag", "time_constant": 0.03})
    ) as env:
        assert [motor.time_constant for motor in env.get_wrapper_attr("motors").values()] == [0.03]
