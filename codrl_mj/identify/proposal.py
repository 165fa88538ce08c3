"""A proposal of `--columns` by the names, units and values of a file's columns, for a person to complete."""

import json
import keyword
import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.columns import EXAMPLES, COLUMN_UNITS, OPEN_UNIT, Column, parse_columns
from codrl_mj.identify.log import counts_per_turn, find_resolution, is_supply_voltage, find_obstacle, find_turn_jumps
from codrl_mj.identify.reading import STAMP, Table, read_table, table_to_log

_NAMES = {
    "only": "enable enabled armed",
    "time": "t time timestamp stamp zeit today millis micros",
    "command": "goal target command commanded cmd setpoint reference ref desired action",
    "temperature": "temp temperature",
    "bus": "bus vbus vin vbat vdc vcc supply battery",
    "duty": "duty pwm load",
    "velocity": "w omega speed velocity vel qd dq drehzahl rpm",
    "position": "q pos position angle theta phi encoder enc winkel counts ticks",
    "torque": "tau torque trq moment effort",
    "current": "i current iq strom",
    "voltage": "u v voltage volts spannung vq uq",
}
"""Signal -> words of its names; of a name with several the first signal counts, and letters only where nothing else."""
_READINGS = {
    "present",
    "feedback",
    "measured",
    "actual",
    "state",
}  # of a signal that only a unit tells, or a position
_NO_SIGNALS = {
    "error",
    "err",
    "limit",
    "max",
    "mode",
    "status",
    "fault",
    "gain",
    "integrator",
    "d",
}  # d: of the d axis
_INPUTS = {"input", "in", "dc"}  # of a servo or an inverter, not of the motor
_SPELLINGS = {
    "deg": "° º degrees",
    "deg/s": "dps",
    "rad": "radians",
    "turn": "rev revs",
    "turn/s": "rev/s",
}
_SPELLINGS |= {"s": "sec seconds", "ms": "millis", "us": "micros", "percent": "%"}
_UNITS = {
    spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings.split()
}
"""How files spell a unit -> as the mapping takes it."""
_TURNS = {"deg": 360.0, "rad": 2.0 * math.pi, "turn": 1.0}  # unit of an angle -> a turn
_STEPS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # unit of time -> [s]
_USUAL = {
    "voltage": (1.0, 60.0),
    "bus": (3.0, 60.0),
    "duty": (0.02, 1.0),
    "temperature": (0.0, 150.0),
}
"""Signal -> range of its largest value in the first unit of `EXAMPLES`, in which another unit is unlikely."""


class Proposal(NamedTuple):
    """Kinds of columns of a log."""

    columns: str
    """As `read_log` and `--columns` take it, once each `UNIT` in it is replaced."""
    doubts: tuple[str, ...]
    """What could not be told, or was inferred from values."""
    problem: str | None = None
    """Why nothing can be identified from these columns, with a remedy; None if something can."""


class _Entry(NamedTuple):
    """A signal of a proposal."""

    column: str
    formula: str
    unit: str


