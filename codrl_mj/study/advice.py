"""What to do about an actuator on a task: its numbers on a bench, held against what the study measured.

The bench gives one dose of everything that the study has an axis for. What ideal-trained policies lose at a dose is
interpolated, policy by policy, between those that were tested, and losses are added up. What policies lose that were
trained on random actuators, or through this one, is known where some were tested with no less of anything, or with no
more. `measured.py` needs no such assumptions, and judges by the same rule.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Actuator, Drive, GearMotor, SampledLoop, Supply
from codrl_mj.study.bench import Delivery, delivery
from codrl_mj.study.doses import AXES, REAL, REFERENCE_SPEEDS, noise, posed, timestep
from codrl_mj.study.evidence import Evidence, Loss, Outcome, total
from codrl_mj.study.grid import check_chosen
from codrl_mj.study.questions import MARGIN
from codrl_mj.tasks import find_task

IDEAL, COMMAND, LOOP = "train on ideal", "command more", "design the loop"
RANDOMISE, THROUGH = "randomise", "train through it"
BUY, MEASURE = "buy another", "measure it"
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

    The first of `OPTIONS` that loses nothing that matters; where none does, the first that is within `MARGIN` of the
    best of those that surely lose less, by more than `MARGIN`, than policies that never met the actuator; where there
    is none, `BUY` if every option surely loses too much, and else `MEASURE`.
    """
    known = {name: options[name] for name in OPTIONS if name in options}
    for name, option in known.items():
        if option.most is not None and option.most.spared:
            return name
    never = known[IDEAL].least
    most = {name: option.most.loss for name, option in known.items() if option.most is not None}
    better = [name for name in most if never is not None and most[name].high < never.loss.low - MARGIN]
    if better:
        best = min(most[name].mean for name in better)
        return next(name for name in better if most[name].mean <= best + MARGIN)
    return BUY if all(option.least is not None and option.least.hurt for option in known.values()) else MEASURE


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
        return Advice(task, found, (), {}, None, "the study has no results of this task here: measure it")
    better, more = redesign(actuator, task), commanded(actuator, task, found)
    options = known(evidence, task, doses(found, task))
    for name, other in ((LOOP, None if better is None else delivered(better, task)), (COMMAND, more)):
        if other is not None:
            options[name] = _untrained(predicted(evidence, task, doses(other, task)))
    untested = ""
    if max(found.at_rest, found.at_speed) > 1.0 + MARGIN:
        untested = "it delivers more than is asked for"
    if found.unasked > max(0.02, found.noise / 2.0):  # the mean of noise over its correlated samples is below that
        untested = f"it pushes with {found.unasked:.2g} of the largest force while nothing is asked for"
    if untested:
        return Advice(task, found, losses, options, MEASURE, f"{untested}, which was not tested")
    verdict = decide(options)
    return Advice(task, found, losses, options, verdict, _reason(verdict, options, found))


def predicted(evidence: Evidence, task: str, asked: Mapping[str, float]) -> tuple[Loss, ...]:
    """What ideal-trained policies lose by doses, by axis; those of which the study knows nothing are left out."""
    return tuple(one for axis, dose in asked.items() if (one := evidence.loss(task, axis, dose)) is not None)


def _untrained(losses: Sequence[Loss]) -> Prospect:
    least = total(one.outcome for one in losses)
    return Prospect(None if any(one.beyond for one in losses) else least, least)


Tests = Mapping[str, Sequence[tuple[Mapping[str, float], Outcome]]]


def known(evidence: Evidence, task: str, asked: Mapping[str, float], tests: Tests | None = None) -> dict[str, Prospect]:
    """What the study knows of policies that met nothing, random actuators, or this one, at doses of every axis.

    What was lost with no less of anything is the most that is lost here, and what there was none of there costs as
    much as it costs policies that never met it; what was lost with no more of anything is the least. `tests` are those
    of `tests_through`, where they are at hand.
    """
    options = {IDEAL: _untrained(predicted(evidence, task, asked))}
    for name, points in (tests or tests_through(evidence, task)).items():
        most, least = [], []
        for there, outcome in points:
            over = {axis: dose for axis, dose in asked.items() if dose > 1.005 * there.get(axis, 0.0) + 1e-9}
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
    trained = {axis: known.trained[task] for axis, known in AXES.items() if task in known.trained}
    tests: dict[str, list[tuple[str, str, dict[str, float]]]] = {
        RANDOMISE: [("generic", f"{axis} {dose:g}", {axis: dose}) for axis, dose in trained.items()],
        THROUGH: [(axis, f"{axis} {dose:g}", {axis: dose}) for axis, dose in trained.items()],
    }
    for name, real in REAL.get(task, {}).items():
        if evidence.outcome(task, name, name) is not None:
            tests[THROUGH].append((name, name, doses(delivered(posed(task, real).actuator, task), task)))
    return {
        kind: [
            (there, outcome) for arm, test, there in each if (outcome := evidence.outcome(task, arm, test)) is not None
        ]
        for kind, each in tests.items()
    }


# -- the bench ------------------------------------------------------------------------------------------------


