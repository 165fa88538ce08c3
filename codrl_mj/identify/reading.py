"""Readers of log files: CSV, JSON, both also as .gz, and Parquet if pyarrow is installed."""

import collections
import csv
import datetime
import gzip
import importlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.identify.columns import Column, Operand, parse_columns
from codrl_mj.identify.log import SIGNALS, Finding, Log, find_resolution

_WORDS = {
    "": np.nan,
    "nan": np.nan,
    "none": np.nan,
    "null": np.nan,
    "na": np.nan,
    "true": 1.0,
    "false": 0.0,
}
STAMP = re.compile(r"(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:\d\d")
"""Date and time, read as seconds since 1970, or time of day, read as seconds since midnight."""
_SIGN_BITS = {
    **dict.fromkeys(("duty", "voltage", "torque"), ((11, 1000.0), (16, 8192.0))),
    **dict.fromkeys(("current", "velocity"), ((16, 8192.0),)),
}
"""Signal -> bits and largest values of servo registers (Feetech) whose highest bit is the sign."""
_MAX_UNUSABLE = 0.2  # share of rows that may be unreadable or out of order


# JSON and Parquet have values of any type, which the readers check one by one.
Content = Any
"""Parsed content of a file."""
Cell = object
"""Cell of a table: a text, a number, None, or a list of them."""


class Table(NamedTuple):
    """The contents of a file."""

    columns: Mapping[str, Sequence[Cell]]  # texts or numbers, all of the same length
    constants: Mapping[str, float]
    ragged: list[int]  # numbers of incomplete rows, from 1
    lines: Sequence[int] = ()  # line of the file for each row
    units: Mapping[str, str] = {}  # column -> unit, if a line states the units
    decimal_commas: bool = False  # True if numbers may have a decimal comma
    # Name of a column of lists -> names of the lists' entries, such as joints.
    entries: Mapping[str, list[str]] = {}

    @property
    def labels(self) -> dict[str, str]:
        """Entries by name -> entries by index, for example action[elbow] -> action[1]."""
        pairs = (
            (name, *pair) for name, entries in self.entries.items() for pair in enumerate(entries)
        )
        return {f"{name}[{entry}]": f"{name}[{index}]" for name, index, entry in pairs}

    def numeric_column(self, name: str) -> np.ndarray:
        """Return a column as numbers, NaN for empty cells."""
        numbers = np.empty(len(self.columns[name]))
        for index, cell in enumerate(self.columns[name]):
            if isinstance(cell, int | float):
                numbers[index] = cell
                continue
            text = "" if cell is None else str(cell).strip()
            try:
                if text.lower() in _WORDS:
                    numbers[index] = _WORDS[text.lower()]
                elif STAMP.match(text):
                    day = "" if "-" in text[:5] else "1970-01-01T"
                    stamp = datetime.datetime.fromisoformat(day + text.replace(",", "."))
                    numbers[index] = stamp.replace(tzinfo=stamp.tzinfo or datetime.UTC).timestamp()
                else:
                    numbers[index] = float(text.replace(",", ".") if self.decimal_commas else text)
            except ValueError:
                remedy = (
                    "write a decimal point"
                    if "," in text
                    else "leave such rows out, or map another column"
                )
                location = f"line {self.lines[index]}" if self.lines else f"row {index + 1}"
                raise ValueError(
                    f"column {name} in {location} is {text!r}, must be a number; {remedy}"
                ) from None
        return numbers


def read_log(path: Path | str, columns: str | Mapping[str, str]) -> Log:
    """Read a log from a file; the log's findings report the rows that could not be read.

    Rows with missing values, and rows whose time does not increase, are left out. The time of the
    log starts at 0.

    Args:
        path: .csv, .txt, .dat, .tsv or .json, each also compressed as .gz, or .parquet. CSV has a
            line of column names, and commas, semicolons, tabs or blanks between values. Lines that
            begin with # or have only one cell are skipped. A line without numbers below the names
            states the units. Decimal commas, times of day (ISO 8601) and Latin-1 are accepted.
            JSON is a list of rows; or an object that contains such a list, and numbers that
            formulas can use; or an object of columns. If the cells of a column are lists,
            `column[0]` is the first entry, and `column[elbow]` the entry with that name, according
            to `features` in the file or in meta/info.json of the data set that contains the file.
        columns: `signal=formula:unit` separated by commas, or a mapping of signals to
            `formula:unit`. A voltage counts as held until the next row, and `mean(formula)` as its
            mean until the next row. `only=formula` leaves out the rows where the formula is 0.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the format is unknown, a column is missing, a cell has text instead of a number,
            or too few rows are left.
    """
    path, mapping = Path(path), parse_columns(columns)
    if not path.is_file():
        raise FileNotFoundError(f"no log at {path}")
    try:
        return table_to_log(
            path.name.removesuffix(".gz").rpartition(".")[0], read_table(path), mapping
        )
    except (ValueError, UnicodeDecodeError, gzip.BadGzipFile, EOFError) as error:
        raise ValueError(f"log {path}: {error}") from None


