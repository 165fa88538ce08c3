"""The mismatch study as a page of Markdown with figures: every number in it is computed from the runs."""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.runs.files import writing
from codrl_mj.study import figures, tables
from codrl_mj.study.conclusions import conclusions_section
from codrl_mj.study.conditions import every_condition
from codrl_mj.study.experiments import EXPERIMENTS
from codrl_mj.study.mismatch import Results, cell_name
from codrl_mj.study.plan import Comparison, Plan, Trial
from codrl_mj.study.statistics import RESAMPLES
from codrl_mj.study.summaries import LEAST_RUNS, Summary, Verdict, by_question, judge, over_all_tests, summarize

PAGE, FOLDER = "mismatch.md", "mismatch"
"""The page, and the folder beside it with its figures and tables."""
_UNITS = {
    "success": ("success", "%", 100.0),
    "tracking_percent": ("torque error", "%", 1.0),
    "saturated_percent": ("saturated", "%", 1.0),
    "peak_current": ("peak current", "A", 1.0),
    "rms_current": ("rms current", "A", 1.0),
    "energy_drawn": ("energy drawn", "J", 1.0),
}


def write(results: Results, out: Path) -> list[Path]:
    """Write page, figures and tables.

    Args:
        results: of the study; whatever is missing is named on the page.
        out: folder for the page.

    Returns:
        The files that were written.
    """
    folder, summary = out / FOLDER, summarize(results)
    drawn = {
        (name, task): _figures(results, summary, name, task, plan, folder)
        for name, of in results.plans.items()
        for task, plan in of.items()
    }
    written = [path for paths in drawn.values() for path in paths]
    written += tables.write(results, summary, folder)
    parts = [
        _head(results),
        conclusions_section(out / PAGE),
        _missing(results),
        *(_experiment(results, summary, name, drawn) for name in results.plans),
        _arrivals(results),
        _actuators(results),
        _METHOD,
    ]
    with writing(out / PAGE) as temporary:
        temporary.write_text("\n".join(part for part in parts if part))
    return [out / PAGE, *written]


def _head(results: Results) -> str:
    config = results.config
    total = results.runs + len(results.untrained)
    arms = [result.trial.arm for result in results.trials.values()]
    agents = {task: dict.fromkeys(arm.agent.upper() for arm in arms if arm.task == task) for task in config.tasks}
    acted = "; ".join(f"{task}: {', '.join(names)}" for task, names in agents.items())
    codes = ", ".join(f"`{code}` ({count})" for code, count in sorted(results.codes.items())) or "none"
    return f"""# The mismatch study

What does it cost to train on another actuator than the one that there will be?

{results.runs} of {total} trainings are finished ({results.seconds / 3600:.1f} hours of one core, in all), with up to
{config.seeds} seeds each; every policy was tested in {config.episodes} episodes on every actuator in question, with
Gymnasium's own reward and time limit.

- Agents: {acted}
- Versions of the code that trained, by digest, with the number of runs: {codes}

`codrl-mj study mismatch` writes this page, its figures and its tables; do not edit it. [How to run it](../studies.md);
[every run]({FOLDER}/{tables.RUNS}) and [every number]({FOLDER}/{tables.RESULTS}) as files.
"""


def _missing(results: Results) -> str:
    """What is not there, and what went wrong."""
    if not (results.untrained or results.untested):
        return ""
    lines = ["## What is missing\n", "The tables below are of the runs that there are; each says how many.\n"]
    for what, names in (("Not trained", results.untrained), ("Trained, but not tested", results.untested)):
        by_kind: dict[str, list[str]] = {}
        for name in names:
            kind, _, seed = name.rpartition(", seed ")
            by_kind.setdefault(kind, []).append(seed)
        lines += [f"- {what}: {kind}: seed {', '.join(seeds)}" for kind, seeds in by_kind.items()]
    if results.failures:
        lines += ["", "Of these, failed:\n", *(f"- {name}: {error}" for name, error in results.failures.items())]
    return "\n".join(lines) + "\n"


def _figures(results: Results, summary: Summary, name: str, task: str, plan: Plan, folder: Path) -> list[Path]:
    """Draw what there is of an experiment on a task."""
    means = {trial.name: summary.trials[trial.name] for trial in plan.trials if trial.name in summary.trials}
    if not means:
        return []
    heading = EXPERIMENTS[name].title
    title = f"{task}: {heading[0].lower()}{heading[1:]}"
    path = folder / f"{name}_{task}.svg"
    tests = [test.name for test in plan.tests]
    if plan.series:
        series: dict[str, dict[str, tuple[Interval, np.ndarray]]] = {
            label: {
                trial.test.name: (means[trial.name].interquartile_mean, results.trials[trial.name].returns)
                for trial in trials
                if trial.name in means
            }
            for label, trials in plan.series
        }
        figures.points(path, {label: found for label, found in series.items() if found}, tests, title)
    else:
        rows = [arm.name for arm in plan.arms]
        values = np.full((len(rows), len(tests)), np.nan)
        for trial in plan.trials:
            if trial.name in means:
                values[rows.index(trial.arm.name), tests.index(trial.test.name)] = means[trial.name].mean
        figures.heat_map(path, values, rows, tests, title)
    questions: dict[str, dict[str, Interval]] = {}
    for pair in plan.comparisons:
        if pair in summary.verdicts:
            questions.setdefault(pair.question, {})[pair.one.test.name] = summary.verdicts[pair].probability
    if not questions:
        return [path]
    compared = folder / f"{name}_{task}_improvement.svg"
    figures.probabilities(compared, questions, f"{task}: which is better?")
    return [path, compared]


