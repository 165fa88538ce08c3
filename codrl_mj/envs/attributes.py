"""The numbers that Gymnasium's environments have as attributes, of ours: `env.unwrapped.gravity = 3.7`.

A task's table says where each of them lives in the MuJoCo model. One that is written changes the model and takes effect
at once; state and motor stay as they are. What is written outlasts resets, and is not in a `snapshot`. What the task's
compiled functions contain can be read only; writing the value that an attribute has is allowed everywhere.
"""

import dataclasses
import math
import numbers
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Ideal
from codrl_mj.disturbances import OFF
from codrl_mj.engine.hill import GRAVITY
from codrl_mj.envs.setup import Setup
from codrl_mj.physics.variation import Variation, write_fields
from codrl_mj.tasks import Task, acrobot, cartpole, mountain_car, mountain_car_continuous, pendulum


class Attribute(NamedTuple):
    """One attribute of a task's environments; `model` is an `mjModel`."""

    read: Callable[[Setup, Any], Any]
    """(set-up, model) -> its value."""
    write: Callable[[Setup, Any, Any], Setup] | None
    """(set-up, model, value) -> the set-up to go on with: changes the model; None where it can be read only."""
    remedy: str = ""
    """What to do instead of writing it."""
    shared: bool = False
    """Whether it is the set-up's: the environments of a vector share it."""


def written(attribute: Attribute, name: str, value: Any, setup: Setup, model: Any) -> Setup:
    """Write an attribute; to be followed by `mj_setConst`.

    Args:
        attribute: which.
        name: its name.
        value: the new value.
        setup: of the environment.
        model: the `mjModel`, which is changed.

    Returns:
        The set-up to go on with.

    Raises:
        AttributeError: it can be read only; the message says why and what to do instead.
        ValueError: the value is no number, or out of bounds.
    """
    present, remedy = attribute.read(setup, model), attribute.remedy
    if np.array_equal(value, present):
        return setup
    if attribute.write is not None and setup.randomization is not None:
        remedy = "actuator and model are drawn at every reset: give `randomize` a distribution of it"
    elif attribute.write is not None:
        try:
            return attribute.write(setup, model, value)
        except ValueError as error:
            raise ValueError(f"{name} = {value!r}: {error}") from None
        except AttributeError as error:
            remedy = str(error)
    raise AttributeError(f"{name} = {value!r}: it can only be {present!r} here; {remedy}")


