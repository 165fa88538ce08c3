"""Training arms of the study, and its preregistered hypotheses: docs/results/insurance_plan.md."""

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from actuator_study.arms import DRAWN
from actuator_study.arms import drawn as drawn_severities
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import AXES, ideal_arm, ideal_trial, make_arm, study_env, timestep
from codrl_mj.study.questions import Contrast, Question
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import find_task
from insurance_study.late import Late

TASKS = ("pendulum", "furuta", "acrobot")
SEVERITIES: Mapping[str, Mapping[str, float]] = {
    task: {axis: description.training_severity[task] for axis, description in AXES.items()}
    for task in TASKS
}
"""Task -> axis -> severity that is trained and tested.

On Acrobot it is the smallest that surely hurts ideal-trained policies, or else the largest.
"""
HARMLESS: Mapping[str, Mapping[str, float]] = {
    "pendulum": {"lag": 0.5, "weakness": 0.0, "delay": 0.5},
    "furuta": {"lag": 0.25, "weakness": 0.1, "delay": 0.0},
    "acrobot": {"lag": 1.0, "weakness": 0.1, "delay": 1.0},
}
"""Task -> axis -> largest severity that is harmless on the page of the first study."""
REMEMBERED = ("lag", "delay")
"""Axes with policies that see their last commands."""


def reach(task: str, axis: str) -> float:
    """Return random actuators' largest severity: twice the harmless or the smallest tested one."""
    return max(2.0 * HARMLESS[task][axis], AXES[axis].severities[1])


def late(task: str, **fields: float) -> Late:
    """Return the actuator of arms with random actuators or visible commands; default: ideal."""
    definition = find_task(task)
    return Late(
        held=round(definition.step_duration / timestep(task)),
        largest=definition.max_force,
        **fields,
    )


@functools.cache
def generic(
    task: str,
    share: float = 1.0,
    name: str = "random",
    with_pushes: bool = True,
    with_lag_and_delay: bool = True,
) -> Arm:
    """Return the arm trained on random gain, lag, delay and pushes, at a share of their reach."""
    step, force = find_task(task).step_duration, find_task(task).max_force
    reaches = {axis: share * reach(task, axis) for axis in ("lag", "weakness", "delay")}
    drawn = {"gain": f"uniform({1 - reaches['weakness']:g}, {1 + reaches['weakness']:g})"}
    if with_lag_and_delay:
        drawn |= {
            "time_constant": f"uniform(0, {reaches['lag'] * step:g})",
            "delay": f"uniform(0, {reaches['delay'] * step:g})",
        }
    pushes = Disturbances(
        pulse_force=0.25 * share * force, pulse_duration=step, pulse_interval=10 * step
    )
    fields: dict[str, Any] = {"disturbances": pushes} if with_pushes else {}
    return make_arm(task, name, study_env(task, late(task), randomize=drawn, **fields))


@functools.cache
def pushes(task: str) -> Arm:
    """Return the arm trained on random pushes only."""
    step, force = find_task(task).step_duration, find_task(task).max_force
    pushed = Disturbances(pulse_force=0.25 * force, pulse_duration=step, pulse_interval=10 * step)
    return make_arm(task, "random pushes alone", study_env(task, disturbances=pushed))


def strength(task: str) -> Arm:
    """Return the arm trained on random gains only."""
    return generic(task, name="random strength alone", with_pushes=False, with_lag_and_delay=False)


def half(task: str) -> Arm:
    """Return the arm with random actuators of half the reach."""
    return generic(task, 0.5, "random, half")


def double(task: str) -> Arm:
    """Return the arm with random actuators of twice the reach."""
    return generic(task, 2.0, "random, double")


@functools.cache
def through(task: str, axis: str) -> Arm:
    """Return the arm trained at the severity of one axis."""
    return make_arm(task, axis, AXES[axis].make_env(task, SEVERITIES[task][axis]))


@functools.cache
def drawn(task: str, axis: str) -> Arm:
    """Return the arm trained on one axis' severities, drawn per episode up to twice its own."""
    return drawn_severities(task, axis, SEVERITIES[task][axis])


