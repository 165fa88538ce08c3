"""What is reported about the paper's experiments: each number with its source, and the check that judges it.

The paper (arXiv 2507.00268) shows one run of each experiment; its numbers are read off figures.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.tasks import TASKS
from reproduction.arms import CENTRE
from reproduction.checks import Check, Verdict, every_seed, higher, one_episode, one_run, same, within
from reproduction.series import Epochs, Series
from reproduction.value_iteration import TASK as VALUE_TASK

PAPER_SAYS, PORT = "paper", "this port"
"""Who says it: the paper; or ourselves, since both kinds of physics are to be one."""

# what the paper's words are taken to mean, which have no number
ALMOST_PERFECT = 5.0  # % of the desired torque's rms
WELL = 20.0  # % of the desired torque's rms
SIMILAR_RETURN = 10.0  # Pendulum: 7 % of its return
ALWAYS = 0.95  # share of the test episodes, in which the paper's one episode is no accident
NEAR_CENTRE = 0.9  # share of the steps of a test
FULL_LENGTH = 4000.0  # steps of an epoch
FULL_RETURN = 3800.0  # of an epoch, that "approaches 4000"


class Measure(NamedTuple):
    """What of the runs a claim is about."""

    text: str
    """What it is, with the unit."""
    values: Callable[[Series], Any]
    """One value for each seed of a series; of `TIMES` an array for each."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement, and how it is judged."""

    task: str
    """Task name."""
    source: str
    """Who says it: `PAPER_SAYS` or `PORT`."""
    statement: str
    """What is said, with the number that is reported."""
    measure: Measure
    """What is judged."""
    arms: tuple[str, ...]
    """Names of the arm that it is about, or of the two that it compares."""
    check: Check
    """How it is judged."""

    @property
    def physics(self) -> str:
        """`mujoco` or `analytic`; both where both are compared."""
        return " and ".join(dict.fromkeys(name.rpartition(", ")[2] for name in self.arms))

    @property
    def section(self) -> str:
        """Where in the paper the experiment is described."""
        name = {VALUE_TASK: "Mountain Car"}.get(self.task, self.task.replace("_", " ").title())
        return f"Solving the {name} Environment"

    def judge(self, series: Mapping[str, Series]) -> Verdict:
        """The verdict by the runs of every arm, by its name."""
        mine = [series[name] for name in self.arms]
        if self.check.paired:
            shared = set.intersection(*(set(one.runs) for one in mine))
            mine = [one.only(shared) for one in mine]
        return self.check(*(self.measure.values(one) for one in mine))


def _near_centre(series: Series) -> np.ndarray:
    return series.tested("returns", CENTRE) / TASKS[series.arm.task].max_episode_steps


def _first_epoch(reached: Callable[[Epochs], np.ndarray]) -> Callable[[Series], np.ndarray]:
    """The first epoch in which something holds; one more than there are if it never does."""
    return lambda series: np.array([1.0 + np.argmax(np.append(reached(one), True)) for one in series.epochs()])


LAST = Measure("mean return of the last 50 training episodes", Series.last_returns)
RETURN = Measure("mean return in test", lambda series: series.tested("returns"))
SUCCESS = Measure("share of test episodes that succeed", lambda series: series.tested("success"))
TIMES = Measure("time to the goal in test [s]", Series.times_to_goal)
TRACKING = Measure("rms torque error / rms desired torque [%]", lambda series: series.tested("tracking_percent"))
LARGEST_ERROR = Measure("largest torque error in test [N·m]", lambda series: series.tested("tracking_max"))
CENTRED = Measure("share of the 500 steps with |x| <= 0.1 m", _near_centre)
LONG_EPOCH = Measure("first epoch of length 4000", _first_epoch(lambda epochs: epochs.lengths >= FULL_LENGTH))
PAID_EPOCH = Measure("first epoch with a return of 3800", _first_epoch(lambda epochs: epochs.returns >= FULL_RETURN))


