"""Losses of every policy in every test of the studies, read from the published rows."""

import csv
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.axes import AXES
from codrl_mj.study.inference import Stratum, effect
from codrl_mj.study.questions import MARGIN
from codrl_mj.study.trials import FAILURE_MARGIN, RUNS

MAX_FAILED_SHARE = 0.1
"""Largest share of failing policies, and of lost success, for a loss to count as negligible."""
_PACKAGE = Path(__file__).parents[1]
EVIDENCE = (_PACKAGE / "_assets" / "study", _PACKAGE.parent / "docs" / "results")
"""Folders that contain the published rows of each study: in a wheel, and in a checkout."""
STUDIES = ("actuators", "insurance")
_COLUMNS = ("task", "trained", "tested", "seed", "score", "success")


class Outcome(NamedTuple):
    """Loss of each policy of an arm in one test, relative to policies on ideal forces."""

    lost: np.ndarray
    """Lost share of the task's span, shape (policies,)."""
    missed: np.ndarray
    """Lost share of successful episodes, shape (policies,); 0 if the task defines no success."""

    @property
    def loss(self) -> Interval:
        """Mean lost share of the span, with its 95 % interval by Student's t over policies."""
        return _interval(self.lost)

    @property
    def success_lost(self) -> Interval:
        """Mean lost share of successful episodes, with its 95 % interval."""
        return _interval(self.missed)

    @property
    def failed(self) -> float:
        """Share of policies whose loss exceeds `FAILURE_MARGIN`."""
        return float(np.mean(self.lost > FAILURE_MARGIN))

    @property
    def is_negligible(self) -> bool:
        """True if the loss is negligible.

        All of these hold: the mean loss is at most `MARGIN`, its interval ends at or below
        `FAILURE_MARGIN`, at most a tenth of the policies fail, and at most a tenth of the success
        is lost.
        """
        within = self.loss.mean <= MARGIN and self.loss.high <= FAILURE_MARGIN
        return (
            within
            and self.failed <= MAX_FAILED_SHARE
            and self.success_lost.mean <= MAX_FAILED_SHARE
        )

    @property
    def is_harmful(self) -> bool:
        """True if the loss certainly exceeds `FAILURE_MARGIN`, or lost success a tenth (95 %)."""
        return self.loss.low > FAILURE_MARGIN or self.success_lost.low > MAX_FAILED_SHARE

    def summary(self) -> dict[str, object]:
        """Return summary statistics as JSON-serializable shares."""
        return {
            "policies": len(self.lost),
            "loss": self.loss._asdict(),
            "median": float(np.median(self.lost)),
            "worst": float(np.max(self.lost)),
            "failed": self.failed,
            "success_lost": self.success_lost._asdict(),
        }


def sum_outcomes(outcomes: Iterable[Outcome]) -> Outcome:
    """Add losses policy by policy, as if their causes did not interact; the sum is at most 1."""
    terms = list(outcomes)
    count = min(len(outcome.lost) for outcome in terms)
    lost, missed = (sum(part[:count] for part in parts) for parts in zip(*terms, strict=True))
    return Outcome(np.minimum(lost, 1.0), np.minimum(missed, 1.0))


class LossBounds(NamedTuple):
    """Upper and lower bound on the loss of policies with one option."""

    upper: Outcome | None
    """Largest possible loss; None if unknown."""
    lower: Outcome | None
    """Smallest possible loss; None if unknown. Identical to `upper` if tested or interpolated."""

    def summary(self) -> dict[str, object]:
        """Return the bounds under the keys of the command line's JSON output."""
        return {"most": self.upper, "least": self.lower}

    @property
    def prefix(self) -> str:
        """Prefix of the loss as text: "at least ", "at most ", or empty if it is exact."""
        if self.upper is None:
            return "at least "
        return "" if self.upper is self.lower else "at most "


class Loss(NamedTuple):
    """Loss of policies trained on ideal forces at one severity of one axis."""

    axis: str
    """Name of the axis."""
    severity: float
    """Severity, in the unit of the axis."""
    outcome: Outcome
    """Loss of each policy; at the largest tested severity if `beyond`."""
    beyond: bool
    """True if the severity exceeds all tested ones, so that `outcome` is a lower bound."""
    between: tuple[str, ...]
    """Names of the tests between which the loss was interpolated."""

    def summary(self) -> dict[str, object]:
        """Return the fields under the keys of the command line's JSON output."""
        names = {"severity": "dose"}
        return {names.get(name, name): value for name, value in self._asdict().items()}


# Scores are numbers in the rows of a study, and texts in its file.
EvidenceRow = Mapping[str, Any]
"""Row of a policy in a test: column -> value."""


