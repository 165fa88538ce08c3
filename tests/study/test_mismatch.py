"""The mismatch study from the runs to the page, and what is said of runs that are not there."""

import csv
import dataclasses
import itertools
import json
import xml.etree.ElementTree

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from codrl_mj.cli import main
from codrl_mj.study.arrivals import ends_at_goal
from codrl_mj.study.cost import costs, seeds_finished
from codrl_mj.study.grid import cell_folder
from codrl_mj.study.mismatch import MismatchConfig, cells, collect, compute, deployments, trials
from codrl_mj.study.page import write
from codrl_mj.study.parallel import Workers
from codrl_mj.study.summaries import LEAST_RUNS, judge, summarize
from codrl_mj.tasks import TASKS
from codrl_mj.training import finished, load_config
from tests.study.pretended import pretend

ONE = Workers(jobs=1)


def score(trial, seed):
    """A return that nothing else has, in CartPole's range."""
    own = trial.arm.condition.name == trial.test.name
    spread = sum(map(ord, trial.name)) % 97
    return 100.0 + (250.0 if own else 0.0) + spread + 3.25 * ((7 * seed + spread) % 5)


def read_rows(out):
    with (out / "mismatch" / "runs.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_results(out):
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads((out / "mismatch" / "results.json").read_text(), parse_constant=refuse)


# -- a real study -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Two conditions and two seeds, trained for a rollout."""
    folder = tmp_path_factory.mktemp("study")
    config = MismatchConfig(folder / "runs", ("cartpole",), ("matrix",), 2, 3, ("ideal", "weaker"), total_steps=512)
    seen = []
    compute(config, ONE, on_cell=lambda kind, name: seen.append((kind, name)))
    write(collect(config), folder / "out")
    return config, folder / "out", seen


@pytest.mark.matrix
def test_a_study_trains_every_cell_and_tests_it_on_every_actuator(real):
    config, _, seen = real
    assert [kind for kind, _ in seen] == ["training"] * 4 + ["test"] * 8
    results = collect(config)
    assert (results.runs, results.untrained, results.untested, dict(results.failures)) == (4, (), (), {})
    for run in (cell_folder(config.root, cell) for cell in cells(config).values()):
        assert finished(run)
        assert load_config(run).env.options.center_radius == 0.1


@pytest.mark.matrix
def test_the_numbers_are_those_of_the_evaluations_in_the_run_folders(real):
    """Read from the folders by what the files say themselves, and reduced by scipy and by counting."""
    config, out, _ = real
    found = {}
    for run in config.root.glob("cartpole-*"):
        trained = json.loads((run / "config.json").read_text())["train"]
        for record in (run / "deployments").iterdir():
            evaluation = json.loads(record.read_text())
            assert evaluation["conditions"]["env"]["options"] == {}
            names = (
                "ideal" if of is None else "weaker"
                for of in (trained["env"]["actuator"], evaluation["conditions"]["env"]["actuator"])
            )
            found.setdefault(tuple(names), {})[trained["seed"]] = evaluation["returns"]["mean"]
    assert len(found) == 4
    rows = {(row["trained"], row["tested"], int(row["seed"])): float(row["return"]) for row in read_rows(out)}
    assert rows == {(*key, seed): value for key, by_seed in found.items() for seed, value in by_seed.items()}
    content = read_results(out)
    page = (out / "mismatch.md").read_text()
    for (trained, tested), by_seed in found.items():
        summary = content["trials"][f"cartpole: {trained} on {tested}"]["summary"]
        values = list(by_seed.values())
        assert summary["mean"] == pytest.approx(np.mean(values), rel=1e-12)
        assert summary["interquartile_mean"]["mean"] == pytest.approx(trim_mean(values, 0.25), rel=1e-12)
        assert f"| `{trained}` | `{tested}` | 2 | {shown(np.mean(values))} |" in page
    (verdict,) = (one for one in content["comparisons"] if one["question"] == "trained on it, over trained on ideal")
    pairs = itertools.product(found["weaker", "weaker"].values(), found["ideal", "weaker"].values())
    expected = np.mean([(one > other) + 0.5 * (one == other) for one, other in pairs])
    assert verdict["probability"]["mean"] == expected
    assert (verdict["runs"], verdict["outcome"]) == ([2, 2], "undecided")


def shown(value):
    return f"{value:.1f}" if abs(value) < 100 else f"{value:.0f}"


@pytest.mark.matrix
def test_a_finished_study_is_not_computed_again(real):
    config, _, _ = real
    before = {path: path.stat().st_mtime_ns for path in config.root.rglob("*")}
    compute(config, ONE)
    assert {path: path.stat().st_mtime_ns for path in config.root.rglob("*")} == before


@pytest.mark.matrix
def test_a_policy_that_cannot_be_tested_is_listed_and_stops_nothing(real, tmp_path, capsys):
    config, _, _ = real
    line = f"--root {config.root} --tasks cartpole --experiments matrix --conditions ideal weaker --seeds 2"
    line = ["study", "mismatch", *line.split(), "--total-steps", "512", "--episodes", "2", "--jobs", "1"]
    broken = cell_folder(config.root, cells(config)["cartpole: ideal, seed 1"]) / "policy.json"
    content = broken.read_text()
    broken.write_text("{")
    try:
        assert main([*line, "--out", str(tmp_path)]) == 1
    finally:
        broken.write_text(content)
    error = capsys.readouterr().err
    assert error.count("failed: cartpole: ideal on ") == 2
    page = (tmp_path / "mismatch.md").read_text()
    assert "- Trained, but not tested: cartpole: ideal on weaker: seed 1" in page
    assert "cartpole: ideal on ideal, seed 1: " in page.partition("Of these, failed:")[2]
    assert len(read_rows(tmp_path)) == 6
    assert main([*line, "--out", str(tmp_path)]) == 0  # mended
    assert len(read_rows(tmp_path)) == 8
    assert "What is missing" not in (tmp_path / "mismatch.md").read_text()
    assert list((config.root / "failures").iterdir()) == []


# -- studies of pretended runs ------------------------------------------------------------------------------

MISSING = ("cartpole: weaker, seed 0", "cartpole: weaker, seed 3", "cartpole: open_loop, dqn, seed 2")


@pytest.fixture(scope="module")
def partial(tmp_path_factory):
    """Most of CartPole's study, written as if it had been run."""
    folder = tmp_path_factory.mktemp("partial")
    config = MismatchConfig(folder / "runs", ("cartpole",), seeds=LEAST_RUNS + 1)
    pretend(config, score, MISSING)
    out = folder / "out"
    out.mkdir()
    (out / "mismatch_conclusions.md").write_text("What a person wrote.\n")
    return config, out, write(collect(config), out)


def test_the_default_study_is_as_large_as_documented():
    config = MismatchConfig()
    assert len(cells(config)) == 5 * (30 + 27 + 26)
    assert sum(map(len, deployments(config).values())) == 5 * len(trials(config))
    assert list(cells(config))[:2] == ["cartpole: ideal, seed 0", "cartpole: paper, seed 0"]


@pytest.mark.matrix
def test_page_tables_and_figures_are_written_whole(partial):
    _, out, files = partial
    assert all(path.is_file() for path in files)
    assert {path for path in out.rglob("*") if path.is_file()} == {*files, out / "mismatch_conclusions.md"}
    page = (out / "mismatch.md").read_text()
    drawings = [path for path in files if path.suffix == ".svg"]
    assert len(drawings) == 2 * 7
    for path in drawings:
        assert xml.etree.ElementTree.parse(path).getroot().tag == "{http://www.w3.org/2000/svg}svg"
        assert f"(mismatch/{path.name})" in page
    assert "nan" not in page.lower().split()


@pytest.mark.matrix
def test_a_page_is_written_alike_and_keeps_what_a_person_wrote(partial):
    config, out, files = partial
    before = {path: path.read_bytes() for path in [*files, out / "mismatch_conclusions.md"]}
    write(collect(config), out)
    assert {path: path.read_bytes() for path in before} == before
    assert "## Conclusions\n\nWhat a person wrote.\n" in (out / "mismatch.md").read_text()


@pytest.mark.matrix
def test_every_trial_is_summarised_from_its_runs(partial):
    config, out, _ = partial
    content = read_results(out)
    assert set(content["trials"]) == set(trials(config))
    for name, trial in trials(config).items():
        missing = [seed for seed in range(5) if f"cartpole: {trial.arm.name}, seed {seed}" in MISSING]
        values = [score(trial, seed) for seed in range(5) if seed not in missing]
        summary = content["trials"][name]["summary"]
        assert summary["runs"] == len(values) == 5 - len(missing)
        assert summary["mean"] == pytest.approx(np.mean(values), rel=1e-12)
        interval = summary["interquartile_mean"]
        assert interval["mean"] == pytest.approx(trim_mean(values, 0.25), rel=1e-12)
        assert min(values) <= interval["low"] <= interval["mean"] <= interval["high"] <= max(values)
        assert (summary["lowest"], summary["highest"]) == (min(values), max(values))
        assert summary["measures"]["success"] == 0.5
        assert summary["measures"]["tracking_percent"] is None


@pytest.mark.matrix
def test_every_comparison_is_mann_whitneys(partial):
    config, _, _ = partial
    results = collect(config)
    summary = summarize(results)
    assert len(summary.verdicts) > 60
    for pair, verdict in summary.verdicts.items():
        one, other = (results.trials[trial.name].returns for trial in (pair.one, pair.other))
        expected = mannwhitneyu(one, other).statistic / (len(one) * len(other))
        assert verdict.probability.mean == pytest.approx(expected, rel=1e-12)
        assert (verdict.one, verdict.other) == pytest.approx((one.mean(), other.mean()), rel=1e-12)
        enough = min(len(one), len(other)) >= LEAST_RUNS
        outcome = "better" if one.min() > other.max() else "worse" if one.max() < other.min() else None
        if outcome is not None:
            assert verdict.outcome == (outcome if enough else "undecided")


@pytest.mark.matrix
def test_comparisons_over_several_tests_are_their_mean(partial):
    config, _, _ = partial
    results = collect(config)
    plan = results.plans["matrix"]["cartpole"]
    asked = [pair for pair in plan.comparisons if pair.question == "trained on it, over trained on ideal"]
    alone = [judge(results, [pair]).probability.mean for pair in asked]
    together = judge(results, asked)
    assert together.probability.mean == pytest.approx(np.mean(alone), rel=1e-12)
    assert together.tests == tuple(pair.one.test.name for pair in asked)
    assert together.runs == (3, 5)


@pytest.mark.matrix
def test_missing_runs_are_named_and_counted(partial):
    _, out, _ = partial
    page = (out / "mismatch.md").read_text()
    missing = page.partition("## What is missing")[2].partition("## Train on one")[0]
    assert "- Not trained: cartpole: weaker: seed 0, 3\n" in missing
    assert "- Not trained: cartpole: open_loop, dqn: seed 2\n" in missing
    assert missing.count("Not trained") == 2
    assert "147 of 150 trainings are finished" in page
    assert "| `weaker` | `weaker` | 3 |" in page
    assert "undecided on `weaker`" in page  # three runs decide nothing, whatever they are


@pytest.mark.matrix
def test_the_findings_have_the_tables_numbers(partial):
    config, out, _ = partial
    page = (out / "mismatch.md").read_text()
    every = trials(config)

    def mean(name, seeds=range(5)):
        return shown(np.mean([score(every[f"cartpole: {name}"], seed) for seed in seeds]))

    findings = page.partition("**trained on it, over trained on ideal**: better on ")[2].partition("\n")[0]
    for name in ("open_loop", "slow_winding", "delay"):
        assert f"`{name}` ({mean(f'{name} on {name}')} against {mean(f'ideal on {name}')})" in findings
    assert f"`weaker` ({mean('weaker on weaker', (1, 2, 4))} against {mean('ideal on weaker')})" in findings


def test_a_study_without_runs_has_a_page_that_says_so(tmp_path):
    config = MismatchConfig(tmp_path / "none", ("cartpole",), ("matrix", "ladder"))
    files = write(collect(config), tmp_path / "out")
    assert not [path for path in files if path.suffix == ".svg"]
    page = (tmp_path / "out" / "mismatch.md").read_text()
    assert "0 of 60 trainings are finished" in page
    assert page.count("no runs on") == 4
    assert not config.root.exists()


def test_a_single_run_has_no_interval(tmp_path):
    config = MismatchConfig(tmp_path / "runs", ("pendulum",), ("ladder",), 1)
    pretend(config, score)
    write(collect(config), tmp_path)
    content = read_results(tmp_path)
    assert all(trial["summary"]["interquartile_mean"]["low"] is None for trial in content["trials"].values())
    assert {one["outcome"] for one in content["comparisons"]} == {"undecided"}


def test_arrivals_at_the_goal_are_counted_where_episodes_end_there(tmp_path):
    assert [task for task in TASKS if ends_at_goal(task)] == [
        "acrobot",
        "mountain_car",
        "mountain_car_continuous",
    ]
    config = MismatchConfig(tmp_path / "runs", ("acrobot", "pendulum"), ("agents",), 3)
    pretend(config, lambda _, seed: -80.25 - seed, ["acrobot: weaker, dqn, seed 1"])
    lengths = {"ideal": [[500, 80, 500, 70], [90] * 7, []], "weaker, dqn": [[500] * 3, None, [500, 500, 499]]}
    for name, cell in cells(config).items():
        task, _, rest = name.partition(": ")
        arm, _, seed = rest.rpartition(", seed ")
        found = lengths.get(arm, [[500]] * 3)[int(seed)]
        if task == "acrobot" and found is not None:
            rows = [f"{index},{index},{-length},{length}" for index, length in enumerate(found, start=1)]
            text = "\n".join(["episode,steps,return,length", *rows])
            (cell_folder(config.root, cell) / "episodes.csv").write_text(text + "\n")
    write(collect(config), tmp_path)
    page = (tmp_path / "mismatch.md").read_text().partition("## Who met the goal")[2].partition("## The actuators")[0]
    assert "| `ideal` | 2, 1, never | 50, 100, 0 | -80.2, -81.2, -82.2 |\n" in page
    assert "| `weaker, dqn` | never, 3 | 0, 33 | -80.2, -82.2 |\n" in page
    assert page.count("| `") == 6
    assert "pendulum" not in page
    arrivals = read_results(tmp_path)["arrivals"]
    assert arrivals["acrobot: ideal, seed 0"] == {"episodes": 4, "arrived": 2, "first": 2}
    assert arrivals["acrobot: ideal, seed 2"] == {"episodes": 0, "arrived": 0, "first": None}
    assert len(arrivals) == 17


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("episode,steps,return,length\n1,2,three,4\n", "three"),
        ("episode,steps,return,length\n1,2,3\n", "reshape"),
        ("episode,steps,length\n1,2,3\n", "'episode,steps,length': must be"),
        ("", "'': must be"),
    ],
)
def test_a_damaged_table_of_episodes_is_named(text, expected, tmp_path):
    config = MismatchConfig(tmp_path / "runs", ("acrobot",), ("agents",), 1)
    pretend(config, score)
    for cell in cells(config).values():
        (cell_folder(config.root, cell) / "episodes.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"episodes\.csv: not a table of episodes: .*{expected}"):
        collect(config)


@pytest.mark.matrix
def test_a_training_that_failed_is_listed_with_its_error(partial, tmp_path):
    config = dataclasses.replace(partial[0], experiments=("agents",))
    cell = cells(config)["cartpole: weaker, seed 0"]
    record = config.root / "failures" / f"{cell_folder(config.root, cell).name}.json"
    record.parent.mkdir()
    record.write_text(json.dumps({"error": "the current loop is unstable", "train": cell.as_mapping()}))
    try:
        write(collect(config), tmp_path)
    finally:
        record.unlink()
    assert "- cartpole: weaker, seed 0: the current loop is unstable\n" in (tmp_path / "mismatch.md").read_text()


# -- what it takes ------------------------------------------------------------------------------------------


@pytest.mark.matrix
def test_the_cost_is_that_of_the_finished_runs(partial):
    config, _, _ = partial
    ppo, dqn = costs(config)
    assert (ppo.agent, ppo.trainings, ppo.trained) == ("ppo", 135, 133)
    assert (dqn.agent, dqn.trainings, dqn.trained) == ("dqn", 15, 14)
    assert ppo.seconds == dqn.seconds == 10.0  # as the pretended runs say
    assert ppo.tests - ppo.tested == 2 * sum(trial.arm.name == "weaker" for trial in trials(config).values())
    assert ppo.left == pytest.approx(2 * 10.0 + (ppo.tests - ppo.tested) * ppo.test_seconds, rel=1e-12)
    assert seeds_finished(config)["cartpole: weaker"] == {0: False, 1: True, 2: True, 3: False, 4: True}


def test_the_default_study_stays_below_four_hours_of_two_cores(tmp_path):
    assert sum(cost.total for cost in costs(MismatchConfig(tmp_path))) < 4 * 3600 * 2


def test_a_dry_run_computes_and_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["study", "mismatch", "--dry-run", "--tasks", "cartpole", "--seeds", "2", "--jobs", "2"]) == 0
    text = capsys.readouterr().out
    for arm in ("cartpole: ideal", "cartpole: weaker, plain reward", "cartpole: paper, voltage, current observed"):
        assert arm in text
    assert "core hours are left" in text
    assert "with 2 jobs" in text
    assert list(tmp_path.iterdir()) == []


