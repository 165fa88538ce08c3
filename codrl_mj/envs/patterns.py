"""Users' values of `actuator` that give different motors different actuators, by patterns."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codrl_mj.actuators import ActuatorModel, ActuatorSetting, is_family

ALL_MOTORS = ".*"
"""Pattern that matches all motors."""


def actuators_by_pattern(actuator: Any, default: str = "ideal") -> Mapping[str, ActuatorSetting]:
    """Return pattern -> actuator, from a user's value of `actuator`."""
    if actuator in ({}, []) or isinstance(actuator, list | tuple):
        raise ValueError(
            f"actuator = {actuator!r}: must be one actuator for all motors, or a mapping of"
            " patterns to actuators, such as {'.*': 'lag'}"
        )
    return pattern_mapping(actuator) or {ALL_MOTORS: default if actuator == "default" else actuator}


def pattern_mapping(actuator: object) -> Mapping[str, ActuatorSetting] | None:
    """Return a user's `actuator` if it is a mapping of patterns to actuators; otherwise None."""
    if not isinstance(actuator, Mapping) or {"family", "name"} & actuator.keys():
        return None
    for value in actuator.values():
        fields = value.items() if isinstance(value, Mapping) else ()
        is_actuator_mapping = any(
            name in ("family", "name")
            or dataclasses.is_dataclass(field_value)
            or isinstance(field_value, Mapping)
            for name, field_value in fields
        )
        if not (
            value is None
            or is_actuator_mapping
            or isinstance(value, str | Path | ActuatorModel)
            or is_family(value)
        ):
            return None
    return actuator or None
