"""What to do about an actuator on a task: its numbers on a bench, held against what the study measured.

The bench gives one dose of everything that the study has an axis for. What ideal-trained policies
lose at a dose is interpolated, policy by policy, between those that were tested, and losses are
added up. What policies lose that were trained on random actuators, or through this one, is known
where some were tested with no less of anything, or with no more. A `Measurement` needs no such
assumptions: it trains and tests policies of its own, in whatever is an environment, and is judged
by the same rule.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL as IDEAL_ACTUATOR
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy, evaluate
from codrl_mj.study.bench import Delivery, commanded, delivered, doses, redesign
from codrl_mj.study.doses import AXES, FLOORS, REAL, SECONDS, generic, ideal, posed
from codrl_mj.study.evidence import Evidence, Loss, Outcome, total
from codrl_mj.study.questions import MARGIN, Scores
from codrl_mj.study.trials import Arm, Collected, Grid, Trial
from codrl_mj.training import TrainConfig, load_config

IDEAL, COMMAND, LOOP = "train on ideal", "command more", "design the loop"
RANDOMISE, THROUGH = "randomise", "train through it"
BUY, MEASURE = "buy another", "measure it"
RANDOM = ("generic", "random")
"""Arms of the two studies that were trained on random actuators, of two reaches."""
OPTIONS = (IDEAL, COMMAND, LOOP, RANDOMISE, THROUGH)
"""What can be done about an actuator, what takes least first; beside it one may buy another, or has to measure it."""


class Prospect(NamedTuple):
    """What is known of something that can be done."""

    most: Outcome | None
    """What policies lose at most; None if it is not known."""
    least: Outcome | None
    """What they lose at least; None if it is not known. The same as `most` where it was tested, or interpolated."""

    @property
    def bound(self) -> str:
        """What to say before the number: `at least`, `at most` or nothing."""
        if self.most is None:
            return "at least "
        return "" if self.most is self.least else "at most "


def decide(options: Mapping[str, Prospect]) -> str:
    """What to do: the rule for what was predicted and for what was measured.

    The first of `OPTIONS` that loses nothing that matters; where none does, the first that is
    within `MARGIN` of the best of those that surely lose less, by more than `MARGIN`, than policies
    that never met the actuator; where there is none, `BUY` if every option surely loses too much,
    and of none but the first it is unknown how much; else `MEASURE`.
    """
    known = {name: options[name] for name in OPTIONS if name in options}
    for name, option in known.items():
        if option.most is not None and option.most.spared:
            return name
    never = known[IDEAL].least
    most = {name: option.most.loss for name, option in known.items() if option.most is not None}
    better = [
        name for name in most if never is not None and most[name].high < never.loss.low - MARGIN
    ]
    if better:
        best = min(most[name].mean for name in better)
        return next(name for name in better if most[name].mean <= best + MARGIN)
    others = (
        option.most for name, option in known.items() if name != IDEAL
    )  # of which an untried one might win
    lost = all(option.least is not None and option.least.hurt for option in known.values())
    return BUY if lost and None not in others else MEASURE


class Advice(NamedTuple):
    """What to do about an actuator on a task."""

    task: str
    """Task name."""
    found: Delivery
    """What the bench measured."""
    losses: tuple[Loss, ...]
    """Of ideal-trained policies, by axis; empty where the study has no results."""
    options: Mapping[str, Prospect]
    """What is known of what can be done, by `OPTIONS`; empty where the study has no results."""
    verdict: str | None
    """One of `OPTIONS`, `BUY` or `MEASURE`; None without evidence."""
    reason: str
    """Why, in a sentence."""


def advise(actuator: Any, task: str, evidence: Evidence) -> Advice:
    """What to do about an actuator, of any family that is asked for forces, on a task, by the study's results."""
    found = delivered(actuator, task)
    losses = predicted(evidence, task, doses(found, task))
    if len(losses) < len(AXES):
        return Advice(
            task, found, (), {}, None, "the study has no results of this task here: measure it"
        )
    better, more = redesign(actuator, task), commanded(actuator, task, found)
    options = known(evidence, task, doses(found, task))
    for name, other in (
        (LOOP, None if better is None else delivered(better, task)),
        (COMMAND, more),
    ):
        if other is not None:
            options[name] = _untrained(predicted(evidence, task, doses(other, task)))
    untested = ""
    if max(found.at_rest, found.at_speed) > 1.0 + MARGIN:
        untested = "it delivers more than is asked for"
    if found.unasked > max(
        0.02, found.noise / 2.0
    ):  # the mean of noise over its correlated samples is below that
        untested = (
            f"it pushes with {found.unasked:.2g} of the largest force while nothing is asked for"
        )
    if untested:
        return Advice(task, found, losses, options, MEASURE, f"{untested}, which was not tested")
    verdict = decide(options)
    return Advice(task, found, losses, options, verdict, _reason(verdict, options, found))


