"""What is reported about the paper's experiments: each number with its source, and the check that judges it.

Two sources: the paper itself (arXiv 2507.00268), each of whose experiments is one run, read off a figure; and a quick
study of the paper's loop on unmodified Gymnasium dynamics, of 2 to 40 seeds, that preceded this package.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.study.reproduction.arms import CENTRE
from codrl_mj.study.reproduction.series import Epochs, Series
from codrl_mj.study.reproduction.value_iteration import Optimum
from codrl_mj.study.reproduction.verdicts import (
    Check,
    EverySeed,
    Higher,
    Holds,
    OneEpisode,
    OneRun,
    Same,
    SomeSeed,
    Verdict,
    Within,
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


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement, and how it is judged."""

    task: str
    """Task name."""
    source: str
    """Who says it: `PAPER_SAYS`, `STUDY_SAYS` or `PORT`."""
    statement: str
    """What is said, with the number that is reported."""
    measure: str
    """What of the runs it is about, with the unit."""
    arms: tuple[str, ...]
    """Names of the arms that it is about; none if it is about no runs."""
    check: Check
    """How it is judged."""
    values: Callable[..., Any]
    """What is judged: a function of the arms' series (of the evidence, where there are none)."""

    @property
    def physics(self) -> str:
        """`mujoco` or `analytic`; both where both are compared, nothing where no runs are needed."""
        return " and ".join(dict.fromkeys(name.rpartition(", ")[2] for name in self.arms))

    @property
    def section(self) -> str:
        """Where in the paper the experiment is described."""
        return f"Solving the {_SECTIONS[self.task]} Environment"

    def judge(self, evidence: Evidence) -> Verdict:
        """The verdict."""
        check: Any = self.check
        found = self.values(*(evidence.series[name] for name in self.arms)) if self.arms else self.values(evidence)
        return check(*found) if isinstance(found, tuple) else check(found)


_SECTIONS = {
    "pendulum": "Pendulum",
    "mountain_car": "Mountain Car",
    "mountain_car_continuous": "Mountain Car",
    "acrobot": "Acrobot",
    "cartpole": "Cartpole",
}


# One value for each seed


def last(series: Series) -> np.ndarray:
    """Mean return of the last 50 training episodes."""
    return series.last_returns()


def returns(series: Series) -> np.ndarray:
    """Mean return in test."""
    return series.tested("returns")


def success(series: Series) -> np.ndarray:
    """Share of the test episodes that succeed."""
    return series.tested("success")


def failure(series: Series) -> np.ndarray:
    """Share of the test episodes that fail."""
    return series.tested("failure")


def settling(series: Series) -> np.ndarray:
    """Median time to the goal [s] of the test episodes, infinite where it is not reached."""
    return np.array([np.median(times) for times in series.times_to_goal()])


def tracking(series: Series) -> np.ndarray:
    """Rms torque error [% of the desired torque's rms]."""
    return series.tested("tracking_percent")


def largest_error(series: Series) -> np.ndarray:
    """Largest torque error [N*m]."""
    return series.tested("tracking_max")


def near_centre(series: Series) -> np.ndarray:
    """Share of the time limit that is spent near the centre of the track."""
    limit = TASKS[series.arm.task].max_episode_steps
    return series.tested("returns", CENTRE) / limit


def _first_epochs(reached: Callable[[Epochs], np.ndarray]) -> Callable[[Series], np.ndarray]:
    """The first epoch in which something holds; one more than there are if it never does."""

    def values(series: Series) -> np.ndarray:
        return np.array([min(one.first(reached(one)), len(one.counts) + 1) for one in series.epochs()], dtype=float)

    return values


full_length = _first_epochs(lambda epochs: epochs.lengths >= FULL_LENGTH)
full_return = _first_epochs(lambda epochs: epochs.returns >= FULL_RETURN)


