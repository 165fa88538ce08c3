"""Questions of a study: contrasts of trials, judged by intervals and corrected p-values.

Scores are shares of each task's span, so that tasks can be pooled. Effects are differences of mean
scores.
"""

import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.inference import (
    Stratum,
    benjamini_hochberg,
    effect,
    equivalence_p,
    holm,
    permutation_p,
    runs_needed,
)
from codrl_mj.study.pages import markdown_table
from codrl_mj.study.trials import StudyResults, Trial

MARGIN = 0.05
"""Largest difference that counts as negligible [share of the task's span]."""
LEVEL = 0.05
"""Significance level of every test, after correction."""


class Contrast(NamedTuple):
    """Two trials whose scores are compared."""

    treatment: Trial
    """Trial that may score higher."""
    control: Trial
    """Reference trial."""

    @property
    def name(self) -> str:
        """Name in the rows of verdicts."""
        return f"{self.treatment.name} over {self.control.name}"

    @property
    def paired(self) -> bool:
        """True if both trials test the same policies."""
        return self.treatment.arm.name == self.control.arm.name


@dataclasses.dataclass(frozen=True)
class Question:
    """Statement that a study can refute."""

    name: str
    """Name, such as `P1`."""
    section: str
    """Section of the page."""
    statement: str
    """Text of the statement."""
    contrasts: tuple[Contrast, ...]
    """Pooled contrasts, with equal weights."""
    kind: Literal["better", "equivalent"] = "better"
    """`better`: treatments score higher; `equivalent`: they differ by less than `MARGIN`."""


class TrialComparison(NamedTuple):
    """Contrast that is tested for a difference, on both sides, and for equivalence."""

    name: str
    """Unique name within the study."""
    section: str
    """Section of the page."""
    treatment: str
    """Text that names the treatment, such as `training through`."""
    contrast: Contrast
    """The two compared trials."""

    @property
    def questions(self) -> tuple[Question, Question]:
        """Hypotheses of a difference and of equivalence."""
        pair = (self.contrast,)
        return (
            Question(
                f"{self.name}: difference", self.section, f"{self.treatment} scores higher", pair
            ),
            Question(
                f"{self.name}: equivalence",
                self.section,
                f"{self.treatment} scores as high",
                pair,
                "equivalent",
            ),
        )


class Scores:
    """Scores of policies in shares of their task's span.

    0 is the mean return of random actions on ideal forces, and 1 the mean return of policies
    trained and tested there.
    """

    def __init__(
        self, collected: StudyResults, floors: Mapping[str, float], ideal_trials: Iterable[Trial]
    ) -> None:
        """Compute the span of each task.

        Args:
            collected: available results of the study.
            floors: task -> mean return of random actions.
            ideal_trials: for each task, the policies trained and tested on ideal forces.
        """
        self._collected, self._floors = collected, floors
        returns = {trial.arm.task: list(collected.scores(trial).values()) for trial in ideal_trials}
        means = {task: float(np.mean(values)) for task, values in returns.items() if values}
        self.ceilings = {task: mean for task, mean in means.items() if mean > floors[task]}
        """Task -> upper end of its span; omits tasks whose ideal-trained policies are untested or
        no better than random actions.
        """

    def by_seed(self, trial: Trial) -> dict[int, float]:
        """Return the score of every policy of a trial by seed; empty if the span is unknown."""
        task = trial.arm.task
        if task not in self.ceilings:
            return {}
        floor, span = self._floors[task], self.ceilings[task] - self._floors[task]
        return {
            seed: (value - floor) / span for seed, value in self._collected.scores(trial).items()
        }

    def stratum(self, contrasts: Sequence[Contrast]) -> Stratum | None:
        """Return the scores of one task's contrasts, averaged by seed; None with < 2 seeds.

        Contrasts may share policies, so that only different seeds are independent. Therefore each
        seed contributes one mean over all contrasts, and only if it was tested in all of them.
        """
        paired = all(contrast.paired for contrast in contrasts)
        sides = [
            [self.by_seed(treatment) for treatment in trials]
            for trials in zip(*contrasts, strict=True)
        ]
        seeds = [set.intersection(*map(set, side)) for side in sides]
        if paired:
            seeds = [seeds[0] & seeds[1]] * 2
        treatment, control = (
            np.array([np.mean([scores[seed] for scores in side]) for seed in sorted(common)])
            for side, common in zip(sides, seeds, strict=True)
        )
        return (
            Stratum(treatment, control, paired) if min(len(treatment), len(control)) >= 2 else None
        )


