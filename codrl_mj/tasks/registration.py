"""Registry of tasks, built-in and custom."""

import itertools
import sys
from typing import Protocol

from codrl_mj.tasks.base import Task
from codrl_mj.user_code import look_up

TASKS: dict[str, Task] = {}
"""Registered tasks by their names on the command line."""


class Registered(Protocol):
    """Task or env source, which other processes find by its name."""

    @property
    def name(self) -> str:
        """Name on the command line."""


def add_task(task: Task) -> Task:
    """Add a task to `TASKS` and return it; a repeated call with the same task does nothing.

    Raises:
        ValueError: it is no task, or another task has its name.
    """
    if not isinstance(task, Task):
        raise ValueError(f"{task!r}: must be a codrl_mj.Task")
    if TASKS.get(task.name, task) is not task:
        raise ValueError(
            f"task {task.name!r} is registered already, as {reference_of(TASKS[task.name])}:"
            " rename one"
        )
    TASKS[task.name] = task
    return task


def reference_of(task: Registered, home: str | None = None) -> str:
    """Return a name under which any process can find a task or env source.

    This is the name of a built-in task, or `module:NAME` of a custom one. For a custom task that is
    no module's variable it is the task's name, which works only in processes that registered it.

    Args:
        task: the task or env source.
        home: the module that is searched first; by default the module of the task's functions.
    """
    # If several modules have the task, its home is preferred; the script, which other processes
    # cannot import by its name, is the last choice.
    functions = getattr(task, "reward", task)
    home, script = home or str(functions.__module__), "__main__"
    others = (module for module in list(sys.modules) if module not in (home, script, "__mp_main__"))
    for module in itertools.chain([home], others, [script]):
        for name, value in list(getattr(sys.modules.get(module), "__dict__", {}).items()):
            if value is task:
                return task.name if module.startswith("codrl_mj.") else f"{module}:{name}"
    return str(task.name)


def find_task(name: str) -> Task:
    """Return the task with a name.

    Args:
        name: a key of `TASKS`, or `module:NAME` of a custom task, which is imported and registered.

    Raises:
        ValueError: unknown name; the nearest known one is suggested.
    """
    task: Task = look_up(name, TASKS, "task")
    return task if name in TASKS else add_task(task)