def _experiment(results: Results, summary: Summary, name: str, drawn: Mapping[tuple[str, str], Sequence[Path]]) -> str:
    experiment, of = EXPERIMENTS[name], results.plans[name]
    parts = [f"## {experiment.title}\n", textwrap.fill(experiment.about, 120, break_long_words=False) + "\n"]
    for task, plan in of.items():
        parts += [f"### {task}\n"]
        parts += [f"![{path.stem}]({FOLDER}/{path.name})\n" for path in drawn[name, task]]
        if not plan.series:
            parts += [_means(results, summary, plan)]
        parts += [_findings(summary, plan), _details(summary, plan)]
    pooled = _pooled(results, of)
    if pooled:
        parts += ["### All tests together\n", pooled]
    return "\n".join(parts)


def _means(results: Results, summary: Summary, plan: Plan) -> str:
    """The mean returns: rows trained on, columns tested on."""
    tests = [test.name for test in plan.tests]
    complete = all(f"{arm.task}: {arm.name} on {test}" in results.trials for arm in plan.arms for test in tests)
    rows = []
    for arm in plan.arms:
        mine = {trial.test.name: trial for trial in plan.trials if trial.arm.name == arm.name}
        row = [f"`{arm.name}`"]
        for test in tests:
            found = summary.trials.get(mine[test].name) if test in mine else None
            row.append("–" if found is None else _number(found.mean))
        if complete and len(tests) > 1:
            together = over_all_tests(results, list(mine.values()))
            row.append("–" if together is None else _interval(together[1]))
        rows.append(row)
    last = ["interquartile mean over all"] if complete and len(tests) > 1 else []
    return "Mean returns; rows are what was trained on, columns what it was tested on:\n\n" + _table(
        ["", *(f"`{test}`" for test in tests), *last], rows
    )


def _findings(summary: Summary, plan: Plan) -> str:
    """What was decided on one task, in words."""
    lines = []
    for question, asked in by_question(plan.comparisons).items():
        verdicts = [summary.verdicts.get(pair) for pair in asked]
        found = [verdict for verdict in verdicts if verdict is not None]
        parts = [
            f"{outcome} on " + ", ".join(_against(verdict) for verdict in found if verdict.outcome == outcome)
            for outcome in ("better", "worse", "undecided")
            if any(verdict.outcome == outcome for verdict in found)
        ]
        without = [pair.one.test.name for pair, verdict in zip(asked, verdicts, strict=True) if verdict is None]
        parts += [f"no runs on {', '.join(map('`{}`'.format, without))}"] if without else []
        lines.append(f"- **{question}**: {'; '.join(parts)}")
    return "\n".join(lines) + "\n" if lines else ""


def _against(verdict: Verdict) -> str:
    return f"`{verdict.tests[0]}` ({_number(verdict.one)} against {_number(verdict.other)})"


def _details(summary: Summary, plan: Plan) -> str:
    """Every trial and every comparison, folded away."""
    rows = []
    for trial in plan.trials:
        found = summary.trials.get(trial.name)
        start = [f"`{trial.arm.name}`", f"`{trial.test.name}`"]
        if found is None:
            rows.append([*start, "0", *["–"] * (3 + len(_UNITS))])
            continue
        measures = [
            "–" if found.measures[name] is None else f"{factor * (found.measures[name] or 0.0):.3g}"
            for name, (_, _, factor) in _UNITS.items()
        ]
        ends = f"{_number(found.lowest)} … {_number(found.highest)}"
        returns = [_number(found.mean), _interval(found.interquartile_mean), ends]
        rows.append([*start, str(found.runs), *returns, *measures])
    header = ["trained on", "tested on", "runs", "mean return", "interquartile mean", "runs' range"]
    every = _table([*header, *(f"{label} [{unit}]" for label, unit, _ in _UNITS.values())], rows)
    verdicts = [summary.verdicts[pair] for pair in plan.comparisons if pair in summary.verdicts]
    compared = _verdicts(verdicts, lambda verdict: f"`{verdict.tests[0]}`", "tested on")
    return f"<details><summary>Every number</summary>\n\n{every}\n{compared}\n</details>\n"


