"""Environments of others on the command line and in run folders: described, trained, continued, measured, filmed."""

import dataclasses
import json
import re
from pathlib import Path

import gymnasium as gym
import imageio
import mujoco
import numpy as np
import pytest
import yaml

import codrl_mj
from codrl_mj.actuators import IDEAL, Drive, Lag
from codrl_mj.agents import PPOConfig, SACConfig
from codrl_mj.catalogue import motor_entry
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy, evaluate, load_episode, run_episodes, save_episode
from codrl_mj.runs.summaries import read_run
from codrl_mj.sizing import demand_of, demands_of
from codrl_mj.training import TrainConfig, history, load_config, train
from codrl_mj.training.config import read_config
from tests.external_envs.models import BareEnv
from tests.matrix import but
from tests.training.interruptions import TERMINATE, crash, differing, interrupt, outcome, resume

pytestmark = pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # deprecated attributes in other people's models
MAXON = {".*": "maxon-ec45-flat-50w"}
QUICK = (
    "--agent.hidden 8 --agent.batch-size 16 --agent.learning-starts 40 --evaluation-episodes 1"
    " --no-tensorboard"
)
EVERYTHING = {
    "observe_actuator": True,
    "disturbances": {"command_delay": 0.12},
    "randomize": {".*": {"motor.resistance": "uniform(0.9, 1.1)"}},
}
SMALL = SACConfig(
    learning_starts=40, batch_size=16, buffer_size=150, hidden=(8,), train_every=4, gradient_steps=1
)


def config(env, num_envs=1):
    often = {"checkpoint_interval": 60, "evaluation_interval": 120, "evaluation_episodes": 1}
    return TrainConfig(env, SMALL, seed=3, num_envs=num_envs, total_steps=240, **often)


CASES = {
    "cheetah": config(EnvConfig("HalfCheetah-v5", MAXON, max_episode_steps=25, **EVERYTHING), 2),
    "reacher by currents": config(
        EnvConfig("Reacher-v5", {"joint.*": "maxon-re65"}, action="current")
    ),
}


class _FromOne(BareEnv):
    action_space = gym.spaces.Discrete(2, start=1)


class _Switched(BareEnv):
    def __init__(self, *, discrete):
        super().__init__()
        self.action_space = gym.spaces.Discrete(2) if discrete else BareEnv.action_space


class _WithDictionaries(BareEnv):
    observation_space = gym.spaces.Dict({"all": BareEnv.observation_space})

    def reset(self, **options):
        observation, info = super().reset(**options)
        return {"all": observation}, info


IDS = {
    "Bare": BareEnv,
    "Endless": BareEnv,
    "Dict": _WithDictionaries,
    "One": _FromOne,
    "Switched": _Switched,
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Another folder, without pictures, where environments of somebody's are registered."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(history, "save_learning_curve", lambda *_: None)
    for name, creator in IDS.items():
        gym.register(
            f"Foreign{name}-v0", creator, max_episode_steps=None if name == "Endless" else 50
        )
    yield
    for name in IDS:
        gym.registry.pop(f"Foreign{name}-v0")


@pytest.fixture(scope="module")
def reacher(tmp_path_factory):
    """A tiny run of two motors on ideal actuators."""
    out = tmp_path_factory.mktemp("trained") / "reacher"
    assert (
        main(["train", "Reacher-v5", "--total-steps", "150", *QUICK.split(), "--out", str(out)])
        == 0
    )
    return out


# -- descriptions ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_a_configuration_survives_json(name):
    whole = json.loads(json.dumps(CASES[name].as_mapping()))
    assert TrainConfig.from_mapping(whole, whole=True) == CASES[name]
    assert (
        TrainConfig.from_mapping({"task": "codrl_mj/Pendulum-v0"}).env.task == "pendulum"
    )  # an id of ours


def test_a_file_says_what_is_behind_what(tmp_path):
    text = (
        "env: {task: HalfCheetah-v5, actuator: {b.*: maxon-ec45-flat-50w, f.*: lag}, options:"
        " {frame_skip: 2}}\n"
    )
    (tmp_path / "train.yaml").write_text(text + "agent: {name: sac, gamma: 0.98}\n")
    found = read_config(tmp_path / "train.yaml")
    assert found.env.driven == {
        "b.*": Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters),
        "f.*": Lag(),
    }
    assert found.env.make().unwrapped.frame_skip == 2
    assert (found.agent.gamma, found.agent.hidden, found.num_envs) == (
        0.98,
        (256, 256),
        1,
    )  # the others as always


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"task": "HalfCheetah-v5", "actuator": {}}, "actuator = {}: must be one for all"),
        ({"task": "HalfCheetah-v5", "actuator": {"(": "lag"}}, "must be a regular expression"),
        (
            {"task": "HalfCheetah-v5", "actuator": {".*": "maxon-ec45-flat"}},
            "or 'maxon-ec45-flat-50w'?",
        ),
        (
            {"task": "HalfCheetah-v5", "actuator": "paper"},
            "but the environment HalfCheetah-v5 has none",
        ),
        ({"task": "HalfCheetah-v5", "max_episode_steps": 0}, "must be an integer >= 1"),
        ({"task": "HalfCheetah-v5", "options": {"frame_skip": {1, 2}}}, "that JSON can hold"),
        ({"task": "HalfCheetah-v5", "levels": [1.0]}, "HalfCheetah-v5 has none"),
    ],
)
def test_bad_descriptions_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        TrainConfig.from_mapping({"env": fields})


