"""The actuators that the mismatch study trains and tests on, by name: each number with its reason."""

import dataclasses
from collections.abc import Iterable
from typing import Any

from codrl_mj.actuators import IDEAL, NAMED, Actuator, CurrentLoop, Supply
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import did_you_mean
from codrl_mj.tasks import Task, find_task, named_actuator


@dataclasses.dataclass(frozen=True)
class Condition:
    """What stands between an action and the force delivered, under a name."""

    name: str
    """Name, on the command line and in tables."""
    description: str
    """What it is, in a line."""
    env: EnvConfig
    """Task and actuator, disturbances, and what is drawn at random."""

    @property
    def actuator(self) -> Any:
        """The actuator."""
        return self.env.actuator


def conditions(task: str) -> dict[str, Condition]:
    """The actuators of the matrix, by name.

    Args:
        task: task name.

    Raises:
        ValueError: unknown task.
    """
    definition, paper = _task_and_paper(task)
    # The slow winding is that of `open_loop`: what differs between the two is the loop alone.
    slow: Any = NAMED["open_loop"][1](paper)
    return _by_name(
        [
            *(
                Condition(name, description, _integrated_as_with_a_motor(EnvConfig(definition.name, name)))
                for name, (description, _) in NAMED.items()
            ),
            Condition(
                "slow_winding",
                f"the paper's loop on a slow winding: L = {slow.motor.inductance:g} H instead of "
                f"{paper.motor.inductance:g} H",
                EnvConfig(definition.name, dataclasses.replace(paper, motor=slow.motor)),
            ),
            low_voltage(definition.name, paper),
            Condition(
                "delay",
                f"the paper's actuator, and every command comes one environment step ({definition.step_duration:g} s) "
                "late, as when the policy is computed while the step before runs",
                EnvConfig(definition.name, paper, disturbances=Disturbances(command_delay=definition.step_duration)),
            ),
            _randomised(task, paper, slow.motor.inductance),
        ]
    )


def _integrated_as_with_a_motor(env: EnvConfig) -> EnvConfig:
    """What makes the ideal actuator's environment differ from a motor's by the motor alone.

    Gymnasium integrates Acrobot in steps of 0.2 s, the paper's inner loop in steps of 0.02 s.
    """
    ideal = env.actuator == IDEAL
    return dataclasses.replace(env, inner_steps=find_task(env.task).motor_inner_steps) if ideal else env


def low_voltage(task: str, paper: Actuator) -> Condition:
    """The paper's actuator on 5 V.

    Its loops ask for peaks of 11 V to 17 V on these tasks, and for 1 V to 2 V to hold the largest force at standstill:
    5 V is between, so that it saturates on the move and not at rest.
    """
    return Condition(
        "low_voltage",
        "the paper's actuator on a 5 V supply instead of 24 V",
        EnvConfig(task, _on_supply(paper, 5.0)),
    )


def _randomised(task: str, paper: Actuator, slowest: float) -> Condition:
    """The paper's actuator with everything drawn that sets the others of the matrix apart, but for delays.

    Gains lie between those of the weakest loop, 0.2, and the strongest, the paper's or those of `weak`, which are 1;
    feed-forward between none and all of the resistance; windings and supplies between the paper's and the worst.
    """
    loop, motor = paper.controller, paper.motor
    weak, weaker = named_actuator("weak", task), named_actuator("weaker", task)
    kp, ki = (
        f"loguniform({getattr(weaker.controller, gain):g}, "
        f"{max(getattr(loop, gain), getattr(weak.controller, gain)):g})"
        for gain in ("kp", "ki")
    )
    supply = low_voltage(task, paper).actuator
    drawn = {
        "controller.kp": kp,
        "controller.ki": ki,
        "controller.kff": f"uniform(0, {motor.resistance:g})",
        "motor.inductance": f"loguniform({motor.inductance:g}, {slowest:g})",
        "controller.max_voltage": f"uniform({supply.controller.max_voltage:g}, {loop.max_voltage:g})",
    }
    text = ", ".join(f"{name.partition('.')[2]} {distribution}" for name, distribution in drawn.items())
    return Condition(
        "randomised",
        f"the paper's actuator, drawn anew in every episode: {text}",
        EnvConfig(task, paper, randomize=tuple(f"{name}={distribution}" for name, distribution in drawn.items())),
    )


