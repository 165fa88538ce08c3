"""What a task declares against what its functions return, once, when it is made: compiled code relies on it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.user_code import call, check_form, source_location

_TEXTS = ("name", "env_id", "asset", "actuator", "agent")
_NAMES = ("state_names", "observation_names", "motors", "integrators")


def check_fields(task: Any) -> None:
    """Refuse fields that are not what a task is made of."""
    for name in _TEXTS:
        _require(task, name, isinstance(getattr(task, name), str | Path), "a text")
    for name in (*_NAMES, "qpos", "qvel", "wrapped", "paper", "forces"):
        _require(task, name, isinstance(getattr(task, name) or (), tuple), "a tuple")
    for name in _NAMES:
        names = getattr(task, name)
        fine = names and all(isinstance(one, str) for one in names) and len({*names}) == len(names)
        _require(task, name, fine, "one or more names, each another")
    motors, forces, defaults = (
        len(task.motors),
        task.forces,
        getattr(task.options, "_field_defaults", {"": None}),
    )
    fine = all(isinstance(one, int | float) and not math.isnan(one) for one in defaults.values())
    fine = fine and len(defaults) == len(task.options._fields)
    _require(task, "options", fine, "a typing.NamedTuple of numbers and flags that have defaults")
    _require(task, "paper", len(task.paper) in (0, motors), f"empty, or of {motors}: `motors`")
    fine = _are_numbers(task.max_force, (), (motors,)) and np.min(task.max_force) > 0.0
    _require(
        task, "max_force", fine, "a finite number > 0" + f", or {motors} of them" * (motors > 1)
    )
    fine = forces is None or (
        forces and _are_numbers(forces, (len(forces), motors)[: 1 + (motors > 1)])
    )
    fine = fine and (forces is None or (np.abs(forces) <= task.max_force).all())
    what = "a tuple of finite numbers" + f", or of tuples of {motors}" * (motors > 1)
    _require(task, "forces", fine, f"{what}, within max_force = {task.max_force}")


def check_layout(task: Any) -> None:
    """Refuse indices and spaces that do not go with the names."""
    states, parts, box = len(task.state_names), (task.qpos, task.qvel), task.observation_space
    fine = all(isinstance(one, int) for part in parts for one in part) and sorted(
        sum(parts, ())
    ) == [*range(states)]
    fine = fine and all(
        part and len({*np.diff(part)}) < 2 and part[0] <= part[-1] for part in parts
    )
    what = (
        f"with qvel = {task.qvel!r} each index of the {states} state_names once, both evenly spaced"
        " and ascending"
    )
    _require(task, "qpos", fine, what)
    _require(
        task,
        "wrapped",
        all(one in range(states) for one in task.wrapped),
        f"indices below {states}",
    )
    of_trials = task.trials and {
        len(task.trials.bounds),
        len(task.trials.edges),
        len(task.trials.start),
    }
    _require(
        task,
        "trials",
        of_trials in (None, {states}),
        f"of {states} bounds, edges and numbers of start",
    )
    wanted: Any = spaces.Box(-np.inf, np.inf, (len(task.observation_names),), np.float32)
    fine = isinstance(box, spaces.Box) and (box.shape, box.dtype) == (wanted.shape, wanted.dtype)
    _require(task, "observation_space", fine, f"such as {wanted}, by observation_names")
    wanted = (
        spaces.Box(-1.0, 1.0, (len(task.motors),))
        if task.forces is None
        else spaces.Discrete(len(task.forces))
    )
    fine = isinstance(task.action_space, spaces.Box) and task.action_space.shape == wanted.shape
    _require(
        task,
        "action_space",
        fine if task.forces is None else task.action_space == wanted,
        f"such as {wanted}",
    )


def check_functions(task: Any) -> None:
    """Call each function on plain numbers, and compare what it returns with what is declared."""
    bounds = call("Task.initial_bounds", task.initial_bounds, None)
    fine = (
        isinstance(bounds, tuple | list | np.ndarray)
        and len(bounds) == 2
        and np.ndim(bounds[0]) == 1
    )
    if (
        not fine
        or not _are_numbers(bounds, (2, len(bounds[0])))
        or (np.subtract(*bounds) > 0.0).any()
    ):
        what = "the lower and the upper bounds of what is drawn, two arrays (k,) of finite numbers"
        raise ValueError(f"{source_location(task.initial_bounds)}: returns {bounds!r}, must return {what}")
    low, high = np.asarray(bounds, dtype=np.float64)
    draws = np.stack([low + share * (high - low) for share in (0.25, 0.75)], axis=-1)
    before, after = (
        np.array(_returned(task, "initial_state", "state_names", draw)) for draw in draws.T
    )
    force = 0.5 * task.max_forces
    _returned(task, "observation", "observation_names", (*after,))
    _returned(
        task,
        "reward",
        "",
        (*before,),
        force if len(force) > 1 else force[0],
        (*after,),
        task.options(),
    )
    _returned(task, "terminated", "", (*after,))
    if task.constrain is not None:
        _returned(task, "constrain", "state_names", (*after,), np.float64(task.step_duration))
    if task.goal is not None:
        _returned(task, "goal", "", (*after,))
    for name, arrays in (("initial_state", draws), ("goal", np.stack([before, after], axis=-1))):
        try:
            if getattr(task, name) is not None:
                call(name, getattr(task, name), arrays)
        except ValueError as error:
            raise ValueError(
                f"{error} (it has to take arrays too, with a number for each of N states)"
            ) from error


def _returned(task: Any, name: str, names: str, *arguments: Any) -> Any:
    """What a function returns: a finite number for each of the task's names, or a single one."""
    function, form = getattr(task, name), getattr(task, names) if names else ""
    value = check_form(
        function, call(f"Task.{name}", function, *arguments), form, f"Task.{names or name}"
    )
    array = np.array(value, dtype=np.float64)
    if (
        ~np.isfinite(array) if names else np.isnan(array)
    ).any():  # a start may have an infinite reward
        raise ValueError(
            f"{source_location(function)}: returns {value} where an episode may start: must be finite"
        )
    return value


def _are_numbers(value: Any, *shapes: tuple[int, ...]) -> bool:
    """Whether a value is finite numbers of one of some shapes."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        return False
    return array.dtype.kind in "iuf" and array.shape in shapes and bool(np.isfinite(array).all())


def _require(task: Any, name: str, fine: Any, what: str) -> None:
    if not fine:
        raise ValueError(f"Task.{name} = {getattr(task, name)!r}: must be {what}")
