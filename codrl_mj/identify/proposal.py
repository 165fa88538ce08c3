"""Proposals for `--columns` from the names, units and values of a file's columns."""

import json
import keyword
import math
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.identify.columns import COLUMN_UNITS, EXAMPLES, OPEN_UNIT, Column, parse_columns
from codrl_mj.identify.log import (
    INPUTS,
    counts_per_turn,
    find_obstacle,
    find_resolution,
    find_turn_jumps,
    is_servo_log,
    is_supply_voltage,
)
from codrl_mj.identify.reading import STAMP, Table, read_table, table_to_log

_NAMES = {
    "only": "enable enabled armed",
    "time": "t time timestamp stamp zeit today millis micros",
    "command": "goal target command commanded cmd setpoint reference ref desired action",
    "temperature": "temp temperature",
    "bus": "bus vbus vin vbat vdc vcc supply battery",
    "duty": "duty pwm load",
    "velocity": "w omega ω speed velocity vel qd dq drehzahl rpm",
    "position": (
        "q pos position angle theta θ phi φ encoder enc winkel turns revolutions counts ticks"
    ),
    "torque": "tau torque trq moment drehmoment effort",
    "current": "i current iq strom",
    "voltage": "u v voltage volts spannung vq uq",
}
"""Signal -> words in the names of its columns.

If a name has words of several signals, the first signal counts. Single letters count only if no
longer word matches.
"""
_READINGS = {"present", "feedback", "measured", "actual", "state"}
"""Words that mark a measured signal without naming it. The unit decides which signal it is;
without a unit it is the position.
"""
# The letter d marks signals of the d axis.
_NO_SIGNALS = {"error", "err", "limit", "max", "mode", "status", "fault", "gain", "integrator", "d"}
"""Words in the name of a column that no fit uses."""
_INPUTS = {"input", "in", "dc"}
"""Words in the name of a signal at the input of a servo or an inverter, not at the motor."""
_MEASURED = {"meas", "measured", "present", "actual", "feedback"}
"""Words in the name of a column that is preferred to other columns of its signal."""
_NOT_MEASURED = {
    *("con", "ctrl", "control", "controller", "cmd", "command", "des", "desired", "target", "goal"),
    *("ref", "reference", "ff", "feedforward", "fric", "friction", "filt", "filtered"),
}
"""Words in the name of a column that is taken only if its signal has no other column: commands,
parts of them, and filtered signals, which are late.
"""
_PLANT_INPUTS = "input", "control", "output"
"""Words in the names of columns that may be a motor's voltage, the most likely one first."""
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
"""Spelling of a unit in files -> unit of the mapping."""
_TURNS = {"deg": 360.0, "rad": 2.0 * math.pi, "turn": 1.0}  # unit of an angle -> size of a turn
_SCALED_UNIT = re.compile(
    r"[x×*]?\s*(\d+(?:\.\d+)?(?:e[-+]?\d+)?)\s*[x×*·]?\s*(\D+)", re.IGNORECASE
)
"""Pattern of a factor and a unit, as in `[0.1 deg]`."""
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # unit of time -> size in [s]
_USUAL_RANGES = {
    "voltage": (1.0, 60.0),
    "bus": (3.0, 60.0),
    "duty": (0.02, 1.0),
    "temperature": (0.0, 150.0),
}
"""Signal -> range of its largest value in which the first unit of `EXAMPLES` is very likely."""


class Proposal(NamedTuple):
    """A proposed mapping of a log's columns."""

    columns: str
    """Mapping for `read_log` and `--columns`, in which each `UNIT` has to be replaced."""
    doubts: tuple[str, ...]
    """Notes on columns that are unknown, or whose signal or unit was inferred from values."""
    problem: str | None = None
    """Reason why nothing can be identified from these columns, with a remedy; None: no problem."""


class _Header(NamedTuple):
    """A column's name, and the units that the file states for it."""

    name: str
    """Name of the column in the file."""
    bare_name: str
    """Name without units."""
    stated_units: tuple[str, ...]
    """Texts of the stated units."""


class _Entry(NamedTuple):
    """A signal of a proposed mapping."""

    column: str
    formula: str
    unit: str


