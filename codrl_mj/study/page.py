"""The mismatch study as a page of Markdown with figures: every number in it is computed from the runs."""

import collections
import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from codrl_mj.runs.files import writing
from codrl_mj.study import figures, tables
from codrl_mj.study.conclusions import conclusions_section
from codrl_mj.study.experiments import EXPERIMENTS
from codrl_mj.study.mismatch import Results
from codrl_mj.study.plan import Plan
from codrl_mj.study.statistics import RESAMPLES
from codrl_mj.study.summaries import LEAST_RUNS, Summary, summarize

PAGE, FOLDER = "mismatch.md", "mismatch"
"""The page, and the folder beside it with its figures and tables."""
_EXPERIMENTS = """## The experiments

How many comparisons were decided for the one, for the other, or not at all; the tables say what is compared with what.
"""


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
        (name, task): _figure(results, summary, name, task, plan, folder)
        for name, of in results.plans.items()
        for task, plan in of.items()
    }
    written = [path for path in drawn.values() if path is not None]
    written += tables.write(results, summary, folder)
    parts = [
        _head(results),
        conclusions_section(out / PAGE),
        _missing(results),
        _EXPERIMENTS,
        *(_experiment(results, summary, name, drawn) for name in results.plans),
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

`codrl-mj study mismatch` writes this page, its figures and its tables; do not edit it ([how to run it](../studies.md)).
The numbers are files: [runs]({FOLDER}/{tables.RUNS}), [trials]({FOLDER}/{tables.TRIALS}),
[comparisons]({FOLDER}/{tables.COMPARISONS}), [arrivals at the goal in training]({FOLDER}/{tables.ARRIVALS}),
[what the actuators' names stand for]({FOLDER}/{tables.ACTUATORS}).
"""


def _missing(results: Results) -> str:
    """What is not there, and what went wrong."""
    if not (results.untrained or results.untested):
        return ""
    lines = ["## What is missing\n", "The tables are of the runs that there are; each row says of how many.\n"]
    for what, names in (("Not trained", results.untrained), ("Trained, but not tested", results.untested)):
        by_kind: dict[str, list[str]] = {}
        for name in names:
            kind, _, seed = name.rpartition(", seed ")
            by_kind.setdefault(kind, []).append(seed)
        lines += [f"- {what}: {kind}: seed {', '.join(seeds)}" for kind, seeds in by_kind.items()]
    if results.failures:
        lines += ["", "Of these, failed:\n", *(f"- {name}: {error}" for name, error in results.failures.items())]
    return "\n".join(lines) + "\n"


def _figure(results: Results, summary: Summary, name: str, task: str, plan: Plan, folder: Path) -> Path | None:
    """Draw what there is of an experiment on a task; None if there is nothing."""
    means = {trial.name: summary.trials[trial.name] for trial in plan.trials if trial.name in summary.trials}
    if not means:
        return None
    heading = EXPERIMENTS[name].title
    title = f"{task}: {heading[0].lower()}{heading[1:]}"
    path = folder / f"{name}_{task}.svg"
    tests = [test.name for test in plan.tests]
    if plan.series:
        series: dict[str, dict[str, np.ndarray]] = {
            label: {trial.test.name: results.trials[trial.name].returns for trial in trials if trial.name in means}
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
    return path


def _experiment(results: Results, summary: Summary, name: str, drawn: Mapping[tuple[str, str], Path | None]) -> str:
    """What an experiment asks, what came of it on each task, and its first picture."""
    experiment, of = EXPERIMENTS[name], results.plans[name]
    about = textwrap.fill(experiment.about, 120, break_long_words=False)
    shown = next(filter(None, (drawn[name, task] for task in of)), None)
    picture = [f"\n![{experiment.title}]({FOLDER}/{shown.name})"] if shown else []
    return "\n".join([f"### {experiment.title}\n", about, *picture, "", *_outcomes(summary, of, name, drawn)]) + "\n"


def _outcomes(
    summary: Summary, of: Mapping[str, Plan], name: str, drawn: Mapping[tuple[str, str], Path | None]
) -> list[str]:
    """How many comparisons of each task were decided, with its pictures."""
    lines = []
    for task, plan in of.items():
        verdicts = [summary.verdicts[pair] for pair in plan.comparisons if pair in summary.verdicts]
        counts = collections.Counter(verdict.outcome for verdict in verdicts)
        said = ", ".join(f"{counts[outcome]} {outcome}" for outcome in ("better", "worse", "undecided"))
        absent = len(plan.comparisons) - len(verdicts)
        picture = drawn[name, task]
        link = f" ([figure]({FOLDER}/{picture.name}))" if picture else ""
        lines.append(f"- {task}: {said}{f', {absent} without runs' if absent else ''}{link}")
    return lines


_METHOD = f"""## How the numbers are made

A score is the mean return of one trained policy over its test episodes. Training runs are what differs from seed to
seed, so intervals are over runs: 95 % percentiles of {RESAMPLES} stratified bootstrap resamples, in which the runs of
each kind are drawn anew, and scores of the same run stay together. The interquartile mean leaves out the best and the
worst quarter of the runs; the probability of improvement is that of a run of the one kind beating a run of the other,
ties counting half (both: [Agarwal et al. 2021](https://arxiv.org/abs/2108.13264)). The one is called better or worse if
that interval leaves out 0.5 and there are at least {LEAST_RUNS} runs of either. Many comparisons are made, and none is
corrected for their number; with few runs bootstrap intervals are too narrow rather than too wide.
"""