# -- bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("tasks", ("cartpol",), "did you mean 'cartpole'"),
        ("tasks", ("mountain_car",), "Known are cartpole, pendulum, acrobot"),
        ("tasks", (), "name one or more"),
        ("experiments", ("matrx",), "did you mean 'matrix'"),
        ("conditions", ("weakr",), "did you mean 'weak"),
        ("seeds", 0, "seeds = 0: must be an integer >= 1"),
        ("seeds", 2.5, "seeds = 2.5: must be an integer >= 1"),
        ("episodes", 0, "episodes = 0: must be an integer >= 1"),
        ("total_steps", -1, "total_steps = -1: must be an integer >= 1"),
    ],
)
def test_bad_configurations_are_refused(field, value, expected):
    with pytest.raises(ValueError, match=field[:-1]) as caught:
        dataclasses.replace(MismatchConfig(), **{field: value})
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--tasks cartpol", "did you mean 'cartpole'"),
        ("--experiments matrx --dry-run", "did you mean 'matrix'"),
        ("--conditions weakr --only-page", "did you mean 'weak"),
        ("--seeds 0 --dry-run", "seeds = 0"),
        ("--jobs 0", "jobs = 0"),
        ("--out file/below", "file is not a folder"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_written(flags, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert main(["study", "mismatch", *flags.split()]) == 2
    assert expected in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
