"""`codrl-mj data`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class Data:
    """List measurements of real motors that others have published, or fetch one of the sets: docs/identify.md.

    Nothing of them comes with codrl_mj: files are fetched from where their authors have them, and checked by digest.

    Example: codrl-mj data dfki_pendulum
    """

    name: Annotated[
        tyro.conf.Positional[str | None], tyro.conf.arg(metavar="NAME", help="The set to fetch; lists them without it.")
    ] = None
    out: Path = Path("data")
    """Folder that gets bench_logs/NAME."""

    def run(self) -> int:
        """List, or fetch."""
        from codrl_mj.cli.terminal import print_table, say
        from codrl_mj.identify.published import fetch, published

        if self.name is None:
            rows = [(name, one["title"], one["licence"], one["source"]) for name, one in published().items()]
            print_table("", ("name", "motor and rig", "licence", "source"), rows)
            return 0
        files = fetch(self.name, self.out)
        for file in files:
            print(file)
        known = published()[self.name]
        say(f"{known['licence']}, {known['source']} at {known['commit'][:10]}; columns: {known['columns']}")
        return 0
