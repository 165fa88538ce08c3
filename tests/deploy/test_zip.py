"""Tests of the export of Stable-Baselines3 zips, with `VecNormalize` and other units.

The expected values are those of Stable-Baselines3: `VecNormalize.normalize_obs`, then the model's
`predict`.
"""

import json
import pickle
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnxruntime
import pytest
import stable_baselines3
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

import codrl_mj
from codrl_mj.cli import main
from codrl_mj.deploy import Board, Contract, export, extract_network
from codrl_mj.deploy.board import missing_tools
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_sb3_zip
from codrl_mj.training.folder import load_config

LEARNS = {
    "ppo": {"n_steps": 16, "batch_size": 16, "n_epochs": 1},
    "sac": {"learning_starts": 8, "batch_size": 8},
}
LEARNS["dqn"] = LEARNS["sac"]
TASK_IDS = {"pendulum": "codrl_mj/Pendulum-v0", "cartpole": "codrl_mj/CartPole-v0"}


class Pushes(gym.ActionWrapper):
    """The inverted pendulum, pushed to a side or not at all."""

    def __init__(self, several=False, **arguments):
        """Take one action, or a vector of one."""
        super().__init__(InvertedPendulumEnv(**arguments))
        self.action_space = gym.spaces.MultiDiscrete([3]) if several else gym.spaces.Discrete(3)

    def action(self, action):
        return np.array([-3.0, 0.0, 3.0])[np.atleast_1d(action)]


gym.register("Pushes-v0", Pushes, max_episode_steps=50)
gym.register("SeveralPushes-v0", Pushes, max_episode_steps=50, kwargs={"several": True})
ZIP = ["--task", "pendulum", "--agent", "ppo", "--trust"]


def model_of(agent, envs):
    """Return a small untrained model."""
    settings = LEARNS[agent] | {"policy_kwargs": {"net_arch": [16]}}
    return getattr(stable_baselines3, agent.upper())(
        "MlpPolicy", envs, **settings, seed=0, device="cpu"
    )


def saved(folder, agent, task, normalized=True, steps=32, **options):
    """Train a model briefly and save it and its `VecNormalize` into two folders; return both."""
    envs = codrl_mj.make_sb3_vec_env(TASK_IDS[task], 2, **options)
    envs = VecNormalize(envs, clip_obs=2.0) if normalized else envs
    model = model_of(agent, envs)
    model.learn(steps)
    (folder / "apart").mkdir()
    model.save(folder / "policy.zip")
    # The statistics are like those of a long training with observations far from zero that hardly
    # change.
    if normalized:
        envs.obs_rms.mean[:] = np.linspace(-300.0, 200.0, len(envs.obs_rms.mean))
        envs.obs_rms.var[:] = np.geomspace(1e-6, 9.0, len(envs.obs_rms.mean))
        envs.save(folder / "apart/statistics.pkl")
    return model, envs


def observed(statistics, count=500):
    """Return raw observations, some of which exceed the clip."""
    rms = statistics.obs_rms
    random = np.random.default_rng(1)
    return (rms.mean + 1.5 * np.sqrt(rms.var) * random.normal(size=(count, len(rms.mean)))).astype(
        np.float32
    )


@pytest.fixture(
    scope="module",
    params=[("pendulum", "ppo"), ("pendulum", "sac"), ("cartpole", "dqn")],
    ids="-".join,
)
def normalized(request, tmp_path_factory):
    """Return task and agent, a folder with the zip, the model, and its statistics."""
    task, agent = request.param
    folder = tmp_path_factory.mktemp(agent)
    return task, agent, folder, *saved(folder, agent, task)


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """Save a zip of PPO that was trained with `VecNormalize`, and return its folder."""
    folder = tmp_path_factory.mktemp("half")
    saved(folder, "ppo", "pendulum")
    return folder


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


# -- statistics ------------------------------------------------------------------------------------


