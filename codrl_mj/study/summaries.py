"""The numbers of the mismatch study's tables, computed from the evaluations of its runs."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.mismatch import Result, Results
from codrl_mj.study.plan import Comparison, Trial
from codrl_mj.study.statistics import Scores, interquartile_mean_interval, probability_of_improvement

LEAST_RUNS = 4
"""Below this many runs of either kind nothing is decided: that every run of the one beats every run of the other
happens by chance once in 20 times with 3 of each, and once in 70 with 4."""

MEASURES = ("success", "tracking_percent", "saturated_percent", "peak_current", "rms_current", "energy_drawn")
"""What is tabulated besides the return: fields of `codrl_mj.evaluation.Evaluation`."""


@dataclasses.dataclass(frozen=True)
class TrialSummary:
    """What a trial came to."""

    runs: int
    """Policies that were tested, >= 1."""
    mean: float
    """Mean of their mean returns."""
    interquartile_mean: Interval
    """Interquartile mean of their mean returns, with its 95 % bootstrap interval."""
    lowest: float
    """The worst policy's mean return."""
    highest: float
    """The best policy's mean return."""
    measures: Mapping[str, float | None]
    """Means of `MEASURES` over the policies; None where there is no such measure."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Whether the one is better than the other, over one or several tests."""

    question: str
    """What was asked."""
    tests: tuple[str, ...]
    """Names of the test conditions, with those of the tasks where several were asked."""
    one: float
    """Mean return of the one; over several tasks it means nothing and is NaN, and so below."""
    other: float
    """Mean return of the other."""
    runs: tuple[int, int]
    """Policies of the one and of the other, in the test that has the fewest."""
    probability: Interval
    """Probability of improvement, with its 95 % bootstrap interval."""

    @property
    def outcome(self) -> Literal["better", "worse", "undecided"]:
        """The one is better or worse if the interval leaves out 0.5, and there are `LEAST_RUNS` of either."""
        if min(self.runs) < LEAST_RUNS:
            return "undecided"
        return "better" if self.probability.low > 0.5 else "worse" if self.probability.high < 0.5 else "undecided"


@dataclasses.dataclass(frozen=True)
class Summary:
    """All that the page and the tables say of the trials and the comparisons."""

    trials: Mapping[str, TrialSummary]
    """By the trial's name; those without a run are left out."""
    verdicts: Mapping[Comparison, Verdict]
    """By comparison; those that lack a side are left out."""


def summarize(results: Results) -> Summary:
    """Summarise every trial and judge every comparison."""
    asked = [pair for of in results.plans.values() for plan in of.values() for pair in plan.comparisons]
    trials = {name: summarize_trial(result) for name, result in results.trials.items()}
    verdicts = {pair: judge(results, [pair]) for pair in asked}
    return Summary(
        {name: summary for name, summary in trials.items() if summary is not None},
        {pair: verdict for pair, verdict in verdicts.items() if verdict is not None},
    )


def summarize_trial(result: Result) -> TrialSummary | None:
    """What a trial came to; None if no policy was tested."""
    returns = result.returns
    if not len(returns):
        return None
    return TrialSummary(
        runs=len(returns),
        mean=float(returns.mean()),
        interquartile_mean=interquartile_mean_interval([returns[:, np.newaxis]]),
        lowest=float(returns.min()),
        highest=float(returns.max()),
        measures={name: _mean(map(functools.partial(measure, name), result.evaluations.values())) for name in MEASURES},
    )


def measure(name: str, evaluation: Mapping[str, Any]) -> float | None:
    """A measure of an evaluation as a number; None if it has none."""
    value = evaluation[name]
    return value["mean"] if isinstance(value, Mapping) else value


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def judge(results: Results, comparisons: Sequence[Comparison]) -> Verdict | None:
    """The answer to a question in one or several tests.

    Args:
        results: of the study.
        comparisons: that ask it; at least one.

    Returns:
        The answer over the tests in which both sides have runs; None if there are none. A run counts if it was made in
        all of the tests that it belongs to.
    """
    scores = _scores(results, [trial for pair in comparisons for trial in (pair.one, pair.other)])
    there = [pair for pair in comparisons if pair.one.name in scores and pair.other.name in scores]
    if not there:
        return None
    pairs = [(scores[pair.one.name], scores[pair.other.name]) for pair in there]
    tasks = {pair.one.arm.task for pair in there}
    means = [np.mean([pair[side].values.mean() for pair in pairs]) for side in (0, 1)]
    prefix = "{task}: " if len(tasks) > 1 else ""
    return Verdict(
        question=there[0].question,
        tests=tuple(prefix.format(task=pair.one.arm.task) + pair.one.test.name for pair in there),
        one=float(means[0]) if len(tasks) == 1 else np.nan,
        other=float(means[1]) if len(tasks) == 1 else np.nan,
        runs=(min(len(one.values) for one, _ in pairs), min(len(other.values) for _, other in pairs)),
        probability=probability_of_improvement(pairs),
    )


def _scores(results: Results, trials: Iterable[Trial]) -> dict[str, Scores]:
    """The scores of each trial, by name, of the runs that every trial of the same arm has; of those that have any."""
    several = {trial.name: trial for trial in trials}
    seeds: dict[str, set[int]] = {}
    for name, trial in several.items():
        there = set(results.trials[name].evaluations)
        kind = _kind(trial)
        seeds[kind] = seeds[kind] & there if kind in seeds else there
    scores = {}
    for name, trial in several.items():
        result = results.trials[name]
        common = [seed in seeds[_kind(trial)] for seed in result.evaluations]
        if any(common):
            scores[name] = Scores(_kind(trial), result.returns[common])
    return scores


def _kind(trial: Trial) -> str:
    return f"{trial.arm.task}: {trial.arm.name}"


def by_question(comparisons: Iterable[Comparison]) -> dict[str, list[Comparison]]:
    """The comparisons by the question that they ask."""
    asked: dict[str, list[Comparison]] = {}
    for pair in comparisons:
        asked.setdefault(pair.question, []).append(pair)
    return asked
