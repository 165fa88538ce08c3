"""A mapping of columns to signals, guessed from names, units and values: a person is to read it before it is used."""

import json
import keyword
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.columns import KINDS, Column
from codrl_mj.identify.log import find_resolution
from codrl_mj.identify.reading import STAMP, Cells, read_table

_WORDS = {
    "only": "enable enabled armed",
    "time": "t time timestamp stamp zeit",
    "command": "goal target command setpoint reference ref cmd desired",
    "temperature": "temp temperature",
    "bus": "bus vbus vin supply vcc battery",
    "duty": "duty pwm",
    "velocity": "w omega speed velocity vel qd dq drehzahl",
    "position": "q pos position angle theta phi encoder enc winkel",
    "torque": "tau torque trq moment",
    "current": "i current iq strom",
    "voltage": "u v voltage spannung",
}
"""Signal -> words of its names; of a name with several the first signal counts."""
_UNITS = {"°": "deg", "º": "deg", "degrees": "deg", "radians": "rad", "sec": "s", "seconds": "s", "%": "percent"}
_LARGE = {"velocity": (1000.0, "rpm"), "current": (200.0, "mA"), "duty": (1.5, "percent")}  # above, in that unit


class Proposal(NamedTuple):
    """What a log's columns may be."""

    columns: str
    """As `read_log` and `--columns` take it."""
    doubts: tuple[str, ...]
    """What could not be told, or was guessed."""


def propose_columns(path: Path | str) -> Proposal:
    """Which signals the columns of a file may be: by names, units in them (`u [V]`, `pos_deg`) or below, and values.

    Args:
        path: of a log, as `read_log` takes it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, or has no time or nothing else.
    """
    table, entries, doubts = read_table(Path(path)), {}, []
    for name in table.columns:
        words = [one for one in re.split(r"[\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()) if one]
        bracket = re.search(r"[\[(]\s*([^\])]*)\s*[\])]", name)
        stated = [table.units.get(name, "").strip("[]() "), *([bracket[1]] if bracket else []), *reversed(words[1:])]
        named = [one for one, known in _WORDS.items() if {*known.split()} & {*words}]
        fitting = [one for one in named if any(text and _valid(one, text) for text in stated[: 1 + bool(bracket)])]
        signal = next((one for one in (*fitting, *named) if one not in entries), None)
        if signal is None:
            doubts.append(f"{name}: " + (f"left out, {named[0]} is another" if named else "not known, left out"))
            continue
        unit = next((one for text in stated if text and (one := _valid(signal, text))), None)
        if unit is None:
            unit, doubt = _guessed(signal, name, table)
            doubts.append(f"{name}: {doubt}")
        plain = name.isidentifier() and not keyword.iskeyword(name)
        entries[signal] = f"{name if plain else json.dumps(name, ensure_ascii=False)}:{unit}"
    if "voltage" not in entries and {"duty", "bus"} <= entries.keys():
        duty, bus = (entries[one].rpartition(":")[0] for one in ("duty", "bus"))
        part = "/100" if entries["duty"].endswith("percent") else ""
        entries["voltage"] = f"{duty}{part}*{bus}:V"
        doubts.append("voltage: taken as the duty's share of the bus")
    if "time" not in entries or len(entries) < 2:
        known = ", ".join(table.columns)
        raise ValueError(f"log {path}: no time, or nothing else, can be told by its columns: {known}")
    return Proposal(",".join(f"{signal}={entry}" for signal, entry in entries.items()), tuple(doubts))


def _valid(signal: str, unit: str) -> str | None:
    """A unit as the mapping takes it, if it is one of the signal."""
    for one in (_UNITS.get(unit, unit), unit.upper() if len(unit) == 1 else unit, f"m{unit[1:].upper()}"):
        try:
            Column(signal, "x", one)
        except ValueError:
            continue
        return one
    return None


def _guessed(signal: str, name: str, table: Cells) -> tuple[str, str]:
    """A unit by a column's values, and what is to be seen to."""
    unit = KINDS[signal] or "1"
    try:
        found = table.numbers(name)
    except ValueError:
        return unit, "holds texts"
    if signal == "time" and any(isinstance(one, str) and STAMP.match(one) for one in table.columns[name][:2]):
        return "s", "clock stamps, read as seconds since the first"
    found = found[np.isfinite(found)]
    largest = float(np.abs(found).max(initial=0.0))
    step = float(np.median(np.diff(found))) if found.size > 1 else 0.0
    if signal == "time" and step > 0.5:
        unit = "us" if step > 50.0 else "ms"
    elif signal == "position" and largest > 40.0 and (grid := find_resolution(found)) > 0.0:
        unit = "deg" if abs(360.0 / grid - round(360.0 / grid)) < 1e-3 else unit  # else it may turn on
    elif signal in _LARGE and largest > _LARGE[signal][0]:
        unit = _LARGE[signal][1]
    return unit, f"no unit is stated, {unit} is a guess (values up to {largest:.4g}): see to it"