def checked_states(states: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Mechanical states as float64.

    Raises:
        ValueError: of another shape, or not finite numbers.
    """
    try:
        array = np.array(states, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"state = {states!r}: must be finite numbers, of shape {shape}")
    return array


def _number(value: Any, positive: bool) -> float:
    if isinstance(value, numbers.Real | np.ndarray) and np.size(value) == 1 and math.isfinite(value):  # type: ignore[arg-type]
        number = float(value)  # type: ignore[arg-type]
        if number > 0.0 or not positive:
            return number
    raise ValueError("must be a finite number" + " > 0" * positive)


def _entry(
    entry: Callable[[Any], tuple[np.ndarray, int]],
    scale: float = 1.0,
    varies: tuple[str, ...] = (),
    only: tuple[str, ...] = (),
    inverse: bool = False,
) -> Attribute:
    """A number of the model.

    Args:
        entry: (model) -> the array that it is in, and where.
        scale: Gymnasium's number for a 1 in the model.
        varies: what is multiplied as the number is, as `randomize` names it; then the number must be > 0.
        only: the fields of the model to which that is limited; all if empty.
        inverse: whether Gymnasium has the number's inverse.
    """

    def read(setup: Setup, model: Any) -> float:  # noqa: ARG001 - an attribute's signature
        array, index = entry(model)
        return scale * float(array[index]) ** (-1 if inverse else 1)

    def write(setup: Setup, model: Any, value: Any) -> Setup:
        number = _number(value, positive=bool(varies))
        if varies:
            factor = (number / read(setup, model)) ** (-1 if inverse else 1)
            fields = Variation(setup.task.name, varies, model).fields(np.full((1, len(varies)), factor), drawn=True)
            write_fields(model, {name: rows for name, rows in fields.items() if not only or name in only})
        array, index = entry(model)
        array[index] = (number / scale) ** (-1 if inverse else 1)
        return setup

    return Attribute(read, write)


def _force(forces: Callable[[Any], tuple[float, ...] | None], value_of: Callable[[Any], Any]) -> Attribute:
    """The forces of the actions.

    Args:
        forces: (value) -> the task's forces; None where the action is the force, and the value its largest.
        value_of: (task) -> the attribute's value.
    """

    def write(setup: Setup, model: Any, value: Any) -> Setup:
        if setup.commands.name != "force" or setup.disturbances != OFF:
            raise AttributeError(
                "the forces are known to the current loop's table or to the drive's disturbances: make an environment "
                "with action='force' and no disturbances"
            )
        task, table = setup.task, forces(value)
        largest = _number(value if table is None else max(map(abs, table)), positive=True)
        model.actuator_ctrlrange[0] *= largest / task.max_force
        return _of_task(setup, dataclasses.replace(task, max_force=largest, forces=table))

    return Attribute(lambda setup, model: value_of(setup.task), write, shared=True)  # noqa: ARG005


def _of_task(setup: Setup, task: Task) -> Setup:
    """The set-up with a changed task."""
    commands = dataclasses.replace(setup.commands, task=task, max_forces=task.max_forces)
    return dataclasses.replace(setup, task=task, commands=commands, view=dataclasses.replace(setup.view, task=task))


def _torques(value: Any) -> tuple[float, ...]:
    if np.shape(value) != (3,):
        raise ValueError("must be three numbers, one for each action")
    return tuple(_number(torque, positive=False) for torque in value)


def _set_step(setup: Setup, model: Any, value: Any) -> Setup:
    duration = _number(value, positive=True)
    if not issubclass(setup.family, Ideal) or setup.disturbances != OFF:
        raise AttributeError("motor and disturbances were checked for this step: make an environment without them")
    model.opt.timestep = duration / setup.inner_steps
    return _of_task(setup, dataclasses.replace(setup.task, step_duration=duration))


def _fixed(value: Any, remedy: str) -> Attribute:
    return Attribute(lambda setup, model: value, None, remedy, shared=True)  # noqa: ARG005


def _follows(read: Callable[[Any], float], remedy: str) -> Attribute:
    return Attribute(lambda setup, model: read(model), None, remedy)  # noqa: ARG005


_COMPILED = "it is compiled into the task's functions: limit or end episodes in a `gymnasium.Wrapper`"
_UNKNOWN = "the MuJoCo model has no such thing"
_WEIGHT = _entry(lambda model: (model.opt.gravity, 2), scale=-1.0)
_STEP = Attribute(lambda setup, model: setup.task.step_duration, _set_step, shared=True)  # noqa: ARG005
_LARGEST = _force(lambda value: None, lambda task: task.max_force)  # noqa: ARG005
_ALONG = ("body_pos", "geom_pos", "geom_size")


def _mass(body: str, only: tuple[str, ...] = (), inverse: bool = False) -> Attribute:
    return _entry(lambda model: (model.body(body).mass, 0), varies=(f"model.mass.{body}",), only=only, inverse=inverse)


def _centre(body: str, scale: float = 1.0, only: tuple[str, ...] = ()) -> Attribute:
    """How far a body's centre of mass is from its joint."""
    return _entry(lambda model: (model.body(body).ipos, 2), scale, varies=(f"model.length.{body}",), only=only)


_CARTPOLE = {
    "gravity": _WEIGHT,
    "masscart": _mass("cart"),
    "masspole": _mass("pole"),
    "total_mass": _follows(
        lambda model: float(model.body("pole").mass[0] + model.body("cart").mass[0]),
        "write masscart and masspole first",
    ),
    "length": _centre("pole"),
    "polemass_length": _follows(
        lambda model: float(model.body("pole").mass[0] * model.body("pole").ipos[2]), "write masspole and length first"
    ),
    "force_mag": _force(
        lambda value: (-_number(value, positive=True), float(value)),
        lambda task: task.max_force,
    ),
    "tau": _STEP,
    "kinematics_integrator": Attribute(
        lambda setup, model: setup.integrator,  # noqa: ARG005
        None,
        "it is compiled into the step: make an environment with integrator='semi-implicit' or 'euler'",
        shared=True,
    ),
    "theta_threshold_radians": _fixed(cartpole.ANGLE_LIMIT, _COMPILED),
    "x_threshold": _fixed(cartpole.X_LIMIT, _COMPILED),
}
_PENDULUM = {
    "max_speed": _fixed(pendulum.MAX_SPEED, _COMPILED),
    "max_torque": _LARGEST,
    "dt": _STEP,
    "g": _WEIGHT,
    "m": _mass("rod"),
    "l": _centre("rod", scale=2.0),
}
_ACROBOT = {
    "dt": _STEP,
    "LINK_LENGTH_1": _entry(
        lambda model: (model.body("lower").pos, 2), scale=-1.0, varies=("model.length.upper",), only=_ALONG
    ),
    "LINK_LENGTH_2": _fixed(1.0, "nothing but the picture depends on it, in Gymnasium too"),
    "LINK_MASS_1": _mass("upper", only=("body_mass",)),
    "LINK_MASS_2": _mass("lower", only=("body_mass",)),
    "LINK_COM_POS_1": _centre("upper", scale=-1.0, only=("body_ipos",)),
    "LINK_COM_POS_2": _centre("lower", scale=-1.0, only=("body_ipos",)),
    "LINK_MOI": _entry(
        lambda model: (model.body("upper").inertia, 1),
        varies=("model.mass.upper", "model.mass.lower"),
        only=("body_inertia",),
    ),
    "MAX_VEL_1": _fixed(acrobot.MAX_SPEED_1, _COMPILED),
    "MAX_VEL_2": _fixed(acrobot.MAX_SPEED_2, _COMPILED),
    "AVAIL_TORQUE": _force(_torques, lambda task: list(task.forces)),
    "torque_noise_max": _fixed(0.0, "make an environment with disturbances"),
    "book_or_nips": _fixed("book", _UNKNOWN),
}
_CAR = {
    "min_position": _fixed(mountain_car.MIN_POSITION, _COMPILED),
    "max_position": _fixed(mountain_car.MAX_POSITION, _COMPILED),
    "max_speed": _fixed(mountain_car.MAX_SPEED, _COMPILED),
    "goal_velocity": _fixed(0.0, _COMPILED),
}

ATTRIBUTES: Mapping[str, Mapping[str, Attribute]] = {
    "cartpole": _CARTPOLE,
    "pendulum": _PENDULUM,
    "acrobot": _ACROBOT,
    "mountain_car": {
        **_CAR,
        "goal_position": _fixed(mountain_car.GOAL, _COMPILED),
        "force": _mass("car", inverse=True),
        "gravity": _entry(lambda model: (model.joint("slider").user, GRAVITY)),
    },
    "mountain_car_continuous": {
        **_CAR,
        "goal_position": _fixed(mountain_car_continuous.GOAL, _COMPILED),
        "power": _mass("car", inverse=True),
        "min_action": _fixed(-mountain_car_continuous.FORCE, _COMPILED),
        "max_action": _fixed(mountain_car_continuous.FORCE, _COMPILED),
    },
}
"""Task name -> attribute name -> where it lives."""


class _Access:
    """One name, on the environments' class: unlike `__getattr__` it leaves all other names as fast as they are."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, env: Any, owner: Any = None) -> Any:
        if env is None:
            return self
        attribute = ATTRIBUTES.get(env.task.name, {}).get(self._name)
        if attribute is not None:
            return env._read_attribute(attribute)
        if self._name in vars(env):
            return vars(env)[self._name]
        raise AttributeError(f"{type(env).__name__} of {env.task.name!r} has no attribute {self._name!r}")

    def __set__(self, env: Any, value: Any) -> None:
        attribute = ATTRIBUTES.get(env.task.name, {}).get(self._name)
        if attribute is None:  # another task's
            vars(env)[self._name] = value
        else:
            env._write_attribute(attribute, self._name, value)


class GymnasiumAttributes:
    """Gives an environment with a `task` the attributes of the task's table."""


for _name in {name for table in ATTRIBUTES.values() for name in table}:
    setattr(GymnasiumAttributes, _name, _Access(_name))
