"""Attributes of environments, as Gymnasium's have them: `env.unwrapped.gravity = 3.7`.

`Task.attributes` says where each of them lives; on the analytic physics numbers of the model are
those of Gymnasium's own environment. One that is written takes effect at once; state and motor stay
as they are. What is written outlasts resets, and is not in a `snapshot`. What the task's compiled
functions contain can be read only; writing the value that an attribute has is allowed everywhere.
"""

import dataclasses
import math
import numbers
from typing import Any

import mujoco
import numpy as np

from codrl_mj.disturbances import NO_DISTURBANCES
from codrl_mj.envs.setup import ResolvedEnv
from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.physics.variation import Variation, field_of, write_fields
from codrl_mj.tasks import Task
from codrl_mj.tasks.attributes import Attribute, Fixed, Follows, ModelNumber, Setting


def shared(attribute: Attribute) -> bool:
    """Whether it is the set-up's: the environments of a vector share it."""
    return isinstance(attribute, Fixed | Setting)


def read(name: str, setup: ResolvedEnv, model: Any) -> Any:
    """The value of an attribute of an environment, whose simulation has this `mjModel`; without one, the physics."""
    attribute = setup.task.attributes[name]
    if isinstance(attribute, Fixed):
        return attribute.value
    if isinstance(attribute, Follows):
        return attribute.of(*(read(each, setup, model) for each in attribute.names))
    if isinstance(attribute, Setting):
        value = getattr(
            setup.plant if attribute is Setting.INTEGRATOR else setup.task, attribute.value
        )
        return list(value) if attribute is Setting.FORCES else value
    if not isinstance(model, mujoco.MjModel):
        return getattr(_gymnasiums(model), name)
    return attribute.scale * float(_place(attribute, model)[0]) ** (-1 if attribute.inverse else 1)


def written(name: str, value: Any, setup: ResolvedEnv, model: Any) -> ResolvedEnv:
    """Write an attribute; to be followed by `mj_setConst`.

    Returns:
        The set-up to go on with.
    """
    present, attribute = read(name, setup, model), setup.task.attributes[name]
    if np.array_equal(value, present):
        return setup
    try:  # the messages are the remedy, or what the value must be
        if isinstance(attribute, Fixed):
            raise AttributeError(attribute.remedy)
        if isinstance(attribute, Follows):
            raise AttributeError(f"write {' and '.join(attribute.names)} first")
        if attribute is Setting.INTEGRATOR:
            known = " or ".join(f"integrator={name!r}" for name in setup.task.integrators)
            raise AttributeError(f"it is compiled into the step: make an environment with {known}")
        if setup.randomization.distributions:
            raise AttributeError(
                "actuator and model are drawn at every reset: give `randomize` a distribution of it"
            )
        if isinstance(attribute, ModelNumber):
            _write_number(name, attribute, value, setup, model)
            return setup
        if attribute is Setting.STEP:
            return _write_step(value, setup, model)
        return _write_forces(value, setup, model, each=attribute is Setting.FORCES)
    except ValueError as error:
        raise ValueError(f"{name} = {value!r}: {error}") from None
    except AttributeError as error:
        raise AttributeError(
            f"{name} = {value!r}: it can only be {present!r} here; {error}"
        ) from None