def test_a_module_of_somebodys_is_not_imported_from_a_run_folder_unasked(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"train": CASES["cheetah"].as_mapping()}))
    text = (
        (tmp_path / "config.json")
        .read_text()
        .replace("HalfCheetah-v5", "tests.external_envs.nobody:Robot-v0")
    )
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match="Pass --trust"):
        load_config(tmp_path)


# -- training -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", but(["reacher by currents"], CASES))
def test_an_interrupted_training_comes_to_the_same_result(tmp_path, name):
    interrupt(CASES[name], tmp_path / "run", 70, TERMINATE)
    interrupt(CASES[name], tmp_path / "run", 70, crash)
    ours, theirs = (
        outcome(resume(CASES[name], tmp_path / run)) for run in ("run", "uninterrupted")
    )
    assert differing(theirs, ours) == []


def test_where_nobody_can_set_the_state_a_continued_training_starts_an_episode():
    tiny = config(EnvConfig("ForeignBare-v0", {".*": "lag"}))
    interrupt(tiny, Path("run"), 70, crash)  # in the second episode
    resume(tiny, Path("run"))
    lengths = np.loadtxt("run/episodes.csv", delimiter=",", skiprows=1)[:, 3]
    assert read_run(Path("run")).steps == 240
    assert set(lengths) == {50.0}  # none was cut


@pytest.mark.parametrize(
    ("env_id", "agent", "message"),
    [
        ("ForeignDict-v0", SMALL, r"must be a vector.*FlattenObservation"),
        ("ForeignOne-v0", PPOConfig(), r"a choice \(Discrete\) that counts from 0"),
    ],
)
def test_spaces_that_nobody_learns_in_are_refused(env_id, agent, message):
    with pytest.raises(ValueError, match=message):
        train(TrainConfig(EnvConfig(env_id), agent, total_steps=8), Path("run"))


def test_the_options_of_an_environment_decide_who_can_act_in_it():
    chosen, options = "ForeignSwitched-v0", {"discrete": True}
    posed = {"task": chosen, "env": {"options": options}}
    assert [TrainConfig.from_mapping(posed | one).agent.name for one in ({}, {"agent": "dqn"})] == [
        "ppo",
        "dqn",
    ]
    assert (
        TrainConfig.from_mapping(
            {"task": chosen, "env": {"options": {"discrete": False}}}
        ).agent.name
        == "sac"
    )
    assert TrainConfig.preset(chosen, "dqn", env={"options": options}).env.options == options
    line = [
        "train",
        chosen,
        "--env.options",
        "discrete=true",
        "--agent",
        "dqn",
        "--total-steps",
        "8",
    ]
    assert (
        main(
            [*line, "--num-envs", "1", "--agent.learning-starts", "4", "--evaluation-episodes", "1"]
        )
        == 0
    )


# -- measuring ------------------------------------------------------------------------------------------------


