"""What is reported about the paper's experiments: each number with its source, and the check that judges it.

The paper (arXiv 2507.00268) shows one run of each experiment; its numbers are read off figures. A
statement is judged by published rows alone (`reproduction.rows`), so whoever has them can judge it
again.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from reproduction.checks import (
    Check,
    Verdict,
    every_seed,
    higher,
    number,
    one_episode,
    one_run,
    same,
    within,
)
from reproduction.rows import Row, times_of
from reproduction.value_iteration import TASK as VALUE_TASK

PAPER_SAYS, PORT = "paper", "this port"
"""Who says it: the paper; or ourselves, since both kinds of physics are to be one."""

# what the paper's words are taken to mean, which have no number
ALMOST_PERFECT = 5.0  # % of the desired torque's rms
WELL = 20.0  # % of the desired torque's rms
SIMILAR_RETURN = {"pendulum": 10.0, "mountain_car": 3.0, "cartpole": 200.0}  # does not matter
ALWAYS = 0.95  # share of the test episodes, in which the paper's one episode is no accident
NEAR_CENTRE = 0.9  # share of the steps of a test


class Measure(NamedTuple):
    """What of the runs a claim is about."""

    text: str
    """What it is, with the unit."""
    column: str
    """Of the published rows."""
    unit: str = ""
    """What is written behind it; `share` for a share, which is written in %."""
    parse: Callable[[str], Any] = float
    """The value of a row by its text."""

    def values(self, rows: Sequence[Row]) -> Any:
        """One for each row that has it, shape (n,); of `TIMES` an array for each."""
        found = [self.parse(row[self.column]) for row in rows if row.get(self.column)]
        return found if self.parse is times_of else np.array(found)


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement, and how it is judged."""

    task: str
    """Task name."""
    source: str
    """Who says it: `PAPER_SAYS` or `PORT`."""
    figure: str
    """Where the paper shows it; empty if only its text says so."""
    statement: str
    """What is said to be so."""
    says: str
    """How, with the number that is reported."""
    measure: Measure
    """What is judged."""
    settings: str
    """Of the agent."""
    motors: tuple[str, ...]
    """What the arm that it is about is called for its motor, or the two that it compares."""
    check: Check
    """How it is judged."""
    counted: bool = True
    """Whether it is the statement's verdict, not that of settings as printed beside repaired ones, or a second look."""
    physics: tuple[str, ...] = ("mujoco",)
    """What it was trained in; of both kinds the first is compared with the second."""

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the arm that it is about, or of the two that it compares."""
        kinds = [(motor, physics) for physics in self.physics for motor in self.motors]
        return tuple(
            f"{self.task}, {self.settings}, {motor}, {physics}" for motor, physics in kinds
        )

    def judge(self, rows: Mapping[str, Sequence[Row]]) -> Verdict:
        """The verdict by the published rows of every arm, by its name; of pairs by the first row of each seed."""
        mine = [rows.get(name, ()) for name in self.arms]
        if self.check.rule == "paired":
            by_seed = [{row["seed"]: row for row in reversed(one)} for one in mine]
            shared = [row["seed"] for row in by_seed[0].values() if row["seed"] in by_seed[1]]
            mine = [[one[seed] for seed in shared] for one in by_seed]
        return self.check(*map(self.measure.values, mine))

    def without_motor(self, rows: Mapping[str, Sequence[Row]]) -> float | None:
        """The mean of what is judged where there is no motor; None if it is not known, compared, or of the motor."""
        column = {TIMES: "time_to_goal"}.get(
            self.measure, self.measure.column
        )  # medians are known of more trainings
        ideal = rows.get(f"{self.task}, {self.settings}, ideal, mujoco", ())
        values = [float(row[column]) for row in ideal if row[column]]
        if not values or len(self.arms) > 1 or self.measure in (TRACKING, LARGEST_ERROR):
            return None
        return float(np.mean(values))


LAST = Measure("mean return of the last 50 training episodes", "last_50")
RETURN = Measure("mean return in test", "returns")
UPRIGHT = Measure("share of test episodes that end upright", "upright", "share")
SUCCESS = Measure("share of test episodes that succeed", "success", "share")
TIMES = Measure("time to the goal in test [s]", "times", "s", times_of)
TRACKING = Measure("rms torque error / rms desired torque [%]", "tracking_percent", "%")
LARGEST_ERROR = Measure("largest torque error in test [N·m]", "tracking_max", "N·m")
CENTRED = Measure("share of the 500 steps with |x| <= 0.1 m", "centred", "share")
LONG_EPOCH = Measure("first epoch of length 4000", "long_epoch")
PAID_EPOCH = Measure("first epoch with a return of 3800", "paid_epoch")

_Row = tuple[str, str, str, Measure, Sequence[str], Check]
"""A claim's figure, statement and number, what is judged, its motors, and how."""


