"""Third-party environments in files, trainings, evaluations and films."""

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
from tests.matrix import matrix_params
from tests.training.interruptions import TERMINATE, crash, differing, interrupt, outcome, resume

# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
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


def train_config(env, num_envs=1):
    intervals = {"checkpoint_interval": 60, "evaluation_interval": 120, "evaluation_episodes": 1}
    return TrainConfig(env, SMALL, seed=3, num_envs=num_envs, total_steps=240, **intervals)


CASES = {
    "cheetah": train_config(
        EnvConfig("HalfCheetah-v5", MAXON, max_episode_steps=25, **EVERYTHING), 2
    ),
    "reacher by currents": train_config(
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
    """Work in a new folder without pictures, with registered third-party environments."""
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
    """Return a tiny run of two joints with ideal actuators."""
    out = tmp_path_factory.mktemp("trained") / "reacher"
    assert (
        main(["train", "Reacher-v5", "--total-steps", "150", *QUICK.split(), "--out", str(out)])
        == 0
    )
    return out


# -- descriptions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_a_configuration_survives_json(name):
    mapping = json.loads(json.dumps(CASES[name].as_mapping()))
    assert TrainConfig.from_mapping(mapping, whole=True) == CASES[name]
    # The Gymnasium id of a built-in task is replaced by its name.
    assert TrainConfig.from_mapping({"task": "codrl_mj/Pendulum-v0"}).env.task == "pendulum"


def test_a_file_assigns_actuators_to_patterns(tmp_path):
    text = (
        "env: {task: HalfCheetah-v5, actuator: {b.*: maxon-ec45-flat-50w, f.*: lag}, options:"
        " {frame_skip: 2}}\n"
    )
    (tmp_path / "train.yaml").write_text(text + "agent: {name: sac, gamma: 0.98}\n")
    train_config = read_config(tmp_path / "train.yaml")
    assert train_config.env.actuators_by_name == {
        "b.*": Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters),
        "f.*": Lag(),
    }
    assert train_config.env.build().unwrapped.frame_skip == 2
    # Fields that the file does not name have their defaults.
    assert (train_config.agent.gamma, train_config.agent.hidden, train_config.num_envs) == (
        0.98,
        (256, 256),
        1,
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"task": "HalfCheetah-v5", "actuator": {}},
            "actuator = {}: must be one actuator for all motors, or a mapping of patterns",
        ),
        ({"task": "HalfCheetah-v5", "actuator": {"(": "lag"}}, "must be a regular expression"),
        (
            {"task": "HalfCheetah-v5", "actuator": {".*": "maxon-ec45-flat"}},
            "or 'maxon-ec45-flat-50w'?",
        ),
        (
            {"task": "HalfCheetah-v5", "actuator": "paper"},
            "but the environment HalfCheetah-v5 has no such actuator",
        ),
        ({"task": "HalfCheetah-v5", "max_episode_steps": 0}, "must be an integer >= 1"),
        ({"task": "HalfCheetah-v5", "options": {"frame_skip": {1, 2}}}, "that JSON can hold"),
        (
            {"task": "HalfCheetah-v5", "levels": [1.0]},
            r"levels = \[1\.0\]: HalfCheetah-v5 has no such field",
        ),
    ],
)
def test_raises_for_bad_configurations(fields, message):
    with pytest.raises(ValueError, match=message):
        TrainConfig.from_mapping({"env": fields})


def test_a_run_folder_imports_modules_only_with_trust(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"train": CASES["cheetah"].as_mapping()}))
    text = (
        (tmp_path / "config.json")
        .read_text()
        .replace("HalfCheetah-v5", "tests.external_envs.missing:Robot-v0")
    )
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match="Pass --trust"):
        load_config(tmp_path)


# -- training -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", matrix_params(["reacher by currents"], CASES))
def test_an_interrupted_training_gives_the_same_result(tmp_path, name):
    interrupt(CASES[name], tmp_path / "run", 70, TERMINATE)
    interrupt(CASES[name], tmp_path / "run", 70, crash)
    resumed, reference = (
        outcome(resume(CASES[name], tmp_path / run)) for run in ("run", "uninterrupted")
    )
    assert differing(reference, resumed) == []