def predicted(evidence: Evidence, task: str, asked: Mapping[str, float]) -> tuple[Loss, ...]:
    """What ideal-trained policies lose by doses, by axis; those of which the study knows nothing are left out."""
    return tuple(
        one for axis, dose in asked.items() if (one := evidence.loss(task, axis, dose)) is not None
    )


def _untrained(losses: Sequence[Loss]) -> Prospect:
    least = total(one.outcome for one in losses)
    return Prospect(None if any(one.beyond for one in losses) else least, least)


Tests = Mapping[str, Sequence[tuple[Mapping[str, float], Outcome]]]


def known(
    evidence: Evidence, task: str, asked: Mapping[str, float], tests: Tests | None = None
) -> dict[str, Prospect]:
    """What the study knows of policies that met nothing, random actuators, or this one, at doses of every axis.

    What was lost with no less of anything is the most that is lost here, and what there was none of
    there costs as much as it costs policies that never met it; what was lost with no more of
    anything is the least. `tests` are those of `tests_through`, where they are at hand.
    """
    options = {IDEAL: _untrained(predicted(evidence, task, asked))}
    for name, points in (tests or tests_through(evidence, task)).items():
        most, least = [], []
        for there, outcome in points:
            over = {
                axis: dose
                for axis, dose in asked.items()
                if dose > 1.005 * there.get(axis, 0.0) + 1e-9
            }
            rest = predicted(evidence, task, over)
            if not any(one.beyond for one in rest):
                alone = Outcome(*(np.maximum(part, 0.0) for part in outcome)) if rest else outcome
                most.append(total([alone, *(one.outcome for one in rest)]))
            if all(dose <= 1.005 * asked[axis] + 1e-9 for axis, dose in there.items()):
                least.append(outcome)
        smallest = min(most, key=lambda one: (not one.spared, one.loss.high), default=None)
        options[name] = Prospect(smallest, max(least, key=lambda one: one.loss.low, default=None))
    return options


def tests_through(evidence: Evidence, task: str) -> Tests:
    """Doses that policies were tested at, and what they lost, of those trained on random actuators or through them."""
    every = [
        (f"{axis} {dose:g}", {axis: dose})
        for axis, known in AXES.items()
        for dose in known.doses[1:]
    ]
    trained = {axis: known.trained[task] for axis, known in AXES.items() if task in known.trained}
    tests: dict[str, list[tuple[str, str, dict[str, float]]]] = {
        RANDOMISE: [(arm, *one) for arm in RANDOM for one in every],
        THROUGH: [(axis, f"{axis} {dose:g}", {axis: dose}) for axis, dose in trained.items()],
    }
    for name, real in REAL.get(task, {}).items():
        if evidence.outcome(task, name, name) is not None:
            tests[THROUGH].append(
                (name, name, doses(delivered(posed(task, real).actuator, task), task))
            )
    return {
        kind: [
            (there, outcome)
            for arm, test, there in each
            if (outcome := evidence.outcome(task, arm, test)) is not None
        ]
        for kind, each in tests.items()
    }


# -- in words -------------------------------------------------------------------------------------------------


def _reason(verdict: str, options: Mapping[str, Prospect], found: Delivery) -> str:
    never = options[IDEAL]
    says = f"policies that never met it lose {in_words(never)}"
    if verdict in (IDEAL, BUY):
        others = ", ".join(
            f"{name} {in_words(option)}" for name, option in options.items() if name != IDEAL
        )
        return says if verdict == IDEAL else f"{says}, and so do all others: {others or 'none'}"
    if verdict == MEASURE:
        untried = [
            name for name, option in options.items() if option.most is None and name != IDEAL
        ]
        return (
            f"{says}; {' and '.join(untried) or 'what else there is'} was not tested with as much"
            " on this task"
        )
    by = f" by {1.0 / found.at_rest:.2f}" if verdict == COMMAND else ""
    chosen = options[verdict]
    in_part = (
        ""
        if chosen.most is not None and chosen.most.spared
        else ": buy another if that is too much"
    )
    return f"{says}, with that{by} {in_words(chosen)}{in_part}"


def in_words(option: Prospect) -> str:
    """What is lost, with its 95 % interval, and how many policies fail."""
    outcome = option.most or option.least
    if outcome is None:
        return "nobody knows what"
    mean, low, high = outcome.loss
    failed = f"{round(outcome.failed * len(outcome.lost))} of {len(outcome.lost)} fail"
    return f"{option.bound}{mean:z.2f} of the span ({low:z.2f} to {high:z.2f}; {failed})"


