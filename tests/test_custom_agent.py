"""Custom agent of scripts/train_custom_agent.py: learning, seeds, time limits and errors."""

import importlib
import itertools
import re
import shlex
from pathlib import Path

import pytest
import torch
import tyro
from safetensors.torch import load_file

SCRIPTS = Path(__file__).parent.parent / "scripts"
PAGE = (Path(__file__).parent.parent / "docs" / "other_agents.md").read_text()
TINY = [
    "--num-envs",
    "4",
    "--rollout",
    "16",
    "--total-steps",
    "128",
    "--minibatches",
    "2",
    "--eval-episodes",
    "2",
]


@pytest.fixture(scope="module")
def script():
    """The script, as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("train_custom_agent")


@pytest.mark.matrix
def test_it_learns_to_balance_and_saves_the_evaluated_policy(script, tmp_path, capsys):
    out = tmp_path / "new" / "agent.safetensors"
    line = (
        "--task cartpole --actuator paper --total-steps 40000 --num-envs 16 --rollout 128"
        " --eval-episodes 20 --seed 0"
    )
    assert script.main([*line.split(), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    mean = float(re.search(r"greedy return: ([\d.]+)", printed)[1])
    # Gymnasium's first CartPole counts as solved at 195; doing nothing useful gives 10 to 25.
    assert mean >= 195
    assert str(out) in printed.replace("\n", "")

    options = script.Options(task="cartpole", actuator="paper", eval_episodes=20)
    envs = script.make_envs(options, 1)
    agent = script.Agent(envs.single_observation_space, envs.single_action_space, options.hidden)
    envs.close()
    agent.load_state_dict(load_file(out))
    assert script.evaluate(agent, options).mean() == pytest.approx(mean, abs=0.1)


@pytest.mark.parametrize("task", ["cartpole", "pendulum"])  # discrete and continuous actions
def test_equal_seeds_give_equal_weights_and_other_seeds_do_not(script, task, tmp_path):
    weights = []
    for name, seed in {"one": "3", "two": "3", "other": "4"}.items():
        out = tmp_path / name
        assert script.main(["--task", task, *TINY, "--seed", seed, "--out", str(out)]) == 0
        weights.append(out.read_bytes())
    assert weights[0] == weights[1]
    assert weights[0] != weights[2]


def test_advantages_are_the_discounted_sum_of_errors_within_each_episode(script):
    generator = torch.Generator().manual_seed(0)
    rewards, values, next_values = torch.randn(3, 7, 2, generator=generator)
    ended = torch.rand(7, 2, generator=generator) < 0.3
    terminated = ended & (torch.rand(7, 2, generator=generator) < 0.5)
    gains = script.advantages(rewards, values, next_values, terminated, ended, 0.9, 0.7)
    errors = rewards + 0.9 * next_values * ~terminated - values
    for row, start in itertools.product(range(2), range(7)):
        last = next((step for step in range(start, 7) if ended[step, row]), 6)
        weights = (0.9 * 0.7) ** torch.arange(last + 1 - start)
        assert gains[start, row].item() == pytest.approx(
            float(weights @ errors[start : last + 1, row]), abs=1e-5
        )


def test_at_a_time_limit_the_last_observation_of_the_episode_is_valued(script, monkeypatch):
    recorded = {}
    original = script.advantages

    def record(rewards, values, next_values, terminated, ended, gamma, lam):
        recorded.update(values=values, next_values=next_values, terminated=terminated, ended=ended)
        return original(rewards, values, next_values, terminated, ended, gamma, lam)

    monkeypatch.setattr(script, "advantages", record)
    # The value is the pendulum's speed, which shows the observation that was valued.
    monkeypatch.setattr(script.Agent, "value", lambda _, observations: observations[..., 2])
    script.train(
        script.Options("pendulum", "ideal", num_envs=4, rollout=210, total_steps=1, minibatches=2)
    )
    values, next_values, ended = recorded["values"], recorded["next_values"], recorded["ended"]
    # Every environment reaches the limit of 200 steps once.
    assert ended.sum() == 4
    assert not recorded["terminated"].any()
    running = ~ended[:-1]
    assert (next_values[:-1][running] == values[1:][running]).all()
    assert (next_values[:-1][~running] != values[1:][~running]).all()
    # In one step gravity and the motor change the speed by at most (15 + 3 * 2) * 0.05 rad/s.
    assert (next_values - values).abs().max() <= 1.05 + 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gamma", "1.5"], "--gamma 1.5: must be from 0 to 1"),
        (["--learning-rate", "nan"], "--learning-rate nan: must be from 0 to inf"),
        (["--num-envs", "0"], "--num-envs 0: must be from 1 to inf"),
        (
            ["--num-envs", "2", "--rollout", "3"],
            "--minibatches 8: must be <= 3, half the steps of a rollout",
        ),
        (["--actuator", "strong"], "strong"),
    ],
)
def test_invalid_arguments_give_one_line_and_leave_no_file(
    script, arguments, message, tmp_path, capsys
):
    assert script.main([*arguments, "--out", str(tmp_path / "agent.safetensors")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_unknown_task_is_refused_with_a_list_of_tasks(script, capsys):
    with pytest.raises(SystemExit, match="2"):
        script.main(["--task", "unicycle"])
    error = capsys.readouterr().err
    assert "unicycle" in error
    assert "mountain_car_continuous" in error


def test_the_documented_commands_are_valid(script):
    commands = re.findall(r"^\$ python scripts/train_custom_agent\.py (.*)$", PAGE, re.MULTILINE)
    assert commands
    for command in commands:
        tyro.cli(script.Options, args=shlex.split(command)).check()
