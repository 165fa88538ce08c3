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
TOLERANCES: Mapping[str, float] = {
    "loss": MARGIN,
    "failures": MAX_FAILED_SHARE,
    "success": MAX_FAILED_SHARE,
}
"""Measure of an outcome -> largest mean that counts as negligible."""
_PACKAGE = Path(__file__).parents[1]
EVIDENCE = (_PACKAGE / "_assets" / "study", _PACKAGE.parent / "docs" / "results")
"""Folders that contain the published rows of each study: in a wheel, and in a checkout."""
STUDIES = ("actuators", "insurance")
WIND_UP = "wind-up"
"""Effect of a missing anti-windup, beside the axes: the loss that it adds to a low supply's."""
SUDDEN = (WIND_UP, "noise")
"""Effects that set in suddenly: between two tested severities their loss is only bounded."""
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
    def measures(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lost score, failure (0 or 1) and lost success of each policy, as in `TOLERANCES`."""
        return self.lost, np.where(self.lost > FAILURE_MARGIN, 1.0, 0.0), self.missed

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


def gains(treatment: Outcome, control: Outcome, paired: bool = False) -> dict[str, Interval]:
    """Return how much less a treatment loses, as 95 % intervals of the measures of `TOLERANCES`.

    `paired` is True if both are losses of the same policies in the same order.
    """
    paired = paired and len(treatment.lost) == len(control.lost)
    return {
        name: effect([Stratum(more, less, paired)])
        for name, more, less in zip(TOLERANCES, control.measures, treatment.measures, strict=True)
    }


def is_better(treatment: Outcome, control: Outcome, paired: bool = False) -> bool:
    """Return True if a treatment certainly loses less, by more than is negligible.

    It is better in one of the measures of `TOLERANCES` and worse in none: the interval of the
    difference excludes 0, and its mean exceeds the tolerance. If every policy fails, a treatment
    is not better, however much smaller the loss. Arguments as for `gains`.
    """
    differences = gains(treatment, control, paired)
    return (
        treatment.failed < 1.0
        and any(
            gain.low > 0.0 and gain.mean > TOLERANCES[name] for name, gain in differences.items()
        )
        and not any(
            gain.high < 0.0 and gain.mean < -TOLERANCES[name] for name, gain in differences.items()
        )
    )


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
    """Names of the tests between which the loss was interpolated, or by which it is bounded."""
    lower: Outcome
    """Lower bound on the loss of each policy; `outcome` unless the loss is only bounded."""

    def summary(self) -> dict[str, object]:
        """Return the fields under the keys of the command line's JSON output."""
        names = {"severity": "dose", "lower": "least"}
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

        The losses of each policy are interpolated linearly between the tested severities. Those of
        `SUDDEN` effects are not: between two tests the outcome with the larger loss, or else with
        less success, is the upper bound, and the other one the lower bound.
        """
        curve = self._curve(task, axis)
        if len(curve) < 2:
            return None
        tested = list(curve)
        index = min(max(int(np.searchsorted(tested, severity)), 1), len(tested) - 1)
        low, high = tested[index - 1], tested[index]
        share = min((severity - low) / (high - low), 1.0)
        outcome = lower = interpolate(curve[low], curve[high], share)
        if axis in SUDDEN and 0.01 < share < 0.99:
            lower, outcome = sorted(
                (curve[low], curve[high]),
                key=lambda loss: max(loss.loss.mean, loss.success_lost.mean),
            )
        name = "supply {:g}, winding up" if axis == WIND_UP else f"{axis} {{:g}}"
        between = {
            name.format(test_severity)
            for test_severity, weight in ((low, 1.0 - share), (high, share))
            if test_severity and weight
        }
        beyond = severity > 1.005 * tested[-1]
        return Loss(axis, severity, outcome, beyond, tuple(sorted(between)), lower)

    def arm_curve(self, task: str, trained: str, axis: str) -> dict[float, Outcome]:
        """Return severity -> loss of an arm's policies, for each tested severity of an axis."""
        outcomes = {
            severity: self.outcome(task, trained, f"{axis} {severity:g}" if severity else "ideal")
            for severity in AXES[axis].severities
        }
        return {severity: outcome for severity, outcome in outcomes.items() if outcome is not None}

    def _curve_of(self, task: str, axis: str) -> dict[float, Outcome]:
        """Return severity -> loss of ideal-trained policies, for 0 and every tested severity."""
        if axis == WIND_UP:
            supplies = {
                severity: f"supply {severity:g}" for severity in AXES["supply"].severities[1:]
            }
            outcomes = {
                severity: self.outcome(task, "ideal", f"{supply}, winding up", supply)
                for severity, supply in supplies.items()
            }
        else:
            reference_test = f"{axis} 0" if AXES[axis].motor_at_zero else "ideal"
            outcomes = {
                severity: self.outcome(task, "ideal", f"{axis} {severity:g}", reference_test)
                for severity in AXES[axis].severities[1:]
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


def interpolate(low: Outcome, high: Outcome, share: float) -> Outcome:
    """Interpolate linearly between two outcomes, policy by policy; `share` 0 is `low`, 1 `high`."""
    count = min(len(low.lost), len(high.lost))
    return Outcome(
        *(
            (1.0 - share) * low_part[:count] + share * high_part[:count]
            for low_part, high_part in zip(low, high, strict=True)
        )
    )


def _interval(values: Sequence[float] | np.ndarray) -> Interval:
    """Return the mean with its 95 % interval by Student's t."""
    sample = np.asarray(values, dtype=float)
    return effect([Stratum(sample, np.zeros_like(sample), paired=True)])
