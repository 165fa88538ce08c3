"""`codrl-mj report`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class Report:
    """Write a report of a run as one HTML file: learning, evaluation, and an episode with film and plots on one clock.

    Several runs are shown side by side. Unfinished and damaged runs are reported as far as they go.

    Example: codrl-mj report runs/cartpole-ppo-weaker-0 --out balance.html
    """

    runs: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN", help="Run folders.")]
    out: Path = Path("report.html")
    """The page to write, .html."""
    which: Literal["last", "best"] = "last"
    """Whose policy acts in the episode: the last, or that of the best evaluation; of an unfinished run its best."""
    seed: int = 0
    """Seed of the episode."""
    film: bool = True
    """Film the episode."""
    replay: bool = False
    """Show it in three dimensions too, on the same clock: 0.7 MB more."""
    certificate: Path | None = None
    """A certificate.json, or its folder, to be summed up; unless given, that in a run folder, if there is one."""
    trust: bool = False
    """Import the modules that a run folder names as its task, agent or actuator if these are somebody's own, which
    executes them."""

    def run(self) -> int:
        """Write the page."""
        from codrl_mj.cli.terminal import progress_bar
        from codrl_mj.pages.report import replays, report

        with progress_bar("") as bar:
            row = bar.add_task("reading", total=None)
            report(
                self.runs,
                self.out,
                which=self.which,
                seed=self.seed,
                trust=self.trust,
                filmed=self.film,
                joined=replays if self.replay else lambda _: (),
                certificate=self.certificate,
                on_part=lambda what: bar.update(row, description=what),
            )
        print(f"wrote {self.out} ({self.out.stat().st_size / 1e6:.1f} MB)")
        return 0