class Verdict(NamedTuple):
    """Result of a question."""

    question: Question
    """The question."""
    runs: tuple[int, int]
    """Number of treatment and of control policies, each the smallest among the tasks."""
    strata: tuple[int, int]
    """Number of contrasts with results, and of all contrasts."""
    effect: Interval
    """Mean difference of scores [share of the span], with interval; NaN without contrasts."""
    p: float
    """p-value before correction: for no difference or, if `equivalent`, for a difference of at
    least the margin; NaN if not judged.
    """
    corrected_p: float
    """p-value after correction for all questions that are judged together."""

    @property
    def outcome(self) -> Literal["yes", "no", "the other way", "open", "not judged"]:
        """Answer; `no` only for `equivalent`, if the whole interval lies beyond the margin."""
        if np.isnan(self.p):
            return "not judged"
        if self.corrected_p < LEVEL:
            return (
                "yes"
                if self.question.kind == "equivalent" or self.effect.mean > 0
                else "the other way"
            )
        beyond = self.effect.low > MARGIN or self.effect.high < -MARGIN
        return "no" if self.question.kind == "equivalent" and beyond else "open"

    def seeds_to_close(self, questions: int) -> int | None:
        """Return the seeds per group that would decide an open question; None if too many.

        With a power of 80 % these seeds detect the observed difference or, for equivalence, its
        distance from the margin in one of the two one-sided tests.

        Args:
            questions: number of questions that Holm corrects together; the level is that of the
                smallest p-value.
        """
        from scipy.stats import t

        runs, half = min(self.runs), (self.effect.high - self.effect.low) / 2
        if runs < 2 or not half > 0:
            return None
        equivalent, observed = self.question.kind == "equivalent", abs(self.effect.mean)
        # The standard deviation of a run follows from the interval as if it compared two groups of
        # `runs` runs each.
        spread = half / t.ppf(0.975, 2 * runs - 2) / np.sqrt(2.0 / runs)
        detectable_effect = MARGIN - observed if equivalent else observed
        return (
            runs_needed(detectable_effect / spread, (2 if equivalent else 1) * LEVEL / questions)
            if detectable_effect > 0
            else None
        )

    def row(self, questions: int) -> dict[str, object]:
        """Return the row of the file of verdicts; `questions` as in `seeds_to_close`."""
        question = self.question
        return {
            "name": question.name,
            "question": question.section,
            "statement": question.statement,
            "kind": question.kind,
            "contrasts": self.strata[1],
            "tested": self.strata[0],
            "policies": min(self.runs),
            "effect": self.effect.mean,
            "low": self.effect.low,
            "high": self.effect.high,
            "p": None if np.isnan(self.p) else self.p,
            "corrected_p": None if np.isnan(self.corrected_p) else self.corrected_p,
            "outcome": self.outcome,
            "seeds_to_close": self.seeds_to_close(questions) if self.outcome == "open" else None,
            "compared": "; ".join(pair.name for pair in question.contrasts),
        }


