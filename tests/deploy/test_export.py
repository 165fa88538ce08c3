"""Tests of the exported policy in other runtimes, and of its contract."""

import csv
import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx.reference import ReferenceEvaluator

from codrl_mj.actuators import DCMotorActuator
from codrl_mj.agents import AGENTS
from codrl_mj.cli import main
from codrl_mj.deploy import Contract, board_test, export, extract_network, onnx_model
from codrl_mj.deploy.spaces import describe_spaces
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy
from codrl_mj.runs.policies import load_policy, save_policy

TASKS = {
    "cartpole": "ppo",
    "pendulum": "ddpg",
    "acrobot": "dqn",
    "mountain_car_continuous": "td3",
    "furuta": "sac",
}
SMALL = {"hidden": (16, 16)}


def trained(task, agent, env=None, **settings):
    """Return a policy with random weights whose actions depend on the observation; its settings.

    `env` has fields of the environment, which the policy fits.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)
    instance = EnvConfig(task, **(env or {})).build()
    config = AGENTS[agent](**settings)
    policy = config.make_policy(instance.observation_space, instance.action_space)
    instance.close()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(1.5).add_(0.02 * torch.randn_like(parameter))
    policy.set_training_mode(False)
    return policy, config


def observed(space, count=10_000):
    """Return observations (count, k), half within the bounds and half partly far beyond."""
    random = np.random.default_rng(1)
    far = random.normal(0.0, 2.0, (count, *space.shape))
    near = random.uniform(np.maximum(space.low, -2.0), np.minimum(space.high, 2.0), far.shape)
    return np.where(np.arange(count)[:, None] % 2, near, far).astype(np.float32)


def runtimes(model):
    """Return functions that compute the model with onnxruntime and with onnx's reference."""
    session = onnxruntime.InferenceSession(model.SerializeToString())
    return (
        lambda observations: session.run(None, {"observation": observations})[0],
        lambda observations: ReferenceEvaluator(model).run(None, {"observation": observations})[0],
    )


TABLES = [
    ("mountain_car", "sarsa", {}),
    ("acrobot", "sarsa", {"tilings": 16, "intervals": (6, 6, 4, 4), "angles": 2}),
]
EACH = [
    *((task, agent, {}) for task, agent in TASKS.items()),
    *TABLES,
    ("pendulum", "ppo", {"unit_actions": True}),
    ("furuta", "ppo", {"activation": "relu", "input_scale": (1.0, 1.0, 1.0, 1.0, 0.05, 0.05)}),
]


@pytest.mark.parametrize(("task", "agent", "settings"), EACH)
def test_other_runtimes_compute_the_policys_actions(task, agent, settings):
    policy, _ = trained(task, agent, **settings)
    observations = observed(policy.observation_space)
    expected = policy.predict(observations, deterministic=True)[0]
    for run in runtimes(onnx_model(extract_network(policy), {})):
        actions = run(observations)
        assert actions.dtype == expected.dtype
        if expected.dtype == np.int64:
            # Two actions may be equally good except for rounding.
            assert (actions != expected).sum() <= 1
        else:
            np.testing.assert_allclose(actions, expected, atol=1e-6, rtol=0)
    assert len(np.unique(expected.round(6))) > 1


