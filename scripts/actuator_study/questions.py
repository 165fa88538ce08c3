"""Hypotheses of the study, as preregistered; docs/results/plan.md states them in words."""

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any

from actuator_study import arms
from actuator_study.arms import (
    DRAWN,
    GOOD,
    LOOPED,
    MARGINAL,
    TRAINED,
    matched,
    trial_at,
    trial_at_zero,
    with_fields,
)
from codrl_mj.disturbances import Disturbances, Joint
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import (
    AXES,
    SECONDS,
    generic_ranges,
    ideal_arm,
    ideal_trial,
    make_arm,
    random_arm,
    study_env,
)
from codrl_mj.study.questions import Contrast, Question
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import find_task


def _trained_trial(arm: Arm, axis: str) -> Trial:
    return trial_at(arm, axis, AXES[axis].training_severity[arm.task])


def _contrasts(axis: str, arm_of: Any, reference_arm_of: Any) -> tuple[Contrast, ...]:
    """Return the contrasts at the axis' trained severity between two arms of each task."""
    return tuple(
        Contrast(_trained_trial(arm_of(task), axis), _trained_trial(reference_arm_of(task), axis))
        for task in TRAINED
    )


@functools.cache
def _generic(task: str) -> Arm:
    return random_arm(ideal_arm(task), generic_ranges(task))


def on_loop(arm: Arm, loop: str) -> Trial:
    """Return the test of an arm's policies on the paper's motor under a current loop."""
    return Trial(
        arm, loop, study_env(arm.task, arms.designed(arm.task) if loop == "designed" else loop)
    )


def through_loop(task: str, loop: str) -> Arm:
    """Return the arm trained on the paper's motor under a current loop."""
    return make_arm(
        task, loop, study_env(task, arms.designed(task) if loop == "designed" else loop)
    )


def on_motor(arm: Arm, kind: str) -> Trial:
    """Return the test of an arm's policies on a motor of the catalogue."""
    chosen = {"good": GOOD, "marginal": MARGINAL}[kind]
    return Trial(arm, f"{kind} motor", study_env(arm.task, chosen[arm.task]))


def through_motor(task: str, label: str = "", **changes: Any) -> Arm:
    """Return the arm trained through the marginal motor, with labeled changes to it."""
    named = ", ".join(filter(None, ["marginal motor", label]))
    return make_arm(task, named, study_env(task, MARGINAL[task], **changes))


WRONG: dict[str, tuple[str, float]] = {
    f"{name} {100 * (factor - 1):+.0f} %": (name, factor)
    for name in ("resistance", "inductance")
    for factor in (0.5, 0.75, 0.9, 1.1, 1.25, 1.5)
}
"""Label -> motor parameter that differs from the trained one, and by what factor.

A torque constant that the loop does not know is the axis `weakness`.
"""


def wrong_motors(task: str) -> dict[str, EnvConfig]:
    """Return environments whose actuator differs from the trained `weaker`, by name."""
    nominal = study_env(task, "weaker")
    step = find_task(task).step_duration
    force = find_task(task).max_force
    # Pushes and friction are given as shares of the task's largest force.
    motor = nominal.actuator.motor

    def pushed(share: float) -> EnvConfig:
        pulses = Disturbances(
            pulse_force=share * force, pulse_duration=step, pulse_interval=10 * step
        )
        return dataclasses.replace(nominal, disturbances=pulses)

    def rubbed(share: float) -> EnvConfig:
        return dataclasses.replace(nominal, joint=Joint(friction=share * force))

    noise = 0.2 * motor.arm_radius * force / motor.torque_constant  # A
    return {
        name: with_fields(nominal, **{f"motor__{field}": getattr(motor, field) * factor})
        for name, (field, factor) in WRONG.items()
    } | {
        "friction 5 %": rubbed(0.05),
        "friction 20 %": rubbed(0.2),
        "current noise 20 %": with_fields(nominal, controller__current_noise=noise),
        "pulses 25 %": pushed(0.25),
        "pulses 50 %": pushed(0.5),
    }


def identified(task: str) -> Arm:
    """Return the arm trained on what identification leaves open: R within 2 %, L within 10 %."""
    nominal = study_env(task, "weaker")
    motor = nominal.actuator.motor

    def around(name: str, share: float) -> str:
        value = getattr(motor, name)
        return f"motor.{name}=uniform({value * (1 - share):g}, {value * (1 + share):g})"

    text = around("resistance", 0.02), around("inductance", 0.1)
    return make_arm(task, "weaker, drawn", dataclasses.replace(nominal, randomize=text))


def _mean_wrong(task: str, names: Iterable[str]) -> list[Contrast]:
    nominal = through_loop(task, "weaker")
    motors = wrong_motors(task)
    return [
        Contrast(Trial(nominal, name, motors[name]), on_loop(nominal, "weaker")) for name in names
    ]


