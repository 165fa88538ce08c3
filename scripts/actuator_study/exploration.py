"""Exploratory tests of the study's policies, which its plan does not have."""

import dataclasses

from actuator_study import arms
from actuator_study.arms import trial_at, with_fields
from actuator_study.questions import on_loop, through_loop
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import AXES, SECONDS, ideal_arm, study_env, supply, timestep
from codrl_mj.study.trials import Trial
from codrl_mj.tasks import find_task


def wound_up(task: str, severity: float) -> EnvConfig:
    """Return an environment with too low a supply and no anti-windup in its current loop."""
    return with_fields(supply(task, severity), controller__anti_windup="none")


def windup() -> dict[str, list[tuple[Trial, Trial]]]:
    """Return tests at all supply severities with and without anti-windup, by task."""
    return {
        task: [
            (
                trial_at(ideal_arm(task), "supply", severity),
                Trial(
                    ideal_arm(task), f"supply {severity:g}, winding up", wound_up(task, severity)
                ),
            )
            for severity in AXES["supply"].severities[1:]
        ]
        for task in SECONDS
    }


def paper_loops(task: str) -> dict[str, EnvConfig]:
    """Return variants of the paper's motor and loop, by name.

    The integration step is varied for motor and mechanics alike. The study's is a tenth of the
    policy's step, the paper's is the whole step.
    """
    nominal, step = study_env(task, "paper"), find_task(task).step_duration
    motor = nominal.actuator.motor
    return {
        "feed-forward 0": with_fields(nominal, controller__kff=0.0),
        "feed-forward R": with_fields(nominal, controller__kff=motor.resistance),
        "half the arm": with_fields(nominal, motor__arm_radius=0.5 * motor.arm_radius),
        "twice the arm": with_fields(nominal, motor__arm_radius=2.0 * motor.arm_radius),
        "step of the policy": dataclasses.replace(nominal, timestep=step),
        "step of a hundredth": dataclasses.replace(nominal, timestep=timestep(task) / 10.0),
    }


def around_the_paper() -> dict[str, list[Trial]]:
    """Return tests on the paper's loop and its variants, by column of a table."""
    return {
        f"{task}, {name}": [
            on_loop(arm, "paper"),
            *(Trial(arm, f"paper, {variant}", env) for variant, env in paper_loops(task).items()),
        ]
        for task in arms.LOOPED
        for name, arm in (
            ("ideal-trained", ideal_arm(task)),
            ("trained on it", through_loop(task, "paper")),
        )
    }


def explored() -> dict[str, Trial]:
    """Return every explored trial once, by name; some also belong to the plan."""
    pairs = [pair for rows in windup().values() for pair in rows]
    trials_explored = [
        *(trial for pair in pairs for trial in pair),
        *(t for column in around_the_paper().values() for t in column),
    ]
    return {trial.name: trial for trial in trials_explored}