@pytest.mark.parametrize("double", [False, True], ids=["float", "double"])
def test_onnx_c_and_contract_have_the_statistics(normalized, tmp_path, double):
    task, agent, folder, model, statistics = normalized
    policy = load_sb3_zip(folder / "policy.zip", agent, True, folder / "apart/statistics.pkl")
    export(policy, EnvConfig(task), agent, tmp_path / "out", 1, double=double)
    observations = observed(statistics)
    clipped = np.abs(statistics.normalize_obs(observations))
    assert 0.05 < (clipped == 2.0).mean() < 0.5
    expected = model.predict(statistics.normalize_obs(observations), deterministic=True)[0]
    assert len(np.unique(expected)) > 1
    actions = onnxruntime.InferenceSession(tmp_path / "out/policy.onnx").run(
        None, {"observation": observations}
    )[0]
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    contract, rms = Contract.read(tmp_path / "out"), statistics.obs_rms
    mean, variance, scale, offset = np.array(
        [
            [entry[name] for name in ("mean", "variance", "scale", "offset")]
            for entry in contract.observations
        ]
    ).T
    np.testing.assert_array_equal(mean, rms.mean)
    np.testing.assert_allclose(variance, rms.var + statistics.epsilon, rtol=1e-12)
    np.testing.assert_allclose(
        scale * observations[0] + offset,
        (observations[0] - rms.mean) / np.sqrt(rms.var + 1e-8),
        atol=1e-6,
    )
    assert {entry["clip"] for entry in contract.observations} == {2.0}
    if missing_tools("host"):
        pytest.skip("NOT RUN: no C compiler: apt-get install gcc")
    with Board(tmp_path / "out") as board:
        commands = np.array([board.command(row) for row in observations[:100]])
    np.testing.assert_allclose(commands, contract.to_commands(expected[:100]), atol=1e-5)


@pytest.mark.parametrize(
    "changes", [{"norm_obs": False}, {"clip_obs": np.inf}], ids=lambda changes: next(iter(changes))
)
def test_other_settings_of_vecnormalize(half, tmp_path, changes):
    envs = codrl_mj.make_sb3_vec_env(TASK_IDS["pendulum"], 1)
    statistics = VecNormalize.load(str(half / "apart/statistics.pkl"), envs)
    vars(statistics).update(changes)
    statistics.save(tmp_path / "other.pkl")
    policy = load_sb3_zip(half / "policy.zip", "ppo", True, tmp_path / "other.pkl")
    export(policy, EnvConfig("pendulum"), "ppo", tmp_path / "out", 1)
    observations = observed(statistics)
    model = stable_baselines3.PPO.load(half / "policy.zip", device="cpu")
    expected = model.predict(statistics.normalize_obs(observations), deterministic=True)[0]
    actions = onnxruntime.InferenceSession(tmp_path / "out/policy.onnx").run(
        None, {"observation": observations}
    )[0]
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    if not missing_tools("host"):
        with Board(tmp_path / "out") as board:
            np.testing.assert_allclose(
                [board.command(row) for row in observations[:50]], expected[:50], atol=1e-5
            )


def test_evaluation_has_the_returns_of_stable_baselines3(normalized, capsys):
    task, agent, folder, model, statistics = normalized
    expected = []
    for seed in range(2):
        env = gym.make(TASK_IDS[task])
        observation, total, over = env.reset(seed=seed)[0], 0.0, False
        while not over:
            action = model.predict(statistics.normalize_obs(observation), deterministic=True)[0]
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + reward, terminated or truncated
        expected.append(total)
    line = f"evaluate {folder}/policy.zip --task {task} --agent {agent} --trust --episodes 2 --json"
    assert main([*line.split(), "--normalize", str(folder / "apart/statistics.pkl")]) == 0
    assert json.loads(capsys.readouterr().out)["returns"]["mean"] == pytest.approx(
        np.mean(expected), rel=1e-6
    )
    policy = load_sb3_zip(folder / "policy.zip", agent, True, folder / "apart/statistics.pkl")
    assert evaluate(policy, EnvConfig(task), 2).returns.mean == pytest.approx(
        np.mean(expected), rel=1e-6
    )


