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

    def stratum(self, contrast: Contrast) -> Stratum | None:
        """A contrast's scores; None with fewer than two policies of either."""
        one, other = self.of(contrast.one), self.of(contrast.other)
        if contrast.paired:
            both = sorted(one.keys() & other.keys())
            one, other = ({seed: found[seed] for seed in both} for found in (one, other))
        values = [np.array(list(found.values())) for found in (one, other)]
        return Stratum(values[0], values[1], contrast.paired) if min(map(len, values)) >= 2 else None


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
    strata = [found for pair in hypothesis.contrasts if (found := scores.stratum(pair)) is not None]
    counts = len(strata), len(hypothesis.contrasts)
    if not strata:
        return _Tested((0, 0), counts, Interval(np.nan, np.nan, np.nan), 1.0)
    fewest = min(len(stratum.one) for stratum in strata), min(len(stratum.other) for stratum in strata)
    p = equivalence_p(strata, MARGIN) if hypothesis.kind == "equivalent" else permutation_p(strata)
    return _Tested(fewest, counts, effect(strata), p)


def seeds_to_close(verdict: Verdict) -> int | None:
    """Seeds of each kind that would tell, if the difference and its spread are what they seem; None if too many.

    Of a hypothesis of a difference, those that find the difference seen with a chance of 80 % at the corrected level;
    of one of equivalence, those that bring the interval's half width below what is left of the margin.
    """
    runs, half = min(verdict.runs), (verdict.effect.high - verdict.effect.low) / 2
    if runs < 2 or not half > 0:
        return None
    if verdict.hypothesis.kind == "equivalent":
        room = MARGIN - abs(verdict.effect.mean)
        return None if room <= 0 else int(np.ceil(runs * max(half / room, 1.0) ** 2))
    spread = half / 2.02 / np.sqrt(2.0 / runs)  # of one run, as if all were of two kinds: t at 38 degrees of freedom
    return runs_needed(abs(verdict.effect.mean) / spread, LEVEL / 12)