def _both(measure: Callable[[Series], np.ndarray]) -> Callable[[Series, Series], tuple[np.ndarray, np.ndarray]]:
    return lambda one, other: (measure(one), measure(other))


def _by_seed(measure: Callable[[Series], np.ndarray]) -> Callable[[Series, Series], tuple[np.ndarray, np.ndarray]]:
    """A measure of the seeds that both arms have."""

    def values(one: Series, other: Series) -> tuple[np.ndarray, np.ndarray]:
        shared = one.runs.keys() & other.runs.keys()
        return measure(one.only(shared)), measure(other.only(shared))

    return values


_LAST = "mean return of the last 50 training episodes"
_TEST = "mean return in test"
_SUCCESS = "share of test episodes that succeed"
_TRACKING = "rms torque error / rms desired torque [%]"
_TIME = "time to the goal in test [s]"


# The claims


def _pendulum() -> list[Claim]:
    printed, ours, ideal = (
        f"pendulum, {name}, mujoco" for name in ("paper, paper gains", "repaired, paper gains", "repaired, ideal")
    )
    upright, settled = Within(low=ALWAYS), EverySeed(4.0)

    def claim(*fields: Any) -> Claim:
        return Claim("pendulum", *fields)

    return [
        claim(
            PAPER_SAYS,
            f"{settings}: the desired torque is tracked almost perfectly",
            _TRACKING,
            (arm,),
            Within(high=ALMOST_PERFECT),
            tracking,
        )
        for settings, arm in (("as printed", printed), ("repaired", ours))
    ] + [
        claim(PAPER_SAYS, "as printed: upright and still within 10 s", _SUCCESS, (printed,), upright, success),
        claim(PAPER_SAYS, "repaired: upright and still within 10 s", _SUCCESS, (ours,), upright, success),
        claim(
            PAPER_SAYS,
            "repaired: the return is the ideal environment's",
            f"{_TEST}: with the motor minus ideal",
            (ours, ideal),
            Same(SIMILAR_RETURN),
            _both(returns),
        ),
        claim(
            STUDY_SAYS,
            "as printed it does not learn: -1413 (one ReLU is all that the critic sees of the state)",
            _TEST,
            (printed,),
            Within(high=-1000.0),
            returns,
        ),
        claim(STUDY_SAYS, "repaired: -147 to -152", _TEST, (ours,), Within(-160.0, -145.0), returns),
        claim(STUDY_SAYS, "repaired, ideal: -150 to -152", _TEST, (ideal,), Within(-160.0, -145.0), returns),
        claim(STUDY_SAYS, "repaired: always upright in the end", _SUCCESS, (ours,), Within(low=1.0), success),
        claim(STUDY_SAYS, "repaired: settles within 4 s", "median settling time [s]", (ours,), settled, settling),
    ]


def _mountain_car(physics: str) -> list[Claim]:
    slow, fast, ideal = (f"mountain_car, paper, {motor}, {physics}" for motor in ("paper gains", "fast gains", "ideal"))

    def claim(*fields: Any) -> Claim:
        return Claim("mountain_car", *fields)

    rivals = (("the ideal environment", ideal), ("perfect tracking (gains 2, 10, 1e-6)", fast))
    return [
        claim(PAPER_SAYS, "gains 1, 1, 1e-2: about -114", _LAST, (slow,), OneRun(-114.0), last),
        claim(
            PAPER_SAYS,
            "gains 1, 1, 1e-2: tracking is imperfect",
            _TRACKING,
            (slow,),
            Within(low=ALMOST_PERFECT),
            tracking,
        ),
        claim(
            PAPER_SAYS,
            "gains 2, 10, 1e-6: tracking is perfect",
            _TRACKING,
            (fast,),
            Within(high=ALMOST_PERFECT),
            tracking,
        ),
        claim(PAPER_SAYS, "gains 1, 1, 1e-2: goal in 85 s", _TIME, (slow,), OneEpisode(85.0), Series.times_to_goal),
        claim(PAPER_SAYS, "gains 2, 10, 1e-6: goal in 100 s", _TIME, (fast,), OneEpisode(100.0), Series.times_to_goal),
        claim(PAPER_SAYS, "ideal: goal in 160 s", _TIME, (ideal,), OneEpisode(160.0), Series.times_to_goal),
        *(
            claim(
                PAPER_SAYS,
                f"imperfect tracking (gains 1, 1, 1e-2) beats {rival}",
                f"{measure}: the first minus the second",
                (slow, arm),
                Higher(),
                _both(values),
            )
            for rival, arm in rivals
            for measure, values in ((_LAST, last), (_TEST, returns))
        ),
        claim(STUDY_SAYS, "gains 1, 1, 1e-2: -123 ± 3", _LAST, (slow,), Within(-126.0, -120.0), last),
        claim(STUDY_SAYS, "gains 2, 10, 1e-6: -118 ± 3", _LAST, (fast,), Within(-121.0, -115.0), last),
        claim(STUDY_SAYS, "ideal: -118 ± 3", _LAST, (ideal,), Within(-121.0, -115.0), last),
    ]