def table_to_log(name: str, table: Table, mapping: Mapping[str, Column]) -> Log:
    """Convert the contents of a file to a log by a mapping of its columns; see `read_log`."""
    count = len(next(iter(table.columns.values()), ()))
    # Incomplete rows are counted, too, so that row numbers match the file.
    row_numbers = np.setdiff1d(np.arange(1, count + len(table.ragged) + 1), table.ragged)
    labels = table.labels
    used = set().union(*(column.names for column in mapping.values()))
    needed = {labels.get(name, name) for name in used} & table.columns.keys()
    # Only the columns in use have to be numeric; the others remain as names for error messages.
    values = {
        **dict.fromkeys(table.columns),
        **table.constants,
        **{name: table.numeric_column(name) for name in needed},
    }
    values |= {label: values[name] for label, name in labels.items() if name in values}
    signals = {
        signal: np.broadcast_to(np.asarray(column.evaluate(values), float), (count,))
        for signal, column in mapping.items()
    }
    time, selected = signals.pop("time"), signals.pop("only", np.ones(count)) != 0.0
    finite = np.isfinite(time) & np.all([np.isfinite(each) for each in signals.values()], axis=0)
    rows = np.flatnonzero(selected & finite)
    forward = time[rows] > np.append(-np.inf, np.maximum.accumulate(time[rows])[:-1])
    findings = [
        *_find_unsigned(values, mapping, row_numbers),
        *_left_out(row_numbers[selected & ~finite], "missing", "lack a number, and are left out"),
        *_left_out(
            row_numbers[rows[~forward]],
            "stamps",
            "have a time that is not later than all times before, and are left out",
        ),
        *(
            Finding(
                "info",
                "units",
                None,
                f"{column.text}: no unit is given, taken as {SIGNALS[column.signal]}",
                "",
            )
            for column in mapping.values()
            if column.unit is None and SIGNALS.get(column.signal)
        ),
        *_left_out(
            np.array(table.ragged), "missing", "have too few or too many cells, and are left out"
        ),
    ]
    unusable = int((selected & ~finite).sum() + (~forward).sum())
    rows = rows[forward]
    if rows.size < 2 or unusable > _MAX_UNUSABLE * max(int(selected.sum()), 1):
        raise ValueError(
            f"{rows.size} of {int(selected.sum())} rows can be used, must be at least 2"
            f" and {1.0 - _MAX_UNUSABLE:.0%} of all: "
            + (
                "; ".join(finding.message for finding in findings if finding.severity != "info")
                or "there are no more"
            )
            + "; check the columns"
        )
    usable = {name: np.ascontiguousarray(signal[rows]) for name, signal in signals.items()}
    resolution = {name: find_resolution(signal) for name, signal in usable.items()}
    mean = "voltage" in mapping and mapping["voltage"].mean
    return Log(
        name,
        time[rows] - time[rows[0]],
        usable,
        resolution,
        mean,
        table.constants,
        row_numbers[rows],
        tuple(findings),
    )


