"""Logs from files: CSV (also .gz), JSON and, where pyarrow is installed, Parquet."""

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

from codrl_mj.identify.columns import Column, parse_columns
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
STAMP = re.compile(r"(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:\d\d")  # seconds since 1970, or since midnight
_SIGN_BITS = {
    **dict.fromkeys(("duty", "voltage", "torque"), ((11, 1000.0), (16, 8192.0))),
    **dict.fromkeys(("current", "velocity"), ((16, 8192.0),)),
}
"""Signal -> bits and largest numbers of registers that servos (Feetech's) give a bit for the sign in."""
_MOST_UNUSABLE = 0.2  # share of rows that may be left out as unreadable or out of order


class Table(NamedTuple):
    """What a file holds."""

    columns: Mapping[str, Any]  # texts or numbers, each of the same length
    constants: Mapping[str, float]
    ragged: list[int]  # rows that are incomplete, from 1
    lines: Sequence[int] = ()  # of the file, of each row
    units: Mapping[str, str] = {}  # by column, where a line states them
    commas: bool = False  # whether a number may have a decimal comma
    entries: Mapping[
        str, list[str]
    ] = {}  # names of the entries of columns that held lists, such as joints

    @property
    def labels(self) -> dict[str, str]:
        """Columns by the names of their entries: action[elbow] -> action[1]."""
        pairs = (
            (name, *pair) for name, entries in self.entries.items() for pair in enumerate(entries)
        )
        return {f"{name}[{entry}]": f"{name}[{place}]" for name, place, entry in pairs}

    def numeric_column(self, name: str) -> np.ndarray:
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
                remedy = (
                    "write a decimal point"
                    if "," in text
                    else "leave such rows out, or map another column"
                )
                where = f"line {self.lines[place]}" if self.lines else f"row {place + 1}"
                raise ValueError(
                    f"column {name} in {where} is {text!r}, must be a number; {remedy}"
                ) from None
        return found


def read_log(path: Path | str, columns: str | Mapping[str, str]) -> Log:
    """A log from a file; what could not be read of it is among the log's findings.

    Rows with missing values, and those whose time does not increase, are left out. Time starts at
    0.

    Args:
        path: .csv, .txt, .dat, .tsv, .json, any of them .gz, or .parquet. CSV has a line of names,
            and a comma, semicolon, tab or blanks between values; lines that begin with # or hold
            one cell are no rows, one without a number under the names is of units. Decimal commas,
            times of day (ISO 8601) and Latin-1 are read. JSON is a list of rows, or an object with
            one such list, such as `entries`, and numbers beside it, which formulas can use, or an
            object of columns. Of a column that holds lists, `column[0]` is the first entry, and
            `column[elbow]` the one of that name: by `features` in the file, or in meta/info.json of
            the data set that the file lies in.
        columns: `signal=formula:unit` separated by commas, or a mapping of signals to
            `formula:unit`. The voltage is what holds from its row to the next, or `mean(formula)`:
            the mean in between. `only=formula` leaves out the rows where it is 0.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of these, lacks a column, has text where a number is needed, or too
            few rows are left.
    """
    path, mapping = Path(path), parse_columns(columns)
    if not path.is_file():
        raise FileNotFoundError(f"no log at {path}")
    try:
        return table_to_log(path.name.removesuffix(".gz").rpartition(".")[0], read_table(path), mapping)
    except (ValueError, UnicodeDecodeError, gzip.BadGzipFile, EOFError) as error:
        raise ValueError(f"log {path}: {error}") from None


