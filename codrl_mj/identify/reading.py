"""Logs from files: CSV (also .gz), JSON and, where pyarrow is installed, Parquet; which columns are which signals."""

import collections
import csv
import datetime
import gzip
import importlib
import json
import keyword
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.identify.columns import KINDS, Column, parse_columns
from codrl_mj.identify.log import SIGNALS, Finding, Log, find_resolution

_WORDS = {"": np.nan, "nan": np.nan, "none": np.nan, "null": np.nan, "na": np.nan, "true": 1.0, "false": 0.0}
STAMP = re.compile(r"(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:\d\d")  # seconds since 1970, or since midnight
_MOST_UNUSABLE = 0.2  # share of rows that may be left out as unreadable or out of order


class Cells(NamedTuple):
    """What a file holds."""

    columns: Mapping[str, Any]  # texts or numbers, each of the same length
    constants: Mapping[str, float]
    ragged: list[int]  # rows that are incomplete, from 1
    lines: Sequence[int] = ()  # of the file, of each row
    units: Mapping[str, str] = {}  # by column, where a line states them
    commas: bool = False  # whether a number may have a decimal comma

    def numbers(self, name: str) -> np.ndarray:
        """A column as numbers, NaN where it is empty."""
        found = np.empty(len(self.columns[name]))
        for place, one in enumerate(self.columns[name]):
            if isinstance(one, int | float):
                found[place] = one
                continue
            text = "" if one is None else str(one).strip()
            try:
                if text.lower() in _WORDS:
                    found[place] = _WORDS[text.lower()]
                elif STAMP.match(text):
                    day = "" if "-" in text[:5] else "1970-01-01T"
                    stamp = datetime.datetime.fromisoformat(day + text.replace(",", "."))
                    found[place] = stamp.replace(tzinfo=stamp.tzinfo or datetime.UTC).timestamp()
                else:
                    found[place] = float(text.replace(",", ".") if self.commas else text)
            except ValueError:
                remedy = "write a decimal point" if "," in text else "leave such rows out, or map another column"
                where = f"line {self.lines[place]}" if self.lines else f"row {place + 1}"
                raise ValueError(f"column {name} in {where} is {text!r}, must be a number; {remedy}") from None
        return found


def read_log(path: Path | str, columns: str | Mapping[str, str]) -> Log:
    """A log from a file; what could not be read of it is among the log's findings.

    Rows with missing values, and those whose time does not increase, are left out. Time starts at 0.

    Args:
        path: .csv, .txt, .dat, .tsv, .json, any of them .gz, or .parquet. CSV has a line of names, and a comma,
            semicolon, tab or blanks between values; lines that begin with # or hold one cell are no rows, one without a
            number under the names is of units. Decimal commas, times of day (ISO 8601) and Latin-1 are read.
            JSON is a list of rows, or an object with one such list, such as `entries`, and numbers beside it,
            which formulas can use, or an object of columns.
        columns: `signal=formula:unit` separated by commas, or a mapping of signals to `formula:unit`. The voltage is
            what holds from its row to the next, or `mean(formula)`: the mean in between. `only=formula` leaves out the
            rows where it is 0.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of these, lacks a column, has text where a number is needed, or too few rows are left.
    """
    path, mapping = Path(path), parse_columns(columns)
    if not path.is_file():
        raise FileNotFoundError(f"no log at {path}")
    try:
        return _log(path.name.removesuffix(".gz").rpartition(".")[0], read_table(path), mapping)
    except (ValueError, UnicodeDecodeError, gzip.BadGzipFile, EOFError) as error:
        raise ValueError(f"log {path}: {error}") from None


