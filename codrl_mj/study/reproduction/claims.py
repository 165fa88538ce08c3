"""What is reported about the paper's experiments: each number with its source, and the check that judges it.

Two sources: the paper itself (arXiv 2507.00268), each of whose experiments is one run, read off a figure; and a quick
study of the paper's loop on unmodified Gymnasium dynamics, of 2 to 40 seeds, that preceded this package.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.study.reproduction.arms import CENTRE
from codrl_mj.study.reproduction.series import Epochs, Series
from codrl_mj.study.reproduction.value_iteration import TASK as VALUE_TASK
from codrl_mj.study.reproduction.value_iteration import Optimum
from codrl_mj.study.reproduction.verdicts import (
    Check,
    Holds,
    Verdict,
    every_seed,
    higher,
    one_episode,
    one_run,
    same,
    some_seed,
    within,
)
from codrl_mj.tasks import TASKS

PAPER_SAYS, STUDY_SAYS, PORT = "paper", "quick study", "this port"
"""Who says it: the paper; the quick study; or ourselves, since both kinds of physics are to be one."""

# what the paper's words are taken to mean, which have no number
ALMOST_PERFECT = 5.0  # % of the desired torque's rms
WELL = 20.0  # % of the desired torque's rms
SIMILAR_RETURN = 10.0  # Pendulum: 7 % of its return
ALWAYS = 0.95  # share of the test episodes, in which the paper's one episode is no accident
NEAR_CENTRE = 0.9  # share of the steps of a test
FULL_LENGTH = 4000.0  # steps of an epoch
FULL_RETURN = 3800.0  # of an epoch, that "approaches 4000"


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What claims are judged by."""

    series: Mapping[str, Series]
    """The runs of every arm, by its name."""
    optima: Sequence[Optimum] = ()
    """Value iteration of the continuous mountain car."""


class Measure(NamedTuple):
    """What of the runs a claim is about."""

    text: str
    """What it is, with the unit."""
    values: Callable[..., Any]
    """One value for each seed of a series; of several, or of the evidence, all that the check is given, as a tuple."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement, and how it is judged."""

    task: str
    """Task name."""
    source: str
    """Who says it: `PAPER_SAYS`, `STUDY_SAYS` or `PORT`."""
    statement: str
    """What is said, with the number that is reported."""
    measured: Measure
    """What is judged."""
    arms: tuple[str, ...]
    """Names of the arms that it is about; none if it is about no runs."""
    check: Check | Holds
    """How it is judged."""

    @property
    def measure(self) -> str:
        """What of the runs it is about, with the unit."""
        return self.measured.text

    @property
    def physics(self) -> str:
        """`mujoco` or `analytic`; both where both are compared, nothing where no runs are needed."""
        return " and ".join(dict.fromkeys(name.rpartition(", ")[2] for name in self.arms))

    @property
    def identity(self) -> tuple[str, str, str, str]:
        """What it has in common with the same claim on the other kind of physics alone."""
        return self.task, self.source, self.statement, self.measure

    @property
    def section(self) -> str:
        """Where in the paper the experiment is described."""
        name = {VALUE_TASK: "Mountain Car"}.get(self.task, self.task.replace("_", " ").title())
        return f"Solving the {name} Environment"

    def judge(self, evidence: Evidence) -> Verdict:
        """The verdict."""
        series = [evidence.series[name] for name in self.arms]
        found = self.measured.values(*series) if series else self.measured.values(evidence)
        return self.check(*found) if isinstance(found, tuple) else self.check(found)


def _near_centre(series: Series) -> np.ndarray:
    return series.tested("returns", CENTRE) / TASKS[series.arm.task].max_episode_steps


def _first_epoch(reached: Callable[[Epochs], np.ndarray]) -> Callable[[Series], np.ndarray]:
    """The first epoch in which something holds; one more than there are if it never does."""
    return lambda series: np.array([1.0 + np.argmax(np.append(reached(one), True)) for one in series.epochs()])


def _settling(series: Series) -> np.ndarray:
    """Infinite where most episodes do not arrive."""
    return np.array([np.median(times) for times in series.times_to_goal()])


LAST = Measure("mean return of the last 50 training episodes", Series.last_returns)
RETURN = Measure("mean return in test", lambda series: series.tested("returns"))
SUCCESS = Measure("share of test episodes that succeed", lambda series: series.tested("success"))
FAILURE = Measure("share of test episodes that fail", lambda series: series.tested("failure"))
SETTLING = Measure("median settling time [s]", _settling)
TIMES = Measure("time to the goal in test [s]", Series.times_to_goal)
TRACKING = Measure("rms torque error / rms desired torque [%]", lambda series: series.tested("tracking_percent"))
LARGEST_ERROR = Measure("largest torque error in test [N·m]", lambda series: series.tested("tracking_max"))
CENTRED = Measure("share of the 500 steps with |x| <= 0.1 m", _near_centre)
LONG_EPOCH = Measure("first epoch of length 4000", _first_epoch(lambda epochs: epochs.lengths >= FULL_LENGTH))
PAID_EPOCH = Measure("first epoch with a return of 3800", _first_epoch(lambda epochs: epochs.returns >= FULL_RETURN))