def table_to_log(name: str, table: Table, mapping: Mapping[str, Column]) -> Log:
    """Return the log that a file's columns are by a mapping, as `read_log` does."""
    count = len(next(iter(table.columns.values()), ()))
    numbers = np.setdiff1d(
        np.arange(1, count + len(table.ragged) + 1), table.ragged
    )  # of the rows, in the file
    labels = table.labels
    used = set().union(*(one.names for one in mapping.values()))
    needed = {labels.get(name, name) for name in used} & table.columns.keys()
    read = {
        **dict.fromkeys(table.columns),
        **table.constants,
        **{one: table.numeric_column(one) for one in needed},
    }
    read |= {label: read[column] for label, column in labels.items() if column in read}
    signals = {
        one: np.broadcast_to(np.asarray(made.evaluate(read), float), (count,))
        for one, made in mapping.items()
    }
    time, wanted = signals.pop("time"), signals.pop("only", np.ones(count)) != 0.0
    finite = np.isfinite(time) & np.all(
        [np.isfinite(values) for values in signals.values()], axis=0
    )
    rows = np.flatnonzero(wanted & finite)
    forward = time[rows] > np.append(-np.inf, np.maximum.accumulate(time[rows])[:-1])
    findings = [
        *_unsigned(read, mapping, numbers),
        *_left_out(
            numbers[wanted & ~finite], "missing", "have no number in some column, and are left out"
        ),
        *_left_out(
            numbers[rows[~forward]],
            "stamps",
            "have a time that is not after the rows before, and are left out",
        ),
        *(
            Finding(
                "info",
                "units",
                None,
                f"{one.text}: no unit is given, taken as {SIGNALS[one.signal]}",
                "",
            )
            for one in mapping.values()
            if one.unit is None and SIGNALS.get(one.signal)
        ),
        *_left_out(
            np.array(table.ragged),
            "missing",
            "have not as many cells as there are columns, and are left out",
        ),
    ]
    unusable = int((wanted & ~finite).sum() + (~forward).sum())
    rows = rows[forward]
    if rows.size < 2 or unusable > _MOST_UNUSABLE * max(int(wanted.sum()), 1):
        raise ValueError(
            f"{rows.size} of {int(wanted.sum())} rows can be used, must be 2 or more, and"
            f" {1.0 - _MOST_UNUSABLE:.0%}: "
            + (
                "; ".join(one.message for one in findings if one.severity != "info")
                or "there are no more"
            )
            + "; check the columns"
        )
    kept = {signal: np.ascontiguousarray(values[rows]) for signal, values in signals.items()}
    resolution = {signal: find_resolution(values) for signal, values in kept.items()}
    mean = "voltage" in mapping and mapping["voltage"].mean
    return Log(
        name,
        time[rows] - time[rows[0]],
        kept,
        resolution,
        mean,
        table.constants,
        numbers[rows],
        tuple(findings),
    )


def _unsigned(
    values: Mapping[str, Any], mapping: Mapping[str, Column], numbers: np.ndarray
) -> Iterator[Finding]:
    """Find columns that look like registers whose sign is read as part of the number."""
    unsigned = (
        one
        for one in mapping.values()
        if not re.search("twos_complement|sign_magnitude", one.formula)
    )
    for name, signal in sorted({(name, one.signal) for one in unsigned for name in one.names}):
        column = np.asarray(values[name] if values[name] is not None else 0.0, float)
        for bits in (8, 16, 32):
            whole = 2.0**bits
            high, low = column >= 0.75 * whole, column < 0.25 * whole
            within = (
                (column >= 0.0) & (column < whole) & (column == np.round(column)) & (high | low)
            )
            if high.any() and low.any() and np.all(within | np.isnan(column)):
                row = int(numbers[np.flatnonzero(high)[0]])
                text = (
                    f"{name} is below {whole / 4:.0f} or above {3 * whole / 4:.0f}: has it {bits}"
                    " bits and a sign?"
                )
                yield Finding(
                    "error", "register", row, text, f"write twos_complement({name}, {bits})"
                )
        for bits, largest in _SIGN_BITS.get(signal, ()):
            half = 2.0 ** (bits - 1)
            high, low = (
                (column >= half) & (column <= half + largest),
                (column >= 0.0) & (column <= largest),
            )
            within = (column == np.round(column)) & (high | low)
            # a signal that changes its sign passes near 0 on both sides
            near = [
                column[one].min() - less <= 0.25 * largest
                for one, less in ((high, half), (low, 0.0))
                if one.any()
            ]
            if len(near) == 2 and all(near) and np.all(within | np.isnan(column)):
                row = int(numbers[np.flatnonzero(high)[0]])
                text = (
                    f"{name} is at most {largest:.0f}, or {half:.0f} and more: is its bit"
                    f" {bits - 1} the sign?"
                )
                yield Finding(
                    "error", "register", row, text, f"write sign_magnitude({name}, {bits})"
                )


def _left_out(rows: np.ndarray, check: str, what: str) -> Iterator[Finding]:
    """What is said of rows, by their numbers in the file, from 1."""
    if rows.size:
        text = f"{rows.size} row{'s' if rows.size > 1 else ''}, the first one {rows[0]}, {what}"
        remedy = (
            "find out why the logger wrote them; sort the file, or cut it, if its clock was set"
            " back"
        )
        severity, remedy = ("error", remedy) if check == "stamps" else ("warning", "")
        yield Finding(severity, check, int(rows[0]), text, remedy)


def read_table(path: Path) -> Table:
    """Return a file's columns, a list's as one column an entry; see `read_log`, which says which files are read."""
    table = _read_table(path)
    columns: dict[str, Any] = {}
    for name, values in table.columns.items():
        lists = (
            [_as_list(value) for value in values]
            if any(_as_list(value) for value in values[:20])
            else []
        )
        for entry in range(max((len(one) for one in lists if one), default=0)):
            columns[f"{name}[{entry}]"] = [
                one[entry] if one and entry < len(one) else None for one in lists
            ]
        if not lists:
            columns[name] = values
    if len(columns) > len(table.columns) and not table.entries:
        for folder in [*path.absolute().parents][:3]:
            if (info := folder / "meta" / "info.json").is_file():
                table = table._replace(
                    entries=_entry_names(json.loads(info.read_text(encoding="utf-8")))
                )
                break
    return table._replace(columns=columns)


