"""The hypotheses of the study, as they were written down before it: docs/results/plan.md has them in words."""

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal

from codrl_mj.disturbances import Disturbances, Joint
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.actuators import arms
from codrl_mj.study.actuators.arms import DRAWN, GOOD, LOOPED, MARGINAL, SECONDS, TRAINED
from codrl_mj.study.actuators.levels import AXES, posed
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import find_task

MARGIN = 0.05
"""Largest difference that does not matter, in shares of the task's span."""


@dataclasses.dataclass(frozen=True)
class Contrast:
    """Two trials of which it is asked whether their scores differ."""

    one: Trial
    """The trial that may be better."""
    other: Trial
    """The trial that it is compared with."""

    @property
    def paired(self) -> bool:
        """Whether the same policies are tested twice."""
        return self.one.arm.name == self.other.arm.name


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """A statement that the study can refute."""

    name: str
    """`P1` and so on of the primary ones, which are corrected together; others are secondary."""
    question: str
    """The question that it belongs to: a section of the page."""
    statement: str
    """What it says."""
    contrasts: tuple[Contrast, ...]
    """What is pooled in it, each with the same weight."""
    kind: Literal["better", "equivalent"] = "better"
    """Whether the one is to score higher, or to differ by less than `MARGIN`."""

    @property
    def primary(self) -> bool:
        """Whether it is one of those that were asked first."""
        return self.name.startswith("P")


def dosed(arm: Arm, axis: str, dose: float) -> Trial:
    """Policies tested on a dose."""
    return Trial(arm, f"{axis} {dose:g}", AXES[axis].at(arm.task, dose))


def at_home(arm: Arm) -> Trial:
    """Policies tested on ideal forces."""
    return Trial(arm, "ideal", posed(arm.task))


def undosed(arm: Arm, axis: str) -> Trial:
    """Policies tested on none of it: on ideal forces, or on the axis' motor."""
    return dosed(arm, axis, 0.0) if AXES[axis].own_motor else at_home(arm)


def _trained_dose(arm: Arm, axis: str) -> Trial:
    return dosed(arm, axis, AXES[axis].trained[arm.task])


def _contrasts(axis: str, one: Any, other: Any) -> tuple[Contrast, ...]:
    """At the axis' trained dose, on every task: arms made by functions of the task."""
    return tuple(Contrast(_trained_dose(one(task), axis), _trained_dose(other(task), axis)) for task in TRAINED)


def on_loop(arm: Arm, loop: str) -> Trial:
    """Policies tested on the paper's motor under a loop."""
    return Trial(arm, loop, posed(arm.task, arms.designed(arm.task) if loop == "designed" else loop))


def through_loop(task: str, loop: str) -> Arm:
    """Trained on the paper's motor under a loop."""
    return arms.arm(task, loop, posed(task, arms.designed(task) if loop == "designed" else loop))


def on_motor(arm: Arm, kind: str) -> Trial:
    """Policies tested on a motor of the catalogue."""
    chosen = {"good": GOOD, "marginal": MARGINAL}[kind]
    return Trial(arm, f"{kind} motor", arms.motor(arm.task, chosen[arm.task]))


def through_motor(task: str, otherwise: str = "", **changes: Any) -> Arm:
    """Trained through the marginal motor of the catalogue, with changes that have a name."""
    named = ", ".join(filter(None, ["marginal motor", otherwise]))
    return arms.arm(task, named, dataclasses.replace(arms.motor(task, MARGINAL[task]), **changes))


WRONG: dict[str, tuple[str, float]] = {
    f"{name} {100 * (factor - 1):+.0f} %": (name, factor)
    for name in ("resistance", "inductance")
    for factor in (0.5, 0.75, 0.9, 1.1, 1.25, 1.5)
}
"""What of the motor is otherwise than in training, by what factor. A torque constant that the loop does not know of is
an axis of its own, `weakness`."""