def remembering_env(task: str, axis: str, severity: float) -> EnvConfig:
    """Return an environment with a lag or a delay, whose policy sees its last four commands."""
    seconds = severity * find_task(task).step_duration
    return study_env(
        task,
        late(task, **{{"lag": "time_constant"}.get(axis, axis): seconds}),
        observe_actuator=True,
    )


@functools.cache
def remembering(task: str, axis: str) -> Arm:
    """Return the arm trained at the severity of one axis, seeing its last four commands."""
    return make_arm(
        task, f"{axis}, remembering", remembering_env(task, axis, SEVERITIES[task][axis])
    )


def trial_at(arm: Arm, axis: str, severity: float | None = None) -> Trial:
    """Return the test of an arm's policies at a severity; the default is the trained one."""
    severity = SEVERITIES[arm.task][axis] if severity is None else severity
    if arm.config.env.observe_actuator:
        return Trial(
            arm, f"{axis} {severity:g}, remembering", remembering_env(arm.task, axis, severity)
        )
    return Trial(arm, f"{axis} {severity:g}", AXES[axis].make_env(arm.task, severity))


def home(arm: Arm) -> Trial:
    """Return the test of an arm's policies on ideal forces."""
    if arm.config.env.observe_actuator:
        return Trial(arm, "ideal, remembering", remembering_env(arm.task, "lag", 0.0))
    return ideal_trial(arm)


def neighbors(task: str, axis: str) -> dict[str, float]:
    """Return the tested severities next to the trained one, as "less" and "more", without 0."""
    severities, index = AXES[axis].severities, AXES[axis].severities.index(SEVERITIES[task][axis])
    neighboring = {
        "less": severities[index - 1],
        "more": severities[index + 1] if index + 1 < len(severities) else 0.0,
    }
    return {side: severity for side, severity in neighboring.items() if severity}


Kind = Callable[[str, str], Arm]
KINDS: Mapping[str, Kind] = {
    "ideal": lambda task, axis: ideal_arm(task),  # noqa: ARG005
    "matched": through,
    "drawn": drawn,
    "remembering": remembering,
    "random": lambda task, axis: generic(task),  # noqa: ARG005
    "half": lambda task, axis: half(task),  # noqa: ARG005
    "double": lambda task, axis: double(task),  # noqa: ARG005
    "pushes": lambda task, axis: pushes(task),  # noqa: ARG005
    "strength": lambda task, axis: strength(task),  # noqa: ARG005
}
"""Name -> function (task, axis) that returns the arm."""


def pairs(
    kind: str, reference_kind: str, axes: Iterable[str] = AXES, tasks: Iterable[str] = TASKS
) -> tuple[Contrast, ...]:
    """Return the contrasts of two kinds at the trained severities."""
    return tuple(
        Contrast(
            trial_at(KINDS[kind](task, axis), axis),
            trial_at(KINDS[reference_kind](task, axis), axis),
        )
        for task in tasks
        for axis in axes
    )


def home_contrasts(
    kind: str, axes: Iterable[str], tasks: Iterable[str] = TASKS
) -> tuple[Contrast, ...]:
    """Return the contrasts of a kind with ideal-trained policies, both on ideal forces."""
    return tuple(
        Contrast(home(KINDS[kind](task, axis)), home(ideal_arm(task)))
        for task in tasks
        for axis in axes
    )


