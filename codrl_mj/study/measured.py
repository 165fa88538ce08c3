"""What to do about an actuator on a task, measured: policies trained on ideal forces and through it, tested on it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL as IDEAL_ACTUATOR
from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.advice import BUY, IDEAL, LOOP, THROUGH, redesign
from codrl_mj.study.doses import FLOORS, REFERENCE_SPEEDS, arm, at_home, ideal, posed
from codrl_mj.study.grid import check_chosen
from codrl_mj.study.inference import Stratum, effect
from codrl_mj.study.questions import MARGIN
from codrl_mj.study.trials import Collected, Grid, Trial


def measured_grid(actuator: Any, task: str, seeds: int, root: Path, episodes: int = 50) -> Grid:
    """The trainings and tests that show what an actuator costs on a task, and what training through it buys.

    Of either kind there are so many runs as `seeds`, >= 2, in folders below `root`.
    """
    check_chosen("task", [task], REFERENCE_SPEEDS)
    if actuator == IDEAL_ACTUATOR:
        raise ValueError("actuator = 'ideal': training through it is training on ideal forces: name another")
    if seeds < 2:
        raise ValueError(f"seeds = {seeds}: an interval needs at least 2")
    return Grid(root, tuple(_measured(actuator, task).values()), lambda _: range(seeds), episodes)


def _measured(actuator: Any, task: str) -> dict[str, Trial]:
    here, untouched = posed(task, actuator), ideal(task)
    through = arm(task, "through it", here)
    found = {"home": at_home(untouched), IDEAL: Trial(untouched, "it", here), THROUGH: Trial(through, "it", here)}
    better = redesign(actuator, task)
    return found if better is None else found | {LOOP: Trial(untouched, "designed", posed(task, better))}


class Measured(NamedTuple):
    """What trainings and tests showed."""

    scores: Mapping[str, Interval]
    """Mean score [shares of the span], by what is done: `IDEAL`, `LOOP`, `THROUGH`. Its 95 % interval is Student's t
    over policies, as if the span were exact."""
    verdict: str
    """The first of them, in this order, that loses no more than `MARGIN`; if none does, the better of loop and
    training, where it wins more than that, and else `BUY`."""


def measured(actuator: Any, task: str, collected: Collected) -> Measured:
    """The verdict of what `measured_grid` found for the same actuator and task, of which nothing may be missing."""
    trials = _measured(actuator, task)
    home = np.array(list(collected.scores(trials.pop("home")).values()))
    found = {name: np.array(list(collected.scores(trial).values())) for name, trial in trials.items()}
    if collected.missing or not len(home):
        why = next((f": {name}: {error}" for name, error in collected.failures.items()), "")
        raise ValueError(f"{len(collected.missing)} of its trainings and tests are missing{why}: run it again")
    span = float(np.mean(home)) - FLOORS[task]
    if span <= 0.0:
        raise ValueError(f"{task}: ideal-trained policies are no better than random actions: train more seeds")
    shares = {name: (values - FLOORS[task]) / span for name, values in found.items()}
    scores = {name: effect([Stratum(share, np.zeros_like(share), paired=True)]) for name, share in shares.items()}
    good = [name for name in (IDEAL, LOOP, THROUGH) if name in scores and scores[name].mean >= 1.0 - MARGIN]
    best = max(scores, key=lambda name: scores[name].mean)
    wins = scores[best].mean - scores[IDEAL].mean > MARGIN
    return Measured(scores, good[0] if good else best if wins else BUY)
