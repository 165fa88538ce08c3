"""What to do about an actuator on a task: its numbers on a bench, held against what the study measured.

The bench gives one dose of everything that the study has an axis for; what ideal-trained policies lose at a dose is
interpolated between those that were tested, and losses are added up. `measured.py` needs no such assumption.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

from codrl_mj.actuators import Actuator, Drive, GearMotor, SampledLoop, Supply
from codrl_mj.evaluation.measures import Interval
from codrl_mj.sizing.bench import Delivery, delivery
from codrl_mj.study.doses import AXES, REFERENCE_SPEEDS, noise, timestep
from codrl_mj.study.evidence import Evidence, Loss
from codrl_mj.study.grid import check_chosen
from codrl_mj.study.questions import MARGIN
from codrl_mj.tasks import find_task

IDEAL, LOOP, THROUGH, BUY = "train on ideal", "design the loop", "train through it", "buy another"
MEASURE = "measure it"
"""What there is to be advised."""


def delivered(actuator: Any, task: str) -> Delivery:
    """What an actuator makes of the commands of a task, on the bench."""
    check_chosen("task", [task], REFERENCE_SPEEDS)
    if actuator.MOTION:
        raise ValueError(
            f"actuator: a {actuator.family} is asked for motion, not for forces: name one of another family"
        )
    known = find_task(task)
    return delivery(actuator, timestep(task), known.step_duration, known.max_force, REFERENCE_SPEEDS[task])


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


class Advice(NamedTuple):
    """What to do about an actuator on a task."""

    task: str
    """Task name."""
    found: Delivery
    """What the bench measured."""
    losses: tuple[Loss, ...]
    """By axis; empty where the study has no results."""
    redesigned: "Advice | None"
    """The same with a designed loop, where there is one to design."""
    verdict: str | None
    """One of `IDEAL`, `LOOP`, `THROUGH`, `BUY` and `MEASURE`; None without evidence."""
    reason: str
    """Why, in a sentence."""

    @property
    def lost(self) -> Interval:
        """All losses, as if they added up, and no more than everything."""
        return Interval(*(min(sum(part), 1.0) for part in zip(*(one.loss for one in self.losses), strict=True)))


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


def advise(actuator: Any, task: str, evidence: Evidence) -> Advice:
    """What to do about an actuator, of any family, on a task, by the study's results."""
    found = delivered(actuator, task)
    known = [evidence.loss(task, axis, dose) for axis, dose in doses(found, task).items()]
    losses = tuple(one for one in known if one is not None)
    better = redesign(actuator, task)
    other = advise(better, task, evidence) if better is not None else None
    if len(losses) < len(AXES):
        return Advice(task, found, (), other, None, "the study has no results of this task here: measure it")
    untested = ""
    if max(found.at_rest, found.at_speed) > 1.0 + MARGIN:
        untested = "it delivers more than is asked for"
    if found.unasked > max(0.02, found.noise / 2.0):  # the mean of noise over its correlated samples is below that
        untested = f"it pushes with {found.unasked:.2g} of the largest force while nothing is asked for"
    if untested:
        return Advice(task, found, losses, other, MEASURE, f"{untested}, which was not tested")
    verdict = decide(losses, other and other.losses)
    plain = Advice(task, found, losses, other, verdict, "")
    return plain._replace(reason=_reason(verdict, plain))


def decide(losses: Sequence[Loss], redesigned: Sequence[Loss] | None) -> str:
    """The verdict: one of `IDEAL`, `LOOP`, `THROUGH` and `BUY`, or `MEASURE`: more than was tested, which cost little.

    It goes by means; their intervals are in `Loss`. `redesigned` are those with a designed loop; None where there is
    none to design.
    """
    if _within(losses):
        return IDEAL
    if redesigned is not None and _within(redesigned):
        return LOOP
    if any(one.lasting for one in losses):
        return BUY if redesigned is None or any(one.lasting for one in redesigned) else LOOP
    return MEASURE if any(one.beyond for one in losses) else THROUGH


def _within(losses: Sequence[Loss]) -> bool:
    return sum(one.loss.mean for one in losses) <= MARGIN and not any(one.beyond for one in losses)


def _reason(verdict: str, advice: Advice) -> str:
    if verdict == IDEAL:
        return f"policies that never met it lose {_share(advice.lost)}"
    if verdict == LOOP and advice.redesigned is not None:
        return f"the same motor under a designed loop loses {_share(advice.redesigned.lost)}"
    decisive = [one for one in advice.losses if one.beyond or verdict != MEASURE]
    worst = max(decisive, key=lambda one: (one.lasting, one.loss.mean))
    known = ", and training through it was not tried on this task"
    if worst.beyond:
        known = ", and no dose as large was tested"
    elif worst.kept is not None:
        known = f"; trained through {worst.trained:g} they lose {worst.kept:.2f}"
    least = "at least " if worst.beyond else ""
    return f"{worst.axis} {worst.dose:.3g} costs {least}{worst.loss.mean:z.2f} of the span{known}"


def _share(lost: Interval) -> str:
    return f"{lost.mean:z.2f} of the span ({lost.low:z.2f} to {lost.high:z.2f})"
