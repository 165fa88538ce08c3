"""What policies lost when the studies tested them, policy by policy: read from the rows that these publish."""

import csv
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.doses import AXES
from codrl_mj.study.inference import Stratum, effect
from codrl_mj.study.questions import MARGIN
from codrl_mj.study.trials import FAILED, RUNS

SPARED = 0.1
"""Share of policies that may fail, and of success that may be lost, where nothing is said to be lost."""
_PACKAGE = Path(__file__).parents[1]
EVIDENCE = (_PACKAGE / "_assets" / "study", _PACKAGE.parent / "docs" / "results")
"""Where the studies' folders with their rows lie: in a wheel, in a checkout."""
STUDIES = ("actuators", "insurance")
_COLUMNS = ("task", "trained", "tested", "seed", "score", "success")


class Outcome(NamedTuple):
    """What policies of one kind lose, each of them, beside those that meet ideal forces."""

    lost: np.ndarray
    """Shares of the task's span, shape (policies,)."""
    missed: np.ndarray
    """Shares of episodes that no longer succeed, shape (policies,); 0 where the task knows no success."""

    @property
    def loss(self) -> Interval:
        """Mean, and its 95 % interval by Student's t over policies."""
        return _interval(self.lost)

    @property
    def success_lost(self) -> Interval:
        """Mean share of episodes that no longer succeed, with its interval."""
        return _interval(self.missed)

    @property
    def failed(self) -> float:
        """Share of policies that lose more than `FAILED`."""
        return float(np.mean(self.lost > FAILED))

    @property
    def spared(self) -> bool:
        """Whether nothing that matters is lost.

        No more than `MARGIN` of the score on the mean, and surely no more than `FAILED`; by no more
        than a tenth of the policies more than that; and no more than a tenth of the success.
        """
        within = self.loss.mean <= MARGIN and self.loss.high <= FAILED
        return within and self.failed <= SPARED and self.success_lost.mean <= SPARED

    @property
    def hurt(self) -> bool:
        """Whether surely more is lost than `FAILED` of the score, or a tenth of the success: by 95 % intervals."""
        return self.loss.low > FAILED or self.success_lost.low > SPARED

    def summary(self) -> dict[str, Any]:
        """What to say of it: numbers in shares."""
        return {
            "policies": len(self.lost),
            "loss": self.loss._asdict(),
            "median": float(np.median(self.lost)),
            "worst": float(np.max(self.lost)),
            "failed": self.failed,
            "success_lost": self.success_lost._asdict(),
        }


def total(outcomes: Iterable[Outcome]) -> Outcome:
    """Losses added up, policy by policy, as if they were of one thing each; no more than everything."""
    several = list(outcomes)
    fewest = min(len(one.lost) for one in several)
    lost, missed = (sum(part[:fewest] for part in parts) for parts in zip(*several, strict=True))
    return Outcome(np.minimum(lost, 1.0), np.minimum(missed, 1.0))


class Loss(NamedTuple):
    """What ideal-trained policies lose by one thing."""

    axis: str
    """What it is."""
    dose: float
    """How much of it."""
    outcome: Outcome
    """Policy by policy; of the largest dose that was tested if it is `beyond`."""
    beyond: bool
    """Whether no dose as large was tested, so that it loses at least as much."""
    between: tuple[str, ...]
    """The tests that it was interpolated between."""


class Evidence:
    """The study's rows: what every policy scored in every test."""

    def __init__(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Index the rows: `task`, `trained`, `tested`, `seed`, `score` [share of the span], `success`; or empty."""
        self.rows = [row for row in rows if row["score"]]  # empty: the task's span was not known
        self._tested: dict[tuple[str, str, str], dict[int, tuple[float, float]]] = {}
        for row in self.rows:
            found = self._tested.setdefault((row["task"], row["trained"], row["tested"]), {})
            found[int(row["seed"])] = float(row["score"]), float(row["success"] or math.nan)
        self._curve = functools.cache(self._curve_of)

    @classmethod
    def read(cls, *files: Path) -> "Evidence":
        """Read files; those of the checkout or the wheel unless some are given, and none if there are none."""
        there = [
            path
            for folder in EVIDENCE
            for study in STUDIES
            if (path := folder / study / RUNS).is_file()
        ]
        rows: list[dict[str, str]] = []
        for path in files or there:
            with path.open(newline="", encoding="utf-8") as opened:
                rows += (found := list(csv.DictReader(opened)))
            if lacking := [name for name in _COLUMNS if found and name not in found[0]]:
                raise ValueError(
                    f"{path}: has no column {lacking[0]!r}: give the {RUNS} of the study"
                )
            for number, row in enumerate(found, start=2):
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
        """The same without some tests, such as `lag 2` or `marginal motor`."""
        return Evidence(row for row in self.rows if row["tested"] not in tested)

    def outcome(
        self, task: str, trained: str, tested: str, besides: str | None = None
    ) -> Outcome | None:
        """What policies lost in a test, by seed; None with fewer than two policies.

        `trained` is an arm, without the task. Each policy is compared with itself in another test,
        or, unless that is given, with the mean of those that were trained and tested on ideal
        forces.
        """
        found, home = (
            self._tested.get((task, trained, tested), {}),
            self._tested.get((task, "ideal", "ideal"), {}),
        )
        if besides is not None:
            paired = self._tested.get((task, trained, besides), {})
            values = [
                np.subtract(paired[seed], found[seed])
                for seed in sorted(found.keys() & paired.keys())
            ]
        else:
            level = np.mean(list(home.values()), axis=0) if home else np.full(2, math.nan)
            values = [level - found[seed] for seed in sorted(found)] if home else []
        return Outcome(*np.nan_to_num(np.transpose(values))) if len(values) >= 2 else None

    def loss(self, task: str, axis: str, dose: float) -> Loss | None:
        """What ideal-trained policies lose by a dose >= 0, in the axis' unit; None if the study does not know.

        Every policy's own losses are interpolated between the doses that were tested.
        """
        curve = self._curve(task, axis)
        if len(curve) < 2:
            return None
        tested = list(curve)
        index = min(max(int(np.searchsorted(tested, dose)), 1), len(tested) - 1)
        low, high = tested[index - 1], tested[index]
        share = min((dose - low) / (high - low), 1.0)
        outcome = Outcome(
            *(
                (1.0 - share) * one + share * other
                for one, other in zip(curve[low], curve[high], strict=True)
            )
        )
        between = {
            f"{axis} {at:g}" for at, weight in ((low, 1.0 - share), (high, share)) if at and weight
        }
        return Loss(axis, dose, outcome, dose > 1.005 * tested[-1], tuple(sorted(between)))

    def _curve_of(self, task: str, axis: str) -> dict[float, Outcome]:
        """Dose -> what ideal-trained policies lose by it, of those that were tested, none first."""
        doses, none = AXES[axis].doses, f"{axis} 0" if AXES[axis].own_motor else "ideal"
        outcomes = {
            dose: self.outcome(task, "ideal", f"{axis} {dose:g}", none) for dose in doses[1:]
        }
        found = {dose: outcome for dose, outcome in outcomes.items() if outcome is not None}
        if not found:
            return {}
        fewest = min(len(one.lost) for one in found.values())
        cut = {dose: Outcome(one.lost[:fewest], one.missed[:fewest]) for dose, one in found.items()}
        return {0.0: Outcome(np.zeros(fewest), np.zeros(fewest))} | cut


def _interval(values: Sequence[float] | np.ndarray) -> Interval:
    sample = np.asarray(values, dtype=float)
    return effect([Stratum(sample, np.zeros_like(sample), paired=True)])
