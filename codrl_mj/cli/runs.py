"""`codrl-mj runs`, `data` and `cache`: run folders, published logs, and compiled code on disk."""

import dataclasses
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import RenderableType
from rich.text import Text

from codrl_mj import compile_cache
from codrl_mj.boundary import Json
from codrl_mj.cli.parsing import AsJson, Output
from codrl_mj.cli.terminal import console, format_number, print_table, print_text
from codrl_mj.runs import summaries
from codrl_mj.runs.files import write_json
from codrl_mj.runs.summaries import SORT_KEYS, Comparison, RunSummary


@dataclasses.dataclass(frozen=True)
class Runs:
    """List the runs of a folder, or compare the differing settings and the results of some runs.

    Example: codrl-mj runs runs --sort return, or codrl-mj runs --compare runs/one runs/other
    """

    root: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(help="Folder to search, with its subfolders.")
    ] = Path("runs")
    sort: Literal[SORT_KEYS] = "name"  # type: ignore[valid-type]
    """Order of the list: names from A to Z, numbers and times descending."""
    compare: tuple[Path, ...] = ()
    """Two or more run folders to compare instead of listing."""
    out: Path | None = None
    """JSON file for the list or the comparison."""
    as_json: AsJson = False

    def run(self) -> Output:
        """List or compare runs."""
        content: dict[str, Json]
        if self.compare:
            comparison = summaries.compare(
                [summaries.read_run(path, str(path)) for path in self.compare]
            )
            _print_comparison(comparison)
            content = vars(comparison)
        else:
            runs = summaries.sort_runs(summaries.find_runs(self.root), self.sort)
            _print_runs(runs)
            units = {"mean_return": "reward", "evaluation_return": "reward", "seconds": "s"}
            content = {"units": units, "runs": [run.as_mapping() for run in runs]}
        if self.out is not None:
            write_json(self.out, content)
            print(f"wrote {self.out}")
        return 0, content


_STATES = {"finished": "green", "unfinished": "yellow", "damaged": "red"}
_RIGHT_COLUMNS = "seed", "steps", "state", "training\nreturn", "evaluated\nreturn", "modified"


def _print_runs(runs: Sequence[RunSummary]) -> None:
    """Print a row for each run, and the problems of damaged runs."""
    rows: list[tuple[RenderableType, ...]] = []
    for run in runs:
        known = map(format_number, (run.task, run.agent, run.actuator, run.seed))
        returns = [
            "–" if value is None else f"{value:.1f}"
            for value in (run.mean_return, run.evaluation_return)
        ]
        steps = "–" if run.steps is None else f"{run.steps:,}"
        if run.steps is not None and run.total_steps and run.state == "unfinished":
            steps += f" ({run.steps / run.total_steps:.0%})"
        time = (
            "–"
            if run.modified is None
            else f"{datetime.datetime.fromtimestamp(run.modified):%m-%d %H:%M}"
        )
        rows.append((run.name, *known, steps, Text(run.state, _STATES[run.state]), *returns, time))
    columns: tuple[str, ...] = ("run", "task", "agent", "actuator", *_RIGHT_COLUMNS)
    # A narrow terminal has no room for the seed, which most names of runs contain, and the time.
    if console().width < 100:
        rows = [(*row[:4], *row[5:-1]) for row in rows]
        columns = tuple(name for name in columns if name not in ("seed", "modified"))
    title = f"{len(runs)} run{'' if len(runs) == 1 else 's'}"
    print_table(title, columns, rows, right=_RIGHT_COLUMNS, whole=columns[1:], padding=(0, 0))
    print_text(
        *(f"{run.name}: damaged: {run.problem}" for run in runs if run.problem is not None),
        style="red",
    )


def _print_comparison(comparison: Comparison) -> None:
    """Print differing settings and results, with as many columns of runs as fit at a time."""
    runs_per_table = 3 if console().width >= 100 else 2
    for first in range(0, len(comparison.names), runs_per_table):
        chunk = slice(first, first + runs_per_table)
        names = comparison.names[chunk]
        for title, content in (
            ("settings that differ", comparison.configuration),
            ("results", comparison.results),
        ):
            if content:
                units = comparison.units if title == "results" else {}
                rows = [
                    (name, units.get(name, ""), *map(format_number, values[chunk]))
                    for name, values in content.items()
                ]
                print_table(title, ("", "unit" if units else "", *names), rows, right=names)


@dataclasses.dataclass(frozen=True)
class Data:
    """List published measurements of real motors, or download a data set (docs/identify.md).

    codrl_mj does not contain the data: files are downloaded from the authors' sites and checked by
    their digests.

    Example: codrl-mj data dfki_pendulum
    """

    name: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(
            metavar="NAME", help="Data set to download; without a name, all data sets are listed."
        ),
    ] = None
    out: Path = Path("data")
    """Folder in which bench_logs/NAME is created."""

    def run(self) -> int:
        """List the data sets, or download one."""
        from codrl_mj.identify.published import fetch, published_datasets

        if self.name is None:
            rows = [
                (name, entry["title"], entry["licence"])
                for name, entry in published_datasets().items()
            ]
            print_table("", ("name", "motor and rig", "licence"), rows)
            print(
                "\n".join(
                    f"{name}: {entry['source']}" for name, entry in published_datasets().items()
                )
            )
            return 0
        files = fetch(self.name, self.out)
        for file in files:
            print(file)
        data_set = published_datasets()[self.name]
        print_text(
            f"{data_set['licence']}, {data_set['source']} at {data_set['commit'][:10]}; columns:"
            f" {data_set['columns']}"
        )
        return 0


@dataclasses.dataclass(frozen=True)
class Cache:
    """Show or clear the cache of compiled code, which saves seconds in each process.

    CODRL_MJ_CACHE names another folder; CODRL_MJ_CACHE=off disables the cache. Outdated code is
    never used, so you need not clear the cache (docs/engine.md).

    Example: codrl-mj cache --clear
    """

    clear: Annotated[
        bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="Delete the cached files.")
    ] = False

    def run(self) -> int:
        """Show or clear the cache."""
        folder = compile_cache.cache_folder()
        if folder is None:
            print("off: disabled by CODRL_MJ_CACHE")
            return 0
        files = [*folder.glob("*.code")]
        size = sum(file.stat().st_size for file in files) / 1e6
        content = (
            f"{len(files)} file{'' if len(files) == 1 else 's'}, {size:.1f} MB"
            if files
            else "empty"
        )
        if self.clear:
            for file in files:
                file.unlink(missing_ok=True)
        print(
            f"{folder}: {content}"
            + (
                ", cleared"
                if self.clear and files
                else f"; at most {compile_cache.MAX_BYTES / 1e6:.0f} MB"
            )
        )
        return 0
