"""Ablation of the five repairs with which DDPG learns the continuous Mountain Car.

docs/results/repairs_plan.md has the arms and the rule, and was written before the first run.

Example: python scripts/study_repairs.py --dry-run, or --only-page to judge the existing rows
"""

import dataclasses
import functools
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
from codrl_mj.fields import integer
from codrl_mj.study.inference import Stratum, effect
from codrl_mj.study.pages import markdown_table, write_csv, write_page
from codrl_mj.study.program import Program, main
from codrl_mj.study.trials import Grid
from reproduction.arms import ARMS, PaperArm
from reproduction.findings import arm_rows
from reproduction.page import FOLDER as REPRODUCTION
from reproduction.rows import RUNS, Row, identity, read_rows, read_trained

TASK, MOTOR = "mountain_car_continuous", "paper gains"
REPAIRS: Mapping[str, Sequence[str]] = {
    "discount": ("gamma",),
    "learning rates": ("learning_rate", "critic_learning_rate"),
    "targets": ("tau",),
    "velocity scale": ("input_scale",),
    "noise": ("noise_sigma", "noise_dt"),
}
"""Repair -> settings of the agent that it changes."""
MARGIN = 5.0
"""Difference of returns that does not matter, as for "about 95" in the reproduction."""
CONFIDENCE = 1.0 - 0.05 / len(REPAIRS)
"""Level of an interval; all of them hold together with 95 % (Bonferroni)."""
LEARNS = 0.95
"""Smallest success rate in test of a training that learns."""
NEEDED, NOT_NEEDED, OPEN, NOT_JUDGED = "needed", "not needed", "open", "not judged"
PAGE, FOLDER, MIN_SEEDS = "repairs.md", "repairs", 2


@functools.cache
def reference(settings: str) -> PaperArm:
    """Return the reproduction's arm with all repairs (`repaired`) or with none (`paper`)."""
    (arm,) = (arm for arm in ARMS if (arm.task, arm.settings, arm.motor) == (TASK, settings, MOTOR))
    return arm


@functools.cache
def without(repair: str) -> PaperArm:
    """Return the arm with all repairs but one, which has the printed settings instead."""
    repaired, printed = reference("repaired"), reference("paper").config.agent
    changes = {name: getattr(printed, name) for name in REPAIRS[repair]}
    agent = dataclasses.replace(repaired.config.agent, **changes)
    return dataclasses.replace(
        repaired,
        name=f"{TASK}, without {repair}, {MOTOR}, mujoco",
        config=dataclasses.replace(repaired.config, agent=agent),
        settings=f"without {repair}",
    )


def judge(difference: Interval) -> str:
    """Judge a repair by the interval of the return without it minus that with all repairs."""
    if difference.high < -MARGIN:
        return NEEDED
    return NOT_NEEDED if difference.low >= -MARGIN else OPEN


class Judged(NamedTuple):
    """Results of an arm."""

    name: str
    returns: np.ndarray
    """Mean return in test of every seed, shape (n,)."""
    last: np.ndarray
    """Mean return of the last 50 training episodes, shape (n,)."""
    learning: int
    """Number of trainings that learn."""
    difference: Interval | None
    """Return minus that with all repairs; None for *all*, *none* and too few seeds."""

    @property
    def outcome(self) -> str:
        """Verdict on the repair that is left out."""
        return judge(self.difference) if self.difference else NOT_JUDGED

    def cells(self) -> list[str]:
        """Return the cells of the page's row."""
        text = "–"
        if self.difference:
            text = "{:+.1f} [{:+.1f}, {:+.1f}]".format(*self.difference)
        verdict = f"**{self.outcome}**" if self.name in REPAIRS else "–"
        means = [f"{values.mean():.1f}" if len(values) else "–" for values in self[1:3]]
        learning = f"{self.learning} of {len(self.returns)}"
        return [self.name, *means, learning, text, verdict]


