"""`codrl-mj identify compare`: a rig's log beside the simulation under its commands."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.parsing import AsJson


@dataclasses.dataclass(frozen=True)
class CompareLog:
    """Simulate the commands of a rig's log, and hold what is observed then against what the rig did.

    The simulation begins anew at what was observed after each window. An error far below "if nothing changed" says that
    the simulation knows the rig; try --actuator with what identify wrote beside the motor of the training.

    Example: codrl-mj identify compare runs/furuta swing.csv --actuator motor/actuator.yaml --out compared.png
    """

    run_folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="RUN", help="Run folder, or what export wrote of it: the environment of the training."),
    ]
    log: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="LOG.csv", help="What the controller recorded, with columns name:unit."),
    ]
    actuator: str | None = None
    """Actuator in the simulation, by name or file; that of the training unless told otherwise."""
    window: float | None = None
    """Time [s] after which the simulation begins anew; half a second, or ten rows, unless told otherwise."""
    out: Path | None = None
    """PNG file for curves of what was observed and simulated."""
    trust: bool = False
    """Import the modules of a run's own task or actuator, which executes them."""
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Compare, print a table, draw."""
        from codrl_mj.cli.terminal import print_table, say
        from codrl_mj.deploy import Contract, compare
        from codrl_mj.deploy.contract import FILE
        from codrl_mj.envs.config import EnvConfig
        from codrl_mj.training.folder import load_config

        if self.out is not None and self.out.suffix != ".png":
            raise ValueError(f"--out {self.out}: the suffix must be .png")
        exported = (self.run_folder / FILE).is_file()
        env = (
            EnvConfig.from_mapping(Contract.read(self.run_folder).assumed)
            if exported
            else load_config(self.run_folder, self.trust).env
        )
        found = compare(env, self.log, self.window, self.actuator)
        columns = list(zip(found.names, found.units, found.errors.tolist(), found.moved.tolist(), strict=True))
        title = f"{self.log.name} through {self.actuator or env.through}: {len(found.starts)} windows"
        rows = [(name, unit or "?", f"{error:.3g}", f"{moved:.3g}") for name, unit, error, moved in columns]
        heads = "", "unit", "error (RMS)", "if nothing changed"
        print_table(title, heads, rows, right=heads[2:])
        if self.out is not None:
            _draw(found, self.out)
            say(f"wrote {self.out}")
        keys = ("name", "unit", "error", "if_nothing_changed")
        return 0, [dict(zip(keys, row, strict=True)) for row in columns]


def _draw(found: Any, out: Path) -> None:
    """Logged and simulated curves of every entry, cut where the simulation begins anew."""
    import numpy as np

    from codrl_mj.pages.plots import Curve, Plot, save

    cut = found.simulated.copy()
    cut[found.starts[1:] - 1] = np.nan
    save(
        [
            Plot(
                name,
                "time [s]",
                f"{name} [{unit or '?'}]",
                (
                    Curve("on the rig", found.time, found.logged[:, place], reference=True),
                    Curve("simulated", found.time, cut[:, place]),
                ),
            )
            for place, (name, unit) in enumerate(zip(found.names, found.units, strict=True))
        ],
        out,
    )