def test_csv_table_gives_the_policys_actions(tmp_path):
    policy, _ = trained("mountain_car", "sarsa")
    export(policy, EnvConfig("mountain_car"), "sarsa", tmp_path / "out", 1)
    header, *rows = csv.reader((tmp_path / "out/table.csv").open())
    assert header == ["tiling", "position", "velocity", "action 0", "action 1", "action 2"]
    weights = {tuple(map(int, row[:3])): np.array(row[3:], float) for row in rows}
    assert len(weights) == 8 * 9 * 9
    low, high = np.array([-1.2, -0.07]), np.array([0.6, 0.07])
    observations = np.random.default_rng(0).uniform(low, high, (300, 2)).astype(np.float32)
    for observation, action in zip(
        observations, policy.predict(observations, deterministic=True)[0], strict=True
    ):
        eighths = np.floor((observation.astype(float) - low) / (high - low) * 64)
        # Sutton's displacements are 1 and 3 eighths of a tile for each tiling.
        tiles = [
            (tiling, *((eighths + tiling * np.array([1, 3]) % 8) // 8).astype(int))
            for tiling in range(8)
        ]
        assert sum(weights[tile] for tile in tiles).argmax() == action
    result = board_test(tmp_path / "out", episodes=2)
    np.testing.assert_array_equal(result.on_board[1].action, result.in_python[1].action)


# -- the folder ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Export a policy for the Furuta pendulum with its motor."""
    folder = tmp_path_factory.mktemp("out") / "furuta"
    export(
        trained("furuta", "ppo")[0],
        EnvConfig("furuta", observe_actuator=False),
        "ppo",
        folder,
        episodes=2,
    )
    return folder


def test_onnx_file_gives_the_golden_actions(exported):
    golden = Contract.read(exported).golden
    observations = np.array(golden["observations"], np.float32)
    model = onnx.load(exported / "policy.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert observations.shape == (200, 6)
    for run in runtimes(model):
        np.testing.assert_allclose(run(observations), golden["actions"], atol=golden["tolerance"])


def test_contract_has_rate_units_bounds_actuators_and_metadata(exported):
    contract = Contract.read(exported)
    assert contract.rate == pytest.approx(50.0)
    assert [entry["unit"] for entry in contract.observations] == [
        "1",
        "1",
        "1",
        "1",
        "rad/s",
        "rad/s",
    ]
    assert [entry["name"] for entry in contract.actions] == ["motor"]
    assert contract.actions[0]["unit"] == "N*m"
    assert contract.actions[0]["most"] == pytest.approx(0.084)
    assert contract.actuators["motor"]["fields"]["motor"]["resistance"] == 8.4
    low, high = np.array([entry["seen"] for entry in contract.observations]).T
    assert (low <= high).all()
    assert contract.late == {"after": pytest.approx(0.03), "unit": "s", "command": [0.0]}
    metadata = {
        entry.key: entry.value for entry in onnx.load(exported / "policy.onnx").metadata_props
    }
    assert json.loads(metadata["observations"])[4]["name"] == "arm_velocity"


CURRENTS = {"action": "current", "observe_actuator": True}


@pytest.mark.parametrize(
    ("task", "changes", "units", "expected"),
    [
        ("cartpole", {}, ["m", "m/s", "rad", "rad/s"], ("motor", "N", [-10.0, 10.0], None)),
        ("pendulum", CURRENTS, ["1", "1", "rad/s", "A", "A"], ("motor", "A", None, 2.0)),
        ("acrobot", {}, ["1"] * 4 + ["rad/s"] * 2, ("motor", "N*m", [-1.0, 0.0, 1.0], None)),
        ("mountain_car", {}, ["m", "m/s"], ("motor", "N", [-1.0, 0.0, 1.0], None)),
        # A third-party environment has bounds but no units.
        (
            "InvertedPendulum-v5",
            {},
            [None] * 4,
            ("slide", None, None, 3.0),
        ),
    ],
)
def test_units_are_those_of_state_signals_and_commands(task, changes, units, expected):
    config = EnvConfig(task, **changes)
    observations, (action,) = describe_spaces(config)
    assert [entry["unit"] for entry in observations] == units
    assert (action["name"], action["unit"], action.get("levels"), action.get("most")) == expected


@pytest.mark.parametrize(
    ("change", "rate", "message"),
    [
        (lambda seen: [seen[1], seen[0], *seen[2:]], None, "their order is sin_arm, cos_arm"),
        (lambda seen: seen[:-1], None, "rod_velocity missing"),
        (
            lambda seen: [*seen[:4], ("arm_velocity", "deg/s"), seen[5]],
            None,
            "its unit is deg/s, must be rad/s",
        ),
        (lambda seen: [*seen[:5], ("rod_velocty", "rad/s")], None, "did you mean 'rod_velocity'"),
        (lambda seen: seen, 100.0, "at 100 Hz, must be 50 Hz"),
    ],
)
def test_raises_for_wrong_observations_or_a_wrong_rate(exported, change, rate, message):
    contract = Contract.read(exported)
    rows = [(entry["name"], entry["unit"]) for entry in contract.observations]
    contract.check_observations(rows, 50.0)
    with pytest.raises(ValueError, match=message):
        contract.check_observations(change(rows), rate)


def test_raises_for_another_actuator_with_the_field_that_differs(exported):
    contract = Contract.read(exported)
    (drive,) = EnvConfig("furuta").actuators_by_name.values()
    contract.check_actuators({"motor": drive})
    weaker = drive.replaced({"supply.voltage": 6.0})
    for actuator, message in {
        weaker: r"supply\.voltage = 6\.0, must be 18\.0",
        DCMotorActuator(): "must be drive",
    }.items():
        with pytest.raises(ValueError, match=message):
            contract.check_actuators({"motor": actuator})


def test_raises_for_an_edited_contract(exported, tmp_path):
    text = (exported / "contract.json").read_text()
    (tmp_path / "contract.json").write_text(text.replace('"rate": 50.0', '"rate": 51.0'))
    with pytest.raises(ValueError, match="sha256"):
        Contract.read(tmp_path)


@pytest.mark.parametrize("agent", ["sac", "td3"])
def test_tolerance_scales_with_the_largest_command(agent, tmp_path):
    env = EnvConfig(
        "pendulum", {"name": "paper", "controller": {"max_voltage": 200.0}}, action="voltage"
    )
    policy, _ = trained("pendulum", agent)
    policy.action_space = policy.actor.action_space = env.build().action_space
    export(policy, env, agent, tmp_path / "out", 1)
    golden = Contract.read(tmp_path / "out").golden
    largest = np.abs(golden["actions"]).max()
    assert largest > 100.0
    assert golden["tolerance"] == pytest.approx(1e-5 * largest)


def test_raises_and_writes_nothing_for_a_policy_that_cannot_be_exported(tmp_path):
    layered = trained("pendulum", "ppo")[0]
    layered.mlp_extractor.policy_net[1] = torch.nn.ELU()
    for policy, message in {
        layered: "a layer is ELU",
        RandomPolicy(
            "pendulum"
        ): "RandomPolicy cannot be exported: it must be of PPO, SAC, TD3, DDPG or",
    }.items():
        with pytest.raises(ValueError, match=message):
            export(policy, EnvConfig("pendulum"), "ppo", tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_export_on_the_command_line(tmp_path, capsys):
    policy, config = trained("pendulum", "ppo", **SMALL)
    save_policy(policy, config, tmp_path / "policy")
    out = tmp_path / "out"
    line = [
        "export",
        str(tmp_path / "policy"),
        "--task",
        "pendulum",
        "--agent",
        "ppo",
        "--episodes",
        "1",
    ]
    assert main([*line, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "angular_velocity" in printed
    assert "20 Hz" in printed
    files = {path: path.read_bytes() for path in out.iterdir()}
    contract = Contract.read(out)
    assert (contract.task, contract.agent) == ("pendulum", "ppo")
    loaded = load_policy(tmp_path / "policy")
    observations = np.array(contract.golden["observations"], np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observations, deterministic=True)[0], contract.golden["actions"]
    )
    assert "typedef float real" in (out / "controller.h").read_text()
    assert (
        main([*line, "--out", str(tmp_path / "small"), "--board", "arduino-due", "--float64"]) == 0
    )
    assert "typedef double real" in (tmp_path / "small" / "controller.h").read_text()
    assert main([*line, "--out", str(out)]) == 2
    assert "is not an empty folder" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in out.iterdir()} == files
