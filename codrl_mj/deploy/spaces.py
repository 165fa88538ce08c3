"""Description of the observations and actions that a policy and its environment exchange."""

import contextlib
from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from gymnasium import spaces

from codrl_mj.envs.commands import command_of
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.setup import ResolvedEnv
from codrl_mj.tasks import Task


class Entry(TypedDict, total=False):
    """Entry of an observation or an action.

    A discrete action is one entry without bounds. Only observations in a contract have `seen` and
    the scaling by which the policy transforms the entry before its first layer: scale * entry +
    offset.
    """

    name: str
    """Name of the entry."""
    unit: str | None
    """Unit; None if it is unknown."""
    least: float | None
    """Smallest value; None if it is not bounded."""
    most: float | None
    """Largest value; None if it is not bounded."""
    levels: list[float]
    """Values of a discrete action's indices, if they are known."""
    seen: list[float]
    """Smallest and largest value in the golden episodes."""
    scale: float
    """Factor of the entry."""
    offset: float
    """Value that is added to the product."""
    mean: float
    """Mean of the entry in the training, if it was normalized."""
    variance: float
    """Variance of the entry in the training, if it was normalized."""
    clip: float | None
    """Largest normalized value; None if it is not limited."""


Entries = list[Entry]
"""Entries of an observation or an action, in order."""


def describe_spaces(env: EnvConfig) -> tuple[Entries, Entries]:
    """Return the entries of the observation, and of the action.

    Raises:
        ValueError: observations or actions are not vectors, and actions are not discrete.
    """
    if env.source.task is None:
        return _describe_external(env)
    return _describe_task(env, env.source.task)


def _describe_task(env: EnvConfig, task: Task) -> tuple[Entries, Entries]:
    """Describe the spaces of a task, with names and units of task, sensors and commands."""
    setup, motors = ResolvedEnv.build(env), env.actuators
    sensor_units = [motors[0].SIGNAL_UNITS.get(name.rpartition(".")[2]) for name in setup.sensors]
    observations = describe_box(
        setup.observation_names,
        setup.observation_space,
        [*task.observation_units, *sensor_units],
    )
    coordinates = [
        task.state_names[task.qpos[task.qvel.index(speed_index)]]
        for speed_index in task.speed_indices
    ]
    joint_units = ["N*m" if name.endswith("[rad]") else "N" for name in coordinates]
    is_force_command = env.action == "force"
    units = (
        joint_units
        if is_force_command
        else [command_of(actuator, env.action).unit for actuator in motors]
    )
    commands = setup.commands
    if isinstance(commands.action_space, spaces.Box):
        return observations, describe_box(task.motors, commands.action_space, units)
    table = np.asarray(commands.action_forces if is_force_command else env.levels)
    names: Entries = [
        {"name": name, "unit": unit} for name, unit in zip(task.motors, units, strict=True)
    ]
    columns = np.reshape(table, (len(table), -1)).T.tolist()
    return observations, [
        {**entry, "levels": levels} for entry, levels in zip(names, columns, strict=True)
    ]


def _describe_external(env: EnvConfig) -> tuple[Entries, Entries]:
    """Describe the spaces of a third-party environment, which have no names and units."""
    with contextlib.closing(env.build()) as opened_env:
        observation_space, action_space = opened_env.observation_space, opened_env.action_space
        motors = opened_env.get_wrapper_attr("recorder").motor_names
    name = env.source.name
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        raise ValueError(f"{name}: observations are {observation_space}: must be vectors")
    observations = describe_box(
        [f"observation {k}" for k in range(observation_space.shape[0])], observation_space
    )
    if isinstance(action_space, spaces.Discrete):
        return observations, [{"name": "action", "unit": None}]
    if not isinstance(action_space, spaces.Box) or len(action_space.shape) != 1:
        raise ValueError(f"{name}: actions are {action_space}: must be vectors, or Discrete")
    names = (
        motors
        if len(motors) == action_space.shape[0]
        else [f"action {k}" for k in range(action_space.shape[0])]
    )
    return observations, describe_box(names, action_space)


def describe_box(
    names: Sequence[str], box: spaces.Box, units: Sequence[str | None] | None = None
) -> Entries:
    """Describe the entries of a vector box, as in `Entries`."""
    bounds = (
        [float(bound) if np.isfinite(bound) else None for bound in side]
        for side in (box.low, box.high)
    )
    columns = zip(names, units or [None] * len(names), *bounds, strict=True)
    return [
        {"name": name, "unit": unit, "least": lower, "most": upper}
        for name, unit, lower, upper in columns
    ]
