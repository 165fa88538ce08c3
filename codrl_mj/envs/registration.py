"""Registration of tasks with Gymnasium."""

from gymnasium.envs.registration import register as register_with_gymnasium
from gymnasium.envs.registration import registry

from codrl_mj.tasks import TASKS, Task, add_task, reference_of

_REGISTERED: dict[str, Task] = {}
"""Tasks that were registered with Gymnasium, by their ids."""


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
    add_task(task)
    if task.env_id not in registry:
        register_with_gymnasium(
            id=task.env_id,
            entry_point=f"{__package__}:ActuatedEnv",
            vector_entry_point=f"{__package__}:ActuatedVectorEnv",
            kwargs={"task": reference_of(task)},
            max_episode_steps=task.max_episode_steps,
            reward_threshold=task.reward_threshold,
        )
        _REGISTERED[task.env_id] = task
    elif _REGISTERED.get(task.env_id) is not task:
        del TASKS[task.name]
        raise ValueError(
            f"environment id {task.env_id!r} is registered already: choose another for task"
            f" {task.name!r}"
        )
    return task


for built_in in list(TASKS.values()):
    register(built_in)
