"""`codrl-mj runs`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.runs.summaries import SORT_KEYS


@dataclasses.dataclass(frozen=True)
class Runs:
    """List the runs of a folder, or compare some: what differs in their settings, and what they came to.

    Example: codrl-mj runs runs --sort return, or codrl-mj runs --compare runs/one runs/other
    """

    root: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="Folder to look in, with its subfolders.")] = Path(
        "runs"
    )
    sort: Literal[SORT_KEYS] = "name"  # type: ignore[valid-type]
    """Order of the list: names from A, numbers and times from the highest."""
    compare: tuple[Path, ...] = ()
    """Two or more run folders to compare instead of listing."""
    out: Path | None = None
    """JSON file for the list or the comparison."""

    def run(self) -> int:
        """List or compare."""
        from codrl_mj.cli.tables import comparison_tables, run_table
        from codrl_mj.cli.terminal import console, say
        from codrl_mj.runs.files import write_json
        from codrl_mj.runs.summaries import compare, find_runs, read_run, sort_runs

        content: Any
        if self.compare:
            comparison = compare([read_run(path, str(path)) for path in self.compare])
            for table in comparison_tables(comparison):
                console().print(table)
            content = comparison.as_mapping()
        else:
            runs = sort_runs(find_runs(self.root), self.sort)
            console().print(run_table(runs))
            for run in runs:
                say("" if run.problem is None else f"{run.name}: damaged: {run.problem}", style="red")
            content = [run.as_mapping() for run in runs]
        if self.out is not None:
            write_json(self.out, content)
            print(f"wrote {self.out}")
        return 0
