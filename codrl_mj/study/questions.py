"""Questions that a study can answer: contrasts of trials, judged with intervals and corrected tests, as rows.

Scores are shares of each task's span, so that tasks can be pooled; effects are differences of mean
scores.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.inference import (
    Stratum,
    effect,
    equivalence_p,
    false_discovery,
    holm,
    permutation_p,
    runs_needed,
)
from codrl_mj.study.trials import Collected, Trial

MARGIN = 0.05
"""Largest difference that does not matter, in shares of the task's span."""
LEVEL = 0.05
"""Level of every test, after correction."""


class Contrast(NamedTuple):
    """Two trials of which it is asked whether their scores differ."""

    one: Trial
    """The trial that may be better."""
    other: Trial
    """The trial that it is compared with."""

    @property
    def name(self) -> str:
        """What rows of verdicts call it."""
        return f"{self.one.name} over {self.other.name}"

    @property
    def paired(self) -> bool:
        """Whether the same policies are tested twice."""
        return self.one.arm.name == self.other.arm.name


@dataclasses.dataclass(frozen=True)
class Question:
    """A statement that a study can refute."""

    name: str
    """What it is called, such as `P1`."""
    section: str
    """The section of the page that it belongs to."""
    statement: str
    """What it says."""
    contrasts: tuple[Contrast, ...]
    """What is pooled in it, each with the same weight."""
    kind: Literal["better", "equivalent"] = "better"
    """Whether the one is to score higher, or to differ by less than `MARGIN`."""


class Scores:
    """Scores of policies in shares of their task's span.

    0 is what random actions get on ideal forces, 1 what policies get there on the mean that were
    trained there.
    """

    def __init__(
        self, collected: Collected, floors: Mapping[str, float], homes: Iterable[Trial]
    ) -> None:
        """Read the spans.

        Args:
            collected: what there is of the study.
            floors: task -> mean return of random actions.
            homes: each task's policies that were trained on ideal forces, tested there.
        """
        self._collected, self._floors = collected, floors
        found = {trial.arm.task: list(collected.scores(trial).values()) for trial in homes}
        means = {task: float(np.mean(values)) for task, values in found.items() if values}
        self.ceilings = {task: mean for task, mean in means.items() if mean > floors[task]}
        """Task -> upper end of its span; without those whose ideal-trained policies are untested,
        or no better than random actions.
        """

    def of(self, trial: Trial) -> dict[int, float]:
        """Score of every policy of a trial by seed; none where the task's span is not known."""
        task = trial.arm.task
        if task not in self.ceilings:
            return {}
        floor, span = self._floors[task], self.ceilings[task] - self._floors[task]
        return {
            seed: (value - floor) / span for seed, value in self._collected.scores(trial).items()
        }

    def stratum(self, contrasts: Sequence[Contrast]) -> Stratum | None:
        """Every policy's mean over contrasts of one task; None with fewer than two policies of either kind.

        Several contrasts may share policies, whose scores then are no independent samples: seeds
        are. A seed counts where it was tested in all of the contrasts.
        """
        paired = all(contrast.paired for contrast in contrasts)
        sides = [[self.of(one) for one in trials] for trials in zip(*contrasts, strict=True)]
        seeds = [set.intersection(*map(set, side)) for side in sides]
        if paired:
            seeds = [seeds[0] & seeds[1]] * 2
        one, other = (
            np.array([np.mean([found[seed] for found in side]) for seed in sorted(common)])
            for side, common in zip(sides, seeds, strict=True)
        )
        return Stratum(one, other, paired) if min(len(one), len(other)) >= 2 else None