def _compared(measure: Measure, how: str) -> Measure:
    """A measure of two arms."""
    return measure._replace(text=f"{measure.text}: {how}")


_Row = tuple[str, Measure, Sequence[str], Check]
"""A claim's statement, what is judged, its arms without task and physics, and how."""


def _paper(task: str, *rows: _Row, physics: Sequence[str] = ("mujoco",)) -> list[Claim]:
    """What the paper says of a task, to be judged on each kind of physics."""
    return [
        Claim(task, PAPER_SAYS, statement, measure, tuple(f"{task}, {arm}, {kind}" for arm in arms), check)
        for kind in physics
        for statement, measure, arms, check in rows
    ]


def _same_physics(task: str, motors: Sequence[str], margin: float) -> list[Claim]:
    """MuJoCo and Gymnasium's own equations give the same results, seed by seed."""
    return [
        Claim(
            task,
            PORT,
            f"{motor}: training in MuJoCo comes to what it comes to on Gymnasium's equations",
            _compared(LAST, "MuJoCo minus Gymnasium"),
            (f"{task}, paper, {motor}, mujoco", f"{task}, paper, {motor}, analytic"),
            same(margin, paired=True),
        )
        for motor in motors
    ]


_PRINTED, _REPAIRED = "paper, paper gains", "repaired, paper gains"
_IDEAL, _FAST = "paper, ideal", "paper, fast gains"
_BOTH = (("as printed", _PRINTED), ("repaired", _REPAIRED))
_RIVALS = (("the ideal environment", _IDEAL), ("perfect tracking (gains 2, 10, 1e-6)", _FAST))

CLAIMS: tuple[Claim, ...] = (
    *_paper(
        "pendulum",
        *(
            (f"{name}: the desired torque is tracked almost perfectly", TRACKING, [arm], within(high=ALMOST_PERFECT))
            for name, arm in _BOTH
        ),
        *((f"{name}: upright and still within 10 s", SUCCESS, [arm], within(low=ALWAYS)) for name, arm in _BOTH),
        (
            "repaired: the return is the ideal environment's",
            _compared(RETURN, "with the motor minus ideal"),
            [_REPAIRED, "repaired, ideal"],
            same(SIMILAR_RETURN),
        ),
    ),
    *_paper(
        "mountain_car",
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
        physics=("mujoco", "analytic"),
    ),
    *_same_physics("mountain_car", ("paper gains", "fast gains", "ideal"), margin=3.0),
    *_paper(
        VALUE_TASK,
        *((f"{name}: the return is about 95", LAST, [arm], within(90.0, 100.0)) for name, arm in _BOTH),
        *((f"{name}: goal in 75 s", TIMES, [arm], one_episode(75.0)) for name, arm in _BOTH),
        *((f"{name}: tracking is nearly perfect", TRACKING, [arm], within(high=ALMOST_PERFECT)) for name, arm in _BOTH),
    ),
    *_paper(
        "acrobot",
        ("the desired torque is well tracked", TRACKING, [_PRINTED], within(high=WELL)),
        ("the return converges to about -200", LAST, [_PRINTED], one_run(-200.0)),
        ("goal in about 25 s", TIMES, [_PRINTED], one_episode(25.0)),
    ),
    *_paper(
        "cartpole",
        ("episodes last the whole epoch from 32 on", LONG_EPOCH, [_PRINTED], one_run(32)),
        ("the return approaches 4000 after epoch 35", PAID_EPOCH, [_PRINTED], one_run(35)),
        ("the torque error is within ±0.1 N·m", LARGEST_ERROR, [_PRINTED], every_seed(0.1)),
        ("pole and cart stay in bounds in test", SUCCESS, [_PRINTED], within(low=ALWAYS)),
        ("the cart stays near the origin in test", CENTRED, [_PRINTED], within(low=NEAR_CENTRE)),
        physics=("mujoco", "analytic"),
    ),
    *_same_physics("cartpole", ("paper gains", "ideal"), margin=200.0),
)
"""Everything that is reported, in the paper's order."""