COMPARED: Mapping[str, tuple[str, str, tuple[str, ...], str]] = {
    "I1": (
        "matched",
        "random",
        tuple(AXES),
        "training at the same severity scores higher than random actuators",
    ),
    "I2": (
        "random",
        "ideal",
        tuple(AXES),
        "training on random actuators scores higher than on ideal forces",
    ),
    "I5": (
        "drawn",
        "random",
        DRAWN,
        "training on drawn severities of the same effect scores higher than random actuators",
    ),
    "I6": (
        "random",
        "pushes",
        tuple(AXES),
        "random actuators score higher than random pushes only",
    ),
    "I7": (
        "random",
        "strength",
        tuple(AXES),
        "random actuators score higher than random strength only",
    ),
    "I8": (
        "remembering",
        "matched",
        REMEMBERED,
        "observing the last commands lets a policy score higher",
    ),
    "I9": (
        "random",
        "half",
        tuple(AXES),
        "random actuators score higher than those with half the reach",
    ),
    "I10": ("double", "random", tuple(AXES), "random actuators with twice the reach score higher"),
}
"""Hypothesis -> kind, reference kind, axes, statement: at the trained severities, pooled."""
AT_HOME: Mapping[str, tuple[str, tuple[str, ...], str]] = {
    "I3": ("random", ("lag",), "on ideal forces, random actuators cost nothing"),
    "I4": (
        "matched",
        tuple(AXES),
        "on ideal forces, training through a single effect costs nothing",
    ),
}
"""Hypothesis -> kind, axes, statement: equivalence."""


@functools.cache
def primary() -> list[Question]:
    """Return the ten primary questions, whose p-values are corrected together."""
    better = [
        Question(name, "insured", statement, pairs(kind, reference, axes))
        for name, (kind, reference, axes, statement) in COMPARED.items()
    ]
    equal = [
        Question(name, "home", statement, home_contrasts(kind, axes), "equivalent")
        for name, (kind, axes, statement) in AT_HOME.items()
    ]
    return sorted(better + equal, key=lambda kind: int(kind.name[1:]))


@functools.cache
def secondary() -> list[Question]:
    """Return all secondary questions, each on a single task, in sections."""
    # Names of sections are values of published rows; the page shows other titles.
    parts: list[tuple[str, str, tuple[Contrast, ...]]] = []
    every = tuple(AXES)
    at_home_too = (("matched", tuple(AXES)), ("drawn", DRAWN), ("remembering", REMEMBERED))
    for task in TASKS:
        parts += [
            (
                "insured",
                f"{task}, {axis}: {kind} over {reference}",
                pairs(kind, reference, [axis], [task]),
            )
            for kind, reference, axes, _ in COMPARED.values()
            for axis in axes
        ]
        parts += [
            (
                "home",
                f"{task}, ideal forces: {kind} over ideal",
                home_contrasts(kind, ["lag"], [task]),
            )
            for kind in ("random", "half", "double", "pushes", "strength")
        ]
        parts += [
            (
                "home",
                f"{task}, ideal forces: {axis}, {kind} over ideal",
                home_contrasts(kind, [axis], [task]),
            )
            for kind, axes in at_home_too
            for axis in axes
        ]
        for kind, axes in (("random", every), ("matched", every), ("drawn", DRAWN)):
            for axis in axes:
                for side, severity in neighbors(task, axis).items():
                    pair = Contrast(
                        trial_at(KINDS[kind](task, axis), axis, severity),
                        trial_at(ideal_arm(task), axis, severity),
                    )
                    parts.append(
                        (
                            "other doses",
                            f"{task}, {axis} {severity:g} ({side}): {kind} over ideal",
                            (pair,),
                        )
                    )
    return [Question(f"S{number}", *kind) for number, kind in enumerate(parts, start=1)]


@functools.cache
def trials() -> tuple[Trial, ...]:
    """Return every trial of the study once, including those of the first study's arms."""
    contrasts = [pair for question in (*primary(), *secondary()) for pair in question.contrasts]
    homes = [Contrast(ideal_trial(ideal_arm(task)), ideal_trial(ideal_arm(task))) for task in TASKS]
    return tuple({trial.name: trial for pair in (*contrasts, *homes) for trial in pair}.values())


def needs_new_policies(trial: Trial) -> bool:
    """Return True if the first study did not train the trial's policies."""
    known = {"ideal", *AXES, *(f"{axis}, drawn" for axis in DRAWN)}
    kind = trial.arm.name.partition(": ")[2]
    return kind != "ideal" and (trial.arm.task == "acrobot" or kind not in known)