def delivered(actuator: Any, task: str, share: float = 1.0) -> Delivery:
    """What an actuator makes of the commands of a task, on the bench, or of a `share` of its largest force."""
    check_chosen("task", [task], REFERENCE_SPEEDS)
    if actuator.MOTION:
        raise ValueError(
            f"actuator: a {actuator.family} is asked for motion, not for forces: name one of another family"
        )
    known = find_task(task)
    return delivery(actuator, timestep(task), known.step_duration, share * known.max_force, REFERENCE_SPEEDS[task])


def doses(found: Delivery, task: str) -> dict[str, float]:
    """The dose of every axis that does to a command what the actuator does, as it was `found` on the task, by axis.

    Weakness g and a supply that lacks a share d leave g*min(1, 2*(1 - d)) of the largest force at rest, and
    g*(1 - 2*d) at the reference speed (`doses.supply`): solved for both, with g at most 1.
    """
    rest, speed = max(found.at_rest, 0.0), min(found.at_speed, found.at_rest)
    strength = rest if speed >= 0.0 else rest - speed
    if rest == 0.0:
        lacks = 1.0
    elif speed >= 0.0:
        lacks = (1.0 - speed / rest) / 2.0
    else:
        lacks = 1.0 - rest / (2.0 * strength)
    loud = found.noise and found.noise / delivered(noise(task, 1.0).actuator, task).noise
    return {
        "lag": found.lag,
        "weakness": max(1.0 - strength, 0.0),
        "supply": lacks,
        "delay": found.dead_time,
        "friction": found.friction,
        "noise": loud,
    }


def commanded(actuator: Any, task: str, found: Delivery) -> Delivery | None:
    """What comes of commands that are larger by what is lost at rest, where that is more than a fiftieth.

    None for a loop that could be designed: what it has not delivered yet is no gear's loss.
    """
    if not 0.1 < found.at_rest < 0.98 or redesign(actuator, task) is not None:
        return None
    more = 1.0 / found.at_rest
    there = delivered(actuator, task, more)
    share = {name: min(getattr(there, name) * more, 1.0) for name in ("at_rest", "at_speed")}
    scaled = {name: getattr(there, name) * more for name in ("friction", "noise", "unasked")}
    return there._replace(**share, **scaled)


def redesign(actuator: Any, task: str) -> Drive | None:
    """The same motor and supply under a designed loop; None if it has one, or no loop that could be designed."""
    if isinstance(actuator, Actuator):  # what a sensor gets wrong no loop makes right
        wrong = actuator.controller.current_noise or actuator.controller.current_bias
        return None if wrong else redesigned(actuator, task)
    if isinstance(actuator, Drive):
        loop = dataclasses.replace(actuator.controller, bandwidth=0.0, kp=0.0, ki=0.0, anti_windup="back_calculation")
        return None if loop == actuator.controller else dataclasses.replace(actuator, controller=loop)
    return None


def redesigned(actuator: Actuator, task: str) -> Drive:
    """The motor and supply of a current loop under a designed one: pole-zero cancellation, anti-windup, a limit."""
    motor, voltage = actuator.motor, actuator.controller.max_voltage
    if actuator.supply is not None:
        voltage = min(voltage, actuator.supply.voltage)
    limit = motor.arm_radius * find_task(task).max_force / motor.torque_constant
    return Drive(
        GearMotor(
            motor.resistance,
            motor.inductance,
            motor.torque_constant,
            motor.back_emf_constant,
            rotor_inertia=0.0,
            arm_radius=motor.arm_radius,
        ),
        SampledLoop(sample_rate=20.0 / timestep(task), max_current=limit),
        Supply(voltage) if actuator.supply is None else dataclasses.replace(actuator.supply, voltage=voltage),
    )


# -- in words -------------------------------------------------------------------------------------------------


def _reason(verdict: str, options: Mapping[str, Prospect], found: Delivery) -> str:
    never = options[IDEAL]
    says = f"policies that never met it lose {in_words(never)}"
    if verdict in (IDEAL, BUY):
        return says if verdict == IDEAL else f"{says}, and so do all others: {_others(options)}"
    if verdict == MEASURE:
        untried = [name for name, option in options.items() if option.most is None and name != IDEAL]
        return f"{says}; {' and '.join(untried) or 'what else there is'} was not tested with as much on this task"
    by = f" by {1.0 / found.at_rest:.2f}" if verdict == COMMAND else ""
    chosen = options[verdict]
    in_part = "" if chosen.most is not None and chosen.most.spared else ": buy another if that is too much"
    return f"{says}, with that{by} {in_words(chosen)}{in_part}"


def _others(options: Mapping[str, Prospect]) -> str:
    return ", ".join(f"{name} {in_words(option)}" for name, option in options.items() if name != IDEAL) or "none"


def in_words(option: Prospect) -> str:
    """What is lost, with its 95 % interval, and how many policies fail."""
    outcome = option.most or option.least
    if outcome is None:
        return "nobody knows what"
    mean, low, high = outcome.loss
    failed = f"{round(outcome.failed * len(outcome.lost))} of {len(outcome.lost)} fail"
    return f"{option.bound}{mean:z.2f} of the span ({low:z.2f} to {high:z.2f}; {failed})"