def test_raises_for_a_policy_without_its_statistics(half, tmp_path, capsys):
    for verb in ("evaluate", "export"):
        assert main([verb, str(half / "policy.zip"), *ZIP]) == 2
        error = capsys.readouterr().err
        assert (
            "trained with VecNormalize and needs its statistics: its last observations were"
            " normalized" in error
        )
        assert "--normalize FILE.pkl, or --normalize none" in error
    assert not list(tmp_path.iterdir())
    raw = load_sb3_zip(half / "policy.zip", "ppo", True, "none")
    expected = stable_baselines3.PPO.load(half / "policy.zip").predict(
        np.ones((1, 3)), deterministic=True
    )[0]
    np.testing.assert_array_equal(raw.predict(np.ones((1, 3)), deterministic=True)[0], expected)


# The second path is rl-zoo3's.
@pytest.mark.parametrize("path", ["statistics.pkl", "CartPole-v0/vecnormalize.pkl"])
def test_raises_for_unused_statistics_beside_a_zip(tmp_path, path):
    model, _ = saved(tmp_path, "ppo", "cartpole", normalized=False)
    # Without a file there is no sign of statistics.
    assert load_sb3_zip(tmp_path / "policy.zip", "ppo", True) is not None
    (tmp_path / path).parent.mkdir(exist_ok=True)
    (tmp_path / path).write_bytes(b"")
    with pytest.raises(
        ValueError, match=rf"needs its statistics.*{path} may have its statistics.*--normalize none"
    ):
        load_sb3_zip(tmp_path / "policy.zip", "ppo", True)
    assert load_sb3_zip(tmp_path / "policy.zip", "ppo", True, "none") is not None
    assert model.num_timesteps > 0


def test_warns_if_a_zip_does_not_tell_about_normalization(tmp_path):
    saved(tmp_path, "dqn", "cartpole", normalized=False)
    with pytest.warns(UserWarning, match="does not say whether it was trained with VecNormalize"):
        load_sb3_zip(tmp_path / "policy.zip", "dqn", True)


def test_raises_if_last_observations_in_a_zip_are_normalized(tmp_path):
    model, _ = saved(tmp_path, "dqn", "cartpole", normalized=False)
    # The pole is at more than its 24 degrees.
    model._last_obs = model._last_obs + np.float32([0.0, 0.0, 1.0, 0.0])
    model.save(tmp_path / "policy.zip")
    with pytest.raises(ValueError, match="are outside its observation space"):
        load_sb3_zip(tmp_path / "policy.zip", "dqn", True)


def test_raises_for_files_without_the_policys_statistics(half, tmp_path):
    class Bomb:
        def __reduce__(self):
            return open, (str(tmp_path / "executed"), "w")

    (tmp_path / "text.pkl").write_text("mean 0")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([0.0]))
    (tmp_path / "bomb.pkl").write_bytes(pickle.dumps(Bomb()))
    VecNormalize(codrl_mj.make_sb3_vec_env(TASK_IDS["cartpole"], 1)).save(tmp_path / "cartpole.pkl")
    for name, message in {
        "none.pkl": "no such file; name the file that VecNormalize.save wrote",
        "text.pkl": "must be a file that VecNormalize.save wrote",
        "list.pkl": "holds a list: must be a file that VecNormalize.save wrote",
        "cartpole.pkl": (
            r"the policy observes Box.*\(3,\).*: name the file that was saved with the policy"
        ),
    }.items():
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            load_sb3_zip(half / "policy.zip", "ppo", True, tmp_path / name)
    with pytest.raises(ValueError, match="Pass --trust"):
        load_sb3_zip(half / "policy.zip", "ppo", False, tmp_path / "bomb.pkl")
    assert not (tmp_path / "executed").exists()


def test_raises_for_statistics_without_a_zip(capsys):
    assert main(["evaluate", "runs/mine", "--normalize", "statistics.pkl"]) == 2
    assert "runs/mine is not a Stable-Baselines3 zip: omit the flag" in capsys.readouterr().err


# -- units -----------------------------------------------------------------------------------------