class Verdict(NamedTuple):
    """What a question came to."""

    question: Question
    """The question."""
    runs: tuple[int, int]
    """Policies of the one and of the other kind, of the contrast that has the fewest."""
    strata: tuple[int, int]
    """Contrasts that could be tested, and contrasts that it has."""
    effect: Interval
    """Mean difference of scores [shares of the span], with its 95 % interval; NaN without any contrast."""
    p: float
    """Uncorrected: of no difference, or, of `equivalent`, of one as large as the margin; NaN if it is not judged."""
    corrected: float
    """The same after the correction for the number of questions that are judged together."""

    @property
    def outcome(self) -> Literal["yes", "no", "the other way", "open", "not judged"]:
        """Whether it holds; `no` of one that says `equivalent`: the interval lies beyond the margin."""
        if np.isnan(self.p):
            return "not judged"
        if self.corrected < LEVEL:
            return (
                "yes"
                if self.question.kind == "equivalent" or self.effect.mean > 0
                else "the other way"
            )
        beyond = self.effect.low > MARGIN or self.effect.high < -MARGIN
        return "no" if self.question.kind == "equivalent" and beyond else "open"

    def seeds_to_close(self, questions: int) -> int | None:
        """Seeds of each kind that would tell, if the difference and its spread are what they seem; None if too many.

        They find it with a chance of 80 %: the difference seen, or, of equivalence, what is left of
        the margin, in one of the two one-sided tests.

        Args:
            questions: that are corrected together by Holm, at whose strictest level it is to be
                found.
        """
        from scipy.stats import t

        runs, half = min(self.runs), (self.effect.high - self.effect.low) / 2
        if runs < 2 or not half > 0:
            return None
        equivalent, seen = self.question.kind == "equivalent", abs(self.effect.mean)
        spread = (
            half / t.ppf(0.975, 2 * runs - 2) / np.sqrt(2.0 / runs)
        )  # of one run, as if all were of two kinds
        least = MARGIN - seen if equivalent else seen
        return (
            runs_needed(least / spread, (2 if equivalent else 1) * LEVEL / questions)
            if least > 0
            else None
        )

    def row(self, questions: int) -> dict[str, Any]:
        """A row of the file of verdicts; `questions` as for `seeds_to_close`."""
        asked = self.question
        return {
            "name": asked.name,
            "question": asked.section,
            "statement": asked.statement,
            "kind": asked.kind,
            "contrasts": self.strata[1],
            "tested": self.strata[0],
            "policies": min(self.runs),
            "effect": self.effect.mean,
            "low": self.effect.low,
            "high": self.effect.high,
            "p": None if np.isnan(self.p) else self.p,
            "corrected_p": None if np.isnan(self.corrected) else self.corrected,
            "outcome": self.outcome,
            "seeds_to_close": self.seeds_to_close(questions) if self.outcome == "open" else None,
            "compared": "; ".join(pair.name for pair in asked.contrasts),
        }


def judge(
    scores: Scores, questions: Sequence[Question], primary: bool = False, least: int = 0
) -> list[Verdict]:
    """Test questions, and correct their p together.

    Of none, or fewer than `least` policies, p says nothing, and who looks often finds something: it
    is not judged, and counts with p = 1.

    Args:
        scores: of the study.
        questions: all that are corrected together.
        primary: whether by Holm; others are corrected by Benjamini and Hochberg.
        least: policies of every kind, without which nothing is judged.
    """
    tested = []
    for question in questions:
        by_task: dict[str, list[Contrast]] = {}
        for pair in question.contrasts:
            if scores.stratum([pair]) is not None:
                by_task.setdefault(pair.one.arm.task, []).append(pair)
        found = {
            task: stratum
            for task, pairs in by_task.items()
            if (stratum := scores.stratum(pairs)) is not None
        }
        strata, counts = (
            list(found.values()),
            (sum(len(by_task[task]) for task in found), len(question.contrasts)),
        )
        if not strata:
            tested.append((question, (0, 0), counts, Interval(*[np.nan] * 3), np.nan))
            continue
        fewest = (
            min(len(stratum.one) for stratum in strata),
            min(len(stratum.other) for stratum in strata),
        )
        p = (
            equivalence_p(strata, MARGIN)
            if question.kind == "equivalent"
            else permutation_p(strata)
        )
        tested.append(
            (question, fewest, counts, effect(strata), p if min(fewest) >= least else np.nan)
        )
    corrected = (holm if primary else false_discovery)(
        [1.0 if np.isnan(p) else p for *_, p in tested]
    )
    return [
        Verdict(*one, np.nan if np.isnan(one[-1]) else float(p))
        for one, p in zip(tested, corrected, strict=True)
    ]