def test_a_resumed_training_starts_an_episode_if_the_state_cannot_be_set():
    tiny = train_config(EnvConfig("ForeignBare-v0", {".*": "lag"}))
    # The interruption is in the second episode.
    interrupt(tiny, Path("run"), 70, crash)
    resume(tiny, Path("run"))
    lengths = np.loadtxt("run/episodes.csv", delimiter=",", skiprows=1)[:, 3]
    assert read_run(Path("run")).steps == 240
    # No episode may be cut.
    assert set(lengths) == {50.0}


@pytest.mark.parametrize(
    ("env_id", "agent", "message"),
    [
        ("ForeignDict-v0", SMALL, r"must be a vector.*FlattenObservation"),
        ("ForeignOne-v0", PPOConfig(), r"a choice \(Discrete\) that counts from 0"),
    ],
)
def test_raises_for_spaces_that_agents_cannot_use(env_id, agent, message):
    with pytest.raises(ValueError, match=message):
        train(TrainConfig(EnvConfig(env_id), agent, total_steps=8), Path("run"))


def test_the_options_of_an_environment_decide_which_agents_fit():
    env_id, options = "ForeignSwitched-v0", {"discrete": True}
    mapping = {"task": env_id, "env": {"options": options}}
    assert [
        TrainConfig.from_mapping(mapping | agent).agent.name for agent in ({}, {"agent": "dqn"})
    ] == [
        "ppo",
        "dqn",
    ]
    assert (
        TrainConfig.from_mapping(
            {"task": env_id, "env": {"options": {"discrete": False}}}
        ).agent.name
        == "sac"
    )
    assert TrainConfig.preset(env_id, "dqn", env={"options": options}).env.options == options
    command = [
        "train",
        env_id,
        "--env.options",
        "discrete=true",
        "--agent",
        "dqn",
        "--total-steps",
        "8",
    ]
    assert (
        main(
            [
                *command,
                "--num-envs",
                "1",
                "--agent.learning-starts",
                "4",
                "--evaluation-episodes",
                "1",
            ]
        )
        == 0
    )


# -- measuring ------------------------------------------------------------------------------------


def test_an_episode_records_every_integration_step_and_survives_a_file():
    """Compare the trace with a loop over `mj_step`."""
    config = EnvConfig("HalfCheetah-v5", MAXON, max_episode_steps=10)
    policy = RandomPolicy(config.build().action_space, 1)
    (episode,) = run_episodes(policy, config.build, 1, seed=4)
    env = config.build()
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
    motors = codrl_mj.evaluation.summarize(config.task, [episode]).motors
    assert list(motors) == ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]
    np.testing.assert_allclose(
        [motor["mechanical_work"] for motor in motors.values()], work, rtol=1e-12
    )
    save_episode(episode, Path("episode.npz"))
    loaded = load_episode(Path("episode.npz"))
    for field in dataclasses.fields(episode):
        np.testing.assert_equal(getattr(loaded, field.name), getattr(episode, field.name))


def test_motors_of_several_families_have_measures_of_their_own_signals():
    config = EnvConfig("Reacher-v5", {"joint0": "lag", "joint1": "maxon-re65"})
    evaluation = evaluate(RandomPolicy(config.build().action_space, 0), config, 2)
    lag, maxon = evaluation.motors.values()
    assert lag["rms_current"] is None
    assert maxon["rms_current"] == pytest.approx(evaluation.rms_current)
    assert maxon["copper_loss"] == pytest.approx(evaluation.copper_loss.mean)
    # Reacher's info does not contain success.
    assert evaluation.success is None


# -- the command line -----------------------------------------------------------------------------


def test_actuators_that_are_not_named_do_not_change():
    line = "evaluate two --actuators joint0=lag --episodes 1 --out result.json"
    config = train_config(EnvConfig("Reacher-v5", {"joint.*": "maxon-re65"}))
    train(dataclasses.replace(config, total_steps=50), Path("two"), tensorboard=False)
    assert main(line.split()) == 0
    motors = json.loads(Path("result.json").read_text())["motors"]
    assert motors["joint0"]["peak_voltage"] is None
    assert motors["joint1"]["peak_voltage"] > 0.0