def propose_columns(path: Path | str) -> Proposal:
    """Propose which signals the columns of a file are: by names, units in them (`u [V]`, `pos_deg`) or below, values.

    A unit that neither the file nor its values tell is left open, as `UNIT`.

    Args:
        path: of a log, as `read_log` takes it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, or has no time or nothing else.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no log at {path}")
    table, entries, doubts = read_table(path), dict[str, _Entry](), list[str]()
    for name in table.columns:
        listed = re.fullmatch(r"(.*)\[(\d+)\]", name)
        if (listed and listed[2] != "0") or re.sub("nanosec$", "sec", name) in {*table.columns} - {
            name
        }:
            continue
        signal, unit, doubt = _signal(name, table, entries)
        if signal and not _numbers(name, table).size:
            signal, doubt = None, "holds no numbers, left out"
        if signal:
            entries[signal], doubt = _entry(signal, name, unit, table)
        if signal and listed:
            others = table.entries.get(
                listed[1], [one for one in table.columns if one.startswith(f"{listed[1]}[")]
            )
            doubt = f"the first of {', '.join(others)} is taken" + (f"; {doubt}" if doubt else "")
        doubts += [f"{name}: {doubt}"] if doubt else []
    doubts += _add_voltage(entries, table)
    if "time" not in entries or len(entries) < 2:
        known = ", ".join(table.columns)
        raise ValueError(
            f"log {path}: no time, or nothing else, can be told by its columns: {known}"
        )
    columns = ",".join(f"{signal}={one.formula}:{one.unit}" for signal, one in entries.items())
    return Proposal(columns, tuple(doubts), _problem(path.stem, table, entries))


def _signal(name: str, table: Table, taken: Collection[str]) -> tuple[str | None, str | None, str]:
    """Return a column's signal and the unit that the file states, None if unknown, and why a column is left out."""
    bracket = re.search(r"[\[(]\s*([^\])]*)\s*[\])]", name)
    bare = name.replace(bracket[0], " ") if bracket else name
    words = [
        one
        for one in re.split(r"[\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", bare).lower())
        if one
    ]
    ends = [
        one for one in re.split(r"[\W_]+", name.lower() if name.isupper() else name) if one
    ]  # mA is one
    stated = [table.units.get(name, "").strip("[]() "), *([bracket[1]] if bracket else [])]
    pairs = [f"{ends[-2]}{sign}{ends[-1]}" for sign in "/*"] if len(ends) > 2 else []  # deg_s, N_m
    inner = [
        one for one in (*reversed(ends[1:-1]), *reversed(words)) if len(one) > 1
    ]  # letters there are of a name
    loose = [*stated, *pairs, *ends[1:][-1:], *inner]
    units = {
        one: next((unit for text in loose if (unit := _valid(one, text))), None) for one in _NAMES
    }
    if {*words} & _NO_SIGNALS or ("state" in words and "observation" not in words):
        return None, None, "by its name no signal that a fit needs, left out"
    if "erpm" in words:
        return (
            None,
            None,
            "electrical turns, left out; write velocity=erpm/7:rpm if the motor has 7 pole pairs",
        )
    long = {one for one in words if len(one) > 1}
    named = [one for one, known in _NAMES.items() if {*known.split()} & long]
    named = named or [one for one, known in _NAMES.items() if {*known.split()} & {*words[:1]}]
    if not named and {*words} & _READINGS:
        named = [one for one in ("velocity", "position", "current", "torque") if units[one]] or [
            "position"
        ]
    if "current" in named and ({*words} & _INPUTS or "bus" in named):
        return None, None, "by its name the supply's current and not the motor's, left out"
    if "voltage" in named and {*words} & {*_INPUTS, "present"}:
        named = ["bus"]
    fitting = [one for one in named if any(_valid(one, text) for text in stated)]
    signal = next(iter([*fitting, *named]), None)
    if signal is None or signal in taken:
        return None, None, f"left out, {signal} is another" if signal else "not known, left out"
    return signal, units[signal], ""


def _valid(signal: str, unit: str) -> str | None:
    """Return a unit as the mapping takes it, if it is one of the signal."""
    if not re.search(r"[^\W\d]|[%°º]", unit) or unit == OPEN_UNIT:
        return None
    if COLUMN_UNITS[signal] == "" and _UNITS.get(unit, unit) != "percent":  # a duty cycle is not in cycles
        return None
    for one in (
        _UNITS.get(unit, unit),
        unit.upper() if len(unit) == 1 else unit,
        unit[:1] + unit[1:].upper(),
    ):
        try:
            Column(signal, "x", one)
        except ValueError:
            continue
        return one
    return None


def _entry(signal: str, name: str, unit: str | None, table: Table) -> tuple[_Entry, str]:
    """Return a signal's entry, with the unit that the file states or its values tell, and what is to be seen to."""
    bare = re.sub(r"\[0\]$", "", name)
    plain = bare.isascii() and bare.isidentifier() and not keyword.iskeyword(bare)
    formula = name if plain else json.dumps(name, ensure_ascii=False)
    values, doubt = _numbers(name, table), ""
    if unit is None:
        unit, doubt = _unit(signal, name, formula, values, table)
    if (rest := re.sub("sec$", "nanosec", name)) != name and rest in table.columns:
        formula += f"+{json.dumps(rest)}/1e9"
    if signal == "position" and (turn := _TURNS.get(unit)) and find_turn_jumps(values, turn).size:
        formula = f"unwrap({formula},{'2*pi' if unit == 'rad' else f'{turn:g}'})"
    return _Entry(name, formula, unit), doubt


def _numbers(name: str, table: Table) -> np.ndarray:
    """Return a column's finite numbers; none if it holds texts."""
    try:
        values = table.numeric_column(name)
    except ValueError:
        return np.empty(0)
    return values[np.isfinite(values)]