def propose_columns(path: Path | str) -> Proposal:
    """Propose a mapping of a file's columns to signals.

    The signals follow from the names of the columns, the units in names (`u [V]`, `pos_deg`) or
    below them, and the values. A unit that remains unknown is left open, as `UNIT`.

    Args:
        path: file in a format that `read_log` reads.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file cannot be read, or no time or no other signal is recognized in it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no log at {path}")
    table, entries, doubts = read_table(path), dict[str, _Entry](), list[str]()
    headers = {name: _parse_header(name, table) for name in table.columns if _is_own(name, table)}
    best_columns = _best_columns(headers, table)
    for name, header in headers.items():
        signal, unit, doubt = _signal(header)
        if signal and not _finite_values(name, table).size:
            signal, doubt = None, "holds no numbers, left out"
        elif signal and best_columns[signal] != name:
            signal, doubt = None, f"left out, another column is the {signal}"
        if signal:
            entries[signal], doubt = _entry(signal, header, unit, table)
        list_entry = re.fullmatch(r"(.*)\[0\]", name)
        if signal and list_entry:
            entry_names = table.entries.get(
                list_entry[1],
                [column for column in table.columns if column.startswith(f"{list_entry[1]}[")],
            )
            doubt = f"the first of {', '.join(entry_names)} is taken" + (
                f"; {doubt}" if doubt else ""
            )
        doubts += [f"{name}: {doubt}"] if doubt else []
    doubts += _add_voltage(entries, table)
    if plant_input := _add_plant_input(entries, headers, table):
        left_out = f"{entries['voltage'].column}: not known, left out"
        doubts = [*(doubt for doubt in doubts if doubt != left_out), plant_input]
    doubts += _other_joints(entries, table)
    if "time" not in entries or len(entries) < 2:
        known = ", ".join(table.columns)
        raise ValueError(
            f"log {path}: no time, or no other signal, was recognized in its columns {known}; write"
            " the mapping by hand, as in time=t:s,current=i:A"
        )
    columns = ",".join(
        f"{signal}={entry.formula}:{entry.unit}" for signal, entry in entries.items()
    )
    return Proposal(columns, tuple(doubts), _problem(path.stem, table, entries))


def _is_own(name: str, table: Table) -> bool:
    """Return True if a column is considered by itself.

    Only the first entry of a list is proposed. Nanoseconds are added to their column of seconds.
    """
    list_entry = re.fullmatch(r".*\[(\d+)\]", name)
    is_rest = re.sub("nanosec$", "sec", name) in {*table.columns} - {name}
    return not (list_entry and list_entry[1] != "0") and not is_rest


def _words(header: _Header) -> list[str]:
    """Return the words in a column's name, in lower case."""
    # iMotor is split into words like i_motor, but a unit such as mA must not be split.
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", header.bare_name).lower()
    return [word for word in re.split(r"[\W\d_]+", separated) if word]


def _best_columns(headers: Mapping[str, _Header], table: Table) -> dict[str, str]:
    """Return the best column of each signal: a measured one, and otherwise the first."""
    ranks: dict[str, list[tuple[int, str]]] = {}
    for name, header in headers.items():
        signal = _signal(header)[0]
        if signal is None or not _finite_values(name, table).size:
            continue
        words = {*_words(header)}
        rank = 2 if words & _NOT_MEASURED else 1
        rank = 0 if words & _MEASURED else rank
        ranks.setdefault(signal, []).append((rank if signal != "command" else 0, name))
    return {
        signal: min(columns, key=lambda column: column[0])[1] for signal, columns in ranks.items()
    }


def _add_plant_input(
    entries: dict[str, _Entry], headers: Mapping[str, _Header], table: Table
) -> str:
    """Map an input of the plant to the voltage if no other column drives the motor.

    Returns:
        A doubt on the mapped column; empty if there is none.
    """
    if entries.keys() & {"voltage", "duty", *INPUTS}:
        return ""
    used = {entry.column for entry in entries.values()}
    for word in _PLANT_INPUTS:
        for name, header in headers.items():
            words = {*_words(header)}
            values = _finite_values(name, table)
            is_input = word in words and not words & _NO_SIGNALS and name not in used
            if is_input and values.size and np.ptp(values) > 0.0:
                entry, _ = _entry("voltage", header, OPEN_UNIT, table)
                entries["voltage"] = entry
                return (
                    f"{name}: by its name the motor's input: replace UNIT by V if it is the voltage"
                    " at the terminals, or write torque= or current="
                )
    return ""