def wrong_motors(task: str) -> dict[str, EnvConfig]:
    """The actuator `weaker`, otherwise than trained through, by name: `WRONG`, and shares of the largest force."""
    nominal, step, force = posed(task, "weaker"), find_task(task).step_duration, find_task(task).max_force
    motor, loop = nominal.actuator.motor, nominal.actuator.controller

    def driven(**parts: Any) -> EnvConfig:
        return dataclasses.replace(nominal, actuator=dataclasses.replace(nominal.actuator, **parts))

    def pushed(share: float) -> EnvConfig:
        pulses = Disturbances(pulse_force=share * force, pulse_duration=step, pulse_interval=10 * step)
        return dataclasses.replace(nominal, disturbances=pulses)

    def rubbed(share: float) -> EnvConfig:
        return dataclasses.replace(nominal, joint=Joint(friction=share * force))

    noise = 0.2 * motor.arm_radius * force / motor.torque_constant  # A
    return {
        name: driven(motor=dataclasses.replace(motor, **{field: getattr(motor, field) * factor}))
        for name, (field, factor) in WRONG.items()
    } | {
        "friction 5 %": rubbed(0.05),
        "friction 20 %": rubbed(0.2),
        "current noise 20 %": driven(controller=dataclasses.replace(loop, current_noise=noise)),
        "pulses 25 %": pushed(0.25),
        "pulses 50 %": pushed(0.5),
    }


def identified(task: str) -> Arm:
    """Trained on what an identification leaves open: R within 2 %, L within 10 %, for every episode anew."""
    nominal = posed(task, "weaker")
    motor = nominal.actuator.motor

    def around(name: str, share: float) -> str:
        value = getattr(motor, name)
        return f"motor.{name}=uniform({value * (1 - share):g}, {value * (1 + share):g})"

    text = around("resistance", 0.02), around("inductance", 0.1)
    return arms.arm(task, "weaker, drawn", dataclasses.replace(nominal, randomize=text))


def _mean_wrong(task: str, names: Iterable[str]) -> list[Contrast]:
    nominal = through_loop(task, "weaker")
    motors = wrong_motors(task)
    return [Contrast(Trial(nominal, name, motors[name]), on_loop(nominal, "weaker")) for name in names]


def primary() -> list[Hypothesis]:
    """The twelve that are corrected together."""
    numbered = enumerate(AXES, start=1)
    quarter = [name for name in WRONG if name.endswith("25 %")]
    return [
        *(
            Hypothesis(
                f"P{number}",
                "matters",
                f"{AXES[axis].title}: policies trained through it score higher on it than policies trained on ideal "
                "forces",
                _contrasts(axis, lambda task, axis=axis: arms.matched(task, axis), arms.ideal),
            )
            for number, axis in numbered
        ),
        Hypothesis(
            "P7",
            "matters",
            "Over all six: training through the very actuator scores higher than generic robustification as the plan "
            "has it",
            tuple(
                pair
                for axis in AXES
                for pair in _contrasts(axis, lambda task, axis=axis: arms.matched(task, axis), arms.generic)
            ),
        ),
        Hypothesis(
            "P8",
            "matters",
            "Over four: policies trained on drawn doses score as high as those trained on the very dose",
            tuple(
                pair
                for axis in DRAWN
                for pair in _contrasts(
                    axis,
                    lambda task, axis=axis: arms.drawn(task, axis),
                    lambda task, axis=axis: arms.matched(task, axis),
                )
            ),
            "equivalent",
        ),
        Hypothesis(
            "P9",
            "tune",
            "A designed loop under ideal-trained policies scores higher than a detuned one under policies that were "
            "trained through it",
            tuple(
                Contrast(on_loop(arms.ideal(task), "designed"), on_loop(through_loop(task, "weaker"), "weaker"))
                for task in LOOPED
            ),
        ),
        Hypothesis(
            "P10",
            "wrong",
            "Policies trained through a motor score as high where its resistance or inductance is 25 % off",
            tuple(pair for task in LOOPED for pair in _mean_wrong(task, quarter)),
            "equivalent",
        ),
        Hypothesis(
            "P11",
            "motors",
            "On a good motor that exists, ideal-trained policies score as high as on ideal forces",
            tuple(Contrast(on_motor(arms.ideal(task), "good"), at_home(arms.ideal(task))) for task in SECONDS),
            "equivalent",
        ),
        Hypothesis(
            "P12",
            "motors",
            "On a marginal motor that exists, policies trained through it score higher than ideal-trained ones",
            tuple(
                Contrast(on_motor(through_motor(task), "marginal"), on_motor(arms.ideal(task), "marginal"))
                for task in MARGINAL
            ),
        ),
    ]