def _log(name: str, table: Cells, mapping: Mapping[str, Column]) -> Log:
    count = len(next(iter(table.columns.values()), ()))
    numbers = np.setdiff1d(np.arange(1, count + len(table.ragged) + 1), table.ragged)  # of the rows, in the file
    needed = set().union(*(one.names for one in mapping.values())) & table.columns.keys()
    read = {**dict.fromkeys(table.columns), **table.constants, **{one: table.numbers(one) for one in needed}}
    signals = {one: np.broadcast_to(np.asarray(made.value(read), float), (count,)) for one, made in mapping.items()}
    time, wanted = signals.pop("time"), signals.pop("only", np.ones(count)) != 0.0
    finite = np.isfinite(time) & np.all([np.isfinite(values) for values in signals.values()], axis=0)
    rows = np.flatnonzero(wanted & finite)
    forward = time[rows] > np.append(-np.inf, np.maximum.accumulate(time[rows])[:-1])
    findings = [
        *_unsigned(read, mapping, numbers),
        *_left_out(numbers[wanted & ~finite], "missing", "have no number in some column, and are left out"),
        *_left_out(
            numbers[rows[~forward]], "stamps", "have a time that is not after the rows before, and are left out"
        ),
        *(
            Finding("info", "units", None, f"{one.text}: no unit is given, taken as {SIGNALS[one.signal]}", "")
            for one in mapping.values()
            if one.unit is None and SIGNALS.get(one.signal)
        ),
        *_left_out(np.array(table.ragged), "missing", "have not as many cells as there are columns, and are left out"),
    ]
    unusable = int((wanted & ~finite).sum() + (~forward).sum())
    rows = rows[forward]
    if rows.size < 2 or unusable > _MOST_UNUSABLE * max(int(wanted.sum()), 1):
        raise ValueError(
            f"{rows.size} of {int(wanted.sum())} rows can be used, must be 2 or more, and {1.0 - _MOST_UNUSABLE:.0%}: "
            + ("; ".join(one.message for one in findings if one.severity != "info") or "there are no more")
            + "; check the columns"
        )
    kept = {signal: np.ascontiguousarray(values[rows]) for signal, values in signals.items()}
    resolution = {signal: find_resolution(values) for signal, values in kept.items()}
    mean = "voltage" in mapping and mapping["voltage"].mean
    return Log(
        name, time[rows] - time[rows[0]], kept, resolution, mean, table.constants, numbers[rows], tuple(findings)
    )


def _unsigned(values: Mapping[str, Any], mapping: Mapping[str, Column], numbers: np.ndarray) -> Iterator[Finding]:
    """Columns that look like registers with a sign that is read without it: the highest and lowest quarter are used."""
    unsigned = (one for one in mapping.values() if "twos_complement" not in one.formula)
    for name in sorted(set().union(*(one.names for one in unsigned))):
        column = np.asarray(values[name] if values[name] is not None else 0.0, float)
        for bits in (8, 16, 32):
            whole = 2.0**bits
            high, low = column >= 0.75 * whole, column < 0.25 * whole
            within = (column >= 0.0) & (column < whole) & (column == np.round(column)) & (high | low)
            if high.any() and low.any() and np.all(within | np.isnan(column)):
                row = int(numbers[np.flatnonzero(high)[0]])
                text = f"{name} is below {whole / 4:.0f} or above {3 * whole / 4:.0f}: has it {bits} bits and a sign?"
                yield Finding("error", "register", row, text, f"write twos_complement({name}, {bits})")


def _left_out(rows: np.ndarray, check: str, what: str) -> Iterator[Finding]:
    """What is said of rows, by their numbers in the file, from 1."""
    if rows.size:
        text = f"{rows.size} row{'s' if rows.size > 1 else ''}, the first one {rows[0]}, {what}"
        remedy = "find out why the logger wrote them; sort the file, or cut it, if its clock was set back"
        severity, remedy = ("error", remedy) if check == "stamps" else ("warning", "")
        yield Finding(severity, check, int(rows[0]), text, remedy)


def read_table(path: Path) -> Cells:
    """A file's columns as they stand there; see `read_log`, which says which files."""
    kind = Path(path.name.removesuffix(".gz")).suffix.lower()
    if kind == ".parquet":
        try:
            parquet = importlib.import_module("pyarrow.parquet")
        except ModuleNotFoundError:
            raise ValueError("reading Parquet needs pyarrow: pip install pyarrow, or save the log as .csv") from None
        return Cells(parquet.read_table(path).to_pydict(), {}, [])
    if kind not in (".csv", ".txt", ".dat", ".tsv", ".json"):
        raise ValueError(f"unknown kind of file {kind!r}, must be .csv, .txt, .dat, .tsv, .json (or .gz) or .parquet")
    content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    try:
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")  # what instruments write for degrees and ohms
    return _json(json.loads(text)) if kind == ".json" else _csv(text)