def judge_rows(rows: Mapping[str, Mapping[int, Row]]) -> list[Judged]:
    """Judge every repair by the seeds that all arms have.

    Args:
        rows: arm (`all`, `none`, or the repair that is left out) -> seed -> row.
    """
    seeds = sorted(set.intersection(*(set(by_seed) for by_seed in rows.values())))
    values = {
        name: np.array(
            [
                [float(by_seed[seed][key]) for key in ("returns", "last_50", "success")]
                for seed in seeds
            ]
        ).reshape(-1, 3)
        for name, by_seed in rows.items()
    }
    every = values["all"][:, 0]
    judged = []
    for name, (returns, last, success) in ((name, array.T) for name, array in values.items()):
        difference = None
        if name in REPAIRS and len(seeds) >= MIN_SEEDS:
            difference = effect([Stratum(returns, every, paired=False)], CONFIDENCE)
        judged.append(Judged(name, returns, last, int(np.sum(success >= LEARNS)), difference))
    return judged


@dataclasses.dataclass(frozen=True, kw_only=True)
class RepairsStudy(Program):
    """Run or resume the ablation of the repairs, and write its rows and page.

    Finished results are not computed again: docs/studies.md. Example: python
    scripts/study_repairs.py --dry-run
    """

    root: Path = Path("runs/repairs")
    """Folder of the run folders."""
    test_episodes: int = integer(100, minimum=1)
    """Test episodes of every policy."""

    @property
    def every(self) -> Grid:
        """All trainings and their tests, whether they are published or not."""
        trials = tuple(trial for name in REPAIRS for trial in without(name).trials.values())
        return Grid(self.root, trials, lambda _: range(self.seeds), self.test_episodes)

    @property
    def grid(self) -> Grid:
        """Trainings that are not published, from each arm's first missing seed on."""
        every, published = self.every, self._published()
        seeds = {
            without(name).name: next(
                (n for n in range(self.seeds) if identity(without(name), n) not in published),
                self.seeds,
            )
            for name in REPAIRS
        }
        return dataclasses.replace(every, seeds_of=lambda arm: range(seeds[arm.name], self.seeds))

    def _published(self) -> dict[tuple[str, ...], list[Row]]:
        """Return the published rows by identity."""
        has_rows = (self.out / FOLDER / RUNS).is_file()
        return read_rows(self.out / FOLDER) if has_rows else {}

    def rows(self) -> dict[str, dict[int, Row]]:
        """Return the rows of all arms by name and seed, new ones and published ones."""
        collected = self.every.collect()
        published, before = self._published(), read_rows(self.out / REPRODUCTION)
        rows = {
            name: {
                seed: before[key][-1]
                for seed in range(self.seeds)
                if (key := identity(reference(settings), seed)) in before
            }
            for name, settings in (("all", "repaired"), ("none", "paper"))
        }
        for name in REPAIRS:
            arm = without(name)
            by_seed = arm_rows(arm, read_trained(arm, collected), published)
            rows[name] = {seed: by_seed[seed][-1] for seed in sorted(by_seed)}
        return rows

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write rows and page of all available results; return files and failures."""
        rows, page, table = self.rows(), self.out / PAGE, self.out / FOLDER / RUNS
        judged = judge_rows(rows)
        new = [row for name in REPAIRS for row in rows[name].values()]
        write_csv(table, new)
        hours = sum(float(row["seconds"]) for row in new) / 3600
        header = [
            *("left out", "return in test", "last 50 episodes", "learn", "minus *all* [99 %]"),
            "verdict",
        ]
        write_page(
            page,
            [
                "# Which repairs does the continuous Mountain Car need?\n",
                markdown_table(header, [item.cells() for item in judged]),
                f"{len(judged[0].returns)} seeds of every arm are judged, by the rule of"
                f" [the plan](repairs_plan.md). The {len(new)} trainings took {hours:.1f} hours of"
                " one core.\n",
            ],
        )
        return [page, table], self.every.collect().failures


if __name__ == "__main__":
    sys.exit(main(RepairsStudy))