def _mountain_car_continuous() -> list[Claim]:
    printed, ours, ideal = (
        f"mountain_car_continuous, {name}, mujoco"
        for name in ("paper, paper gains", "repaired, paper gains", "repaired, ideal")
    )

    def claim(*fields: Any) -> Claim:
        return Claim("mountain_car_continuous", *fields)

    both, near = (("as printed", printed), ("repaired", ours)), Within(90.0, 100.0)
    return [
        *(claim(PAPER_SAYS, f"{name}: the return is about 95", _LAST, (arm,), near, last) for name, arm in both),
        *(
            claim(PAPER_SAYS, f"{name}: goal in 75 s", _TIME, (arm,), OneEpisode(75.0), Series.times_to_goal)
            for name, arm in both
        ),
        *(
            claim(
                PAPER_SAYS,
                f"{name}: tracking is nearly perfect",
                _TRACKING,
                (arm,),
                Within(high=ALMOST_PERFECT),
                tracking,
            )
            for name, arm in both
        ),
        claim(STUDY_SAYS, "as printed it fails: -99.9", _TEST, (printed,), Within(high=0.0), returns),
        claim(STUDY_SAYS, "repaired: 91 to 93", _TEST, (ours,), Within(91.0, 94.0), returns),
        claim(STUDY_SAYS, "repaired, ideal: likewise", _TEST, (ideal,), Within(91.0, 94.0), returns),
        *(
            claim(
                STUDY_SAYS,
                f"a discount factor of {discount} makes standing still optimal"
                if still
                else f"a discount factor of {discount} makes driving optimal",
                "what value iteration's policy does in Gymnasium's environment",
                (),
                Holds("it applies no force in any episode" if still else "it reaches the goal in every episode"),
                _optimum(discount, still),
            )
            for discount, still in ((0.85, True), (0.9, True), (0.95, False), (0.99, False))
        ),
    ]


def _optimum(discount: float, still: bool) -> Callable[[Evidence], tuple[bool | None, str]]:
    """Whether the best policy at a discount factor stands still, or always arrives; and what it does."""

    def values(evidence: Evidence) -> tuple[bool | None, str]:
        found = next((one for one in evidence.optima if one.discount == discount), None)
        if found is None:
            return None, ""
        text = f"return {found.returns.mean:.1f}, {100 * found.success:.0f} % of episodes reach the goal"
        return (found.stands_still if still else found.success == 1.0), text

    return values