def _compared(measure: Measure, how: str, by_seed: bool = False) -> Measure:
    """A measure of two arms; `by_seed`, of the seeds that both have."""

    def values(one: Series, other: Series) -> tuple[np.ndarray, np.ndarray]:
        if by_seed:
            one, other = one.only(other.runs), other.only(one.runs)
        return measure.values(one), measure.values(other)

    return Measure(f"{measure.text}: {how}", values)


def _optimum(discount: float, still: bool) -> Measure:
    """Whether the best policy at a discount factor stands still, or always arrives; and what it does."""

    def values(evidence: Evidence) -> tuple[bool | None, str]:
        for one in evidence.optima:
            if one.discount == discount:
                text = f"return {one.returns.mean:.1f}, {100 * one.success:.0f} % of episodes reach the goal"
                return (one.stands_still if still else one.success == 1.0), text
        return None, ""

    return Measure("what value iteration's policy does in Gymnasium's environment", values)


Row = tuple[str, Measure, Sequence[str], Check | Holds]
"""A claim's statement, what is judged, its arms without task and physics, and how."""


def _claims(task: str, physics: str, paper: Sequence[Row], study: Sequence[Row]) -> list[Claim]:
    """The claims about a task on one kind of physics: the paper's and the quick study's."""
    return [
        Claim(task, source, statement, measured, tuple(f"{task}, {arm}, {physics}" for arm in arms), check)
        for source, rows in ((PAPER_SAYS, paper), (STUDY_SAYS, study))
        for statement, measured, arms, check in rows
    ]


def _same_physics(task: str, motors: Sequence[str], margin: float) -> list[Claim]:
    """MuJoCo and Gymnasium's own equations give the same results, seed by seed."""
    return [
        Claim(
            task,
            PORT,
            f"{motor}: training in MuJoCo comes to what it comes to on Gymnasium's equations",
            _compared(LAST, "MuJoCo minus Gymnasium", by_seed=True),
            (f"{task}, paper, {motor}, mujoco", f"{task}, paper, {motor}, analytic"),
            same(margin, paired=True),
        )
        for motor in motors
    ]


_PRINTED, _REPAIRED = "paper, paper gains", "repaired, paper gains"
_IDEAL, _REPAIRED_IDEAL, _FAST = "paper, ideal", "repaired, ideal", "paper, fast gains"
_BOTH = (("as printed", _PRINTED), ("repaired", _REPAIRED))

_PENDULUM = _claims(
    "pendulum",
    "mujoco",
    paper=[
        *(
            (f"{name}: the desired torque is tracked almost perfectly", TRACKING, [arm], within(high=ALMOST_PERFECT))
            for name, arm in _BOTH
        ),
        *((f"{name}: upright and still within 10 s", SUCCESS, [arm], within(low=ALWAYS)) for name, arm in _BOTH),
        (
            "repaired: the return is the ideal environment's",
            _compared(RETURN, "with the motor minus ideal"),
            [_REPAIRED, _REPAIRED_IDEAL],
            same(SIMILAR_RETURN),
        ),
    ],
    study=[
        (
            "as printed it does not learn: -1413 (one ReLU is all that the critic sees of the state)",
            RETURN,
            [_PRINTED],
            within(high=-1000.0),
        ),
        ("repaired: -147 to -152", RETURN, [_REPAIRED], within(-160.0, -145.0)),
        ("repaired, ideal: -150 to -152", RETURN, [_REPAIRED_IDEAL], within(-160.0, -145.0)),
        ("repaired: always upright in the end", SUCCESS, [_REPAIRED], within(low=1.0)),
        ("repaired: settles within 4 s", SETTLING, [_REPAIRED], every_seed(4.0)),
    ],
)

_RIVALS = (("the ideal environment", _IDEAL), ("perfect tracking (gains 2, 10, 1e-6)", _FAST))