def _as_list(value: Any) -> list[Any] | None:
    """Return a cell's list, also from a text such as `[0.1 2]`; None if it holds none."""
    if isinstance(value, str) and value[:1] == "[" and value[-1:] == "]":
        return value.strip("[]").replace(",", " ").split()
    return (
        value
        if isinstance(value, list) and not any(isinstance(one, list | dict) for one in value)
        else None
    )


def _entry_names(content: Any) -> dict[str, list[str]]:
    """Return the names of the entries of list columns, from the `features` of a parsed file; empty without them."""
    features = content.get("features") if isinstance(content, dict) else None
    found = {}
    for name, feature in features.items() if isinstance(features, dict) else ():
        names = feature.get("names") if isinstance(feature, dict) else None
        # Some files list the names under the kind of entry, as {"motors": [...]}.
        names = next(iter(names.values()), None) if isinstance(names, dict) else names
        if isinstance(names, list):
            found[name] = [*map(str, names)]
    return found


def _read_table(path: Path) -> Table:
    """Return a file's columns as they stand there."""
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
    except UnicodeDecodeError:
        text = content.decode("latin-1")  # what instruments write for degrees and ohms
    return _json(json.loads(text)) if kind == ".json" else _csv(text)


def _csv(text: str) -> Table:
    """A table after whatever comments: names are in the last line before the numbers, or above units."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    bare = [(number, line) for number, line in lines if not line.startswith("#")]
    last = [line for _, line in bare[-20:]]
    usual = [one for one in ";\t," if 2 * sum(one in line for line in last) > len(last)]
    separator = next(
        (one for _, line in bare for one in usual if one in line), " "
    )  # the names' own, not a note's
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
            raise ValueError(f"line {number} is no row of cells: {error}") from None
        cells.append((number, [cell.strip() for cell in row]))
    common = (
        collections.Counter(len(row) for _, row in cells[-20:]).most_common(1)[0][0] if cells else 0
    )
    filled = (
        place for place, (_, row) in enumerate(cells) if len(row) == common and _is_filled(row)
    )
    first = next(filled, len(cells))
    above = [row for _, row in cells[:first] if len(row) > 1 or separator == " "]
    if first == 0 or not above:  # names behind a #, as numpy writes them
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
        and all(len(one) < 12 for one in above[-1])
    ):
        units = above.pop()
    names = above[-1] if above else []
    if len(named := [one for one in names if one]) > len({*named}) or not named:
        raise ValueError(
            "a line must name the columns, each once, above the numbers; it is"
            f" {separator.join(names)!r}"
        )
    rows = cells[first:]
    ragged = [place for place, (_, row) in enumerate(rows, 1) if len(row) != len(names)]
    whole = [row for _, row in rows if len(row) == len(names)]
    columns = (
        dict(zip(names, zip(*whole, strict=True), strict=True))
        if whole
        else dict.fromkeys(names, ())
    )
    kept = [number for number, row in rows if len(row) == len(names)]
    return Table(columns, {}, ragged, kept, dict(zip(names, units, strict=False)), separator != ",")


def _is_filled(row: Sequence[str]) -> bool:
    """Whether a row is one of the table's: numbers for the most part, or nothing but what stands for a missing one."""
    missing, numbers = sum(cell.lower() in ("", "null", "none", "na") for cell in row), 0
    for cell in row:
        try:
            for one in _as_list(cell) or [cell.replace(",", ".")]:
                float(one)
            numbers += 1
        except ValueError:
            numbers += bool(STAMP.match(cell))
    return missing == len(row) or 2 * numbers > len(row) - missing


def _json(content: Any) -> Table:
    given = content if isinstance(content, dict) else {"": content}
    constants = {name: float(one) for name, one in given.items() if isinstance(one, int | float)}
    lists = {name: one for name, one in given.items() if isinstance(one, list) and one}
    tables = [one for one in lists.values() if isinstance(one[0], dict)]
    if len(tables) == 1 and all(isinstance(row, dict) for row in tables[0]):
        names = dict.fromkeys(name for row in tables[0] for name in row)
        columns = {name: [row.get(name) for row in tables[0]] for name in names}
        return Table(columns, constants, [], entries=_entry_names(content))
    if (
        isinstance(content, dict)
        and not tables
        and lists
        and len({len(one) for one in lists.values()}) == 1
    ):
        return Table(lists, constants, [], entries=_entry_names(content))
    raise ValueError(
        "JSON must be a list of rows, an object with one such list and numbers beside it, or an"
        " object of columns of the same length"
    )