def _other_joints(entries: Mapping[str, _Entry], table: Table) -> list[str]:
    """Return a doubt if the file has the same columns for several joints."""
    for signal in ("position", "velocity"):
        numbered = signal in entries and re.fullmatch(r"(.*?)(\d+)", entries[signal].column)
        if not numbered:
            continue
        pattern = re.escape(numbered[1]) + r"\d+"
        columns = [name for name in table.columns if re.fullmatch(pattern, name)]
        if len(columns) > 1:
            return [
                f"{', '.join(columns)}: several joints, of which {numbered[0]} is taken: a fit of"
                " one joint is right only if the others were held"
            ]
    return []


def _signal(header: _Header) -> tuple[str | None, str | None, str]:
    """Return a column's signal, its stated unit, and the reason why it is left out.

    Signal and unit are None if they are unknown.
    """
    name, stated = header.name, header.stated_units
    words = _words(header)
    parts = [part for part in re.split(r"[\W_]+", name.lower() if name.isupper() else name) if part]
    # The last two parts may be a unit, as in deg_s or N_m.
    has_pair = len(parts) > 2 and not any(re.search(r"\d", part) for part in parts[-2:])
    pairs = [f"{parts[-2]}{sign}{parts[-1]}" for sign in "/*"] if has_pair else []
    # Single letters inside a name are rarely units.
    inner = [
        fragment for fragment in (*reversed(parts[1:-1]), *reversed(words)) if len(fragment) > 1
    ]
    texts = [*stated, *pairs, *parts[1:][-1:], *inner]
    units = {
        signal: next((unit for text in texts if (unit := _valid_unit(signal, text))), None)
        for signal in _NAMES
    }
    # A unit without its factor would be wrong. It stays open here, and `_entry` applies the factor
    # if its meaning is clear.
    units |= {signal: None for signal in _NAMES if _unit_factor(signal, stated, parts)[0]}
    if {*words} & _NO_SIGNALS or ("state" in words and "observation" not in words):
        return None, None, "by its name not a signal that a fit uses, left out"
    if "erpm" in words:
        return (
            None,
            None,
            "electrical turns, left out; write velocity=erpm/7:rpm if the motor has 7 pole pairs",
        )
    long_words = {word for word in words if len(word) > 1}
    candidates = [signal for signal, known in _NAMES.items() if {*known.split()} & long_words]
    candidates = candidates or [
        signal for signal, known in _NAMES.items() if {*known.split()} & {*words[:1]}
    ]
    # The command of a PWM is the duty itself.
    if {"command", "duty"} <= {*candidates}:
        candidates.remove("command")
    if not candidates and {*words} & _READINGS:
        candidates = [
            signal for signal in ("velocity", "position", "current", "torque") if units[signal]
        ] or ["position"]
    if "current" in candidates and ({*words} & _INPUTS or "bus" in candidates):
        return None, None, "by its name the supply's current and not the motor's, left out"
    # Servos call the voltage of their supply the present (input) voltage.
    if "voltage" in candidates and {*words} & {*_INPUTS, "present"}:
        candidates = ["bus"]
    with_unit = [
        signal for signal in candidates if any(_valid_unit(signal, text) for text in stated)
    ]
    best = next(iter([*with_unit, *candidates]), None)
    if best is None:
        return None, None, "not known, left out"
    return best, units[best], ""


def _parse_header(name: str, table: Table) -> _Header:
    """Find the units that the file states for a column.

    The unit is in a separate line of the file, or in the name: in brackets, after "in", or as a
    sign at its end.
    """
    bracket = re.search(r"[\[(]\s*([^\])]*)\s*[\])]", name)
    bare = (name.replace(bracket[0], " ") if bracket else name).strip()
    suffix = re.search(r"\sin\s+(\S+)$|([°º%](?:/\w+)?)$", bare)
    texts = [
        table.units.get(name, ""),
        bracket[1] if bracket else "",
        (suffix[1] or suffix[2]) if suffix else "",
    ]
    units = tuple(text.strip("[]() ") for text in texts if text)
    return _Header(name, bare[: suffix.start()] if suffix else bare, units)


