"""Tables in the terminal: width and content."""

import contextlib
import io

import pytest

from codrl_mj.cli.evaluate import print_evaluations
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import MEASURES, RandomPolicy, evaluate


@pytest.fixture(scope="module")
def results():
    """Return evaluations of random policies by task and actuator."""
    return {
        (task, actuator): evaluate(
            RandomPolicy(task), EnvConfig(task, actuator, max_episode_steps=30), episodes=3
        )
        for task, actuator in (
            ("cartpole", "ideal"),
            ("cartpole", "weaker"),
            ("acrobot", "paper"),
            ("pendulum", "weak"),
        )
    }


def printed(evaluations, **options):
    """Return the tables as lines of a terminal, without trailing spaces."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        print_evaluations(evaluations, **options)
    return [line.rstrip() for line in out.getvalue().splitlines()]


def test_a_row_has_the_main_measures(results):
    result = results["cartpole", "weaker"]
    lines = printed({"mine": result}, details=False)
    (row,) = (line for line in lines if "mine" in line)
    assert (
        " ".join(row.split()) == f"mine {100 * result.success.mean:.0f} % {result.returns.mean:.1f}"
        f" [{result.returns.low:.1f}, {result.returns.high:.1f}] {result.tracking_rms:.3g} N·m"
        f" {result.saturated_percent:.1f} % {result.peak_voltage:.1f} V"
        f" {result.energy_drawn.mean:.3g} J"
    )
    assert "3 episodes per row" in lines[0]


def test_missing_measures_of_an_ideal_actuator_are_dashes(results):
    lines = printed(
        {"perfect": results["cartpole", "ideal"], "mine": results["cartpole", "weaker"]}
    )
    (row,) = (line for line in lines if line.split()[:1] == ["perfect"])
    assert row.split()[-3:] == ["–", "–", "–"]
    ideal_table = "\n".join(printed({"perfect": results["cartpole", "ideal"]}))
    assert "|u|" not in ideal_table  # No column consists of dashes.
    assert "copper" not in ideal_table
    assert "time" not in ideal_table.split("measure")[0]  # A pole has no time to goal.


@pytest.mark.parametrize("count", [1, 2, 4])
def test_tables_fit_the_terminal_without_breaking_numbers(results, count):
    names = [
        f"a policy with a long name, the {index}th of them, on [some] actuator"
        for index in range(count)
    ]
    lines = printed(dict(zip(names, results.values(), strict=False)))
    assert max(map(len, lines)) <= 110
    text = "\n".join(lines)
    for result in list(results.values())[:count]:
        assert "{:.1f} [{:.1f}, {:.1f}]".format(*result.returns) in text
        assert f"{result.tracking_rms:.3g} N·m" in text


def test_every_measure_is_in_one_of_the_tables(results):
    result = results["pendulum", "weak"]
    text = " ".join(" ".join(printed({"mine": result})).split())
    for name, field in MEASURES.items():
        shown_above = name in (
            "returns",
            "failure",
            "tracking_rms",
            "saturated_percent",
            "peak_voltage",
        )
        has_row = f"{field.metadata['label']} [" in text
        assert has_row != (shown_above or getattr(result, name) is None), name
    assert f"copper loss [J] {result.copper_loss.mean:.3g} [{result.copper_loss.low:.3g}," in text
    assert f"{result.terminated} task, {3 - result.terminated} time limit" in text