VOLTS = {"actuator": {"name": "paper", "controller": {"max_voltage": 12.0}}, "action": "voltage"}


@pytest.fixture(scope="module")
def volts(tmp_path_factory):
    """Save a zip of PPO that commands the voltage of a 12 V motor, and a file of that motor."""
    folder = tmp_path_factory.mktemp("volts")
    saved(folder, "ppo", "pendulum", normalized=False, **VOLTS)
    (folder / "apart/motor.yaml").write_text("name: paper\ncontroller: {max_voltage: 12.0}\n")
    return folder


def test_volts_are_not_exported_as_torques(volts, tmp_path, capsys):
    path, motor = str(volts / "policy.zip"), str(volts / "apart/motor.yaml")
    for verb in (
        ["evaluate", path, *ZIP, "--episodes", "1"],
        ["render", path, *ZIP, "--out", "film.gif"],
        ["replay", path, *ZIP],
        ["view", path, *ZIP],
        ["export", path, *ZIP],
    ):
        assert main(verb) == 2
        error = capsys.readouterr().err
        assert "action_space: the policy was trained with Box(-12.0, 12.0, (1,), float32)" in error
        assert (
            "but the environment has Box(-2.0, 2.0, (1,), float32): repeat the settings of its"
            " training" in error
        )
        assert "--env.action" in error
    # The task's default motor has other voltages.
    assert main(["export", path, *ZIP, "--env.action", "voltage"]) == 2
    assert "Box(-12.0, 12.0, (1,), float32)" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert (
        main(["export", path, *ZIP, "--env.action", "voltage", "--actuator", motor, "--out", "out"])
        == 0
    )
    assert "no current loop: this policy commands a voltage" in capsys.readouterr().out
    (action,) = Contract.read(tmp_path / "out").actions
    assert (action["unit"], action["least"], action["most"]) == ("V", -12.0, 12.0)
    with pytest.raises(ValueError, match=r"Box\(-12\.0, 12\.0.*has Box\(-2\.0, 2\.0"):
        export(
            load_sb3_zip(volts / "policy.zip", "ppo", True),
            EnvConfig("pendulum"),
            "ppo",
            tmp_path / "other",
        )


def test_a_contract_needs_the_bounds_of_the_training(volts):
    policy = load_sb3_zip(volts / "policy.zip", "ppo", True)
    with pytest.raises(ValueError, match=r"Box\(-12\.0, 12\.0.*but the environment has Box\(-24\."):
        Contract.from_policy(policy, EnvConfig("pendulum", action="voltage"), "ppo", episodes=1)


def test_an_evaluation_makes_only_the_environments_of_its_episodes(volts, capsys, monkeypatch):
    configs = []

    def make(config, original=EnvConfig.build, **options):
        configs.append(config)
        return original(config, **options)

    monkeypatch.setattr(EnvConfig, "build", make)
    line = ["evaluate", str(volts / "policy.zip"), *ZIP, "--episodes", "2"]
    assert (
        main([*line, "--env.action", "voltage", "--actuator", str(volts / "apart/motor.yaml")]) == 0
    )
    assert len(configs) == 2
    # The first environment shows that the others would not fit either.
    assert main(line) == 2
    assert "action_space: the policy was trained with Box(-12.0" in capsys.readouterr().err
    assert len(configs) == 3


@pytest.mark.filterwarnings("default::UserWarning")
def test_warns_of_another_motor_in_an_evaluation(volts, capsys):
    line = [
        "evaluate",
        str(volts / "policy.zip"),
        *ZIP,
        "--episodes",
        "1",
        "--env.action",
        "voltage",
    ]
    assert main([*line, "--actuator", "paper", "--actuator.controller.max-voltage", "6"]) == 0
    assert (
        "warning: action_space: the policy was trained with Box(-12.0, 12.0"
        in capsys.readouterr().err
    )
    assert main([*line, "--actuator", str(volts / "apart/motor.yaml")]) == 0
    assert "warning" not in capsys.readouterr().err