def _unit_factor(
    signal: str, stated: Collection[str], parts: Collection[str] = ()
) -> tuple[str, str | None]:
    """Return the factor and the unit in texts such as `0.1 deg`.

    The unit is None if the meaning of the factor is unclear, as in `deg x10`. Without a factor the
    result is an empty text and None.
    """
    for text in stated:
        if not re.search(r"\d", text) or _valid_unit(signal, text):
            continue
        match = _SCALED_UNIT.fullmatch(text)
        if match and (unit := _valid_unit(signal, match[2].strip())):
            return match[1], unit
        if any(_valid_unit(signal, word) for word in re.split(r"[\W\d_]+", text)):
            return text, None
    # A name such as pos_01deg or pos_x10 states a factor, but not how it is meant.
    matches = (re.fullmatch(r"x\d+|\d+x|\d+(\D+)", part) for part in parts)
    return next(
        (
            (match[0], None)
            for match in matches
            if match and (not match[1] or _valid_unit(signal, match[1]))
        ),
        ("", None),
    )


def _valid_unit(signal: str, unit: str) -> str | None:
    """Return a unit in the spelling of the mapping; None if it is not a unit of the signal."""
    if not re.search(r"[^\W\d]|[%°º]", unit) or unit == OPEN_UNIT:
        return None
    # A column duty_cycle is not in cycles: only percent is a unit of a share.
    if COLUMN_UNITS[signal] == "" and _UNITS.get(unit, unit) != "percent":
        return None
    # Names in capitals or lower case lose the case of their units: v for V, ma for mA.
    for spelling in (
        _UNITS.get(unit, unit),
        unit.upper() if len(unit) == 1 else unit,
        unit[:1] + unit[1:].upper(),
    ):
        try:
            Column(signal, "x", spelling)
        except ValueError:
            continue
        return spelling
    return None


def _entry(signal: str, header: _Header, unit: str | None, table: Table) -> tuple[_Entry, str]:
    """Return the mapping of a signal, and a doubt if its unit is not clearly stated."""
    name = header.name
    bare = re.sub(r"\[0\]$", "", name)
    # In a formula, names that are not identifiers are quoted.
    is_identifier = bare.isascii() and bare.isidentifier() and not keyword.iskeyword(bare)
    formula = name if is_identifier else json.dumps(name, ensure_ascii=False)
    values, doubt = _finite_values(name, table), ""
    factor, scaled_unit = _unit_factor(signal, header.stated_units)
    if scaled_unit:
        values, unit = values * float(factor), scaled_unit
        formula = f"{formula}*{factor}"
        doubt = f"its unit is stated with a factor of {factor}, which is applied: check it"
    elif unit is None:
        unit, doubt = _infer_unit(signal, name, formula, values, table)
    # ROS 2 writes seconds and nanoseconds in two columns.
    if (nanoseconds := re.sub("sec$", "nanosec", name)) != name and nanoseconds in table.columns:
        formula += f"+{json.dumps(nanoseconds)}/1e9"
    if signal == "position" and (turn := _TURNS.get(unit)) and find_turn_jumps(values, turn).size:
        formula = f"unwrap({formula},{'2*pi' if unit == 'rad' else f'{turn:g}'})"
    return _Entry(name, formula, unit), doubt


def _finite_values(name: str, table: Table) -> np.ndarray:
    """Return the finite numbers of a column; an empty array if it contains text."""
    try:
        values = table.numeric_column(name)
    except ValueError:
        return np.empty(0)
    finite: np.ndarray = values[np.isfinite(values)]
    return finite


