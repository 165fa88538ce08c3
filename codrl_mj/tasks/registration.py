"""The tasks that are known, ours and anybody's, and their registration with Gymnasium."""

import itertools
import sys
from typing import Any

from gymnasium.envs.registration import register as register_with_gymnasium
from gymnasium.envs.registration import registry

from codrl_mj.tasks.base import Task
from codrl_mj.user_code import look_up

TASKS: dict[str, Task] = {}
"""Every task by its name on the command line."""


def register(task: Task) -> Task:
    """Make a task known: `gymnasium.make` and `make_vec` take its id, and every other face and command its name.

    Harmless when repeated.

    Args:
        task: the task, of any module.

    Returns:
        The task.

    Raises:
        ValueError: another task has its name, or another environment its id.
    """
    if not hasattr(task, "env_id"):
        raise ValueError(f"{task!r}: must be a codrl_mj.Task")
    if TASKS.get(task.name, task) is not task:
        raise ValueError(
            f"task {task.name!r} is registered already, of {reference_of(TASKS[task.name])}:"
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
    """What finds a task, or a world, by its name in any process: the name of ours, `module:NAME` of somebody's.

    Of one that stands in no module it is the name, which only processes know that have registered
    it.

    Args:
        task: the task or world.
        home: the module to look for it first; that of a task's functions if none is named.
    """
    home, script = (
        home or task.reward.__module__,
        "__main__",
    )  # the first and the last choice where several have it
    others = (module for module in list(sys.modules) if module not in (home, script, "__mp_main__"))
    for module in itertools.chain([home], others, [script]):
        for name, value in list(getattr(sys.modules.get(module), "__dict__", {}).items()):
            if value is task:
                return task.name if module.startswith("codrl_mj.") else f"{module}:{name}"
    return str(task.name)


def find_task(name: str) -> Task:
    """The task called `name`.

    Args:
        name: a key of `TASKS`; or `module:NAME` of anybody's task, which is imported and
            registered.

    Raises:
        ValueError: unknown name; the nearest known one is suggested.
    """
    task: Task = look_up(name, TASKS, "task")
    return task if name in TASKS else register(task)
