"""What ideal-trained policies lose by a dose of one thing, as the study measured it: read from its results."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.doses import AXES, dosed, ideal, matched, undosed
from codrl_mj.study.questions import MARGIN, Contrast

HYPOTHESES = "hypotheses.csv"
"""A row for every question of the study."""
_PACKAGE = Path(__file__).parents[1]
EVIDENCE = (_PACKAGE / "_assets" / "study", _PACKAGE.parent / "docs" / "results" / "actuators")
"""Where the study's results lie: in a wheel, in a checkout."""
_COLUMNS = ("name", "compared", "effect", "low", "high")


class Loss(NamedTuple):
    """What ideal-trained policies lose by one thing, in shares of the task's span."""

    axis: str
    """What it is."""
    dose: float
    """How much of it."""
    loss: Interval
    """With its 95 % interval; of the nearest dose that was tested if it is `beyond`."""
    beyond: bool
    """Whether no dose as large was tested, so that it loses at least as much."""
    rows: tuple[str, ...]
    """Names of the hypotheses that it is between."""
    kept: float | None
    """What policies that are trained through it lose at the dose that was trained through; None if none was."""
    trained: float
    """The dose that was trained through; infinite if none was."""

    @property
    def lasting(self) -> bool:
        """Whether training through it buys it back, as far as is known, is to be denied.

        So it is where it costs more than `MARGIN`, and no dose as large was tested, or policies that were trained
        through no more of it still lose as much.
        """
        if self.loss.mean <= MARGIN:
            return False
        return self.beyond or (self.dose >= self.trained and self.kept is not None and self.kept > MARGIN)


class Evidence:
    """The study's answers: its file hypotheses.csv."""

    def __init__(self, rows: Sequence[Mapping[str, str]]) -> None:
        """Index the rows of the file."""
        self._rows = {row["compared"]: row for row in rows if row["effect"]}  # empty: without runs
        self._curves: dict[tuple[str, str], _Curve | None] = {}

    @classmethod
    def read(cls, file: Path | None = None) -> "Evidence":
        """Read a file; that of the checkout or the wheel unless one is given, and none if there is none."""
        there = [file] if file is not None else [folder / HYPOTHESES for folder in EVIDENCE]
        for path in there:
            if path.is_file() or file is not None:
                with path.open(newline="", encoding="utf-8") as opened:
                    rows = list(csv.DictReader(opened))
                if lacking := [name for name in _COLUMNS if rows and name not in rows[0]]:
                    raise ValueError(f"{path}: has no column {lacking[0]!r}: give the {HYPOTHESES} of the study")
                for number, row in enumerate(rows, start=2):
                    for key in _COLUMNS[2:]:
                        if row["effect"] and not _finite(row[key]):
                            raise ValueError(f"{path}, line {number}: {key} = {row[key]!r}: must be a finite number")
                return cls(rows)
        return cls([])

    def effect(self, contrast: Contrast) -> tuple[str, Interval] | None:
        """Name and effect of the hypothesis that has this comparison alone; None if it was not answered."""
        row = self._rows.get(contrast.name)
        if row is None:
            return None
        return row["name"], Interval(*(float(row[key]) for key in ("effect", "low", "high")))

    def loss(self, task: str, axis: str, dose: float) -> Loss | None:
        """What ideal-trained policies lose by a dose >= 0, in the axis' unit; None if it is not known."""
        if (task, axis) not in self._curves:
            self._curves[task, axis] = self._curve(task, axis)
        curve, tested = self._curves[task, axis], AXES[axis].doses
        if curve is None:
            return None
        between = Interval(*(float(np.interp(dose, tested, values)) for values in zip(*curve.lost, strict=True)))
        index = min(int(np.searchsorted(tested, dose)), len(tested) - 1)
        places = (index,) if tested[index] == dose else (index - 1, index)
        rows = tuple(curve.rows[place - 1] for place in places if place >= 1)
        return Loss(axis, dose, between, dose > 1.005 * tested[-1], rows, curve.kept, curve.trained)

    def _curve(self, task: str, axis: str) -> "_Curve | None":
        home, tested = ideal(task), AXES[axis].doses
        none = undosed(home, axis)
        found = {dose: self.effect(Contrast(dosed(home, axis, dose), none)) for dose in tested[1:]}
        known = {dose: effect for dose, effect in found.items() if effect is not None}
        if len(known) < len(found):
            return None
        lost = [Interval(0.0, 0.0, 0.0), *(Interval(-e.mean, -e.high, -e.low) for _, e in known.values())]
        rows = [name for name, _ in known.values()]
        if task not in AXES[axis].trained:
            return _Curve(lost, rows, None, math.inf)
        at = AXES[axis].trained[task]
        won = self.effect(Contrast(dosed(matched(task, axis), axis, at), dosed(home, axis, at)))
        return _Curve(lost, rows, None if won is None else lost[tested.index(at)].mean - won[1].mean, at)


def _finite(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except (TypeError, ValueError):  # None where a row is too short
        return False


class _Curve(NamedTuple):
    """Dose and response of an axis on a task."""

    lost: list[Interval]
    """By dose, of ideal-trained policies."""
    rows: list[str]
    """Hypotheses, of all doses but none."""
    kept: float | None
    trained: float