def _infer_unit(
    signal: str, name: str, formula: str, values: np.ndarray, table: Table
) -> tuple[str, str]:
    """Infer the unit of a column from its values; return the unit or `OPEN_UNIT`, and a doubt."""
    if signal == "time" and any(
        isinstance(cell, str) and STAMP.match(cell) for cell in table.columns[name][:2]
    ):
        return "s", "clock stamps, read as seconds since the first"
    if signal == "only":
        return "1", "rows where it is 0 are left out"
    largest = float(np.abs(values).max(initial=0.0))
    is_integer = bool(np.all(values == np.round(values)))
    size = f"values up to {largest:.4g}"
    units = _time_units(values) if signal == "time" else []
    if len(units) == 1:
        return (
            units[0],
            f"no unit is stated, {units[0]} is inferred from the steps ({size}): check it",
        )
    for unit, turn in _TURNS.items() if signal == "position" and values.size else ():
        if find_turn_jumps(values, turn).size and np.ptp(values) <= 1.1 * turn:
            return (
                unit,
                f"no unit is stated, {unit} is inferred from jumps by {turn:.4g}: check it",
            )
        if count := counts_per_turn(find_resolution(values), turn):
            return (
                unit,
                f"no unit is stated, {unit} is inferred from {count} steps per turn: check it",
            )
    low, high = _USUAL_RANGES.get(signal, (math.inf, 0.0))
    # Whole numbers near 50 may be tenths of a volt, as in the registers of servos for 5 V.
    if low < largest <= high and len(name) > 1 and not (is_integer and largest > 45.0):
        unit = re.split(r"\W", EXAMPLES[signal])[0]
        return unit, f"no unit is stated, {unit} is a guess ({size}): check it"
    likely = " or ".join(units) if signal == "time" and units else EXAMPLES[signal]
    hint = f"no unit is stated: replace UNIT by {likely} ({size})"
    if signal in ("position", "velocity"):
        hint += "; ODrive and moteus log turns"
    if is_integer and signal not in ("time", "command") and len(np.unique(values)) > 3:
        scale = (
            "/4096:turn with 4096 counts per turn"
            if signal == "position"
            else f"*STEP:{COLUMN_UNITS[signal] or '1'} with the size of a step"
        )
        hint += f"; whole numbers may come from a register: {signal}={formula}{scale}"
    if signal == "voltage" and len(name) == 1:
        hint += "; or write torque= or velocity= if the column is one of them"
    return OPEN_UNIT, hint


def _time_units(values: np.ndarray) -> list[str]:
    """Return the units in which the usual time step is 40 us to 0.5 s, the longest unit first."""
    step = float(np.median(np.diff(values))) if values.size > 1 else 0.0
    return [unit for unit, size in _SECONDS.items() if 4e-5 <= step * size <= 0.5]


def _add_voltage(entries: dict[str, _Entry], table: Table) -> list[str]:
    """Map an almost constant voltage to the supply, derive the motor's voltage, and return doubts.

    With a duty, the motor's voltage is the duty times the voltage of the supply.
    """
    doubts = []
    if "voltage" in entries and "bus" not in entries:
        name, values = entries["voltage"].column, _finite_values(entries["voltage"].column, table)
        responses = [
            _finite_values(entries[signal].column, table)
            for signal in ("current", "torque", "velocity")
            if signal in entries
        ]
        # With a duty, the motor's voltage varies. An almost constant voltage is then that of the
        # supply, even if no other signal shows that the motor reverses.
        if is_supply_voltage(
            values, [*responses, np.array([-1.0, 1.0])] if "duty" in entries else responses
        ):
            entries["bus"] = entries.pop("voltage")
            doubts.append(f"{name}: hardly changes, taken as the supply's voltage")
    if (
        "voltage" not in entries
        and {"duty", "bus"} <= entries.keys()
        and entries["duty"].unit != OPEN_UNIT
    ):
        duty, bus = entries["duty"], entries["bus"]
        percent = "/100" if duty.unit == "percent" else ""
        entries["voltage"] = _Entry(bus.column, f"{duty.formula}{percent}*{bus.formula}", bus.unit)
        doubts.append("voltage: computed as the duty times the bus voltage")
    return doubts


def _problem(name: str, table: Table, entries: dict[str, _Entry]) -> str | None:
    """Return why a fit cannot use these columns, whatever their units; None if it can."""
    units = {
        signal: COLUMN_UNITS[signal] or "1" if entry.unit == OPEN_UNIT else entry.unit
        for signal, entry in entries.items()
    }
    try:
        log = table_to_log(
            name,
            table,
            parse_columns(
                {signal: f"{entries[signal].formula}:{unit}" for signal, unit in units.items()}
            ),
        )
    except ValueError as error:
        return str(error)
    obstacle = find_obstacle([log])
    # While the unit of time is open, the rows may still be frequent enough.
    if obstacle is None or (obstacle.check == "rows" and entries["time"].unit == OPEN_UNIT):
        return None
    if obstacle.check == "signals" and is_servo_log(log):
        return None
    return f"{obstacle.message}; {obstacle.remedy}"
