"""Attributes that Gymnasium's environments have, for example `env.unwrapped.gravity = 3.7`.

`Task.attributes` maps each name to the quantity that it reads and writes. With the analytic
physics, Gymnasium's environment holds the numbers of the model. A written attribute takes effect at
once; the state and the motor stay as they are. Written values persist after a reset and are not
part of a `snapshot`. Values that are compiled into the task's functions are read-only, but writing
the value that an attribute already has is always allowed.
"""

import abc
import dataclasses
import math
import numbers
from typing import TypeAlias

import mujoco
import numpy as np

from codrl_mj.boundary import AttributeValue, PickledState
from codrl_mj.disturbances import NO_DISTURBANCES
from codrl_mj.envs.config import Env
from codrl_mj.envs.setup import ResolvedEnv
from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.physics.base import Physics
from codrl_mj.physics.variation import Variation, field_of, write_fields
from codrl_mj.tasks import Task
from codrl_mj.tasks.attributes import Attribute, Derived, Fixed, ModelNumber, Setting

AttributeOwner: TypeAlias = mujoco.MjModel | Physics
"""Object with the numbers of a task: the model, or the physics if it has no MuJoCo model."""


def is_shared(attribute: Attribute) -> bool:
    """Return True if all environments of a vector share the attribute's value."""
    return isinstance(attribute, Fixed | Setting)


def read(name: str, setup: ResolvedEnv, model: AttributeOwner) -> AttributeValue:
    """Return an attribute's value.

    Args:
        name: name of the attribute.
        setup: the environment's resolved configuration.
        model: the `mjModel` of its simulation; the `Physics` if it has no MuJoCo model.
    """
    attribute = setup.task.attributes[name]
    if isinstance(attribute, Fixed):
        return attribute.value
    if isinstance(attribute, Derived):
        return attribute.function(*(read(source, setup, model) for source in attribute.names))
    if isinstance(attribute, Setting):
        value = getattr(
            setup.simulation if attribute is Setting.INTEGRATOR else setup.task, attribute.value
        )
        return list(value) if attribute is Setting.FORCES else value
    if not isinstance(model, mujoco.MjModel):
        return getattr(_gymnasium_env(model), name)
    return attribute.scale * float(_number_view(attribute, model)[0]) ** (
        -1 if attribute.inverse else 1
    )


def write(
    name: str, value: AttributeValue, setup: ResolvedEnv, model: AttributeOwner
) -> ResolvedEnv:
    """Write an attribute; the caller must call `mj_setConst` afterwards.

    Returns:
        The resolved configuration with the new value.
    """
    present, attribute = read(name, setup, model), setup.task.attributes[name]
    if np.array_equal(value, present):
        return setup
    # The functions below raise errors with only the remedy or the allowed values. The handlers at
    # the end put the attribute's name and value in front.
    try:
        if isinstance(attribute, Fixed):
            raise AttributeError(attribute.remedy)
        if isinstance(attribute, Derived):
            raise AttributeError(f"write {' and '.join(attribute.names)} first")
        if attribute is Setting.INTEGRATOR:
            known = " or ".join(
                f"integrator={integrator!r}" for integrator in setup.task.integrators
            )
            raise AttributeError(f"it is compiled into the step: make an environment with {known}")
        if setup.randomization.distributions:
            raise AttributeError(
                "actuator or model are drawn at every reset: give `randomize` a distribution for it"
            )
        if isinstance(attribute, ModelNumber):
            _write_number(name, attribute, value, setup, model)
            return setup
        if attribute is Setting.STEP:
            return _write_step(value, setup, model)
        return _write_forces(value, setup, model, per_action=attribute is Setting.FORCES)
    except ValueError as error:
        raise ValueError(f"{name} = {value!r}: {error}") from None
    except AttributeError as error:
        raise AttributeError(
            f"{name} = {value!r}: must be {present!r} in this environment; {error}"
        ) from None


