"""Fields of motors that can be drawn from a distribution.

The module needs no numba, so that adapters to other simulators can use it where numba is missing.
"""

from collections.abc import Callable, Mapping

from codrl_mj.actuators import (
    ActuatorModel,
    Family,
    Ideal,
    choices_of,
    field_paths,
    field_values,
    from_array,
)
from codrl_mj.envs.distributions import Choice, Distribution, split_pattern


def check_motor_field(
    field: str, distribution: Distribution, motor: ActuatorModel, fixed: Mapping[str, str]
) -> None:
    """Raise if a motor's field cannot be drawn from a distribution."""
    if isinstance(motor, Ideal):
        raise ValueError(
            "the ideal actuator has no motor and no controller to draw; choose another actuator"
        )
    if field in fixed:
        raise ValueError(f"{fixed[field]}; draw it with action='force'")
    field_type, choices = type_of_field(type(motor), field), choices_of(type(motor), field)
    if choices:
        if not isinstance(distribution, Choice) or any(
            value not in range(len(choices)) for value in distribution.values
        ):
            numbered = ", ".join(f"{index} for {word}" for index, word in enumerate(choices))
            raise ValueError(f"{field} is a word: draw it from a Choice of {numbered}")
    elif field_type is not float:
        if not isinstance(distribution, Choice) or any(
            type(value) is not field_type for value in distribution.values
        ):
            raise ValueError(f"{field} must be drawn from a Choice of {field_type.__name__} values")
    elif any(isinstance(value, bool) for value in distribution.extremes):
        raise ValueError(f"{field} must be a number")
    for value in distribution.extremes:
        # Building the actuator checks the bounds of the field itself.
        motor.replaced({field: value})


def type_of_field(family: Family, path: str) -> type:
    """Return the type of a family's field: float, int or bool."""
    value: object = family()
    for part in split_pattern(path)[1].split("."):
        value = getattr(value, part, None)
    return type(value) if isinstance(value, int) else float


def depends_on(
    quantity: Callable[[ActuatorModel], object], motor: ActuatorModel, path: str
) -> bool:
    """Return True if a quantity of a motor depends on a field.

    A factor of 0 would hide the dependence, so the test is repeated with all fields at 2.
    """
    family: Family = type(motor)
    fields, field = field_paths(family), split_pattern(path)[1]
    for values in (field_values(motor), (2.0,) * len(fields)):
        changed = [value + (name == field) for name, value in zip(fields, values, strict=True)]
        if quantity(from_array(family, values)) != quantity(from_array(family, changed)):
            return True
    return False
