"""What was looked at beyond the plan: more tests of the study's policies, tabulated and concluded from with care."""

import dataclasses

from actuator_study import arms
from actuator_study.arms import dosed, otherwise
from actuator_study.questions import on_loop, through_loop
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import AXES, SECONDS, ideal, study_env, supply, timestep
from codrl_mj.study.trials import Trial
from codrl_mj.tasks import find_task


def wound_up(task: str, dose: float) -> EnvConfig:
    """A supply that comes short, under a loop whose integrator goes on while the voltage saturates."""
    return otherwise(supply(task, dose), controller__anti_windup="none")


def windup() -> dict[str, list[tuple[Trial, Trial]]]:
    """Task -> ideal-trained policies on every dose of the supply, with anti-windup and without."""
    return {
        task: [
            (
                dosed(ideal(task), "supply", dose),
                Trial(ideal(task), f"supply {dose:g}, winding up", wound_up(task, dose)),
            )
            for dose in AXES["supply"].severities[1:]
        ]
        for task in SECONDS
    }


def paper_loops(task: str) -> dict[str, EnvConfig]:
    """The paper's motor and loop otherwise than the paper has them, by name.

    The integration step is varied for motor and mechanics alike. The study's is a tenth of the
    policy's step, the paper's the whole of it.
    """
    nominal, step = study_env(task, "paper"), find_task(task).step_duration
    motor = nominal.actuator.motor
    return {
        "feed-forward 0": otherwise(nominal, controller__kff=0.0),
        "feed-forward R": otherwise(nominal, controller__kff=motor.resistance),
        "half the arm": otherwise(nominal, motor__arm_radius=0.5 * motor.arm_radius),
        "twice the arm": otherwise(nominal, motor__arm_radius=2.0 * motor.arm_radius),
        "step of the policy": dataclasses.replace(nominal, timestep=step),
        "step of a hundredth": dataclasses.replace(nominal, timestep=timestep(task) / 10.0),
    }


def around_the_paper() -> dict[str, list[Trial]]:
    """Column of a table -> policies on the paper's loop, and on what is otherwise; ideal-trained and trained on it."""
    return {
        f"{task}, {name}": [
            on_loop(arm, "paper"),
            *(
                Trial(arm, f"paper, {otherwise}", env)
                for otherwise, env in paper_loops(task).items()
            ),
        ]
        for task in arms.LOOPED
        for name, arm in (
            ("ideal-trained", ideal(task)),
            ("trained on it", through_loop(task, "paper")),
        )
    }


def explored() -> dict[str, Trial]:
    """Every trial of the exploration once, by name; some are the plan's."""
    pairs = [pair for rows in windup().values() for pair in rows]
    found = [
        *(trial for pair in pairs for trial in pair),
        *(t for column in around_the_paper().values() for t in column),
    ]
    return {trial.name: trial for trial in found}
