"""Who is trained on what, and the hypotheses as they were written down before: docs/results/insurance_plan.md."""

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from actuator_study.arms import DRAWN
from actuator_study.arms import drawn as drawn_doses
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import AXES, arm, ideal_trial, ideal, study_env, timestep
from codrl_mj.study.questions import Contrast, Question
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import find_task
from insurance_study.late import Late

TASKS = ("pendulum", "furuta", "acrobot")
DOSES: Mapping[str, Mapping[str, float]] = {
    task: {axis: one.training_severity[task] for axis, one in AXES.items()} for task in TASKS
}
"""Task -> axis -> the dose that is trained through and tested: on Acrobot the smallest that surely
hurts ideal-trained policies, or, where none does, the largest.
"""
HARMLESS: Mapping[str, Mapping[str, float]] = {
    "pendulum": {"lag": 0.5, "weakness": 0.0, "delay": 0.5},
    "furuta": {"lag": 0.25, "weakness": 0.1, "delay": 0.0},
    "acrobot": {"lag": 1.0, "weakness": 0.1, "delay": 1.0},
}
"""Task -> axis -> the largest dose that the page of the first study reads as harmless."""
REMEMBERED = ("lag", "delay")
"""The axes that a policy which sees its last commands is trained on."""


def reach(task: str, axis: str) -> float:
    """The largest dose that random actuators have: twice the harmless one, or the smallest that was tested."""
    return max(2.0 * HARMLESS[task][axis], AXES[axis].severities[1])


def late(task: str, **fields: float) -> Late:
    """The actuator of the random and of the remembering arms; without fields it is ideal."""
    definition = find_task(task)
    return Late(
        held=round(definition.step_duration / timestep(task)),
        largest=definition.max_force,
        **fields,
    )


@functools.cache
def generic(
    task: str, share: float = 1.0, named: str = "random", pushed: bool = True, late_too: bool = True
) -> Arm:
    """Trained on random strength, lag and delay, and random pushes: on a share of what the rule says."""
    step, force = find_task(task).step_duration, find_task(task).max_force
    most = {axis: share * reach(task, axis) for axis in ("lag", "weakness", "delay")}
    drawn = {"gain": f"uniform({1 - most['weakness']:g}, {1 + most['weakness']:g})"}
    if late_too:
        drawn |= {
            "time_constant": f"uniform(0, {most['lag'] * step:g})",
            "delay": f"uniform(0, {most['delay'] * step:g})",
        }
    pushes = Disturbances(
        pulse_force=0.25 * share * force, pulse_duration=step, pulse_interval=10 * step
    )
    fields: dict[str, Any] = {"disturbances": pushes} if pushed else {}
    return arm(task, named, study_env(task, late(task), randomize=drawn, **fields))


@functools.cache
def pushes(task: str) -> Arm:
    """Trained on random pushes and nothing else."""
    step, force = find_task(task).step_duration, find_task(task).max_force
    pushed = Disturbances(pulse_force=0.25 * force, pulse_duration=step, pulse_interval=10 * step)
    return arm(task, "random pushes alone", study_env(task, disturbances=pushed))


def strength(task: str) -> Arm:
    """Trained on random strength and nothing else."""
    return generic(task, named="random strength alone", pushed=False, late_too=False)


def half(task: str) -> Arm:
    """Random actuators of half the reach."""
    return generic(task, 0.5, "random, half")


def double(task: str) -> Arm:
    """Random actuators of twice the reach."""
    return generic(task, 2.0, "random, double")


@functools.cache
def through(task: str, axis: str) -> Arm:
    """Trained through the dose of one thing."""
    return arm(task, axis, AXES[axis].make_env(task, DOSES[task][axis]))


@functools.cache
def drawn(task: str, axis: str) -> Arm:
    """Trained on doses of one thing that are drawn for every episode, from none to twice the trained one."""
    return drawn_doses(task, axis, DOSES[task][axis])


def remembered(task: str, axis: str, dose: float) -> EnvConfig:
    """A lag or a delay under a policy that sees its last four commands."""
    seconds = dose * find_task(task).step_duration
    return study_env(
        task,
        late(task, **{{"lag": "time_constant"}.get(axis, axis): seconds}),
        observe_actuator=True,
    )


@functools.cache
def remembering(task: str, axis: str) -> Arm:
    """Trained through the dose of one thing, seeing its last four commands."""
    return arm(task, f"{axis}, remembering", remembered(task, axis, DOSES[task][axis]))


def under(arm: Arm, axis: str, dose: float | None = None) -> Trial:
    """Policies on a dose of one thing; the one that is trained through, unless another is given."""
    dose = DOSES[arm.task][axis] if dose is None else dose
    if arm.config.env.observe_actuator:
        return Trial(arm, f"{axis} {dose:g}, remembering", remembered(arm.task, axis, dose))
    return Trial(arm, f"{axis} {dose:g}", AXES[axis].make_env(arm.task, dose))


def home(arm: Arm) -> Trial:
    """Policies on ideal forces."""
    if arm.config.env.observe_actuator:
        return Trial(arm, "ideal, remembering", remembered(arm.task, "lag", 0.0))
    return ideal_trial(arm)


def neighbours(task: str, axis: str) -> dict[str, float]:
    """The doses below and above the trained one, of those that the first study tested; none is no dose."""
    doses, at = AXES[axis].severities, AXES[axis].severities.index(DOSES[task][axis])
    found = {"less": doses[at - 1], "more": doses[at + 1] if at + 1 < len(doses) else 0.0}
    return {which: dose for which, dose in found.items() if dose}


