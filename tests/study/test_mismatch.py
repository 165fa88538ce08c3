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


def read_rows(out, name="runs"):
    with (out / "mismatch" / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def number(text):
    return float(text) if text else None


def read_trials(out):
    return {f"{row['task']}: {row['trained']} on {row['tested']}": row for row in read_rows(out, "trials")}


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
    summaries = read_trials(out)
    for (trained, tested), by_seed in found.items():
        summary = summaries[f"cartpole: {trained} on {tested}"]
        values = list(by_seed.values())
        assert int(summary["runs"]) == 2
        assert float(summary["mean"]) == pytest.approx(np.mean(values), rel=1e-12)
        assert float(summary["interquartile_mean"]) == pytest.approx(trim_mean(values, 0.25), rel=1e-12)
    (verdict,) = (
        one for one in read_rows(out, "comparisons") if one["question"] == "trained on it, over trained on ideal"
    )
    pairs = itertools.product(found["weaker", "weaker"].values(), found["ideal", "weaker"].values())
    expected = np.mean([(one > other) + 0.5 * (one == other) for one, other in pairs])
    assert float(verdict["probability_of_improvement"]) == expected
    assert (verdict["runs_one"], verdict["runs_other"], verdict["outcome"]) == ("2", "2", "undecided")


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
    assert len(drawings) == 7
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
    summaries = read_trials(out)
    assert set(summaries) == set(trials(config))
    for name, trial in trials(config).items():
        missing = [seed for seed in range(5) if f"cartpole: {trial.arm.name}, seed {seed}" in MISSING]
        values = [score(trial, seed) for seed in range(5) if seed not in missing]
        summary = {
            key: number(text) for key, text in summaries[name].items() if key not in ("task", "trained", "tested")
        }
        assert summary["runs"] == len(values) == 5 - len(missing)
        assert summary["mean"] == pytest.approx(np.mean(values), rel=1e-12)
        middle = summary["interquartile_mean"]
        assert middle == pytest.approx(trim_mean(values, 0.25), rel=1e-12)
        low, high = summary["interquartile_low"], summary["interquartile_high"]
        assert min(values) <= low <= middle <= high <= max(values)
        assert (summary["lowest"], summary["highest"]) == (min(values), max(values))
        assert summary["success"] == 0.5
        assert summary["tracking_percent"] is None


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
    missing = page.partition("## What is missing")[2].partition("## The experiments")[0]
    assert "- Not trained: cartpole: weaker: seed 0, 3\n" in missing
    assert "- Not trained: cartpole: open_loop, dqn: seed 2\n" in missing
    assert missing.count("Not trained") == 2
    assert "147 of 150 trainings are finished" in page
    assert read_trials(out)["cartpole: weaker on weaker"]["runs"] == "3"
    undecided = [row["tests"] for row in read_rows(out, "comparisons") if row["outcome"] == "undecided"]
    assert "weaker" in undecided  # three runs decide nothing, whatever they are


@pytest.mark.matrix
def test_the_page_is_short_and_counts_what_the_table_decides(partial):
    _, out, _ = partial
    page = (out / "mismatch.md").read_text()
    assert len(page.splitlines()) <= 150
    found = {}
    for row in read_rows(out, "comparisons"):
        if row["experiment"] == "matrix" and ";" not in row["tests"]:  # not those over several tests
            found[row["outcome"]] = found.get(row["outcome"], 0) + 1
    outcomes = ("better", "worse", "undecided")
    assert "- cartpole: " + ", ".join(f"{found.get(one, 0)} {one}" for one in outcomes) in page


def test_a_study_without_runs_has_a_page_that_says_so(tmp_path):
    config = MismatchConfig(tmp_path / "none", ("cartpole",), ("matrix", "ladder"))
    files = write(collect(config), tmp_path / "out")
    assert not [path for path in files if path.suffix == ".svg"]
    page = (tmp_path / "out" / "mismatch.md").read_text()
    assert "0 of 60 trainings are finished" in page
    assert page.count("without runs") == 2
    assert not config.root.exists()


def test_a_single_run_has_no_interval(tmp_path):
    config = MismatchConfig(tmp_path / "runs", ("pendulum",), ("ladder",), 1)
    pretend(config, score)
    write(collect(config), tmp_path)
    assert {trial["interquartile_low"] for trial in read_rows(tmp_path, "trials")} == {""}
    assert {one["outcome"] for one in read_rows(tmp_path, "comparisons")} == {"undecided"}


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
    rows = read_rows(tmp_path, "arrivals")
    assert {row["task"] for row in rows} == {"acrobot"}
    keys = ("trained", "seed", "episodes", "arrived", "first", "return_in_test_there")
    found = {(row["trained"], row["seed"]): tuple(row[key] for key in keys[2:]) for row in rows}
    assert found["ideal", "0"] == ("4", "2", "2", "-80.25")
    assert found["ideal", "2"] == ("0", "0", "", "-82.25")
    assert found["weaker, dqn", "2"] == ("3", "1", "3", "-82.25")
    assert len(found) == len(rows) == 17


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
