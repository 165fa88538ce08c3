"""`codrl-mj runs`, `data` and `cache`: what lies on disk, of trainings, of others, of compiled code."""

import dataclasses
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.text import Text

from codrl_mj import compile_cache
from codrl_mj.cli.parsing import AsJson
from codrl_mj.cli.terminal import console, number, print_table, say
from codrl_mj.runs import summaries
from codrl_mj.runs.files import write_json
from codrl_mj.runs.summaries import SORT_KEYS, Comparison, RunSummary


@dataclasses.dataclass(frozen=True)
class Runs:
    """List the runs of a folder, or compare some: what differs in their settings, and what they came to.

    Example: codrl-mj runs runs --sort return, or codrl-mj runs --compare runs/one runs/other
    """

    root: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(help="Folder to look in, with its subfolders.")
    ] = Path("runs")
    sort: Literal[SORT_KEYS] = "name"  # type: ignore[valid-type]
    """Order of the list: names from A, numbers and times from the highest."""
    compare: tuple[Path, ...] = ()
    """Two or more run folders to compare instead of listing."""
    out: Path | None = None
    """JSON file for the list or the comparison."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """List or compare."""
        content: Any
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
_OF_RUNS = "seed", "steps", "state", "training\nreturn", "evaluated\nreturn", "modified"


def _print_runs(runs: Sequence[RunSummary]) -> None:
    """A row for each run, and what is damaged."""
    rows: list[Any] = []
    for run in runs:
        known = map(number, (run.task, run.agent, run.actuator, run.seed))
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
    columns: tuple[str, ...] = ("run", "task", "agent", "actuator", *_OF_RUNS)
    if console().width < 100:  # without what the names of most runs have, and the time
        rows = [(*row[:4], *row[5:-1]) for row in rows]
        columns = tuple(name for name in columns if name not in ("seed", "modified"))
    title = f"{len(runs)} run{'' if len(runs) == 1 else 's'}"
    print_table(title, columns, rows, right=_OF_RUNS, whole=columns[1:], padding=(0, 0))
    say(
        *(f"{run.name}: damaged: {run.problem}" for run in runs if run.problem is not None),
        style="red",
    )


def _print_comparison(comparison: Comparison) -> None:
    """What differs in the configuration, and the results: a column for each run, as many as fit at a time."""
    some = 3 if console().width >= 100 else 2
    for begin in range(0, len(comparison.names), some):
        chunk = slice(begin, begin + some)
        names = comparison.names[chunk]
        for title, content in (
            ("settings that differ", comparison.configuration),
            ("results", comparison.results),
        ):
            if content:
                units = comparison.units if title == "results" else {}
                rows = [
                    (one, units.get(one, ""), *map(number, values[chunk]))
                    for one, values in content.items()
                ]
                print_table(title, ("", "unit" if units else "", *names), rows, right=names)


@dataclasses.dataclass(frozen=True)
class Data:
    """List measurements of real motors that others have published, or fetch one of the sets: docs/identify.md.

    Nothing of them comes with codrl_mj: files are fetched from where their authors have them, and
    checked by digest.

    Example: codrl-mj data dfki_pendulum
    """

    name: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(metavar="NAME", help="The set to fetch; lists them without it."),
    ] = None
    out: Path = Path("data")
    """Folder that gets bench_logs/NAME."""

    def run(self) -> int:
        """List, or fetch."""
        from codrl_mj.identify.published import fetch, published_datasets

        if self.name is None:
            rows = [
                (name, one["title"], one["licence"]) for name, one in published_datasets().items()
            ]
            print_table("", ("name", "motor and rig", "licence"), rows)
            print(
                "\n".join(f"{name}: {one['source']}" for name, one in published_datasets().items())
            )
            return 0
        files = fetch(self.name, self.out)
        for file in files:
            print(file)
        known = published_datasets()[self.name]
        say(
            f"{known['licence']}, {known['source']} at {known['commit'][:10]}; columns:"
            f" {known['columns']}"
        )
        return 0


@dataclasses.dataclass(frozen=True)
class Cache:
    """Show what compiled code is kept on disk, which saves seconds in every process after the first, or clear it.

    CODRL_MJ_CACHE names another folder; CODRL_MJ_CACHE=off keeps nothing. Code that does not fit
    any more is never used, so that nothing has to be cleared: docs/engine.md.

    Example: codrl-mj cache --clear
    """

    clear: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help="Delete it.")] = False

    def run(self) -> int:
        """Show or clear."""
        place = compile_cache.cache_folder()
        if place is None:
            print("off: CODRL_MJ_CACHE says so")
            return 0
        files = [*place.glob("*.code")]
        size = sum(file.stat().st_size for file in files) / 1e6
        told = (
            f"{len(files)} file{'' if len(files) == 1 else 's'}, {size:.1f} MB"
            if files
            else "empty"
        )
        if self.clear:
            for file in files:
                file.unlink(missing_ok=True)
        print(
            f"{place}: {told}"
            + (
                ", cleared"
                if self.clear and files
                else f"; at most {compile_cache.MAX_BYTES / 1e6:.0f} MB"
            )
        )
        return 0