def _paper(
    task: str, *rows: _Row, settings: Sequence[str] = ("paper",), counted: bool = True
) -> list[Claim]:
    """What the paper says of a task; where its settings do not learn, the repaired ones count."""
    return [
        Claim(task, PAPER_SAYS, *row[:4], of, tuple(row[4]), row[5], counted and of == settings[-1])
        for row in rows
        for of in settings
    ]


def _same_physics(task: str, motors: Sequence[str]) -> list[Claim]:
    """MuJoCo and Gymnasium's own equations give the same results, seed by seed."""
    check, both = same(SIMILAR_RETURN[task], paired=True), ("mujoco", "analytic")
    return [
        Claim(
            task,
            PORT,
            "",
            f"{motor}: MuJoCo less Gymnasium",
            "0",
            LAST,
            "paper",
            (motor,),
            check,
            physics=both,
        )
        for motor in motors
    ]


_BOTH = ("paper", "repaired")
_MOTOR, _FAST, _IDEAL = ("paper gains",), ("fast gains",), ("ideal",)
_RIVALS = (("no motor", "75 s sooner", "ideal"), ("gains 2, 10, 1e-6", "15 s sooner", "fast gains"))


def _beats(measure: Measure) -> list[_Row]:
    """The paper's gains against both rivals; a step is a second and costs 1."""
    check = higher(SIMILAR_RETURN["mountain_car"])
    return [
        ("", f"beats {rival}", by, measure, (*_MOTOR, other), check) for rival, by, other in _RIVALS
    ]


_PERFECT, _TRACKED = within(high=ALMOST_PERFECT), "torque error"
CLAIMS: tuple[Claim, ...] = (
    *_paper(
        "pendulum",
        ("5b", _TRACKED, "almost none", TRACKING, _MOTOR, _PERFECT),
        ("5c–f", "upright within 10 s", "yes", UPRIGHT, _MOTOR, within(low=ALWAYS)),
        settings=_BOTH,
    ),
    *_paper(
        "pendulum",
        (
            "5a",
            "return, less ideal's",
            "similar",
            RETURN,
            ("paper gains", "ideal"),
            same(SIMILAR_RETURN["pendulum"]),
        ),
        settings=("repaired",),
    ),
    *_paper(
        "mountain_car",
        ("6a", "return, last 50", "-114", LAST, _MOTOR, one_run(-114.0)),
        ("6b", _TRACKED, "imperfect", TRACKING, _MOTOR, within(low=ALMOST_PERFECT)),
        ("", f"{_TRACKED}, gains 2, 10, 1e-6", "perfect", TRACKING, _FAST, _PERFECT),
        ("6c", "goal", "85 s", TIMES, _MOTOR, one_episode(85.0)),
        ("", "goal, gains 2, 10, 1e-6", "100 s", TIMES, _FAST, one_episode(100.0)),
        ("", "goal, no motor", "160 s", TIMES, _IDEAL, one_episode(160.0)),
        *_beats(RETURN),
    ),
    *_paper("mountain_car", *_beats(LAST), counted=False),
    *_same_physics("mountain_car", ("paper gains", "fast gains", "ideal")),
    *_paper(
        VALUE_TASK,
        ("7a", "return, last 50", "95", LAST, _MOTOR, within(90.0, 100.0)),
        ("7c", "goal", "75 s", TIMES, _MOTOR, one_episode(75.0)),
        ("7b", _TRACKED, "almost none", TRACKING, _MOTOR, _PERFECT),
        settings=_BOTH,
    ),
    *_paper(
        "acrobot",
        ("8b", _TRACKED, "small", TRACKING, _MOTOR, within(high=WELL)),
        ("8a", "return, last 50", "-200", LAST, _MOTOR, one_run(-200.0)),
        ("8c", "goal", "25 s", TIMES, _MOTOR, one_episode(25.0)),
    ),
    *_paper(
        "cartpole",
        ("9a", "whole epochs from", "epoch 32", LONG_EPOCH, _MOTOR, one_run(32)),
        ("9a", "return near 4000 from", "epoch 35", PAID_EPOCH, _MOTOR, one_run(35)),
        ("9b", "largest torque error", "0.1 N·m", LARGEST_ERROR, _MOTOR, every_seed(0.1)),
        ("9c–d", "in bounds", "yes", SUCCESS, _MOTOR, within(low=ALWAYS)),
        ("9d", "near the origin", "yes", CENTRED, _MOTOR, within(low=NEAR_CENTRE)),
    ),
    *_same_physics("cartpole", ("paper gains", "ideal")),
)
"""Everything that is reported, in the paper's order."""


def needed(arm: str) -> set[str]:
    """The columns by which an arm's claims are judged."""
    return {claim.measure.column for claim in CLAIMS if arm in claim.arms}


def as_text(measure: Measure, value: float) -> str:
    """A measured value with its unit."""
    return (
        f"{number(100 * value)} %"
        if measure.unit == "share"
        else f"{number(value)} {measure.unit}".strip()
    )