def secondary() -> list[Hypothesis]:
    """All others, by question; each is one contrast."""
    found: list[tuple[str, str, Contrast]] = []
    for task in SECONDS:
        ideal = arms.ideal(task)
        for axis, described in AXES.items():
            found += [
                (
                    "matters",
                    f"{task}, ideal-trained: {axis} {dose:g} over none",
                    Contrast(dosed(ideal, axis, dose), undosed(ideal, axis)),
                )
                for dose in described.doses[1:]
            ]
    for task in TRAINED:
        for axis in AXES:
            matched = arms.matched(task, axis)
            for one, other in (
                (matched, arms.ideal(task)),
                (matched, arms.generic(task)),
                (arms.generic(task), arms.ideal(task)),
            ):
                pair = Contrast(_trained_dose(one, axis), _trained_dose(other, axis))
                found.append(("matters", f"{_trained_dose(one, axis).name}, over {other.name}", pair))
        found += [
            ("matters", f"{task}, {axis}: drawn over matched", pair)
            for axis in DRAWN
            for pair in [
                Contrast(_trained_dose(arms.drawn(task, axis), axis), _trained_dose(arms.matched(task, axis), axis))
            ]
        ]
    for task in LOOPED:
        for loop in ("weaker", "paper", "designed"):
            pair = Contrast(on_loop(through_loop(task, loop), loop), on_loop(arms.ideal(task), loop))
            found.append(("tune", f"{task}, {loop} loop: trained through it over ideal-trained", pair))
        found.append(
            (
                "tune",
                f"{task}: designed loop over the paper's, ideal-trained",
                Contrast(on_loop(arms.ideal(task), "designed"), on_loop(arms.ideal(task), "paper")),
            )
        )
        nominal, open_ = through_loop(task, "weaker"), identified(task)
        motors = wrong_motors(task)
        for name, env in motors.items():
            found += [
                (
                    "wrong",
                    f"{task}, {name} over nominal",
                    Contrast(Trial(nominal, name, env), on_loop(nominal, "weaker")),
                ),
                (
                    "wrong",
                    f"{task}, {name}: drawn over nominal",
                    Contrast(Trial(open_, name, env), Trial(nominal, name, env)),
                ),
            ]
    for task in SECONDS:
        ideal = arms.ideal(task)
        found.append(("motors", f"{task}: good motor over ideal", Contrast(on_motor(ideal, "good"), at_home(ideal))))
    for task in MARGINAL:
        ideal, through = arms.ideal(task), through_motor(task)
        found += [
            ("motors", f"{task}: marginal motor over ideal", Contrast(on_motor(ideal, "marginal"), at_home(ideal))),
            (
                "motors",
                f"{task}, marginal motor: trained through it over ideal-trained",
                Contrast(on_motor(through, "marginal"), on_motor(ideal, "marginal")),
            ),
        ]
    told = {task: [through_motor(task, "current and reference observed", observe_actuator=True)] for task in TRAINED}
    # on Pendulum the marginal drive's current limit would bind the torque arm alone
    told["furuta"].append(through_motor("furuta", "voltage", action="voltage"))
    found += [
        (
            "command",
            f"{arm.name}, over torque and no more",
            Contrast(on_motor(arm, "marginal"), on_motor(through_motor(task), "marginal")),
        )
        for task, several in told.items()
        for arm in several
    ]
    return [Hypothesis(f"S{k}", where, says, (pair,)) for k, (where, says, pair) in enumerate(found, start=1)]


def trials() -> tuple[Trial, ...]:
    """Every trial of the study once."""
    of_hypotheses = [
        trial
        for hypothesis in (*primary(), *secondary())
        for pair in hypothesis.contrasts
        for trial in (pair.one, pair.other)
    ]
    return tuple({trial.name: trial for trial in of_hypotheses}.values())