def _csv(text: str) -> Cells:
    """A table after whatever comments: names are in the last line before the numbers, or above units."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    bare = [(number, line) for number, line in lines if not line.startswith("#")]
    last = [line for _, line in bare[-20:]]
    usual = [one for one in ";\t," if 2 * sum(one in line for line in last) > len(last)]
    separator = next((one for _, line in bare for one in usual if one in line), " ")  # the names' own, not a note's
    cells = []
    for number, line in bare:
        try:
            row = next(
                csv.reader([line.strip() if separator == " " else line], delimiter=separator, skipinitialspace=True)
            )
        except csv.Error as error:
            raise ValueError(f"line {number} is no row of cells: {error}") from None
        cells.append((number, [cell.strip() for cell in row]))
    common = collections.Counter(len(row) for _, row in cells[-20:]).most_common(1)[0][0] if cells else 0
    filled = (place for place, (_, row) in enumerate(cells) if len(row) == common and _is_filled(row))
    first = next(filled, len(cells))
    above = [row for _, row in cells[:first] if len(row) > 1 or separator == " "]
    if first == 0 or not above:  # names behind a #, as numpy writes them
        comments = [line.lstrip("# ") for _, line in lines if line.startswith("#")]
        above = [[cell.strip() for cell in row] for row in csv.reader(comments, delimiter=separator)]
        above = [row for row in above if len(row) == common][-1:] or above[-1:]
    units: list[str] = []
    width = len(cells[first][1]) if first < len(cells) else 0
    if len(above) > 1 and len(above[-1]) == len(above[-2]) == width and all(len(one) < 12 for one in above[-1]):
        units = above.pop()
    names = above[-1] if above else []
    if len(named := [one for one in names if one]) > len({*named}) or not named:
        raise ValueError(f"a line must name the columns, each once, above the numbers; it is {separator.join(names)!r}")
    rows = cells[first:]
    ragged = [place for place, (_, row) in enumerate(rows, 1) if len(row) != len(names)]
    whole = [row for _, row in rows if len(row) == len(names)]
    columns = dict(zip(names, zip(*whole, strict=True), strict=True)) if whole else dict.fromkeys(names, ())
    kept = [number for number, row in rows if len(row) == len(names)]
    return Cells(columns, {}, ragged, kept, dict(zip(names, units, strict=False)), separator != ",")


def _is_filled(row: Sequence[str]) -> bool:
    """Whether a row is one of the table's: numbers for the most part, or nothing but what stands for a missing one."""
    missing, numbers = sum(cell.lower() in ("", "null", "none", "na") for cell in row), 0
    for cell in row:
        try:
            float(cell.replace(",", "."))
            numbers += 1
        except ValueError:
            numbers += bool(STAMP.match(cell))
    return missing == len(row) or 2 * numbers > len(row) - missing


def _json(content: Any) -> Cells:
    given = content if isinstance(content, dict) else {"": content}
    constants = {name: float(one) for name, one in given.items() if isinstance(one, int | float)}
    lists = {name: one for name, one in given.items() if isinstance(one, list) and one}
    tables = [one for one in lists.values() if isinstance(one[0], dict)]
    if len(tables) == 1 and all(isinstance(row, dict) for row in tables[0]):
        names = dict.fromkeys(name for row in tables[0] for name in row)
        return Cells({name: [row.get(name) for row in tables[0]] for name in names}, constants, [])
    if isinstance(content, dict) and not tables and lists and len({len(one) for one in lists.values()}) == 1:
        return Cells(lists, constants, [])
    raise ValueError(
        "JSON must be a list of rows, an object with one such list and numbers beside it, or an object of columns of "
        "the same length"
    )


# -- proposed, for a person to read before it is used -----------------------------------------------------------------

_NAMES = {
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
        ends = re.split(r"[\W_]+", name.lower() if name.isupper() else name)[1:]  # mA is one, and none of two words
        stated = [table.units.get(name, "").strip("[]() "), *([bracket[1]] if bracket else []), *reversed(ends)]
        stated += reversed(words[1:])
        named = [one for one, known in _NAMES.items() if {*known.split()} & {*words}]
        fitting = [one for one in named if any(text and _valid(one, text) for text in stated[: 1 + bool(bracket)])]
        signal = next((one for one in (*fitting, *named) if one not in entries), None)
        if signal is None:
            doubts.append(f"{name}: " + (f"left out, {named[0]} is another" if named else "not known, left out"))
            continue
        unit = next((one for text in stated if text and (one := _valid(signal, text))), None)
        if unit is None:
            unit, doubt = _guessed(signal, name, table)
            doubts.append(f"{name}: {doubt}")
        plain = name.isascii() and name.isidentifier() and not keyword.iskeyword(name)
        entries[signal] = f"{name if plain else json.dumps(name, ensure_ascii=False)}:{unit}"
    if "voltage" not in entries and {"duty", "bus"} <= entries.keys():
        duty, bus = entries["duty"].rpartition(":")[0], entries["bus"].rpartition(":")
        part = "/100" if entries["duty"].endswith("percent") else ""
        entries["voltage"] = f"{duty}{part}*{bus[0]}:{bus[2]}"
        doubts.append("voltage: taken as the duty's share of the bus")
    if "time" not in entries or len(entries) < 2:
        known = ", ".join(table.columns)
        raise ValueError(f"log {path}: no time, or nothing else, can be told by its columns: {known}")
    return Proposal(",".join(f"{signal}={entry}" for signal, entry in entries.items()), tuple(doubts))


def _valid(signal: str, unit: str) -> str | None:
    """A unit as the mapping takes it, if it is one of the signal."""
    for one in (_UNITS.get(unit, unit), unit.upper() if len(unit) == 1 else unit, unit[:1] + unit[1:].upper()):
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
