"""`codrl-mj runs`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.runs import SORT_KEYS


@dataclasses.dataclass(frozen=True)
class Runs:
    """List the runs in a folder, or compare some of them: what differs in their settings, and their results.

    Damaged run folders are listed as such. Example: codrl-mj runs runs --sort return, or
    codrl-mj runs --compare cartpole-ppo-ideal-0 cartpole-ppo-weaker-0
    """

    root: tyro.conf.Positional[Path] = Path("runs")
    """Folder to look for runs in, at any depth."""
    sort: Literal[SORT_KEYS] = "name"  # type: ignore[valid-type]
    """Order: names from A, numbers and times from the highest."""
    compare: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar="RUN RUN ...", help="Runs to compare: names as listed, or their folders."),
    ] = ()
    out: Path | None = None
    """JSON file for the list or the comparison."""

    def run(self) -> int:
        """Read the run folders and print a table."""
        from codrl_mj.runs import compare, find_runs, read_run, sort_runs
        from codrl_mj.terminal import print_comparison, print_runs

        content: Any
        if self.compare:
            places = [self.root / name if (self.root / name).is_dir() else Path(name) for name in self.compare]
            comparison = compare([read_run(place, name) for place, name in zip(places, self.compare, strict=True)])
            print_comparison(comparison)
            content = comparison.as_mapping()
        else:
            runs = sort_runs(find_runs(self.root), self.sort)
            print_runs(runs)
            content = {"runs": [run.as_mapping() for run in runs]}
        if self.out is not None:
            from codrl_mj.files import write_json

            write_json(self.out, content)
            print(f"wrote {self.out}")
        return 0
