"""Registry of tasks, built-in and custom, and their registration with Gymnasium."""

import itertools
import sys
from typing import Any

from gymnasium.envs.registration import register as register_with_gymnasium
from gymnasium.envs.registration import registry

from codrl_mj.tasks.base import Task
from codrl_mj.user_code import look_up

TASKS: dict[str, Task] = {}
"""Registered tasks by their names on the command line."""


def register(task: Task) -> Task:
    """Register a task, so that `gymnasium.make` accepts its id, and commands accept its name.

    A repeated call with the same task does nothing.

    Args:
        task: the task, from any module.

    Returns:
        The task.

    Raises:
        ValueError: another task has the name, or another environment the id.
    """
    if not hasattr(task, "env_id"):
        raise ValueError(f"{task!r}: must be a codrl_mj.Task")
    if TASKS.get(task.name, task) is not task:
        raise ValueError(
            f"task {task.name!r} is registered already, as {reference_of(TASKS[task.name])}:"
            " rename one"
        )
    if task.name not in TASKS and task.env_id in registry:
        raise ValueError(
            f"environment id {task.env_id!r} is registered already: choose another for task"
            f" {task.name!r}"
        )
    if task.env_id not in registry:
        register_with_gymnasium(
            id=task.env_id,
            entry_point="codrl_mj.envs:ActuatedEnv",
            vector_entry_point="codrl_mj.envs:ActuatedVectorEnv",
            kwargs={"task": reference_of(task)},
            max_episode_steps=task.max_episode_steps,
            reward_threshold=task.reward_threshold,
        )
    TASKS[task.name] = task
    return task


def reference_of(task: Any, home: str | None = None) -> str:
    """Return a name under which any process can find a task or env source.

    This is the name of a built-in task, or `module:NAME` of a custom one. For a custom task that is
    no module's variable it is the task's name, which works only in processes that registered it.

    Args:
        task: the task or env source.
        home: the module that is searched first; by default the module of the task's functions.
    """
    # If several modules have the task, its home is preferred; the script, which other processes
    # cannot import by its name, is the last choice.
    home, script = home or task.reward.__module__, "__main__"
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
    return task if name in TASKS else register(task)
