"""Checks of a new task: its fields, and the results of its functions against its declarations.

Compiled code relies on these declarations.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from codrl_mj.user_code import call, check_form, source_location

# Users declare the fields of a task: these checks find the values that are not of the declared
# type.
UncheckedTask = Any
"""Task whose fields may have values of any type."""
_TEXTS = ("name", "env_id", "asset", "actuator", "agent")
_NAMES = ("state_names", "observation_names", "motors", "integrators")


def check_fields(task: UncheckedTask) -> None:
    """Raise an error if a field has a wrong type or value."""
    for name in _TEXTS:
        _require(task, name, isinstance(getattr(task, name), str | Path), "a string")
    for name in (*_NAMES, "qpos", "qvel", "wrapped", "paper", "forces"):
        _require(task, name, isinstance(getattr(task, name) or (), tuple), "a tuple")
    for name in _NAMES:
        names = getattr(task, name)
        is_valid = (
            names and all(isinstance(entry, str) for entry in names) and len({*names}) == len(names)
        )
        _require(task, name, is_valid, "one or more names, all different")
    motors = len(task.motors)
    forces = task.forces
    defaults = getattr(task.options, "_field_defaults", {"": None})
    is_valid = all(
        isinstance(entry, int | float) and not math.isnan(entry) for entry in defaults.values()
    )
    is_valid = is_valid and len(defaults) == len(task.options._fields)
    _require(
        task, "options", is_valid, "a typing.NamedTuple of numbers and flags that have defaults"
    )
    _require(
        task,
        "paper",
        len(task.paper) in (0, motors),
        f"empty, or have {motors} entries, one for each of `motors`",
    )
    is_valid = _are_numbers(task.max_force, (), (motors,)) and np.min(task.max_force) > 0.0
    _require(
        task, "max_force", is_valid, "a finite number > 0" + f", or {motors} of them" * (motors > 1)
    )
    is_valid = forces is None or (
        forces and _are_numbers(forces, (len(forces), motors)[: 1 + (motors > 1)])
    )
    is_valid = is_valid and (forces is None or (np.abs(forces) <= task.max_force).all())
    requirement = "a tuple of finite numbers" + f", grouped into tuples of {motors}" * (motors > 1)
    _require(task, "forces", is_valid, f"{requirement}, within max_force = {task.max_force}")


def check_layout(task: UncheckedTask) -> None:
    """Raise an error if indices or spaces do not fit the names."""
    states, parts, box = len(task.state_names), (task.qpos, task.qvel), task.observation_space
    is_valid = all(isinstance(index, int) for part in parts for index in part) and sorted(
        sum(parts, ())
    ) == [*range(states)]
    is_valid = is_valid and all(
        part and len({*np.diff(part)}) < 2 and part[0] <= part[-1] for part in parts
    )
    requirement = (
        f"indices that together with qvel = {task.qvel!r} are each index of the {states}"
        " state_names once; both must be evenly spaced and ascending"
    )
    _require(task, "qpos", is_valid, requirement)
    _require(
        task,
        "wrapped",
        all(index in range(states) for index in task.wrapped),
        f"indices below {states}",
    )
    lengths = task.reference_states and {
        len(task.reference_states.bounds),
        len(task.reference_states.edges),
        len(task.reference_states.start),
    }
    _require(
        task,
        "reference_states",
        lengths in (None, {states}),
        f"ReferenceStates with {states} entries in each of bounds, edges and start",
    )
    expected: spaces.Box | spaces.Discrete = spaces.Box(
        -np.inf, np.inf, (len(task.observation_names),), np.float32
    )
    is_valid = isinstance(box, spaces.Box) and (box.shape, box.dtype) == (
        expected.shape,
        expected.dtype,
    )
    _require(
        task,
        "observation_space",
        is_valid,
        f"such as {expected}, with an entry for each of observation_names",
    )
    expected = (
        spaces.Box(-1.0, 1.0, (len(task.motors),))
        if task.forces is None
        else spaces.Discrete(len(task.forces))
    )
    is_valid = (
        isinstance(task.action_space, spaces.Box) and task.action_space.shape == expected.shape
    )
    _require(
        task,
        "action_space",
        is_valid if task.forces is None else task.action_space == expected,
        f"such as {expected}",
    )


def check_functions(task: UncheckedTask) -> None:
    """Call each function on plain numbers, and compare its result with the declaration."""
    bounds = call("Task.initial_bounds", task.initial_bounds, None)
    is_valid = (
        isinstance(bounds, tuple | list | np.ndarray)
        and len(bounds) == 2
        and np.ndim(bounds[0]) == 1
    )
    if (
        not is_valid
        or not _are_numbers(bounds, (2, len(bounds[0])))
        or (np.subtract(*bounds) > 0.0).any()
    ):
        form = "the lower and the upper bounds of the draws, two arrays (k,) of finite numbers"
        raise ValueError(
            f"{source_location(task.initial_bounds)}: returns {bounds!r}, must return {form}"
        )
    low, high = np.asarray(bounds, dtype=np.float64)
    draws = np.stack([low + share * (high - low) for share in (0.25, 0.75)], axis=-1)
    before, after = (
        np.array(_call_function(task, "initial_state", "state_names", draw)) for draw in draws.T
    )
    force = 0.5 * task.max_forces
    _call_function(task, "observation", "observation_names", (*after,))
    _call_function(
        task,
        "reward",
        "",
        (*before,),
        force if len(force) > 1 else force[0],
        (*after,),
        task.options(),
    )
    _call_function(task, "terminated", "", (*after,))
    if task.constrain is not None:
        _call_function(task, "constrain", "state_names", (*after,), np.float64(task.step_duration))
    if task.goal is not None:
        _call_function(task, "goal", "", (*after,))
    for name, arrays in (("initial_state", draws), ("goal", np.stack([before, after], axis=-1))):
        try:
            if getattr(task, name) is not None:
                call(name, getattr(task, name), arrays)
        except ValueError as error:
            raise ValueError(
                f"{error} (it must accept arrays too, with a number for each of N states)"
            ) from error


def _call_function(task: UncheckedTask, name: str, names: str, *arguments: object) -> object:
    """Return a function's result: a finite number for each of the task's names, or a single one."""
    function, form = getattr(task, name), getattr(task, names) if names else ""
    value: object = check_form(
        function, call(f"Task.{name}", function, *arguments), form, f"Task.{names or name}"
    )
    array = np.array(value, dtype=np.float64)
    # Entries of states and observations must be finite; a reward may be infinite.
    if (~np.isfinite(array) if names else np.isnan(array)).any():
        raise ValueError(
            f"{source_location(function)}: returns {value} for a state where an episode may start:"
            " must be finite"
        )
    return value


def _are_numbers(value: object, *shapes: tuple[int, ...]) -> bool:
    """Return True if a value consists of finite numbers and has one of some shapes."""
    try:
        array = np.asarray(value)
    except ValueError:
        # numpy makes no array of nested tuples with different lengths.
        return False
    return array.dtype.kind in "iuf" and array.shape in shapes and bool(np.isfinite(array).all())


def _require(task: UncheckedTask, name: str, is_valid: object, requirement: str) -> None:
    if not is_valid:
        raise ValueError(f"Task.{name} = {getattr(task, name)!r}: must be {requirement}")
