"""Reported results of the paper's experiments, with their sources and the checks that judge them.

The paper (arXiv 2507.00268) shows one run of each experiment; its numbers are read off figures.
Claims are judged by published rows only (`reproduction.rows`), so every reader can repeat that.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from reproduction.checks import (
    Check,
    Verdict,
    behavior,
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
"""Sources: the paper; or this port, since both kinds of physics should give the same results."""

# These thresholds stand for words of the paper that have no number. The first two are shares [%] of
# the desired torque's rms.
ALMOST_PERFECT = 5.0
WELL = 20.0
# Differences of returns that do not matter.
SIMILAR_RETURN = {"pendulum": 10.0, "mountain_car": 3.0, "cartpole": 200.0}
# Reach of "about", "approximately" and "~" on both sides, of returns and of times [s].
ABOUT = 5.0
# Share of the test episodes from which on a behavior is the usual one.
ALWAYS = 0.95
# Share of the steps of a test episode.
NEAR_CENTRE = 0.9


class Measure(NamedTuple):
    """Quantity of the runs that a claim is about."""

    text: str
    """Description with the unit."""
    column: str
    """Column of the published rows."""
    unit: str = ""
    """Unit that follows a value; `share` for shares, which are written in %."""
    parse: Callable[[str], Any] = float
    """Function from a row's text to a value."""

    def values(self, rows: Sequence[Row]) -> Any:
        """Return the values of the rows that have one, shape (n,); a list of arrays for `TIMES`."""
        values = [self.parse(row[self.column]) for row in rows if row.get(self.column)]
        return values if self.parse is times_of else np.array(values)


@dataclasses.dataclass(frozen=True)
class Claim:
    """Reported statement, and the check that judges it."""

    task: str
    """Task name."""
    source: str
    """Source: `PAPER_SAYS` or `PORT`."""
    figure: str
    """Figure of the paper; empty if only the text has the statement."""
    statement: str
    """Statement in a few words."""
    says: str
    """Reported number or word."""
    measure: Measure
    """Quantity that is judged."""
    settings: str
    """Settings of the agent."""
    motors: tuple[str, ...]
    """Names of the motor of the judged arm, or of the two compared arms."""
    check: Check
    """Check that judges it."""
    counted: bool = True
    """True for the statement's verdict.

    False for a second look, and for settings as printed if repaired ones exist.
    """
    physics: tuple[str, ...] = ("mujoco",)
    """Physics of the trainings; the first of two is compared with the second."""

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the judged arm, or of the two compared arms."""
        kinds = [(motor, physics) for physics in self.physics for motor in self.motors]
        return tuple(
            f"{self.task}, {self.settings}, {motor}, {physics}" for motor, physics in kinds
        )

    def judge(self, rows: Mapping[str, Sequence[Row]]) -> Verdict:
        """Judge the claim by the published rows of every arm, by its name.

        Pairs are formed from the first row of each seed.
        """
        arm_rows = [rows.get(name, ()) for name in self.arms]
        if self.check.rule == "paired":
            by_seed = [
                {row["seed"]: row for row in reversed(rows_by_seed)} for rows_by_seed in arm_rows
            ]
            shared = [row["seed"] for row in by_seed[0].values() if row["seed"] in by_seed[1]]
            arm_rows = [[rows_by_seed[seed] for seed in shared] for rows_by_seed in by_seed]
        return self.check(*map(self.measure.values, arm_rows))

    def without_motor(self, rows: Mapping[str, Sequence[Row]]) -> float | None:
        """Return the judged mean without a motor, if it is known and means something.

        It is None for comparisons and for quantities of the motor.
        """
        # Times are only known of some trainings, their medians of more.
        column = {TIMES: "time_to_goal"}.get(self.measure, self.measure.column)
        ideal = rows.get(f"{self.task}, {self.settings}, ideal, mujoco", ())
        values = [float(row[column]) for row in ideal if row[column]]
        if not values or len(self.arms) > 1 or column.startswith("tracking"):
            return None
        return float(np.mean(values))


LAST = Measure("mean return of the last 50 training episodes", "last_50")
RETURN = Measure("mean return in test", "returns")
UPRIGHT = Measure("share of test episodes that end upright", "upright", "share")
SUCCESS = Measure("share of test episodes that succeed", "success", "share")
TIMES = Measure("time to the goal in test [s]", "times", "s", times_of)
TRACKING = Measure("rms torque error / rms desired torque [%]", "tracking_percent", "%")
STEP_TRACKING = Measure(TRACKING.text + " at policy steps", "tracking_step_percent", "%")
"""Torque error of tasks with an inner loop: the paper's Algorithm 2 reports its last torque."""
LARGEST_ERROR = Measure("largest torque error in test [N·m]", "tracking_max", "N·m")
CENTRED = Measure("share of the 500 steps with |x| <= 0.1 m", "centred", "share")
LONG_EPOCH = Measure("first epoch of length 4000", "long_epoch")
PAID_EPOCH = Measure("first epoch with a return of 3800", "paid_epoch")

_Row = tuple[str, str, str, Measure, Sequence[str], Check]
"""Figure, statement and number of a claim, its quantity, its motors, and its check."""