def test_raises_for_other_observations(tmp_path, capsys):
    envs = VecFrameStack(codrl_mj.make_sb3_vec_env(TASK_IDS["pendulum"], 1), 4)
    model_of("ppo", envs).save(tmp_path / "stacked.zip")
    envs = codrl_mj.make_sb3_vec_env(
        TASK_IDS["pendulum"], 1, actuator="paper", observe_actuator=True
    )
    model_of("ppo", envs).save(tmp_path / "current.zip")
    assert main(["export", "stacked.zip", *ZIP]) == 2
    assert (
        "(4 times as many: stacked frames, as with VecFrameStack, are not supported)"
        in capsys.readouterr().err
    )
    assert main(["export", "current.zip", *ZIP]) == 2
    assert "observation_space: the policy was trained with" in capsys.readouterr().err
    line = [
        "export",
        "current.zip",
        *ZIP,
        "--episodes",
        "1",
        "--actuator",
        "paper",
        "--env.observe-actuator",
    ]
    assert main(line) == 0
    assert [entry["unit"] for entry in Contract.read(tmp_path / "exported").observations][3:] == [
        "A",
        "A",
    ]


def test_run_is_exported_with_the_environment_of_its_training(tmp_path, capsys):
    tiny = (
        "--num-envs 1 --agent.rollout-steps 64 --agent.batch-size 64 --agent.epochs 1"
        " --agent.hidden 8"
    )
    line = f"train pendulum --agent ppo --total-steps 64 {tiny} --actuator weaker --out run"
    assert main(line.split()) == 0
    for flags, names in {"--actuator ideal": "actuator", "--env.action voltage": "action"}.items():
        assert main(["export", "run", *flags.split()]) == 2
        assert (
            f"{names}: export uses the environment in which run was"
            in capsys.readouterr().err.replace("actuator.controller", "")
        )
    assert main(["export", "run", "--episodes", "1"]) == 0
    assert Contract.read(tmp_path / "exported").assumed == load_config(Path("run")).env.as_mapping()


def test_statistics_count_in_the_size_of_the_network(half):
    plain, normalized = (
        extract_network(load_sb3_zip(half / "policy.zip", "ppo", True, statistics))
        for statistics in ("none", half / "apart/statistics.pkl")
    )
    assert normalized.size == plain.size + 2 * 3


@pytest.mark.parametrize("agent", ["ppo", "dqn"])
def test_discrete_actions_of_anybody_are_exported_as_their_index(
    tmp_path, monkeypatch, capsys, agent
):
    monkeypatch.chdir(tmp_path)
    model = model_of(agent, gym.make("Pushes-v0"))
    model.save(tmp_path / "policy.zip")
    told = [
        "--task",
        "tests.deploy.test_zip:Pushes-v0",
        "--agent",
        agent,
        "--trust",
        "--normalize",
        "none",
    ]
    assert main(["export", "policy.zip", *told, "--out", "exported"]) == 0, capsys.readouterr().err
    observations = np.random.default_rng(0).normal(size=(300, 4)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    actions = onnxruntime.InferenceSession("exported/policy.onnx").run(
        None, {"observation": observations}
    )[0]
    assert (actions == expected).all()
    assert Contract.read(tmp_path / "exported").actions == [{"name": "action", "unit": None}]
    if not missing_tools("host"):
        with Board(tmp_path / "exported", trust=True) as board:
            assert [board.command(one)[0] for one in observations[:50]] == expected[:50].tolist()


def test_several_discrete_actions_are_refused_by_name(tmp_path, capsys):
    model_of("ppo", gym.make("SeveralPushes-v0")).save(tmp_path / "policy.zip")
    told = [
        "--task",
        "tests.deploy.test_zip:SeveralPushes-v0",
        "--agent",
        "ppo",
        "--trust",
        "--normalize",
        "none",
    ]
    assert (
        main(["export", str(tmp_path / "policy.zip"), *told, "--out", str(tmp_path / "exported")])
        == 2
    )
    assert "actions are MultiDiscrete([3]): must be vectors, or Discrete" in capsys.readouterr().err