def _pooled(results: Results, of: Mapping[str, Plan]) -> str:
    """The questions over all tests of each task, and over all tasks."""
    asked = by_question(_comparisons(of))
    verdicts: list[tuple[str, Verdict]] = []
    for pairs in asked.values():
        by_task = {task: [pair for pair in pairs if pair.one.arm.task == task] for task in of}
        several = {task: mine for task, mine in by_task.items() if len(mine) > 1}
        groups = several | ({"all tasks": pairs} if sum(map(bool, by_task.values())) > 1 else {})
        verdicts += [(label, verdict) for label, group in groups.items() if (verdict := judge(results, group))]
    labels = {id(verdict): label for label, verdict in verdicts}
    return _verdicts(
        [verdict for _, verdict in verdicts],
        lambda verdict: f"{labels[id(verdict)]} ({len(verdict.tests)} tests)",
        "over",
    )


def _comparisons(of: Mapping[str, Plan]) -> list[Comparison]:
    return [pair for plan in of.values() for pair in plan.comparisons]


def _verdicts(verdicts: Sequence[Verdict], place: Callable[[Verdict], str], heading: str) -> str:
    if not verdicts:
        return ""
    rows = [
        [
            verdict.question,
            place(verdict),
            " / ".join(map(str, verdict.runs)),
            "–" if np.isnan(verdict.one) else _number(verdict.one),
            "–" if np.isnan(verdict.other) else _number(verdict.other),
            _interval(verdict.probability, ".2f"),
            verdict.outcome,
        ]
        for verdict in verdicts
    ]
    header = ["question", heading, "runs", "the one", "the other", "probability of improvement", "the one is"]
    return _table(header, rows)


def _arrivals(results: Results) -> str:
    """Who met the goal in training, and what came of it."""
    arms = {(result.trial.arm.task, result.trial.arm.name): result.trial.arm for result in results.trials.values()}
    rows: dict[str, list[list[str]]] = {}
    for (task, name), arm in arms.items():
        met = {seed: results.arrivals.get(cell_name(task, name, seed)) for seed in range(results.config.seeds)}
        found = {seed: arrivals for seed, arrivals in met.items() if arrivals is not None}
        own = results.trials.get(Trial(arm, arm.condition).name)
        tests = own.evaluations if own else {}
        columns = [
            ["never" if of.first is None else str(of.first) for of in found.values()],
            [f"{100 * of.arrived / max(of.episodes, 1):.0f}" for of in found.values()],
            [_number(tests[seed]["returns"]["mean"]) if seed in tests else "–" for seed in found],
        ]
        if found:
            rows.setdefault(task, []).append([f"`{name}`", *(", ".join(column) for column in columns)])
    header = ["trained on", "first arrival [episode]", "arrivals [% of the episodes]", "mean return in test there"]
    parts = [f"### {task}\n\n{_table(header, of)}" for task, of in rows.items()]
    return "\n".join([_ARRIVALS, *parts]) if parts else ""


def _actuators(results: Results) -> str:
    """What the names stand for."""
    parts = ["## The actuators\n"]
    used = {name for of in results.plans.values() for plan in of.values() for name in _names(plan.trials)}
    for task in results.config.tasks:
        known = every_condition(task)
        rows = [[f"`{name}`", condition.description] for name, condition in known.items() if name in used]
        parts += [f"### {task}\n", _table(["name", "is"], rows)]
    return "\n".join(parts)


def _names(trials: Iterable[Trial]) -> set[str]:
    return {name for trial in trials for name in (trial.test.name, trial.arm.condition.name)}


_ARRIVALS = """## Who met the goal in training

Where only the goal tells one action from another, nothing can be learned before it has been reached once. A number for
each seed, in their order.
"""

_METHOD = f"""## How the numbers are made

A score is the mean return of one trained policy over its test episodes. Training runs are what differs from seed to
seed, so intervals are over runs: 95 % percentiles of {RESAMPLES} stratified bootstrap resamples, in which the runs of
each kind are drawn anew, and scores of the same run stay together. The interquartile mean leaves out the best and the
worst quarter of the runs; the probability of improvement is that of a run of the one kind beating a run of the other,
ties counting half (both: [Agarwal et al. 2021](https://arxiv.org/abs/2108.13264)). The one is called better or worse if
that interval leaves out 0.5 and there are at least {LEAST_RUNS} runs of either. Many comparisons are made, and none is
corrected for their number; with few runs bootstrap intervals are too narrow rather than too wide.
"""


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _number(value: float) -> str:
    return f"{value:.1f}" if abs(value) < 100 else f"{value:.0f}"


def _interval(interval: Interval, form: str | None = None) -> str:
    mean, low, high = (_number(value) if form is None else format(value, form) for value in interval)
    return mean if np.isnan(interval.low) else f"{mean} [{low}, {high}]"