def validate_states(states: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return mechanical states as float64; raise if their shape is wrong or one is not finite."""
    try:
        array = np.array(states, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"state = {states!r}: must be finite numbers, of shape {shape}")
    return array


def _number_view(attribute: ModelNumber, model: AttributeOwner) -> np.ndarray:
    """Return a view of the attribute's number in the model, shape (1,); writes change the model."""
    array, row = field_of(model, attribute.field), 0
    if attribute.owner:
        # MuJoCo's field names begin with the kind of object (`body_mass`), and the model has an
        # accessor of that name (`model.body(name)`).
        row = getattr(model, attribute.field.partition("_")[0])(attribute.owner).id
    rows = array.reshape(len(array) if attribute.owner else 1, -1)
    return rows[row, attribute.entry : attribute.entry + 1]


def _gymnasium_env(physics: AttributeOwner) -> Env:
    """Return the Gymnasium environment behind a physics without a MuJoCo model."""
    if not isinstance(physics, AnalyticPhysics) or not hasattr(physics.reference_env, "env"):
        raise AttributeError(
            f"{type(physics).__name__} has no MuJoCo model or data, and no Gymnasium environment"
            " that holds this number; use physics='mujoco'"
        )
    env: Env = physics.reference_env.env
    return env


def _finite_number(value: AttributeValue, positive: bool) -> float:
    """Return a value as float; raise if it is not finite, or not > 0 if `positive`."""
    if (
        isinstance(value, numbers.Real | np.ndarray)
        and np.size(value) == 1  # type: ignore[arg-type]
        and math.isfinite(value)
    ):
        number = float(value)
        if number > 0.0 or not positive:
            return number
    raise ValueError("must be a finite number" + " > 0" * positive)


def _write_number(
    attribute_name: str,
    attribute: ModelNumber,
    value: AttributeValue,
    setup: ResolvedEnv,
    model: AttributeOwner,
) -> None:
    """Write a number of the model, and the quantities that vary with it."""
    power, varies = -1 if attribute.inverse else 1, attribute.varies
    number = _finite_number(value, positive=bool(varies))
    if not isinstance(model, mujoco.MjModel):
        setattr(env := _gymnasium_env(model), attribute_name, number)
        for dependent_name, dependent in setup.task.attributes.items():
            # Gymnasium stores dependent attributes separately, and does not update them itself.
            if isinstance(dependent, Derived) and attribute_name in dependent.names:
                setattr(env, dependent_name, read(dependent_name, setup, model))
        return
    if varies:
        factors = np.full((1, len(varies)), (number / read(attribute_name, setup, model)) ** power)
        fields = Variation(model, varies).fields(factors, shown=True)
        shown_fields = attribute.only or fields
        write_fields(
            model,
            {field: rows for field, rows in fields.items() if field in shown_fields},
        )
    _number_view(attribute, model)[0] = (number / attribute.scale) ** power


def _write_forces(
    value: AttributeValue, setup: ResolvedEnv, model: AttributeOwner, per_action: bool
) -> ResolvedEnv:
    """Write the force of each action; or the largest force, and scale the others in proportion."""
    task = setup.task
    if (
        setup.config.action != "force"
        or setup.config.disturbances != NO_DISTURBANCES
        or len(task.motors) > 1
    ):
        raise AttributeError(
            "it can only be written in an environment with one motor, action='force' and no"
            " disturbances, because other settings depend on it: make such an environment"
        )
    table = task.forces
    if per_action:
        if np.shape(value) != (len(table or ()),):
            raise ValueError(f"must be {len(table or ())} numbers, one for each action")
        table = tuple(_finite_number(force, positive=False) for force in value)
        value = max(map(abs, table))
    largest = _finite_number(value, positive=True)
    if table is not None and not per_action:
        table = tuple(largest * (force / task.max_force) for force in table)
    if isinstance(model, mujoco.MjModel):
        model.actuator(task.motors[0]).ctrlrange[:] *= largest / task.max_force
    return dataclasses.replace(
        setup, task=dataclasses.replace(task, max_force=largest, forces=table)
    )


def _write_step(value: AttributeValue, setup: ResolvedEnv, model: AttributeOwner) -> ResolvedEnv:
    """Write the duration of an environment step [s]; the number of inner steps does not change."""
    duration = _finite_number(value, positive=True)
    if setup.simulation.motors_added or setup.config.disturbances != NO_DISTURBANCES:
        raise AttributeError(
            "motor and disturbances were checked for this step: make an environment without them"
        )
    if isinstance(model, mujoco.MjModel):
        model.opt.timestep = duration / setup.inner_steps
    else:
        _gymnasium_env(model)
        assert isinstance(model, AnalyticPhysics)
        model.timestep = duration / setup.inner_steps
    return dataclasses.replace(setup, task=dataclasses.replace(setup.task, step_duration=duration))


class _AttributeDescriptor:
    """Descriptor of one attribute on the environments' class.

    Unlike `__getattr__`, it does not slow down the access to any other attribute.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(
        self, env: "GymnasiumAttributes | None", owner: type | None = None
    ) -> AttributeValue:
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

    def __set__(self, env: "GymnasiumAttributes", value: AttributeValue) -> None:
        attribute = env.task.attributes.get(self._name)
        # All environments share the class, so the descriptor may be of another task's attribute.
        if attribute is None:
            vars(env)[self._name] = value
        else:
            env._write_attribute(self._name, value)


class GymnasiumAttributes:
    """Mixin that gives an environment the attributes of its task."""

    @property
    @abc.abstractmethod
    def task(self) -> Task:
        """The task."""

    @abc.abstractmethod
    def _read_attribute(self, name: str) -> AttributeValue:
        """Return an attribute's value."""

    @abc.abstractmethod
    def _write_attribute(self, name: str, value: AttributeValue) -> None:
        """Write an attribute's value."""

    def __setstate__(self, state: PickledState) -> None:
        """Restore the environment, in this or another process."""
        self.__dict__.update(state)
        self._offer_attributes(self.task)

    def _offer_attributes(self, task: Task) -> None:
        """Add descriptors of a task's attributes to the class; call it at the end of `__init__`."""
        for name in task.attributes:
            if isinstance(vars(GymnasiumAttributes).get(name), _AttributeDescriptor):
                continue
            if name in vars(self) or hasattr(type(self), name):
                raise ValueError(
                    f"attributes of task {task.name!r}: environments have a {name!r} of their own"
                )
            setattr(GymnasiumAttributes, name, _AttributeDescriptor(name))
