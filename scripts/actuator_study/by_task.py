"""Verdicts of pooled questions task by task, and the tasks on which a pooled verdict rests."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.inference import effect
from codrl_mj.study.pages import TITLES
from codrl_mj.study.questions import MARGIN, Contrast, Question, Scores, Verdict, judge

BY_TASK = "by_task.csv"
"""File with a row for every pooled question and task."""
RESTS = """*Rests on* names each task without which the interval no longer supports the verdict, with the pooled effect of
the other tasks."""
"""Explanation of the column that `rests_text` fills."""


class TaskVerdict(NamedTuple):
    """A pooled question on one of its tasks."""

    question: Question
    """The pooled question."""
    task: str
    """Task name."""
    verdict: Verdict
    """Verdict of the contrasts on this task, corrected together with those of all other tasks."""
    others: Interval | None
    """Effect pooled over the other tasks; None if there is none, or the task is untested."""
    is_needed: bool
    """True if the pooled verdict does not hold without this task."""

    @property
    def text(self) -> str:
        """Outcome and effect with its interval."""
        if not self.verdict.strata[0]:
            return "–"
        mean, low, high = self.verdict.effect
        return f"{self.verdict.outcome}, {mean:+z.2f} [{low:+z.2f}, {high:+z.2f}]"

    @property
    def row(self) -> dict[str, object]:
        """Row of the published table."""
        shown = ("effect", "low", "high", "p", "corrected_p", "outcome", "policies")
        judged = self.verdict.row(1)
        mean, low, high = self.others or (None, None, None)
        return {
            "name": self.question.name,
            "task": self.task,
            **{name: judged[name] for name in shown},
            "others_effect": mean,
            "others_low": low,
            "others_high": high,
            "rests_on": self.is_needed,
        }


def judge_by_task(
    scores: Scores, pooled: Sequence[Verdict], min_policies: int = 0
) -> list[TaskVerdict]:
    """Judge pooled questions on each of their tasks, and pooled over all other tasks.

    No plan has these comparisons. They are corrected together, by Benjamini and Hochberg.
    """
    contrasts_of: dict[tuple[int, str], list[Contrast]] = {}
    for number, verdict in enumerate(pooled):
        for contrast in verdict.question.contrasts:
            contrasts_of.setdefault((number, contrast.treatment.arm.task), []).append(contrast)
    strata = {
        key: scores.stratum(tested)
        for key, contrasts in contrasts_of.items()
        if (tested := [contrast for contrast in contrasts if scores.stratum([contrast])])
    }
    single = [
        dataclasses.replace(pooled[number].question, contrasts=tuple(contrasts))
        for (number, _), contrasts in contrasts_of.items()
    ]
    results = []
    for (number, task), verdict in zip(
        contrasts_of, judge(scores, single, min_policies=min_policies), strict=True
    ):
        other_strata = [
            stratum
            for (pooled_number, tested_task), stratum in strata.items()
            if pooled_number == number and tested_task != task and stratum is not None
        ]
        others = effect(other_strata) if other_strata and (number, task) in strata else None
        is_needed = others is not None and not _supports(others, pooled[number])
        results.append(TaskVerdict(pooled[number].question, task, verdict, others, is_needed))
    return results


def _supports(interval: Interval, verdict: Verdict) -> bool:
    """Return True if an interval alone would lead to the same outcome."""
    inside = interval.low > -MARGIN and interval.high < MARGIN
    beyond = interval.low > MARGIN or interval.high < -MARGIN
    if verdict.question.kind == "equivalent":
        return {"yes": inside, "no": beyond}.get(verdict.outcome, True)
    return {"yes": interval.low > 0, "the other way": interval.high < 0}.get(verdict.outcome, True)


def rests_text(name: str, verdicts: Iterable[TaskVerdict]) -> str:
    """Return the tasks on which a question's verdict rests, with the effect without each."""
    texts = [
        f"{TITLES[verdict.task]}: {mean:+z.3f} [{low:+z.3f}, {high:+z.3f}]"
        for verdict in verdicts
        if verdict.is_needed and verdict.question.name == name and verdict.others is not None
        for mean, low, high in [verdict.others]
    ]
    return "; ".join(texts) or "–"
