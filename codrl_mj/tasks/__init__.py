"""The tasks: the only definition of their observations, rewards, ends and resets."""

from collections.abc import Mapping
from typing import Any

from codrl_mj.actuators import check_same_family, resolve
from codrl_mj.tasks import (
    acrobot,
    cartpole,
    furuta,
    mountain_car,
    mountain_car_continuous,
    pendulum,
)
from codrl_mj.tasks.base import Task
from codrl_mj.tasks.registration import TASKS, find_task, reference_of, register
from codrl_mj.tasks.twin import ReferenceEnv

OURS = tuple(
    register(each.TASK)
    for each in (pendulum, cartpole, acrobot, mountain_car, mountain_car_continuous)
)
"""The tasks that rebuild Gymnasium's, and have the paper's actuators."""
register(furuta.TASK)


def resolve_actuators(given: Any, task: Task) -> tuple[Any, ...]:
    """Turn whatever a user may write for a task's actuator into one for each of its motors.

    Args:
        given: what `codrl_mj.actuators.resolve` takes, or the name `default`, which is the task's
            own actuator; for all motors, or a list of these, one for each.
        task: the task, whose own actuators the names vary.

    Raises:
        ValueError: unknown name or field, a value out of bounds, or not one for each motor, or of
            several families.
    """
    count = len(task.motors)
    each = list(given) if isinstance(given, list | tuple) else [given] * count
    if len(each) != count:
        hint = "; a list with one for each environment is for codrl_mj.make_vec" * (count == 1)
        there = f"{task.name} has {count} motor{'s' * (count > 1)} ({', '.join(task.motors)})"
        raise ValueError(f"actuator: got {len(each)} actuators, but {there}{hint}")
    for at, one in enumerate(each):  # the task's own in the place of `default`
        if isinstance(one, Mapping) and one.get("name") == "default":
            each[at] = {**one, "name": task.default_actuator}
        elif isinstance(one, str) and one == "default":
            each[at] = task.default_actuator
    papers = task.paper or (None,) * count
    actuators = tuple(
        resolve(one, paper, task.name) for one, paper in zip(each, papers, strict=True)
    )
    check_same_family(actuators)
    return actuators


def named_actuator(name: str, task: str) -> Any:
    """The actuator called `name` on `task`; with several motors a tuple of them.

    Args:
        name: one of `codrl_mj.actuators.NAMED`, `default`, or a family's.
        task: a task name, as on the command line.

    Raises:
        ValueError: unknown name; the nearest known one is suggested.
    """
    actuators = resolve_actuators(name, find_task(task))
    return actuators[0] if len(actuators) == 1 else actuators


__all__ = [
    "OURS",
    "TASKS",
    "Task",
    "ReferenceEnv",
    "find_task",
    "named_actuator",
    "reference_of",
    "register",
    "resolve_actuators",
]