def _unit(
    signal: str, name: str, formula: str, values: np.ndarray, table: Table
) -> tuple[str, str]:
    """Return the unit that a column's values tell, or an open one, and what is to be seen to."""
    if signal == "time" and any(
        isinstance(one, str) and STAMP.match(one) for one in table.columns[name][:2]
    ):
        return "s", "clock stamps, read as seconds since the first"
    if signal == "only":
        return "1", "rows where it is 0 are left out"
    largest, whole = (
        float(np.abs(values).max(initial=0.0)),
        bool(np.all(values == np.round(values))),
    )
    seen = f"values up to {largest:.4g}"
    units = _time_units(values) if signal == "time" else []
    if len(units) == 1:
        return units[0], f"no unit is stated, {units[0]} is taken by the steps ({seen}): see to it"
    for unit, turn in _TURNS.items() if signal == "position" and values.size else ():
        if find_turn_jumps(values, turn).size and np.ptp(values) <= 1.1 * turn:
            return (
                unit,
                f"no unit is stated, {unit} is taken, for it jumps by {turn:.4g}: see to it",
            )
        if count := counts_per_turn(find_resolution(values), turn):
            return (
                unit,
                f"no unit is stated, {unit} is taken by its steps, {count} a turn: see to it",
            )
    low, high = _USUAL.get(signal, (math.inf, 0.0))
    # Whole volts near 50 may be tenths, as servos of 5 V have them in a register.
    if low < largest <= high and len(name) > 1 and not (whole and largest > 45.0):
        unit = re.split(r"\W", EXAMPLES[signal])[0]
        return unit, f"no unit is stated, {unit} is a guess ({seen}): see to it"
    likely = " or ".join(units) if signal == "time" and units else EXAMPLES[signal]
    hint = f"no unit is stated: replace UNIT by {likely} ({seen})"
    if signal in ("position", "velocity"):
        hint += "; ODrive and moteus log turns"
    if whole and signal not in ("time", "command") and len(np.unique(values)) > 3:
        scale = (
            "/4096:turn of 4096 counts"
            if signal == "position"
            else f"*STEP:{COLUMN_UNITS[signal] or '1'} of such steps"
        )
        hint += f"; whole numbers may be those of a register: {signal}={formula}{scale}"
    if signal == "voltage" and len(name) == 1:
        hint += "; or write torque= or velocity= if it is one"
    return OPEN_UNIT, hint


def _time_units(values: np.ndarray) -> list[str]:
    """Return the units in which a time's usual step is from 40 us to half a second, the longest first."""
    step = float(np.median(np.diff(values))) if values.size > 1 else 0.0
    return [unit for unit, size in _STEPS.items() if 4e-5 <= step * size <= 0.5]


def _add_voltage(entries: dict[str, _Entry], table: Table) -> list[str]:
    """Tell the motor's voltage from the supply's, of which a duty makes it, and return what is to be seen to."""
    doubts = []
    if "voltage" in entries and "bus" not in entries:
        name, values = entries["voltage"].column, _numbers(entries["voltage"].column, table)
        others = [
            _numbers(entries[one].column, table)
            for one in ("current", "torque", "velocity")
            if one in entries
        ]
        if is_supply_voltage(values, [*others, np.array([-1.0, 1.0])] if "duty" in entries else others):
            entries["bus"] = entries.pop("voltage")
            doubts.append(f"{name}: hardly changes, taken as the supply's voltage")
    if (
        "voltage" not in entries
        and {"duty", "bus"} <= entries.keys()
        and entries["duty"].unit != OPEN_UNIT
    ):
        duty, bus = entries["duty"], entries["bus"]
        part = "/100" if duty.unit == "percent" else ""
        entries["voltage"] = _Entry(bus.column, f"{duty.formula}{part}*{bus.formula}", bus.unit)
        doubts.append("voltage: taken as the duty's share of the bus")
    return doubts


def _problem(name: str, table: Table, entries: dict[str, _Entry]) -> str | None:
    """Return why a fit cannot use these columns, whichever units are filled in; None if it can."""
    units = {
        one: COLUMN_UNITS[one] or "1" if entry.unit == OPEN_UNIT else entry.unit
        for one, entry in entries.items()
    }
    try:
        log = table_to_log(
            name,
            table,
            parse_columns({one: f"{entries[one].formula}:{unit}" for one, unit in units.items()}),
        )
    except ValueError as error:
        return str(error)
    found = find_obstacle([log])
    if found is None or (found.check == "rows" and entries["time"].unit == OPEN_UNIT):
        return None
    return f"{found.message}; {found.remedy}"