def _find_unsigned(
    values: Mapping[str, Operand | None], mapping: Mapping[str, Column], row_numbers: np.ndarray
) -> Iterator[Finding]:
    """Find columns that look like signed registers read as unsigned numbers."""
    unconverted = (
        column
        for column in mapping.values()
        if not re.search("twos_complement|sign_magnitude", column.formula)
    )
    for name, signal in sorted(
        {(name, column.signal) for column in unconverted for name in column.names}
    ):
        numbers = np.asarray(values[name] if values[name] is not None else 0.0, float)
        # Negative numbers in two's complement are in the upper half of the range. A signal that
        # stays within a quarter of its range around 0 has no values in the middle half.
        for bits in (8, 16, 32):
            range_size = 2.0**bits
            high, low = numbers >= 0.75 * range_size, numbers < 0.25 * range_size
            plausible = (
                (numbers >= 0.0)
                & (numbers < range_size)
                & (numbers == np.round(numbers))
                & (high | low)
            )
            if high.any() and low.any() and np.all(plausible | np.isnan(numbers)):
                row = int(row_numbers[np.flatnonzero(high)[0]])
                text = (
                    f"{name} is below {range_size / 4:.0f} or above {3 * range_size / 4:.0f}: is it"
                    f" a signed number of {bits} bits?"
                )
                yield Finding(
                    "error", "register", row, text, f"write twos_complement({name}, {bits})"
                )
        for bits, largest in _SIGN_BITS.get(signal, ()):
            half = 2.0 ** (bits - 1)
            high = (numbers >= half) & (numbers <= half + largest)
            low = (numbers >= 0.0) & (numbers <= largest)
            plausible = (numbers == np.round(numbers)) & (high | low)
            # A signal that changes its sign passes near 0 on both sides.
            is_near_zero = [
                numbers[side].min() - zero <= 0.25 * largest
                for side, zero in ((high, half), (low, 0.0))
                if side.any()
            ]
            if (
                len(is_near_zero) == 2
                and all(is_near_zero)
                and np.all(plausible | np.isnan(numbers))
            ):
                row = int(row_numbers[np.flatnonzero(high)[0]])
                text = (
                    f"{name} is at most {largest:.0f}, or {half:.0f} and more: is its bit"
                    f" {bits - 1} the sign?"
                )
                yield Finding(
                    "error", "register", row, text, f"write sign_magnitude({name}, {bits})"
                )


def _left_out(rows: np.ndarray, check: str, reason: str) -> Iterator[Finding]:
    """Report rows that are left out; `rows` are their numbers in the file, from 1."""
    if rows.size:
        text = f"{rows.size} row{'s' if rows.size > 1 else ''}, the first one {rows[0]}, {reason}"
        remedy = (
            "find out why the logger wrote them; sort the file, or cut it, if its clock was set"
            " back"
        )
        severity, remedy = ("error", remedy) if check == "stamps" else ("warning", "")
        yield Finding(severity, check, int(rows[0]), text, remedy)


def read_table(path: Path) -> Table:
    """Return the contents of a file, with a column for each entry of a list.

    See `read_log` for the formats.
    """
    table = _read_table(path)
    columns: dict[str, Sequence[Cell]] = {}
    for name, values in table.columns.items():
        lists = (
            [_as_list(value) for value in values]
            if any(_as_list(value) for value in values[:20])
            else []
        )
        for entry in range(max((len(cells) for cells in lists if cells), default=0)):
            columns[f"{name}[{entry}]"] = [
                cells[entry] if cells and entry < len(cells) else None for cells in lists
            ]
        if not lists:
            columns[name] = values
    # A LeRobot data set describes its list columns in meta/info.json above the file.
    if len(columns) > len(table.columns) and not table.entries:
        for folder in [*path.absolute().parents][:3]:
            if (info := folder / "meta" / "info.json").is_file():
                table = table._replace(
                    entries=_entry_names(json.loads(info.read_text(encoding="utf-8")))
                )
                break
    return table._replace(columns=columns)


def _as_list(value: Cell) -> Sequence[Cell] | None:
    """Return a cell's list, also from a text such as `[0.1 2]`; None if it holds none."""
    if isinstance(value, str):
        return _split_list(value)
    return (
        value
        if isinstance(value, list) and not any(isinstance(entry, list | dict) for entry in value)
        else None
    )


def _split_list(text: str) -> list[str] | None:
    """Return the entries of a text such as `[0.1 2]`; None for other texts."""
    return (
        text.strip("[]").replace(",", " ").split() if text[:1] == "[" and text[-1:] == "]" else None
    )


def _entry_names(content: Content) -> dict[str, list[str]]:
    """Return the entries' names of list columns, from `features` in a parsed file."""
    features = content.get("features") if isinstance(content, dict) else None
    entries = {}
    for name, feature in features.items() if isinstance(features, dict) else ():
        names = feature.get("names") if isinstance(feature, dict) else None
        # Some files list the names under the kind of entry, as {"motors": [...]}.
        names = next(iter(names.values()), None) if isinstance(names, dict) else names
        if isinstance(names, list):
            entries[name] = [*map(str, names)]
    return entries


