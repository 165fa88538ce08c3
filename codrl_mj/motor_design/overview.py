"""What is known of motors, as plain values: the catalogue in rows, and one motor with the origin of every number."""

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any

from codrl_mj.actuators import Drive
from codrl_mj.catalogue import MotorEntry, MotorNumbers, motor_entry, motor_names
from codrl_mj.catalogue.datasheet import KINDS
from codrl_mj.catalogue.derivation import OTHER_NAMES
from codrl_mj.fields import check_names
from codrl_mj.motor_design.drives import ABILITY_UNITS, Abilities, abilities, continuous_torque

COLUMNS = (
    *("name", "kind", "voltage", "resistance", "inductance", "torque_constant", "rotor_inertia", "gear_ratio"),
    *Abilities._fields,
    "continuous_torque",
)
"""What a row of `catalogue_rows` has, in SI."""
_ROUNDED = 0.01
"""Relative difference up to which a datasheet's values are taken to be rounded."""


def catalogue_rows(sort: str = "name") -> list[dict[str, Any]]:
    """Every motor of the catalogue at its nominal voltage, or 24 V; None where a number is not known.

    Args:
        sort: one of `COLUMNS`: names and kinds from A, numbers from the highest, unknown ones last.

    Raises:
        ValueError: there is no such column; the nearest is suggested.
    """
    check_names([sort], COLUMNS, "column")
    rows = []
    for entry in map(motor_entry, motor_names()):
        numbers, drive = entry.numbers, Drive.of(entry.numbers)
        can = abilities(drive)._asdict()
        known = {name: getattr(numbers, name) for name in COLUMNS[2:8]}
        known |= {name: value if math.isfinite(value) else None for name, value in can.items()}
        known["continuous_torque"] = continuous_torque(drive, numbers.continuous_current)
        rows.append({"name": entry.name, "kind": entry.kind, **known})
    if sort in ("name", "kind"):
        return sorted(rows, key=lambda row: row[sort])
    return sorted(rows, key=lambda row: (row[sort] is None, -(row[sort] or 0.0)))


def explain(drive: Drive, entry: MotorEntry | None = None) -> dict[str, Any]:
    """All that is known of a motor: JSON-serialisable but for infinite values.

    Args:
        drive: the motor with its drive.
        entry: its datasheet, where it has one.

    Returns:
        `drive`, the fields of motor, controller and supply, and `abilities`, each a list of mappings with `name`,
        `value` and `unit`; `assumed`; and of a datasheet `manufacturer`, `product`, `kind`, `numbers`, such mappings
        with `how` it came about and its `sources`, `unknown`, `disagreements`, `estimated` and `notes`.
    """
    parts: dict[str, Any] = {"motor": drive.motor, "controller": drive.controller, "supply": drive.supply}
    found: dict[str, Any] = {
        "drive": [
            _value(f"{part}.{field.name}", getattr(owner, field.name), field.metadata.get("unit", ""))
            for part, owner in parts.items()
            if owner is not None
            for field in dataclasses.fields(owner)
        ],
        "abilities": [_value(name, value, ABILITY_UNITS[name]) for name, value in abilities(drive)._asdict().items()],
        "assumed": drive.assumed,
    }
    if entry is None:
        return found
    torque = continuous_torque(drive, entry.numbers.continuous_current)
    found["abilities"].insert(2, _value("continuous_torque", torque, "N*m"))
    names = [field.name for field in dataclasses.fields(MotorNumbers) if field.name not in ("derived", "disagreements")]
    derived = entry.numbers.derived
    return found | {
        **{name: getattr(entry, name) for name in ("manufacturer", "product", "kind")},
        "numbers": [
            _value(name, getattr(entry.numbers, name), KINDS[OTHER_NAMES.get(name, name)].unit)
            | {"how": derived[name], "sources": _sources(derived[name], entry)}
            for name in names
            if name in derived
        ],
        "unknown": [name for name in names if name not in derived],
        "disagreements": _disagreements(entry.numbers),
        "estimated": dict(entry.estimated),
        "notes": entry.notes,
    }


def _disagreements(numbers: MotorNumbers) -> list[str]:
    """What a datasheet contradicts itself in, and in one sentence what it only rounds."""
    rounded = [one.quantity for one in numbers.disagreements if abs(one.difference) < _ROUNDED]
    told = list(map(str, numbers.disagreements[: len(numbers.disagreements) - len(rounded)]))
    return [*told, f"less than {_ROUNDED:.0%}, by rounding: {', '.join(rounded)}"] if rounded else told


def unknown_in_words(names: Sequence[str]) -> str:
    """What is said of a motor's unknown numbers; empty where all are known."""
    words = ", ".join(name.replace("max_", "highest ").replace("_", " ") for name in names)
    return f"Not known, for no source has it and it follows from nothing that one has: {words}." if words else ""


def _value(name: str, value: Any, unit: str) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit}


def _sources(sentence: str, entry: MotorEntry) -> list[str]:
    """Where the printed values that a sentence of `MotorNumbers.derived` names were found."""
    known = (entry.sources.get(word) for word in re.findall(r"\w+", sentence.replace("_at_output", "")))
    return list(dict.fromkeys(source for source in known if source is not None))
