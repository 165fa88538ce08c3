"""What the hypotheses came to: scores in shares of each task's span, effects with intervals, corrected p."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.actuators import arms
from codrl_mj.study.actuators.questions import MARGIN, Contrast, Hypothesis, at_home
from codrl_mj.study.inference import Stratum, effect, equivalence_p, false_discovery, holm, permutation_p, runs_needed
from codrl_mj.study.trials import Collected, Trial

LEVEL = 0.05
"""Level of every test, after correction."""
FLOORS: Mapping[str, float] = {
    "pendulum": -1223.0,
    "cartpole": 17.8,
    "acrobot": -499.8,
    "furuta": 3.1,
    "mountain_car": -200.0,
    "mountain_car_continuous": -32.9,
}
"""Task -> mean return of random actions on ideal forces, over 300 episodes: the lower end of the task's span."""


class Scores:
    """Scores of policies in shares of their task's span.

    0 is what random actions get on ideal forces, 1 what policies get there on the mean that were trained there.
    """

    def __init__(self, collected: Collected) -> None:
        """Read the spans.

        Args:
            collected: what there is of the study.
        """
        self._collected = collected
        homes = {task: list(collected.scores(at_home(arms.ideal(task))).values()) for task in arms.SECONDS}
        means = {task: float(np.mean(found)) for task, found in homes.items() if found}
        self.ceilings = {task: mean for task, mean in means.items() if mean > FLOORS[task]}
        """Task -> upper end of its span; without those whose ideal-trained policies are untested, or no better than
        random actions."""

    def of(self, trial: Trial) -> dict[int, float]:
        """Score of every policy of a trial by seed; none where the task's span is not known."""
        task = trial.arm.task
        if task not in self.ceilings:
            return {}
        span = self.ceilings[task] - FLOORS[task]
        return {seed: (value - FLOORS[task]) / span for seed, value in self._collected.scores(trial).items()}

    def stratum(self, contrasts: Sequence[Contrast]) -> Stratum | None:
        """Every policy's mean over contrasts of one task; None with fewer than two policies of either kind.

        Several contrasts may share policies, whose scores then are no independent samples: seeds are. A seed counts
        where it was tested in all of the contrasts.
        """
        paired = all(contrast.paired for contrast in contrasts)
        sides = [
            [self.of(one) for one in trials] for trials in zip(*((c.one, c.other) for c in contrasts), strict=True)
        ]
        seeds = [set.intersection(*map(set, side)) for side in sides]
        if paired:
            seeds = [seeds[0] & seeds[1]] * 2
        one, other = (
            np.array([np.mean([found[seed] for found in side]) for seed in sorted(common)])
            for side, common in zip(sides, seeds, strict=True)
        )
        return Stratum(one, other, paired) if min(len(one), len(other)) >= 2 else None


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a hypothesis came to."""

    hypothesis: Hypothesis
    """The hypothesis."""
    runs: tuple[int, int]
    """Policies of the one and of the other kind, of the contrast that has the fewest."""
    strata: tuple[int, int]
    """Contrasts that could be tested, and contrasts that it has."""
    effect: Interval
    """Mean difference of scores [shares of the span], with its 95 % interval; NaN without any contrast."""
    p: float
    """Of the test, uncorrected: of no difference, or, of `equivalent`, of one as large as the margin."""
    corrected: float
    """The same after the correction for the number of hypotheses of its kind."""

    @property
    def outcome(self) -> Literal["yes", "no", "the other way", "open"]:
        """Whether it holds; `no` of one that says `equivalent`: the interval lies beyond the margin."""
        if self.corrected < LEVEL:
            return "yes" if self.hypothesis.kind == "equivalent" or self.effect.mean > 0 else "the other way"
        beyond = self.effect.low > MARGIN or self.effect.high < -MARGIN
        return "no" if self.hypothesis.kind == "equivalent" and beyond else "open"


class _Tested(NamedTuple):
    runs: tuple[int, int]
    strata: tuple[int, int]
    effect: Interval
    p: float


def judge(scores: Scores, hypotheses: Sequence[Hypothesis]) -> list[Verdict]:
    """Test hypotheses of one kind, and correct their p together: primary ones by Holm, others by Benjamini-Hochberg.

    Args:
        scores: of the study.
        hypotheses: all primary, or all secondary ones. One of which nothing is there yet counts in the correction of
            the primary ones, with p = 1.
    """
    tested = [_test(scores, hypothesis) for hypothesis in hypotheses]
    correct = holm if hypotheses and hypotheses[0].primary else false_discovery
    corrected = correct([one.p for one in tested])
    return [
        Verdict(hypothesis, *one, float(p)) for hypothesis, one, p in zip(hypotheses, tested, corrected, strict=True)
    ]


def _test(scores: Scores, hypothesis: Hypothesis) -> _Tested:
    by_task: dict[str, list[Contrast]] = {}
    for pair in hypothesis.contrasts:
        if scores.stratum([pair]) is not None:
            by_task.setdefault(pair.one.arm.task, []).append(pair)
    found = {task: scores.stratum(pairs) for task, pairs in by_task.items()}
    strata = [stratum for stratum in found.values() if stratum is not None]
    counts = sum(len(by_task[task]) for task in found if found[task] is not None), len(hypothesis.contrasts)
    if not strata:
        return _Tested((0, 0), counts, Interval(np.nan, np.nan, np.nan), 1.0)
    fewest = min(len(stratum.one) for stratum in strata), min(len(stratum.other) for stratum in strata)
    p = equivalence_p(strata, MARGIN) if hypothesis.kind == "equivalent" else permutation_p(strata)
    return _Tested(fewest, counts, effect(strata), p)


def seeds_to_close(verdict: Verdict) -> int | None:
    """Seeds of each kind that would tell, if the difference and its spread are what they seem; None if too many.

    They find it with a chance of 80 % at the strictest of Holm's levels: the difference seen, or, of equivalence, what
    is left of the margin, in one of the two one-sided tests.
    """
    from scipy.stats import t

    runs, half = min(verdict.runs), (verdict.effect.high - verdict.effect.low) / 2
    if runs < 2 or not half > 0:
        return None
    equivalent, seen = verdict.hypothesis.kind == "equivalent", abs(verdict.effect.mean)
    spread = half / t.ppf(0.975, 2 * runs - 2) / np.sqrt(2.0 / runs)  # of one run, as if all were of two kinds
    least = MARGIN - seen if equivalent else seen
    return runs_needed(least / spread, (2 if equivalent else 1) * LEVEL / 12) if least > 0 else None