def _read_table(path: Path) -> Table:
    """Return the contents of a file; columns of lists are not split yet."""
    kind = Path(path.name.removesuffix(".gz")).suffix.lower()
    if kind == ".parquet":
        try:
            parquet = importlib.import_module("pyarrow.parquet")
        except ModuleNotFoundError:
            raise ValueError(
                "reading Parquet needs pyarrow: pip install pyarrow, or save the log as .csv"
            ) from None
        return Table(parquet.read_table(path).to_pydict(), {}, [])
    if kind not in (".csv", ".txt", ".dat", ".tsv", ".json"):
        raise ValueError(
            f"unknown kind of file {kind!r}, must be .csv, .txt, .dat, .tsv, .json (or .gz) or"
            " .parquet"
        )
    content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    try:
        text = content.decode(
            "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        )
    # Instruments often write signs such as ° and µ in Latin-1.
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return _json(json.loads(text)) if kind == ".json" else _csv(text)


def _csv(text: str) -> Table:
    """Parse a CSV table, even if comments or other text precede it.

    The columns' names are in the last line before the numbers, or above a line of units.
    """
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    bare = [(number, line) for number, line in lines if not line.startswith("#")]
    last = [line for _, line in bare[-20:]]
    # A candidate for the separator occurs in most of the last lines. Among several candidates, the
    # one in the first line with any of them is taken: that is usually the line of names.
    usual = [mark for mark in ";\t," if 2 * sum(mark in line for line in last) > len(last)]
    separator = next((mark for _, line in bare for mark in usual if mark in line), " ")
    cells = []
    for number, line in bare:
        try:
            row = next(
                csv.reader(
                    [line.strip() if separator == " " else line],
                    delimiter=separator,
                    skipinitialspace=True,
                )
            )
        except csv.Error as error:
            raise ValueError(f"line {number} is not a row of cells: {error}") from None
        cells.append((number, [cell.strip() for cell in row]))
    common = (
        collections.Counter(len(row) for _, row in cells[-20:]).most_common(1)[0][0] if cells else 0
    )
    filled = (
        index for index, (_, row) in enumerate(cells) if len(row) == common and _is_filled(row)
    )
    first = next(filled, len(cells))
    above = [row for _, row in cells[:first] if len(row) > 1 or separator == " "]
    # numpy writes the line of names as a comment, after a #.
    if first == 0 or not above:
        comments = [line.lstrip("# ") for _, line in lines if line.startswith("#")]
        above = [
            [cell.strip() for cell in row] for row in csv.reader(comments, delimiter=separator)
        ]
        above = [row for row in above if len(row) == common][-1:] or above[-1:]
    units: list[str] = []
    width = len(cells[first][1]) if first < len(cells) else 0
    if (
        len(above) > 1
        and len(above[-1]) == len(above[-2]) == width
        and all(len(cell) < 12 for cell in above[-1])
    ):
        units = above.pop()
    names = above[-1] if above else []
    if len(named := [name for name in names if name]) > len({*named}) or not named:
        raise ValueError(
            "a line must name the columns, each once, above the numbers; it is"
            f" {separator.join(names)!r}"
        )
    rows = cells[first:]
    ragged = [index for index, (_, row) in enumerate(rows, 1) if len(row) != len(names)]
    complete = [row for _, row in rows if len(row) == len(names)]
    columns = (
        dict(zip(names, zip(*complete, strict=True), strict=True))
        if complete
        else dict.fromkeys(names, ())
    )
    line_numbers = [number for number, row in rows if len(row) == len(names)]
    return Table(
        columns, {}, ragged, line_numbers, dict(zip(names, units, strict=False)), separator != ","
    )


def _is_filled(row: Sequence[str]) -> bool:
    """Return True if most cells of a row are numbers, or if all cells mark missing values."""
    num_missing, num_numbers = sum(cell.lower() in ("", "null", "none", "na") for cell in row), 0
    for cell in row:
        try:
            for number in _split_list(cell) or [cell.replace(",", ".")]:
                float(number)
            num_numbers += 1
        except ValueError:
            num_numbers += bool(STAMP.match(cell))
    return num_missing == len(row) or 2 * num_numbers > len(row) - num_missing


def _json(content: Content) -> Table:
    """Convert parsed JSON, which is a list of rows or an object."""
    fields = content if isinstance(content, dict) else {"": content}
    constants = {
        name: float(value) for name, value in fields.items() if isinstance(value, int | float)
    }
    lists = {name: value for name, value in fields.items() if isinstance(value, list) and value}
    tables = [values for values in lists.values() if isinstance(values[0], dict)]
    if len(tables) == 1 and all(isinstance(row, dict) for row in tables[0]):
        names = dict.fromkeys(name for row in tables[0] for name in row)
        columns = {name: [row.get(name) for row in tables[0]] for name in names}
        return Table(columns, constants, [], entries=_entry_names(content))
    if (
        isinstance(content, dict)
        and not tables
        and lists
        and len({len(values) for values in lists.values()}) == 1
    ):
        return Table(lists, constants, [], entries=_entry_names(content))
    raise ValueError(
        "JSON must be a list of rows, an object with one such list and other numbers, or an"
        " object of columns of the same length"
    )