# -- measured ---------------------------------------------------------------------------------------------------

RANDOM_EPISODES = 100
"""Of random actions, whose mean return is the lower end of the span of a task that the study does not have."""


class Measurement(NamedTuple):
    """Trainings and tests that show what an actuator costs, and what can be done about it."""

    grid: Grid
    """Of all of them."""
    home: Trial
    """Policies that were trained on ideal forces, tested there."""
    options: Mapping[str, Trial]
    """What is done -> its policies, tested on the actuator, or on its motor under a designed loop."""

    def judged(self, collected: Collected) -> dict[str, Prospect]:
        """What policies lose by what is done, for `decide`, as if the span were exact; nothing may be missing of it."""
        if collected.missing:
            why = next((f": {name}: {error}" for name, error in collected.failures.items()), "")
            raise ValueError(
                f"{len(collected.missing)} of its trainings and tests are missing{why}: run it"
                " again"
            )
        env = self.home.env
        floor = FLOORS.get(env.task) if self.home.arm == _ideal_arm(env.task) else None
        if floor is None:
            floor = evaluate(RandomPolicy(env.action_space), env, RANDOM_EPISODES).returns.mean
        scores, succeeded = (
            Scores(collected, {env.task: floor}, [self.home]),
            _values(collected, self.home, "success"),
        )
        if not scores.ceilings:
            raise ValueError(
                f"{env.task}: ideal-trained policies are no better than random actions: train more"
                " seeds"
            )
        options = {}
        for name, trial in self.options.items():
            lost = 1.0 - np.array(list(scores.of(trial).values()))
            missed = (
                np.mean(succeeded) - _values(collected, trial, "success")
                if len(succeeded)
                else 0.0 * lost
            )
            options[name] = Prospect(outcome := Outcome(lost, missed), outcome)
        return options


def measurement(
    actuator: Any, subject: str, seeds: int, root: Path, episodes: int = 50, trust: bool = False
) -> Measurement:
    """What there is to be trained and tested.

    `subject` is a task, the Gymnasium id of an environment of others, or the folder of a run, whose
    environment, agent and budget are taken; `actuator` whatever an `EnvConfig` takes; of every kind
    there are so many runs as `seeds`, in folders below `root`. With `trust` modules are imported
    that a run's folder names, which executes them.
    """
    if seeds < 2:
        raise ValueError(f"seeds = {seeds}: an interval needs at least 2")
    base = _ideal_arm(subject, trust)
    untouched = base.config.env  # and its reward: it is what policies were trained for
    here = dataclasses.replace(untouched, actuator=actuator)
    if all(one == IDEAL_ACTUATOR for one in here.actuators):
        raise ValueError(
            "actuator = 'ideal': training through it is training on ideal forces: name another"
        )
    env = dataclasses.replace(base.config.env, actuator=actuator)
    through = Arm(
        f"{base.task}: through it", dataclasses.replace(base.config, env=env), base.seconds
    )
    options = {IDEAL: Trial(base, "it", here)}
    if (
        "timestep" in here.source.fields and len(here.actuators) == 1
    ):  # a loop is designed, and a lag drawn, for one
        better = redesign(here.actuators[0], base.task)
        if better is not None:
            options[LOOP] = Trial(base, "designed", dataclasses.replace(untouched, actuator=better))
        options[RANDOMISE] = Trial(generic(base), "it", here)
    options[THROUGH] = Trial(through, "it", here)
    home = Trial(base, "ideal", untouched)
    return Measurement(
        Grid(root, (home, *options.values()), lambda _: range(seeds), episodes), home, options
    )


def _ideal_arm(subject: str, trust: bool = False) -> Arm:
    """The training on ideal forces: the study's, that of a run, or the default one of a world."""
    if subject in SECONDS:
        return ideal(subject)
    if (Path(subject) / "config.json").is_file():
        config = load_config(Path(subject), trust)
    else:
        env = EnvConfig(subject)
        config = TrainConfig.preset(subject, env.source.default_agent(env))
    never = max(config.total_steps or 10**9, 10**9)
    env = dataclasses.replace(
        config.env, actuator=IDEAL_ACTUATOR, randomize=None, allow_unstable=False
    )
    config = dataclasses.replace(
        config, env=env, seed=0, evaluation_interval=never, checkpoint_interval=never
    )
    return Arm(f"{config.task}: ideal", config, 60.0)


def _values(collected: Collected, trial: Trial, measure: str) -> np.ndarray:
    return np.array(list(collected.scores(trial, measure).values()))