def checked_states(states: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Mechanical states as float64."""
    try:
        array = np.array(states, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"state = {states!r}: must be finite numbers, of shape {shape}")
    return array


def _place(attribute: ModelNumber, model: Any) -> np.ndarray:
    """The number where it is, live, shape (1,)."""
    array, row = field_of(model, attribute.field), 0
    if attribute.owner:
        row = getattr(model, attribute.field.partition("_")[0])(attribute.owner).id
    rows = array.reshape(len(array) if attribute.owner else 1, -1)
    return rows[row, attribute.entry : attribute.entry + 1]


def _gymnasiums(physics: Any) -> Any:
    """The Gymnasium environment that a physics without a MuJoCo model drives."""
    if not isinstance(physics, AnalyticPhysics) or not hasattr(physics.twin, "env"):
        raise AttributeError(
            f"{type(physics).__name__} has no MuJoCo model or data, and no environment of"
            " Gymnasium's, whose number it is; use physics='mujoco'"
        )
    return physics.twin.env


def _number(value: Any, positive: bool) -> float:
    if (
        isinstance(value, numbers.Real | np.ndarray)
        and np.size(value) == 1  # type: ignore[arg-type]
        and math.isfinite(value)
    ):
        number = float(value)  # type: ignore[arg-type]
        if number > 0.0 or not positive:
            return number
    raise ValueError("must be a finite number" + " > 0" * positive)


def _write_number(
    name: str, attribute: ModelNumber, value: Any, setup: ResolvedEnv, model: Any
) -> None:
    power, varies = -1 if attribute.inverse else 1, attribute.varies
    number = _number(value, positive=bool(varies))
    if not isinstance(model, mujoco.MjModel):
        setattr(env := _gymnasiums(model), name, number)
        for other, follows in setup.task.attributes.items():
            if (
                isinstance(follows, Follows) and name in follows.names
            ):  # attributes of their own in Gymnasium
                setattr(env, other, read(other, setup, model))
        return
    if varies:
        factors = np.full((1, len(varies)), (number / read(name, setup, model)) ** power)
        fields = Variation(model, varies).fields(factors, shown=True)
        only = attribute.only or fields
        write_fields(model, {name: rows for name, rows in fields.items() if name in only})
    _place(attribute, model)[0] = (number / attribute.scale) ** power


def _write_forces(value: Any, setup: ResolvedEnv, model: Any, each: bool) -> ResolvedEnv:
    """The forces of the actions, each or the largest of them."""
    task = setup.task
    if setup.config.action != "force" or setup.config.disturbances != NO_DISTURBANCES or len(task.motors) > 1:
        raise AttributeError(
            "the forces are known to the current loop's table, to the drive's disturbances or to"
            " several motors: make an environment of one motor with action='force' and no"
            " disturbances"
        )
    table = task.forces
    if each:
        if np.shape(value) != (len(table or ()),):
            raise ValueError(f"must be {len(table or ())} numbers, one for each action")
        table = tuple(_number(force, positive=False) for force in value)
        value = max(map(abs, table))
    largest = _number(value, positive=True)
    if table is not None and not each:
        table = tuple(largest * (force / task.max_force) for force in table)
    if isinstance(model, mujoco.MjModel):
        model.actuator(task.motors[0]).ctrlrange[:] *= largest / task.max_force
    return dataclasses.replace(
        setup, task=dataclasses.replace(task, max_force=largest, forces=table)
    )


def _write_step(value: Any, setup: ResolvedEnv, model: Any) -> ResolvedEnv:
    duration = _number(value, positive=True)
    if setup.plant.motors_added or setup.config.disturbances != NO_DISTURBANCES:
        raise AttributeError(
            "motor and disturbances were checked for this step: make an environment without them"
        )
    if isinstance(model, mujoco.MjModel):
        model.opt.timestep = duration / setup.inner_steps
    else:
        _gymnasiums(model)
        model.timestep = duration / setup.inner_steps
    return dataclasses.replace(setup, task=dataclasses.replace(setup.task, step_duration=duration))


class _Access:
    """One name, on the environments' class: unlike `__getattr__` it leaves all other names as fast as they are."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, env: Any, owner: Any = None) -> Any:
        if env is None:
            return self
        attribute = env.task.attributes.get(self._name)
        if attribute is not None:
            return env._read_attribute(self._name)
        if self._name in vars(env):
            return vars(env)[self._name]
        raise AttributeError(
            f"{type(env).__name__} of {env.task.name!r} has no attribute {self._name!r}"
        )

    def __set__(self, env: Any, value: Any) -> None:
        attribute = env.task.attributes.get(self._name)
        if attribute is None:  # another task's
            vars(env)[self._name] = value
        else:
            env._write_attribute(self._name, value)


class GymnasiumAttributes:
    """Gives an environment the attributes of its task."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore, in this or another process."""
        self.__dict__.update(state)
        self._offer_attributes(self.task)  # type: ignore[attr-defined]

    def _offer_attributes(self, task: Task) -> None:
        """Make the names of a task's attributes known to the class; called when an environment has been made."""
        for name in task.attributes:
            if isinstance(vars(GymnasiumAttributes).get(name), _Access):
                continue
            if name in vars(self) or hasattr(type(self), name):
                raise ValueError(
                    f"attributes of task {task.name!r}: environments have a {name!r} of their own"
                )
            setattr(GymnasiumAttributes, name, _Access(name))
