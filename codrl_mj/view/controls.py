"""What can be set of an actuator and of disturbances while a simulation runs, read from their fields."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from codrl_mj.fields import parts


@dataclasses.dataclass(frozen=True)
class Control:
    """A field that can be set."""

    path: tuple[str, ...]
    """Names from the outermost part to the field."""
    unit: str
    """Its unit; empty for none."""
    value: Any
    """What it is now; None where it is not set."""
    low: float | None = None
    """Of a number: where its slider begins; the bound, or a little above one that is excluded."""
    high: float | None = None
    """Of a number: where its slider ends; None where a scale for it is not known, so that it is typed."""
    options: tuple[str, ...] = ()
    """Of a word: what it may be."""

    @property
    def endless(self) -> bool:
        """Whether the end of the slider stands for infinity."""
        return self.value == math.inf

    def parsed(self, shown: Any) -> Any:
        """The field's value for what a slider shows."""
        if self.endless and self.high is not None and shown >= self.high:
            return math.inf
        return shown


def controls(
    settings: Any, scale: float | None = None, ends: Mapping[str, float] = MappingProxyType({})
) -> list[Control]:
    """Numbers, words and flags in an actuator or disturbances, and in its parts.

    The slider of an infinite voltage ends at `scale` [V], without which infinite fields are left out; that of a field
    that is 0 where `ends` says so by its name.
    """
    found = [
        dataclasses.replace(one, high=ends[one.path[-1]]) if one.value == 0 and one.path[-1] in ends else one
        for one in _within(settings, (), scale)
    ]
    return [one for one in found if not (one.endless and one.high is None)]


def _within(settings: Any, path: tuple[str, ...], scale: float | None) -> list[Control]:
    found, nested = [], parts(type(settings))
    for field in dataclasses.fields(settings):
        value, own = getattr(settings, field.name), (*path, field.name)
        if field.name in nested:
            found += _within(field.metadata.get("absent") if value is None else value, own, scale)
        elif "options" in field.metadata:
            found.append(Control(own, "", value, options=field.metadata["options"]))
        elif isinstance(value, bool):
            found.append(Control(own, "", value))
        elif isinstance(value, int | float):
            unit = field.metadata.get("unit", "")
            low, high = field.metadata.get("between", (None, None))
            ends = _slider(value, low, high, scale if unit == "V" else None)
            found.append(Control(own, unit, value, *ends))
    return found


def _slider(
    value: float, low: float | None, high: float | None, scale: float | None
) -> tuple[float | None, float | None]:
    """From a twentieth of the value to four times it, within the bounds; of what is 0 the bounds alone."""
    if math.isinf(value):
        return (scale / 100, scale) if scale else (None, None)
    if value == 0:
        return low, high
    near, far = sorted((0.05 * value, 4 * value))
    return (near if low is None else max(low, near)), (far if high is None else min(high, far))


def nested(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """A mapping of mappings with a value at a path."""
    *outer, last = path
    made = {last: value}
    for name in reversed(outer):
        made = {name: made}
    return made