def _acrobot() -> list[Claim]:
    ours, ideal = (f"acrobot, paper, {motor}, mujoco" for motor in ("paper gains", "ideal"))

    def claim(*fields: Any) -> Claim:
        return Claim("acrobot", *fields)

    return [
        claim(PAPER_SAYS, "the desired torque is well tracked", _TRACKING, (ours,), Within(high=WELL), tracking),
        claim(PAPER_SAYS, "the return converges to about -200", _LAST, (ours,), OneRun(-200.0), last),
        claim(PAPER_SAYS, "goal in about 25 s", _TIME, (ours,), OneEpisode(25.0), Series.times_to_goal),
        claim(STUDY_SAYS, "-83 to -95 in training", _LAST, (ours,), Within(-95.0, -80.0), last),
        claim(STUDY_SAYS, "ideal: likewise", _LAST, (ideal,), Within(-95.0, -80.0), last),
        claim(
            STUDY_SAYS,
            "of some seeds the greedy policy often never finishes: of one in three, 30 % of the episodes",
            "share of test episodes that fail",
            (ours,),
            SomeSeed(1 - ALWAYS),
            failure,
        ),
    ]


def _cartpole(physics: str) -> list[Claim]:
    ours, ideal = (f"cartpole, paper, {motor}, {physics}" for motor in ("paper gains", "ideal"))

    def claim(*fields: Any) -> Claim:
        return Claim("cartpole", *fields)

    whole, paid = "first epoch of length 4000", "first epoch with a return of 3800"
    return [
        claim(PAPER_SAYS, "episodes last the whole epoch from 32 on", whole, (ours,), OneRun(32), full_length),
        claim(PAPER_SAYS, "the return approaches 4000 after epoch 35", paid, (ours,), OneRun(35), full_return),
        claim(
            PAPER_SAYS,
            "the torque error is within ±0.1 N·m",
            "largest torque error in test [N·m]",
            (ours,),
            EverySeed(0.1),
            largest_error,
        ),
        claim(PAPER_SAYS, "pole and cart stay in bounds in test", _SUCCESS, (ours,), Within(low=ALWAYS), success),
        claim(
            PAPER_SAYS,
            "the cart stays near the origin in test",
            "share of the 500 steps with |x| <= 0.1 m",
            (ours,),
            Within(low=NEAR_CENTRE),
            near_centre,
        ),
        claim(
            STUDY_SAYS,
            "an epoch's return reaches 3800 by epoch 30 to 47",
            paid,
            (ours,),
            EverySeed(50.0),
            full_return,
        ),
        claim(STUDY_SAYS, "500 of 500 in test", _TEST, (ours,), Within(low=500.0), returns),
        claim(STUDY_SAYS, "ideal: likewise", _TEST, (ideal,), Within(low=500.0), returns),
        claim(
            STUDY_SAYS,
            "the torque error reaches 0.119 N·m",
            "largest torque error in test [N·m]",
            (ours,),
            Within(0.1, 0.14),
            largest_error,
        ),
    ]


def _physics(task: str, motors: Sequence[str], margin: float) -> list[Claim]:
    """MuJoCo and Gymnasium's own equations give the same results, seed by seed."""
    return [
        Claim(
            task,
            PORT,
            f"{motor}: training in MuJoCo comes to what it comes to on Gymnasium's equations",
            f"{_LAST}: MuJoCo minus Gymnasium",
            (f"{task}, paper, {motor}, mujoco", f"{task}, paper, {motor}, analytic"),
            Same(margin, paired=True),
            _by_seed(last),
        )
        for motor in motors
    ]


CLAIMS: tuple[Claim, ...] = (
    *_pendulum(),
    *_mountain_car("mujoco"),
    *_mountain_car("analytic"),
    *_physics("mountain_car", ("paper gains", "fast gains", "ideal"), margin=3.0),
    *_mountain_car_continuous(),
    *_acrobot(),
    *_cartpole("mujoco"),
    *_cartpole("analytic"),
    *_physics("cartpole", ("paper gains", "ideal"), margin=200.0),
)
"""Everything that is reported, in the paper's order."""


def claims_of(tasks: Sequence[str]) -> list[Claim]:
    """The claims about some tasks."""
    return [claim for claim in CLAIMS if claim.task in tasks]