def _paper(
    task: str, *rows: _Row, settings: Sequence[str] = ("paper",), counted: bool = True
) -> list[Claim]:
    """Return the paper's claims about a task; the last of the settings counts."""
    return [
        Claim(
            task,
            PAPER_SAYS,
            *row[:4],
            name,
            tuple(row[4]),
            row[5],
            counted and name == settings[-1],
        )
        for row in rows
        for name in settings
    ]


def _same_physics(task: str, motors: Sequence[str]) -> list[Claim]:
    """Return the claims that MuJoCo and Gymnasium's equations give the same results per seed."""
    check, engines = same(SIMILAR_RETURN[task], paired=True), ("mujoco", "analytic")
    return [
        Claim(
            task,
            PORT,
            "",
            f"{motor}: MuJoCo minus Gymnasium",
            "0",
            LAST,
            "paper",
            (motor,),
            check,
            physics=engines,
        )
        for motor in motors
    ]


_BOTH = ("paper", "repaired")
_MOTOR, _FAST, _IDEAL = ("paper gains",), ("fast gains",), ("ideal",)
_RIVALS = (("no motor", "75 s sooner", "ideal"), ("gains 2, 10, 1e-6", "15 s sooner", "fast gains"))


def _beats(measure: Measure) -> list[_Row]:
    """Return the claims that the paper's gains beat both rivals; a step is 1 s and costs 1."""
    check = higher(SIMILAR_RETURN["mountain_car"])
    return [
        ("", f"beats {rival}", advantage, measure, (*_MOTOR, rival_motor), check)
        for rival, advantage, rival_motor in _RIVALS
    ]


_PERFECT, _TRACKED = within(high=ALMOST_PERFECT), "torque error"
_LAST = "return of the last 50 episodes"
CLAIMS: tuple[Claim, ...] = (
    *_paper(
        "pendulum",
        ("5b", _TRACKED, "almost none", TRACKING, _MOTOR, _PERFECT),
        ("5c–f", "upright within 10 s", "yes", UPRIGHT, _MOTOR, behavior(ALWAYS)),
        settings=_BOTH,
    ),
    *_paper(
        "pendulum",
        (
            "5a",
            "return minus that without a motor",
            "similar",
            RETURN,
            ("paper gains", "ideal"),
            same(SIMILAR_RETURN["pendulum"]),
        ),
        settings=("repaired",),
    ),
    *_paper(
        "mountain_car",
        ("6a", _LAST, "about -114", LAST, _MOTOR, one_run(-114.0, ABOUT)),
        ("6b", _TRACKED, "imperfect", STEP_TRACKING, _MOTOR, within(low=ALMOST_PERFECT)),
        ("", f"{_TRACKED}, gains 2, 10, 1e-6", "perfect", STEP_TRACKING, _FAST, _PERFECT),
        ("6c", "time to the goal", "under 85 s", TIMES, _MOTOR, one_episode(85.0, under=True)),
        ("", "time to the goal, gains 2, 10, 1e-6", "100 s", TIMES, _FAST, one_episode(100.0)),
        ("", "time to the goal, no motor", "160 s", TIMES, _IDEAL, one_episode(160.0)),
        *_beats(RETURN),
    ),
    *_paper("mountain_car", *_beats(LAST), counted=False),
    *_same_physics("mountain_car", ("paper gains", "fast gains", "ideal")),
    *_paper(
        VALUE_TASK,
        ("7a", _LAST, "about 95", LAST, _MOTOR, one_run(95.0, ABOUT)),
        ("7c", "time to the goal", "75 s", TIMES, _MOTOR, one_episode(75.0)),
        ("7b", _TRACKED, "almost none", STEP_TRACKING, _MOTOR, _PERFECT),
        settings=_BOTH,
    ),
    *_paper(
        "acrobot",
        ("8b", _TRACKED, "small", STEP_TRACKING, _MOTOR, within(high=WELL)),
        ("8a", _LAST, "about -200", LAST, _MOTOR, one_run(-200.0, ABOUT)),
        ("8c", "time to the goal", "about 25 s", TIMES, _MOTOR, one_episode(25.0, ABOUT)),
    ),
    *_paper(
        "cartpole",
        ("9a", "first whole epoch", "epoch 32", LONG_EPOCH, _MOTOR, one_run(32)),
        ("9a", "first epoch with a return near 4000", "epoch 35", PAID_EPOCH, _MOTOR, one_run(35)),
        ("9b", "largest torque error", "0.1 N·m", LARGEST_ERROR, _MOTOR, every_seed(0.1)),
        ("9c–d", "in bounds", "yes", SUCCESS, _MOTOR, behavior(ALWAYS)),
        ("9d", "near the origin", "yes", CENTRED, _MOTOR, within(low=NEAR_CENTRE)),
    ),
    *_same_physics("cartpole", ("paper gains", "ideal")),
)
"""All reported claims, in the paper's order."""


def needed(arm: str) -> set[str]:
    """Return the columns that an arm's claims need."""
    return {claim.measure.column for claim in CLAIMS if arm in claim.arms}


def as_text(measure: Measure, value: float) -> str:
    """Format a measured value with its unit."""
    return (
        f"{number(100 * value)} %"
        if measure.unit == "share"
        else f"{number(value)} {measure.unit}".strip()
    )