def stall_supply(task: str) -> Condition:
    """The paper's actuator on a supply that just holds the task's largest force at standstill: u = R*r*F/kT.

    No command, of force or of voltage, then gets more force at standstill than the task allows.

    Args:
        task: task name.

    Raises:
        ValueError: unknown task.
    """
    definition, paper = _task_and_paper(task)
    motor = paper.motor
    volts = motor.resistance * motor.arm_radius * definition.max_force / motor.torque_constant
    return Condition(
        "stall_supply",
        f"the paper's actuator on {volts:g} V, which just holds the task's largest force at standstill",
        EnvConfig(definition.name, _on_supply(paper, volts)),
    )


def ladder(task: str) -> dict[str, Condition]:
    """The way from the ideal actuator to a real one, one rung at a time, each on top of those before it.

    Commands are quantised only where they are continuous: two or three levels stay what they are.

    Args:
        task: task name.

    Raises:
        ValueError: unknown task.
    """
    definition, paper = _task_and_paper(task)
    known = conditions(task)
    motor = paper.motor
    late = {"command_delay": definition.step_duration}
    # 16 steps over the range: a converter of 4 bits, at the coarse end of what is built
    coarse = {"command_quantum": definition.max_force / 8} if definition.forces is None else {}
    # Half the winding's resistance: a stalled motor gets a third less current from it
    sag = 0.5 * motor.resistance
    low = known["low_voltage"].env
    rungs = [
        known["ideal"],
        Condition(
            "winding",
            f"the paper's winding (R = {motor.resistance:g} ohm, L = {motor.inductance:g} H) driven open loop: "
            "u = R*i_ref + kE*omega",
            EnvConfig(
                definition.name,
                Actuator(motor, CurrentLoop(kp=0.0, kff=motor.resistance, max_voltage=paper.controller.max_voltage)),
            ),
        ),
        known["paper"],
        known["low_voltage"],
        Condition(
            "late",
            f"`low_voltage`, and every command comes one environment step ({definition.step_duration:g} s) late",
            dataclasses.replace(low, disturbances=Disturbances(**late)),
        ),
        Condition(
            "coarse",
            f"`late`, and commands in steps of {definition.max_force / 8:g} N*m",
            dataclasses.replace(low, disturbances=Disturbances(**late, **coarse)),
        ),
        Condition(
            "sagging",
            f"`{'coarse' if coarse else 'late'}`, and a supply that sags: of {sag:g} ohm",
            dataclasses.replace(
                low,
                actuator=dataclasses.replace(low.actuator, supply=Supply(resistance=sag)),
                disturbances=Disturbances(**late, **coarse),
            ),
        ),
    ]
    return _by_name(rung for rung in rungs if coarse or rung.name != "coarse")


def every_condition(task: str) -> dict[str, Condition]:
    """All conditions of a task, by name."""
    return ladder(task) | conditions(task) | _by_name([stall_supply(task)])


def check_condition(name: str, tasks: Iterable[str]) -> None:
    """Raise unless one of the tasks has such a condition.

    Raises:
        ValueError: none has; the nearest known one is suggested.
    """
    known = list(dict.fromkeys(name for task in tasks for name in every_condition(task)))
    if name not in known:
        raise ValueError(f"unknown condition {name!r}: {did_you_mean(name, known)}Known: {', '.join(known)}")


def _task_and_paper(task: str) -> tuple[Task, Actuator]:
    definition = find_task(task)
    paper = named_actuator("paper", definition.name)
    return definition, paper


def _on_supply(actuator: Actuator, volts: float) -> Actuator:
    return dataclasses.replace(actuator, controller=dataclasses.replace(actuator.controller, max_voltage=volts))


def _by_name(several: Iterable[Condition]) -> dict[str, Condition]:
    return {condition.name: condition for condition in several}