def test_every_integration_step_is_looked_at_nothing_changes_by_it_and_a_file_keeps_it():
    """The trace, against the sums of a loop over `mj_step` of one's own."""
    known = EnvConfig("HalfCheetah-v5", MAXON, max_episode_steps=10)
    policy = RandomPolicy(known.make().action_space, 1)
    (episode,) = run_episodes(policy, known.make, 1, seed=4)
    env = known.make()
    env.reset(seed=4)
    model, data = env.unwrapped.model, env.unwrapped.data
    work = np.zeros(6)
    for action, inside in zip(
        episode.action, episode.trace["actual_force"].reshape(10, 5, 6), strict=True
    ):
        data.ctrl[:] = action
        for force in inside:
            before = model.actuator_gear[:, 0] * data.qvel[3:]
            mujoco.mj_step(model, data)
            np.testing.assert_array_equal(force, data.actuator_force)
            work += (
                force
                * (before + model.actuator_gear[:, 0] * data.qvel[3:])
                / 2
                * model.opt.timestep
            )
    np.testing.assert_array_equal(episode.state[-1], np.concatenate([data.qpos, data.qvel]))
    found = codrl_mj.evaluation.summarize(known.task, [episode]).motors
    assert list(found) == ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]
    np.testing.assert_allclose([one["mechanical_work"] for one in found.values()], work, rtol=1e-12)
    save_episode(episode, Path("episode.npz"))
    again = load_episode(Path("episode.npz"))
    for field in dataclasses.fields(episode):
        np.testing.assert_equal(getattr(again, field.name), getattr(episode, field.name))


def test_motors_of_several_families_are_measured_by_what_they_have():
    mixed = EnvConfig("Reacher-v5", {"joint0": "lag", "joint1": "maxon-re65"})
    found = evaluate(RandomPolicy(mixed.make().action_space, 0), mixed, 2)
    lag, maxon = found.motors.values()
    assert lag["rms_current"] is None
    assert maxon["rms_current"] == pytest.approx(found.rms_current)
    assert maxon["copper_loss"] == pytest.approx(found.copper_loss.mean)
    assert found.success is None  # Reacher says nothing of it


# -- the command line -----------------------------------------------------------------------------------------


def test_motors_that_are_not_named_stay_what_they_were():
    line = "evaluate two --actuators joint0=lag --episodes 1 --out result.json"
    two = config(EnvConfig("Reacher-v5", {"joint.*": "maxon-re65"}))
    train(dataclasses.replace(two, total_steps=50), Path("two"), tensorboard=False)
    assert main(line.split()) == 0
    motors = json.loads(Path("result.json").read_text())["motors"]
    assert motors["joint0"]["peak_voltage"] is None
    assert motors["joint1"]["peak_voltage"] > 0.0


def test_draws_of_the_model_survive_files_and_flags():
    env = EnvConfig("Reacher-v5", {".*": "lag"}, randomize={"model.gravity": "uniform(0.9, 1.1)"})
    assert (
        TrainConfig.from_mapping(json.loads(json.dumps(config(env).as_mapping())), whole=True).env
        == env
    )
    both = ["model.gravity=uniform(0.9, 1.1)", ".*:time_constant=uniform(0.01, 0.02)"]
    other = EnvConfig("Reacher-v5", {".*": "lag"}, randomize=both)
    assert other.randomize == tuple(both)
    nested = {"model.gravity": "uniform(0.9, 1.1)", ".*": {"time_constant": "uniform(0.01, 0.02)"}}
    assert EnvConfig("Reacher-v5", {".*": "lag"}, randomize=nested) == other
    envs = codrl_mj.make_sb3_vec_env(other, 2)
    envs.reset()
    drawn = envs.randomization
    assert set(drawn) == {"model.gravity", ".*:time_constant", "rejected"}
    assert drawn["model.gravity"].shape == (2,)
    train(dataclasses.replace(config(other), total_steps=50), Path("run"), tensorboard=False)
    assert main(["evaluate", "run", "--episodes", "1"]) == 0


def test_an_environment_without_a_time_limit_needs_one():
    endless = EnvConfig("ForeignEndless-v0", {".*": "lag"})
    with pytest.raises(ValueError, match="registered without a time limit"):
        endless.make()
    limited = dataclasses.replace(endless, max_episode_steps=5)
    assert TrainConfig(limited, SACConfig()).evaluation_env.time_limit == 5
    assert evaluate(RandomPolicy(limited.make().action_space), limited, 1).length.mean == 5


