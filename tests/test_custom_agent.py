"""An agent of one's own: the script learns, repeats itself, looks beyond time limits, and refuses nonsense."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path

import pytest
import torch
import tyro
from safetensors.torch import load_file

SCRIPT = Path(__file__).parent.parent / "scripts" / "train_custom_agent.py"
PAGE = (Path(__file__).parent.parent / "docs" / "other_agents.md").read_text()
TINY = ["--num-envs", "4", "--rollout", "16", "--total-steps", "128", "--minibatches", "2", "--eval-episodes", "2"]


@pytest.fixture(scope="module")
def script():
    """The script, as a module."""
    specification = importlib.util.spec_from_file_location("train_custom_agent", SCRIPT)
    module = importlib.util.module_from_spec(specification)
    sys.modules["train_custom_agent"] = module
    specification.loader.exec_module(module)
    yield module
    del sys.modules["train_custom_agent"]


@pytest.mark.matrix
def test_it_learns_to_balance_and_the_file_holds_what_was_evaluated(script, tmp_path, capsys):
    out = tmp_path / "new" / "agent.safetensors"
    arguments = ["--total-steps", "40000", "--num-envs", "16", "--rollout", "128", "--eval-episodes", "20"]
    arguments += ["--seed", "0", "--out", str(out)]
    assert script.main(["--task", "cartpole", "--actuator", "paper", *arguments]) == 0
    printed = capsys.readouterr().out
    mean = float(re.search(r"greedy return: ([\d.]+)", printed)[1])
    assert mean >= 195  # what Gymnasium's first CartPole called solved; doing nothing useful gives 10 to 25
    assert str(out) in printed.replace("\n", "")

    options = script.Options(task="cartpole", actuator="paper", eval_episodes=20)
    envs = script.make_envs(options, 1)
    agent = script.Agent(envs.single_observation_space, envs.single_action_space, options.hidden)
    envs.close()
    agent.load_state_dict(load_file(out))
    assert script.evaluate(agent, options).mean() == pytest.approx(mean, abs=0.1)


@pytest.mark.parametrize("task", ["cartpole", "pendulum"])  # discrete and continuous actions
def test_a_seed_repeats_the_weights_and_another_does_not(script, task, tmp_path):
    weights = []
    for name, seed in {"one": "3", "two": "3", "other": "4"}.items():
        out = tmp_path / name
        assert script.main(["--task", task, *TINY, "--seed", seed, "--out", str(out)]) == 0
        weights.append(out.read_bytes())
    assert weights[0] == weights[1]
    assert weights[0] != weights[2]


def test_a_value_that_is_right_leaves_no_advantage_except_where_the_task_ends(script):
    # one unit of reward a step for ever is worth 1 / (1 - gamma) from anywhere, time limit or not
    gamma, worth = 0.9, 10.0
    rewards, values = torch.ones(6, 1), torch.full((6, 1), worth)
    never, limit = torch.zeros(6, 1, dtype=torch.bool), torch.zeros(6, 1, dtype=torch.bool)
    limit[2] = True
    for ended in (never, limit):
        gains = script.advantages(rewards, values, values, never, ended, gamma, 0.8)
        torch.testing.assert_close(gains, torch.zeros(6, 1), atol=1e-6, rtol=0)
    gains = script.advantages(rewards, values, values, limit, limit, gamma, 0.8)
    lost = -gamma * worth * (gamma * 0.8) ** torch.tensor([2.0, 1.0, 0.0])  # the loss at step 2, seen from 0, 1 and 2
    torch.testing.assert_close(gains[:, 0], torch.cat([lost, torch.zeros(3)]), atol=1e-5, rtol=0)


def test_advantages_are_the_discounted_sum_of_errors_within_each_episode(script):
    generator = torch.Generator().manual_seed(0)
    rewards, values, after = torch.randn(3, 7, 2, generator=generator)
    ended = torch.rand(7, 2, generator=generator) < 0.3
    terminated = ended & (torch.rand(7, 2, generator=generator) < 0.5)
    gains = script.advantages(rewards, values, after, terminated, ended, 0.9, 0.7)
    for row in range(2):
        for start in range(7):
            total, weight = 0.0, 1.0
            for step in range(start, 7):
                beyond = 0.0 if terminated[step, row] else 0.9 * after[step, row].item()
                total += weight * (rewards[step, row].item() + beyond - values[step, row].item())
                weight *= 0.9 * 0.7
                if ended[step, row]:
                    break
            assert gains[start, row].item() == pytest.approx(total, abs=1e-5)


def test_at_a_time_limit_the_episodes_own_last_observation_is_valued(script, monkeypatch):
    recorded = {}
    original = script.advantages

    def record(rewards, values, next_values, terminated, ended, gamma, lam):
        recorded.update(values=values, next_values=next_values, terminated=terminated, ended=ended)
        return original(rewards, values, next_values, terminated, ended, gamma, lam)

    monkeypatch.setattr(script, "advantages", record)
    monkeypatch.setattr(script.Agent, "value", lambda _, observations: observations[..., 2])  # the pendulum's speed
    script.train(script.Options("pendulum", "ideal", num_envs=4, rollout=210, total_steps=1, minibatches=2))
    values, next_values, ended = recorded["values"], recorded["next_values"], recorded["ended"]
    assert ended.sum() == 4  # the limit of 200 steps
    assert not recorded["terminated"].any()
    running = ~ended[:-1]
    assert (next_values[:-1][running] == values[1:][running]).all()
    assert (next_values[:-1][~running] != values[1:][~running]).all()
    # in one step gravity and the motor change the speed by no more than (15 + 3 * 2) * 0.05 rad/s
    assert (next_values - values).abs().max() <= 1.05 + 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gamma", "1.5"], "--gamma 1.5: must be from 0 to 1"),
        (["--learning-rate", "nan"], "--learning-rate nan: must be from 0 to inf"),
        (["--num-envs", "0"], "--num-envs 0: must be from 1 to inf"),
        (["--num-envs", "2", "--rollout", "3"], "--minibatches 8: must be <= 3, half the steps of a rollout"),
        (["--actuator", "strong"], "strong"),
    ],
)
def test_bad_arguments_cost_one_line_and_leave_nothing(script, arguments, message, tmp_path, capsys):
    assert script.main([*arguments, "--out", str(tmp_path / "agent.safetensors")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_unknown_task_is_answered_with_those_there_are(script, capsys):
    with pytest.raises(SystemExit) as done:
        script.main(["--task", "unicycle"])
    assert done.value.code == 2
    error = capsys.readouterr().err
    assert "unicycle" in error
    assert "mountain_car_continuous" in error


def test_the_documented_commands_are_understood(script):
    commands = re.findall(r"^\$ python scripts/train_custom_agent\.py (.*)$", PAGE, re.MULTILINE)
    assert commands
    for command in commands:
        tyro.cli(script.Options, args=shlex.split(command)).check()