def test_randomization_survives_files_and_flags():
    env = EnvConfig("Reacher-v5", {".*": "lag"}, randomize={"model.gravity": "uniform(0.9, 1.1)"})
    assert (
        TrainConfig.from_mapping(
            json.loads(json.dumps(train_config(env).as_mapping())), whole=True
        ).env
        == env
    )
    paths = ["model.gravity=uniform(0.9, 1.1)", ".*:time_constant=uniform(0.01, 0.02)"]
    flat_config = EnvConfig("Reacher-v5", {".*": "lag"}, randomize=paths)
    assert flat_config.randomize == tuple(paths)
    nested = {"model.gravity": "uniform(0.9, 1.1)", ".*": {"time_constant": "uniform(0.01, 0.02)"}}
    assert EnvConfig("Reacher-v5", {".*": "lag"}, randomize=nested) == flat_config
    envs = codrl_mj.make_sb3_vec_env(flat_config, 2)
    envs.reset()
    drawn_values = envs.randomization
    assert set(drawn_values) == {"model.gravity", ".*:time_constant", "rejected"}
    assert drawn_values["model.gravity"].shape == (2,)
    train(
        dataclasses.replace(train_config(flat_config), total_steps=50),
        Path("run"),
        tensorboard=False,
    )
    assert main(["evaluate", "run", "--episodes", "1"]) == 0


def test_raises_for_an_environment_without_a_time_limit():
    endless = EnvConfig("ForeignEndless-v0", {".*": "lag"})
    refused = {
        "evaluation": lambda: evaluate(RandomPolicy(endless.action_space), endless, 1),
        "training": lambda: TrainConfig(endless, SACConfig()),
    }
    for call in refused.values():
        with pytest.raises(ValueError, match="registered without a time limit"):
            call()
    assert endless.build().spec.max_episode_steps is None
    limited = dataclasses.replace(endless, max_episode_steps=5)
    assert TrainConfig(limited, SACConfig()).evaluation_env.time_limit == 5
    assert evaluate(RandomPolicy(limited.build().action_space), limited, 1).length.mean == 5


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
    assert load_config(reacher).env.actuators_by_name == {".*": IDEAL}
    line = (
        f"evaluate {reacher} --actuators joint0=maxon-re65 joint1=lag --episodes 2 --out"
        " result.json"
    )
    assert main(line.split()) == 0
    output = capsys.readouterr().out
    assert "motors of reacher" in output
    assert "joint1" in output
    result = json.loads(Path("result.json").read_text())
    assert result["conditions"]["env"]["actuator"]["joint1"] == Lag().as_mapping()
    assert main(["runs", str(reacher.parent)]) == 0
    runs_output = capsys.readouterr().out
    assert "Reacher-v5" in runs_output
    assert "ideal" in runs_output


def test_motors_are_chosen_for_the_demand_of_a_policy_and_meet_it(reacher, capsys):
    # No datasheet contains everything that is needed, hence the exit status 1.
    assert main(["motor", "choose", str(reacher), "--out", "chosen"]) == 1
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
    demand = demands_of(reacher, episodes=2)["joint0"]
    # Reacher's forces are up to 200 times 1.
    assert demand.model_gear == 200.0
    assert 1.0 < np.abs(demand.torque).max() <= 200.0


def test_an_episode_is_filmed_with_the_strip_of_a_motor(reacher, capsys):
    line = (
        f"render {reacher} --motor joint1 --out film.gif --width 160 --height 120 --trajectory"
        " episode.npz"
    )
    assert main(line.split()) == 0
    frames = imageio.mimread("film.gif")
    # 50 steps of 20 ms at half the rate, and the last state.
    assert len(frames) == 26
    assert len(load_episode(Path("episode.npz")).reward) == 50
    # These rows show the scene.
    assert np.ptp(frames[0][60:120].astype(int)) > 50
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
        (
            "train Reacher-v5 --env.options action=1",
            "'action' is not an argument of the environment",
        ),
        ("train Reacher-v5 --env.randomize motor.resistance", "must be FIELD=DISTRIBUTION"),
        ("train HalfCheetah-v5 --actuators bthigh", "must be PATTERN=NAME"),
        ("train Cheetah-v5", "Cheetah.* doesn't exist"),
        ("train HalfCheetah-v5 --agent dqn", "cannot act in the Box actions of HalfCheetah-v5"),
        (
            "train CartPole-v1",
            (
                "CartPole-v1: the environment has no MuJoCo model .*: use this package's task"
                " 'cartpole', which has motors"
            ),
        ),
        ("motor choose Reacher-v5", "no scripted controller for it; train it"),
    ],
)
def test_errors_of_the_command_line_are_one_line(capfd, line, message):
    assert main([*line.split(), "--out", "run"]) == 2
    errors = [
        text for text in capfd.readouterr().err.splitlines() if text.startswith("codrl-mj: error")
    ]
    assert len(errors) == 1
    assert re.search(message, errors[0])
    assert not Path("run").exists()
