"""The tasks: the only definition of their observations, rewards, ends and resets."""

import difflib

from codrl_mj.tasks import acrobot, cartpole, mountain_car, mountain_car_continuous, pendulum
from codrl_mj.tasks.base import Task

_MODULES = (pendulum, cartpole, acrobot, mountain_car, mountain_car_continuous)
TASKS: dict[str, Task] = {module.TASK.name: module.TASK for module in _MODULES}
"""Every task by its name on the command line."""


def find_task(name: str) -> Task:
    """The task called `name`.

    Args:
        name: a key of `TASKS`.

    Raises:
        ValueError: unknown name; the nearest known one is suggested.
    """
    if name not in TASKS:
        near = difflib.get_close_matches(name, TASKS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"unknown task {name!r}: {hint}Known tasks: {', '.join(TASKS)}")
    return TASKS[name]


__all__ = ["TASKS", "Task", "find_task"]