def test_a_policy_of_stable_baselines_is_evaluated_by_the_id(capsys):
    from stable_baselines3 import PPO

    PPO("MlpPolicy", "Reacher-v5", n_steps=8, batch_size=8).save("policy.zip")
    line = (
        "evaluate policy.zip --task Reacher-v5 --agent ppo --trust --actuator maxon-re65"
        " --episodes 1"
    )
    assert main(line.split()) == 0
    assert "policy.zip on maxon-re65" in capsys.readouterr().out


def test_a_run_is_evaluated_on_other_motors(reacher, capsys):
    assert load_config(reacher).env.driven == {".*": IDEAL}
    line = (
        f"evaluate {reacher} --actuators joint0=maxon-re65 joint1=lag --episodes 2 --out"
        " result.json"
    )
    assert main(line.split()) == 0
    shown = capsys.readouterr().out
    assert "motors of reacher" in shown
    assert "joint1" in shown
    result = json.loads(Path("result.json").read_text())
    assert result["conditions"]["env"]["actuator"]["joint1"] == Lag().as_mapping()
    assert main(["runs", str(reacher.parent)]) == 0
    listed = capsys.readouterr().out
    assert "Reacher-v5" in listed
    assert "ideal" in listed


def test_motors_are_chosen_for_what_a_policy_asked_and_do_it(reacher, capsys):
    assert (
        main(["motor", "choose", str(reacher), "--out", "chosen"]) == 1
    )  # none has all that is asked for in print
    assert "joint1" in capsys.readouterr().out
    chosen = yaml.safe_load(Path("chosen/actuators.yaml").read_text())
    assert list(chosen) == ["joint0", "joint1"]
    assert Path("chosen/joint1.png").stat().st_size > 1000
    line = f"evaluate {reacher} --actuators chosen/actuators.yaml --episodes 2 --out result.json"
    assert main(line.split()) == 0
    result = json.loads(Path("result.json").read_text())
    assert result["saturated_percent"] == 0.0
    assert all(motor["tracking_percent"] < 5.0 for motor in result["motors"].values())
    with pytest.raises(ValueError, match="must be one of joint0, joint1"):
        demand_of(reacher)
    asked = demands_of(reacher, episodes=2)["joint0"]
    assert asked.model_gear == 200.0  # Reacher's: forces are up to 200 times 1
    assert 1.0 < np.abs(asked.torque).max() <= 200.0


def test_an_episode_is_filmed_with_the_strip_of_a_motor(reacher, capsys):
    line = (
        f"render {reacher} --motor joint1 --out film.gif --width 160 --height 120 --trajectory"
        " episode.npz"
    )
    assert main(line.split()) == 0
    frames = imageio.mimread("film.gif")
    assert len(frames) == 26  # 50 steps of 20 ms, at half the rate, and the end
    assert len(load_episode(Path("episode.npz")).reward) == 50
    assert np.ptp(frames[0][60:120].astype(int)) > 50  # the scene
    capsys.readouterr()
    assert main(["render", str(reacher), "--motor", "joint", "--out", "other.gif"]) == 2
    assert "did you mean 'joint1'" in capsys.readouterr().err.replace("joint0", "joint1")
    assert not Path("other.gif").exists()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train HalfCheetah-v5 --actuators thigh=lag", "'thigh': no actuator has such a name"),
        (
            "train Reacher-v5 --env.options nope=3",
            "options = .*nope.*Reacher-v5 does not take them",
        ),
        ("train Reacher-v5 --env.options action=1", "'action' is no argument of the environment's"),
        ("train Reacher-v5 --env.randomize motor.resistance", "must be FIELD=DISTRIBUTION"),
        ("train HalfCheetah-v5 --actuators bthigh", "must be PATTERN=NAME"),
        ("train Cheetah-v5", "Cheetah.* doesn't exist"),
        ("train HalfCheetah-v5 --agent dqn", "cannot act in the Box actions of HalfCheetah-v5"),
        (
            "train CartPole-v1",
            (
                "CartPole-v1: the environment has no MuJoCo model .*: take 'cartpole', our task of"
                " it that has"
            ),
        ),
        ("motor choose Reacher-v5", "no scripted controller for it; train it"),
    ],
)
def test_what_cannot_be_costs_one_line(capfd, line, message):
    assert main([*line.split(), "--out", "run"]) == 2
    said = [one for one in capfd.readouterr().err.splitlines() if one.startswith("codrl-mj: error")]
    assert len(said) == 1
    assert re.search(message, said[0])
    assert not Path("run").exists()