def _mountain_car(physics: str) -> list[Claim]:
    return _claims(
        "mountain_car",
        physics,
        paper=[
            ("gains 1, 1, 1e-2: about -114", LAST, [_PRINTED], one_run(-114.0)),
            ("gains 1, 1, 1e-2: tracking is imperfect", TRACKING, [_PRINTED], within(low=ALMOST_PERFECT)),
            ("gains 2, 10, 1e-6: tracking is perfect", TRACKING, [_FAST], within(high=ALMOST_PERFECT)),
            ("gains 1, 1, 1e-2: goal in 85 s", TIMES, [_PRINTED], one_episode(85.0)),
            ("gains 2, 10, 1e-6: goal in 100 s", TIMES, [_FAST], one_episode(100.0)),
            ("ideal: goal in 160 s", TIMES, [_IDEAL], one_episode(160.0)),
            *(
                (
                    f"imperfect tracking (gains 1, 1, 1e-2) beats {rival}",
                    _compared(measure, "the first minus the second"),
                    [_PRINTED, arm],
                    higher(),
                )
                for rival, arm in _RIVALS
                for measure in (LAST, RETURN)
            ),
        ],
        study=[
            ("gains 1, 1, 1e-2: -123 ± 3", LAST, [_PRINTED], within(-126.0, -120.0)),
            ("gains 2, 10, 1e-6: -118 ± 3", LAST, [_FAST], within(-121.0, -115.0)),
            ("ideal: -118 ± 3", LAST, [_IDEAL], within(-121.0, -115.0)),
        ],
    )


_MOUNTAIN_CAR_CONTINUOUS = _claims(
    VALUE_TASK,
    "mujoco",
    paper=[
        *((f"{name}: the return is about 95", LAST, [arm], within(90.0, 100.0)) for name, arm in _BOTH),
        *((f"{name}: goal in 75 s", TIMES, [arm], one_episode(75.0)) for name, arm in _BOTH),
        *((f"{name}: tracking is nearly perfect", TRACKING, [arm], within(high=ALMOST_PERFECT)) for name, arm in _BOTH),
    ],
    study=[
        ("as printed it fails: -99.9", RETURN, [_PRINTED], within(high=0.0)),
        ("repaired: 91 to 93", RETURN, [_REPAIRED], within(91.0, 94.0)),
        ("repaired, ideal: likewise", RETURN, [_REPAIRED_IDEAL], within(91.0, 94.0)),
        *(
            (
                f"a discount factor of {discount} makes {'standing still' if still else 'driving'} optimal",
                _optimum(discount, still),
                [],
                Holds("it applies no force in any episode" if still else "it reaches the goal in every episode"),
            )
            for discount, still in ((0.85, True), (0.9, True), (0.95, False), (0.99, False))
        ),
    ],
)

_ACROBOT = _claims(
    "acrobot",
    "mujoco",
    paper=[
        ("the desired torque is well tracked", TRACKING, [_PRINTED], within(high=WELL)),
        ("the return converges to about -200", LAST, [_PRINTED], one_run(-200.0)),
        ("goal in about 25 s", TIMES, [_PRINTED], one_episode(25.0)),
    ],
    study=[
        ("-83 to -95 in training", LAST, [_PRINTED], within(-95.0, -80.0)),
        ("ideal: likewise", LAST, [_IDEAL], within(-95.0, -80.0)),
        (
            "of some seeds the greedy policy often never finishes: of one in three, 30 % of the episodes",
            FAILURE,
            [_PRINTED],
            some_seed(1 - ALWAYS),
        ),
    ],
)


def _cartpole(physics: str) -> list[Claim]:
    return _claims(
        "cartpole",
        physics,
        paper=[
            ("episodes last the whole epoch from 32 on", LONG_EPOCH, [_PRINTED], one_run(32)),
            ("the return approaches 4000 after epoch 35", PAID_EPOCH, [_PRINTED], one_run(35)),
            ("the torque error is within ±0.1 N·m", LARGEST_ERROR, [_PRINTED], every_seed(0.1)),
            ("pole and cart stay in bounds in test", SUCCESS, [_PRINTED], within(low=ALWAYS)),
            ("the cart stays near the origin in test", CENTRED, [_PRINTED], within(low=NEAR_CENTRE)),
        ],
        study=[
            ("an epoch's return reaches 3800 by epoch 30 to 47", PAID_EPOCH, [_PRINTED], every_seed(50.0)),
            ("500 of 500 in test", RETURN, [_PRINTED], within(low=500.0)),
            ("ideal: likewise", RETURN, [_IDEAL], within(low=500.0)),
            ("the torque error reaches 0.119 N·m", LARGEST_ERROR, [_PRINTED], within(0.1, 0.14)),
        ],
    )


CLAIMS: tuple[Claim, ...] = (
    *_PENDULUM,
    *_mountain_car("mujoco"),
    *_mountain_car("analytic"),
    *_same_physics("mountain_car", ("paper gains", "fast gains", "ideal"), margin=3.0),
    *_MOUNTAIN_CAR_CONTINUOUS,
    *_ACROBOT,
    *_cartpole("mujoco"),
    *_cartpole("analytic"),
    *_same_physics("cartpole", ("paper gains", "ideal"), margin=200.0),
)
"""Everything that is reported, in the paper's order."""