class ComparisonVerdict(NamedTuple):
    """Comparison with its two verdicts."""

    comparison: TrialComparison
    """The comparison."""
    difference: Verdict
    """Verdict on a difference of either sign."""
    equivalence: Verdict
    """Verdict on a difference below `MARGIN`."""

    @property
    def outcome(self) -> Literal["better", "worse", "equivalent", "undecided", "not judged"]:
        """Verdict on the treatment; a difference that is surely below the margin is equivalent."""
        if np.isnan(self.difference.p):
            return "not judged"
        if self.equivalence.outcome == "yes":
            return "equivalent"
        if self.difference.outcome == "yes":
            return "better"
        return "worse" if self.difference.outcome == "the other way" else "undecided"

    @property
    def table_cells(self) -> tuple[str, str, str, str]:
        """Texts of the difference with its interval, both corrected p-values and the outcome."""
        interval = self.difference.effect
        effect_text = f"{interval.mean:+.3f} [{interval.low:+.3f}, {interval.high:+.3f}]"
        p_difference, p_equivalence = (
            "–" if np.isnan(verdict.p) else f"{verdict.corrected_p:.2g}"
            for verdict in (self.difference, self.equivalence)
        )
        return (
            "–" if np.isnan(interval.mean) else effect_text,
            p_difference,
            p_equivalence,
            self.outcome,
        )


def judge_comparisons(
    scores: Scores, comparisons: Sequence[TrialComparison], complete: bool
) -> list[ComparisonVerdict]:
    """Test comparisons and correct all their p-values together, by Holm's method.

    Args:
        scores: scores of the study.
        comparisons: all comparisons of the study.
        complete: True if all planned results exist; before, no p-value is reported.
    """
    questions = [question for comparison in comparisons for question in comparison.questions]
    verdicts = judge(scores, questions, primary=True, min_policies=2 if complete else sys.maxsize)
    return [
        ComparisonVerdict(comparison, difference, equivalence)
        for comparison, difference, equivalence in zip(
            comparisons, verdicts[::2], verdicts[1::2], strict=True
        )
    ]


def comparison_table(verdicts: Sequence[ComparisonVerdict]) -> str:
    """Return the Markdown table of comparisons with their verdicts."""
    header = ("comparison", "difference [95 %]", "p, difference", "p, equivalence", "verdict")
    return markdown_table(
        header, ([verdict.comparison.name, *verdict.table_cells] for verdict in verdicts)
    )


def judge(
    scores: Scores, questions: Sequence[Question], primary: bool = False, min_policies: int = 0
) -> list[Verdict]:
    """Test questions and correct their p-values together.

    A question with fewer than `min_policies` policies in a group is not judged, and enters the
    correction with a p-value of 1: otherwise repeated looks at growing data would inflate the
    number of false positives.

    Args:
        scores: scores of the study.
        questions: all questions that are corrected together.
        primary: True to correct by Holm, False by Benjamini and Hochberg.
        min_policies: smallest number of policies in each group to judge a question.
    """
    tested = []
    for question in questions:
        by_task: dict[str, list[Contrast]] = {}
        for pair in question.contrasts:
            if scores.stratum([pair]) is not None:
                by_task.setdefault(pair.treatment.arm.task, []).append(pair)
        strata_by_task = {
            task: stratum
            for task, pairs in by_task.items()
            if (stratum := scores.stratum(pairs)) is not None
        }
        strata = list(strata_by_task.values())
        counts = (sum(len(by_task[task]) for task in strata_by_task), len(question.contrasts))
        if not strata:
            tested.append((question, (0, 0), counts, Interval(*[np.nan] * 3), np.nan))
            continue
        min_runs = (
            min(len(stratum.treatment) for stratum in strata),
            min(len(stratum.control) for stratum in strata),
        )
        p = (
            equivalence_p(strata, MARGIN)
            if question.kind == "equivalent"
            else permutation_p(strata)
        )
        tested.append(
            (
                question,
                min_runs,
                counts,
                effect(strata),
                p if min(min_runs) >= min_policies else np.nan,
            )
        )
    corrected = (holm if primary else benjamini_hochberg)(
        [1.0 if np.isnan(p) else p for *_, p in tested]
    )
    return [
        Verdict(*partial, np.nan if np.isnan(partial[-1]) else float(p))
        for partial, p in zip(tested, corrected, strict=True)
    ]