Kind = Callable[[str, str], Arm]
KINDS: Mapping[str, Kind] = {
    "ideal": lambda task, axis: ideal(task),  # noqa: ARG005
    "matched": through,
    "drawn": drawn,
    "remembering": remembering,
    "random": lambda task, axis: generic(task),  # noqa: ARG005
    "half": lambda task, axis: half(task),  # noqa: ARG005
    "double": lambda task, axis: double(task),  # noqa: ARG005
    "pushes": lambda task, axis: pushes(task),  # noqa: ARG005
    "strength": lambda task, axis: strength(task),  # noqa: ARG005
}
"""Name -> (task, axis) -> what was trained."""


def pairs(
    one: str, other: str, axes: Iterable[str] = AXES, tasks: Iterable[str] = TASKS
) -> tuple[Contrast, ...]:
    """Two kinds at the trained doses."""
    return tuple(
        Contrast(under(KINDS[one](task, axis), axis), under(KINDS[other](task, axis), axis))
        for task in tasks
        for axis in axes
    )


def at_homes(one: str, axes: Iterable[str], tasks: Iterable[str] = TASKS) -> tuple[Contrast, ...]:
    """What a kind scores on ideal forces, over what ideal-trained policies do."""
    return tuple(
        Contrast(home(KINDS[one](task, axis)), home(ideal(task))) for task in tasks for axis in axes
    )


COMPARED: Mapping[str, tuple[str, str, tuple[str, ...], str]] = {
    "I1": (
        "matched",
        "random",
        tuple(AXES),
        "training through the very dose scores higher than random actuators",
    ),
    "I2": ("random", "ideal", tuple(AXES), "random actuators score higher than ideal forces"),
    "I5": (
        "drawn",
        "random",
        DRAWN,
        "doses of the very thing, drawn, score higher than random actuators",
    ),
    "I6": (
        "random",
        "pushes",
        tuple(AXES),
        "random actuators score higher than random pushes alone",
    ),
    "I7": (
        "random",
        "strength",
        tuple(AXES),
        "random actuators score higher than random strength alone",
    ),
    "I8": (
        "remembering",
        "matched",
        REMEMBERED,
        "seeing its last commands lets a policy score higher",
    ),
    "I9": (
        "random",
        "half",
        tuple(AXES),
        "random actuators score higher than those of half the reach",
    ),
    "I10": ("double", "random", tuple(AXES), "random actuators of twice the reach score higher"),
}
"""Hypothesis -> kind, other kind, axes, what it says: at the trained doses, pooled over axes and tasks."""
AT_HOME: Mapping[str, tuple[str, tuple[str, ...], str]] = {
    "I3": ("random", ("lag",), "on ideal forces random actuators cost nothing"),
    "I4": ("matched", tuple(AXES), "on ideal forces training through one thing costs nothing"),
}
"""Hypothesis -> kind, axes, what it says: equivalence."""


@functools.cache
def primary() -> list[Question]:
    """The ten that are corrected together."""
    better = [
        Question(name, "insured", says, pairs(one, other, axes))
        for name, (one, other, axes, says) in COMPARED.items()
    ]
    equal = [
        Question(name, "home", says, at_homes(kind, axes), "equivalent")
        for name, (kind, axes, says) in AT_HOME.items()
    ]
    return sorted(better + equal, key=lambda one: int(one.name[1:]))


@functools.cache
def secondary() -> list[Question]:
    """All others, each of one task: each axis by itself, other doses, and what each kind costs at home."""
    found: list[tuple[str, str, tuple[Contrast, ...]]] = []
    every, at_home_too = (
        tuple(AXES),
        (("matched", tuple(AXES)), ("drawn", DRAWN), ("remembering", REMEMBERED)),
    )
    for task in TASKS:
        found += [
            ("insured", f"{task}, {axis}: {one} over {other}", pairs(one, other, [axis], [task]))
            for one, other, axes, _ in COMPARED.values()
            for axis in axes
        ]
        found += [
            ("home", f"{task}, ideal forces: {one} over ideal", at_homes(one, ["lag"], [task]))
            for one in ("random", "half", "double", "pushes", "strength")
        ]
        found += [
            (
                "home",
                f"{task}, ideal forces: {axis}, {one} over ideal",
                at_homes(one, [axis], [task]),
            )
            for one, axes in at_home_too
            for axis in axes
        ]
        for one, axes in (("random", every), ("matched", every), ("drawn", DRAWN)):
            for axis in axes:
                for which, dose in neighbours(task, axis).items():
                    pair = Contrast(
                        under(KINDS[one](task, axis), axis, dose), under(ideal(task), axis, dose)
                    )
                    found.append(
                        (
                            "other doses",
                            f"{task}, {axis} {dose:g} ({which}): {one} over ideal",
                            (pair,),
                        )
                    )
    return [Question(f"S{number}", *one) for number, one in enumerate(found, start=1)]


@functools.cache
def trials() -> tuple[Trial, ...]:
    """Every trial of the study once, those of the first study's arms among them."""
    both = [pair for question in (*primary(), *secondary()) for pair in question.contrasts]
    homes = [Contrast(ideal_trial(ideal(task)), ideal_trial(ideal(task))) for task in TASKS]
    return tuple({trial.name: trial for pair in (*both, *homes) for trial in pair}.values())


def new(trial: Trial) -> bool:
    """Whether its policies are none of the first study's."""
    known = {"ideal", *AXES, *(f"{axis}, drawn" for axis in DRAWN)}
    kind = trial.arm.name.partition(": ")[2]
    return kind != "ideal" and (trial.arm.task == "acrobot" or kind not in known)