@functools.cache
def primary() -> list[Question]:
    """Return the twelve primary questions, whose p-values are corrected together."""
    numbered = enumerate(AXES, start=1)
    quarter = [name for name in WRONG if name.endswith("25 %")]
    return [
        *(
            Question(
                f"P{number}",
                "matters",
                f"{AXES[axis].title}: policies trained through it score higher on it than policies"
                " trained on ideal forces",
                # `axis=axis` binds the loop variable now; a plain closure would see the last
                # axis.
                _contrasts(axis, lambda task, axis=axis: matched(task, axis), ideal_arm),
            )
            for number, axis in numbered
        ),
        Question(
            "P7",
            "matters",
            "Over all six effects: training through the same actuator scores higher than training"
            " on random actuators as defined in the plan",
            tuple(
                pair
                for axis in AXES
                for pair in _contrasts(axis, lambda task, axis=axis: matched(task, axis), _generic)
            ),
        ),
        Question(
            "P8",
            "matters",
            "Over four effects: policies trained on drawn severities score as high as those trained"
            " at the same severity",
            tuple(
                pair
                for axis in DRAWN
                for pair in _contrasts(
                    axis,
                    lambda task, axis=axis: arms.drawn(task, axis),
                    lambda task, axis=axis: matched(task, axis),
                )
            ),
            "equivalent",
        ),
        Question(
            "P9",
            "tune",
            "A designed loop under ideal-trained policies scores higher than a detuned one under"
            " policies that were trained through it",
            tuple(
                Contrast(
                    on_loop(ideal_arm(task), "designed"),
                    on_loop(through_loop(task, "weaker"), "weaker"),
                )
                for task in LOOPED
            ),
        ),
        Question(
            "P10",
            "wrong",
            "Policies trained through a motor score as high where its resistance or inductance is"
            " 25 % off",
            tuple(pair for task in LOOPED for pair in _mean_wrong(task, quarter)),
            "equivalent",
        ),
        Question(
            "P11",
            "motors",
            "On a good off-the-shelf motor, ideal-trained policies score as high as on ideal forces",
            tuple(
                Contrast(on_motor(ideal_arm(task), "good"), ideal_trial(ideal_arm(task)))
                for task in SECONDS
            ),
            "equivalent",
        ),
        Question(
            "P12",
            "motors",
            "On a marginal off-the-shelf motor, policies trained through it score higher than"
            " ideal-trained ones",
            tuple(
                Contrast(
                    on_motor(through_motor(task), "marginal"), on_motor(ideal_arm(task), "marginal")
                )
                for task in MARGINAL
            ),
        ),
    ]


@functools.cache
def secondary() -> list[Question]:
    """Return all secondary questions by section; each is one contrast."""
    contrasts: list[tuple[str, str, Trial, Trial]] = []
    for task in SECONDS:
        home = ideal_arm(task)
        for axis, described in AXES.items():
            for severity in described.severities[1:]:
                statement = f"{task}, ideal-trained: {axis} {severity:g} over none"
                contrasts.append(
                    (
                        "matters",
                        statement,
                        trial_at(home, axis, severity),
                        trial_at_zero(home, axis),
                    )
                )
    for task in TRAINED:
        for axis in AXES:
            through, generic = matched(task, axis), _generic(task)
            for trained, reference in (
                (through, ideal_arm(task)),
                (through, generic),
                (generic, ideal_arm(task)),
            ):
                pair = _trained_trial(trained, axis), _trained_trial(reference, axis)
                contrasts.append(("matters", f"{pair[0].name}, over {reference.name}", *pair))
        for axis in DRAWN:
            pair = (
                _trained_trial(arms.drawn(task, axis), axis),
                _trained_trial(matched(task, axis), axis),
            )
            contrasts.append(("matters", f"{task}, {axis}: drawn over matched", *pair))
    for task in LOOPED:
        home, nominal, open_ = ideal_arm(task), through_loop(task, "weaker"), identified(task)
        for loop in ("weaker", "paper", "designed"):
            statement = f"{task}, {loop} loop: trained through it over ideal-trained"
            contrasts.append(
                ("tune", statement, on_loop(through_loop(task, loop), loop), on_loop(home, loop))
            )
        statement = f"{task}: designed loop over the paper's, ideal-trained"
        contrasts.append(("tune", statement, on_loop(home, "designed"), on_loop(home, "paper")))
        for name, env in wrong_motors(task).items():
            wrong_trial = Trial(nominal, name, env)
            contrasts.append(
                ("wrong", f"{task}, {name} over nominal", wrong_trial, on_loop(nominal, "weaker"))
            )
            contrasts.append(
                (
                    "wrong",
                    f"{task}, {name}: drawn over nominal",
                    Trial(open_, name, env),
                    wrong_trial,
                )
            )
    for task in SECONDS:
        home = ideal_arm(task)
        contrasts.append(
            ("motors", f"{task}: good motor over ideal", on_motor(home, "good"), ideal_trial(home))
        )
    for task in MARGINAL:
        marginal_trial = on_motor(ideal_arm(task), "marginal")
        contrasts.append(
            (
                "motors",
                f"{task}: marginal motor over ideal",
                marginal_trial,
                ideal_trial(ideal_arm(task)),
            )
        )
        statement = f"{task}, marginal motor: trained through it over ideal-trained"
        contrasts.append(
            ("motors", statement, on_motor(through_motor(task), "marginal"), marginal_trial)
        )
    observing_arms = [
        through_motor(task, "current and reference observed", observe_actuator=True)
        for task in TRAINED
    ]
    # On Pendulum the current limit of the marginal drive would bind only the arm with torque
    # commands, so only Furuta is trained with voltage commands.
    for command_arm in (*observing_arms, through_motor("furuta", "voltage", action="voltage")):
        torque_trial = on_motor(through_motor(command_arm.task), "marginal")
        contrasts.append(
            (
                "command",
                f"{command_arm.name}, over torque and no more",
                on_motor(command_arm, "marginal"),
                torque_trial,
            )
        )
    return [
        Question(f"S{number}", section, statement, (Contrast(trial, reference),))
        for number, (section, statement, trial, reference) in enumerate(contrasts, start=1)
    ]


@functools.cache
def trials() -> tuple[Trial, ...]:
    """Return every trial of the study once."""
    pairs = [pair for question in (*primary(), *secondary()) for pair in question.contrasts]
    return tuple({trial.name: trial for pair in pairs for trial in pair}.values())