class Evidence:
    """Scores of every policy in every test of the studies."""

    def __init__(self, rows: Iterable[EvidenceRow]) -> None:
        """Index rows by task, arm and test.

        Args:
            rows: mappings with the columns `task`, `trained`, `tested`, `seed`, `score` [share of
                the span] and `success`; the last two may be empty.
        """
        # The score is empty if the task's span was unknown when the row was written.
        self.rows = [row for row in rows if row["score"]]
        self._tested: dict[tuple[str, str, str], dict[int, tuple[float, float]]] = {}
        for row in self.rows:
            by_seed = self._tested.setdefault((row["task"], row["trained"], row["tested"]), {})
            by_seed[int(row["seed"])] = float(row["score"]), float(row["success"] or math.nan)
        self._curve = functools.cache(self._curve_of)

    @classmethod
    def read(cls, *files: Path) -> "Evidence":
        """Read files of rows; by default the published rows, from the checkout or the wheel."""
        published = [
            path
            for folder in EVIDENCE
            for study in STUDIES
            if (path := folder / study / RUNS).is_file()
        ]
        rows: list[dict[str, str]] = []
        for path in files or published:
            with path.open(newline="", encoding="utf-8") as file:
                rows += (file_rows := list(csv.DictReader(file)))
            if missing_columns := [
                name for name in _COLUMNS if file_rows and name not in file_rows[0]
            ]:
                raise ValueError(
                    f"{path}: has no column {missing_columns[0]!r}: give the {RUNS} of the study"
                )
            for number, row in enumerate(file_rows, start=2):
                for key in ("score", "success"):
                    try:
                        finite = math.isfinite(float(row[key] or 0.0))
                    except ValueError:
                        finite = False
                    if not finite:
                        raise ValueError(
                            f"{path}, line {number}: {key} = {row[key]!r}: must be a finite number"
                        )
        return cls(rows)

    def without(self, *tested: str) -> "Evidence":
        """Return a copy without the named tests, such as `lag 2` or `marginal motor`."""
        return Evidence(row for row in self.rows if row["tested"] not in tested)

    def outcome(
        self, task: str, trained: str, tested: str, paired_test: str | None = None
    ) -> Outcome | None:
        """Return the losses of an arm's policies in a test; None with fewer than two policies.

        Args:
            task: task name.
            trained: name of the arm, without the task.
            tested: name of the test.
            paired_test: test whose scores of the same policies are the reference; None takes the
                mean score of the policies that were trained and tested on ideal forces.
        """
        scores = self._tested.get((task, trained, tested), {})
        ideal_scores = self._tested.get((task, "ideal", "ideal"), {})
        if paired_test is not None:
            paired = self._tested.get((task, trained, paired_test), {})
            values = [
                np.subtract(paired[seed], scores[seed])
                for seed in sorted(scores.keys() & paired.keys())
            ]
        else:
            level = (
                np.mean(list(ideal_scores.values()), axis=0)
                if ideal_scores
                else np.full(2, math.nan)
            )
            values = [level - scores[seed] for seed in sorted(scores)] if ideal_scores else []
        return Outcome(*np.nan_to_num(np.transpose(values))) if len(values) >= 2 else None

    def loss(self, task: str, axis: str, severity: float) -> Loss | None:
        """Return the loss of ideal-trained policies at a severity >= 0; None without study results.

        The losses of each policy are interpolated linearly between the tested severities.
        """
        curve = self._curve(task, axis)
        if len(curve) < 2:
            return None
        tested = list(curve)
        index = min(max(int(np.searchsorted(tested, severity)), 1), len(tested) - 1)
        low, high = tested[index - 1], tested[index]
        share = min((severity - low) / (high - low), 1.0)
        outcome = Outcome(
            *(
                (1.0 - share) * low_part + share * high_part
                for low_part, high_part in zip(curve[low], curve[high], strict=True)
            )
        )
        between = {
            f"{axis} {test_severity:g}"
            for test_severity, weight in ((low, 1.0 - share), (high, share))
            if test_severity and weight
        }
        return Loss(axis, severity, outcome, severity > 1.005 * tested[-1], tuple(sorted(between)))

    def _curve_of(self, task: str, axis: str) -> dict[float, Outcome]:
        """Return severity -> loss of ideal-trained policies, for 0 and every tested severity."""
        severities = AXES[axis].severities
        reference_test = f"{axis} 0" if AXES[axis].motor_at_zero else "ideal"
        outcomes = {
            severity: self.outcome(task, "ideal", f"{axis} {severity:g}", reference_test)
            for severity in severities[1:]
        }
        available = {
            severity: outcome for severity, outcome in outcomes.items() if outcome is not None
        }
        if not available:
            return {}
        count = min(len(outcome.lost) for outcome in available.values())
        # Losses are interpolated policy by policy, so that every severity needs the same policies.
        # The shortest test determines how many are used.
        cut = {
            severity: Outcome(outcome.lost[:count], outcome.missed[:count])
            for severity, outcome in available.items()
        }
        return {0.0: Outcome(np.zeros(count), np.zeros(count))} | cut


def _interval(values: Sequence[float] | np.ndarray) -> Interval:
    """Return the mean with its 95 % interval by Student's t."""
    sample = np.asarray(values, dtype=float)
    return effect([Stratum(sample, np.zeros_like(sample), paired=True)])
