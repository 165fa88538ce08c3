"""Tasks: one definition of observations, rewards, terminations and resets for all physics."""

from collections.abc import Mapping
from typing import Any

from codrl_mj.actuators import ActuatorModel, ActuatorSetting, check_same_family, resolve
from codrl_mj.tasks import (
    acrobot,
    cartpole,
    furuta,
    mountain_car,
    mountain_car_continuous,
    pendulum,
)
from codrl_mj.tasks.base import Task
from codrl_mj.tasks.reference_env import ReferenceEnv
from codrl_mj.tasks.registration import TASKS, add_task, find_task, reference_of

PAPER_TASKS = tuple(
    add_task(module.TASK)
    for module in (pendulum, cartpole, acrobot, mountain_car, mountain_car_continuous)
)
"""Tasks that rebuild those of Gymnasium and have the paper's actuators."""
add_task(furuta.TASK)


def resolve_actuators(
    actuator: ActuatorSetting | list[ActuatorSetting] | tuple[ActuatorSetting, ...], task: Task
) -> tuple[ActuatorModel, ...]:
    """Return an actuator for each of a task's motors.

    Args:
        actuator: an argument of `codrl_mj.actuators.resolve`, or the name `default` for the task's
            default actuator. A list has an entry for each motor; anything else applies to all
            motors.
        task: the task; names such as `weak` are variations of its paper actuators.

    Raises:
        ValueError: unknown name or field, a value out of bounds, a list of another length than
            `task.motors`, or actuators of several families.
    """
    count = len(task.motors)
    requests = list(actuator) if isinstance(actuator, list | tuple) else [actuator] * count
    if len(requests) != count:
        hint = "; codrl_mj.make_vec takes a list with an actuator for each environment" * (
            count == 1
        )
        motors = f"{task.name} has {count} motor{'s' * (count > 1)} ({', '.join(task.motors)})"
        raise ValueError(f"actuator: got {len(requests)} actuators, but {motors}{hint}")
    # `default` depends on the task, which `resolve` does not know.
    for index, request in enumerate(requests):
        if isinstance(request, Mapping) and request.get("name") == "default":
            requests[index] = {**request, "name": task.default_actuator}
        elif isinstance(request, str) and request == "default":
            requests[index] = task.default_actuator
    papers = task.paper or (None,) * count
    actuators = tuple(
        resolve(request, paper, task.name) for request, paper in zip(requests, papers, strict=True)
    )
    check_same_family(actuators)
    return actuators


# The name determines the family of the actuator, and the task whether there are several.
NamedActuator = Any
"""An `ActuatorModel`, or a tuple of them."""


def named_actuator(name: str, task: str) -> NamedActuator:
    """Return the actuator of a name on a task; a tuple if the task has several motors.

    Args:
        name: a name of `codrl_mj.actuators.NAMED`, `default`, or the name of a family.
        task: a task name, as on the command line.

    Raises:
        ValueError: unknown name; the nearest known one is suggested.
    """
    actuators = resolve_actuators(name, find_task(task))
    return actuators[0] if len(actuators) == 1 else actuators


__all__ = [
    "PAPER_TASKS",
    "TASKS",
    "Task",
    "add_task",
    "ReferenceEnv",
    "find_task",
    "named_actuator",
    "reference_of",
    "resolve_actuators",
]
