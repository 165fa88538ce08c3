"""Ablation of the five repairs with which DDPG learns the continuous Mountain Car.

docs/results/repairs_plan.md has the arms and the rule, and was written before the first run.

Example: python scripts/study_repairs.py --dry-run, or --only-page to judge the existing rows
"""

import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.evaluation.measures import Interval
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
MARGIN, LEARNS, MIN_SEEDS = 5.0, 0.95, 2
"""Return that does not matter; success rate of a training that learns; seeds that are needed."""
CONFIDENCE = 1.0 - 0.05 / len(REPAIRS)
"""Level of an interval; all of them hold together with 95 % (Bonferroni)."""
NEEDED, NOT_NEEDED, OPEN, NOT_JUDGED = "needed", "not needed", "open", "not judged"
PAGE, FOLDER = "repairs.md", "repairs"
_ABOUT = """\
The *repaired* settings of DDPG change five things at once. This study leaves out one repair at a
time. [The plan](repairs_plan.md) has the values and the rule: a repair is *needed* if the return in
test is surely lower without it, by more than 5. A training learns if its policy reaches the goal in
at least 95 of 100 episodes.
"""


def reference(settings: str) -> PaperArm:
    """Return the reproduction's arm with all repairs (`repaired`) or with none (`paper`)."""
    (arm,) = (arm for arm in ARMS if (arm.task, arm.settings, arm.motor) == (TASK, settings, MOTOR))
    return arm


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


class Judged(NamedTuple):
    """Results of an arm; the difference is None for *all*, *none* and with too few seeds."""

    name: str
    values: np.ndarray
    """Return in test, return of the last 50 training episodes, success rate; shape (seeds, 3)."""
    difference: Interval | None
    """Return in test minus that with all repairs."""

    @property
    def outcome(self) -> str:
        """Verdict on the repair that is left out."""
        if self.difference is None:
            return NOT_JUDGED
        open_or_not = NOT_NEEDED if self.difference.low >= -MARGIN else OPEN
        return NEEDED if self.difference.high < -MARGIN else open_or_not

    @property
    def learning(self) -> int:
        """Number of trainings that learn."""
        return int(np.sum(self.values[:, 2] >= LEARNS))

    def cells(self) -> list[str]:
        """Return the cells of the page's row."""
        text = "{:+.1f} [{:+.1f}, {:+.1f}]".format(*self.difference) if self.difference else "–"
        means = [f"{values.mean():.1f}" if len(values) else "–" for values in self.values.T[:2]]
        name, verdict = self.name, "–"
        if self.name in REPAIRS:
            name, verdict = f"all without {self.name}", f"**{self.outcome}**"
        return [name, *means, f"{self.learning} of {len(self.values)}", text, verdict]


def judge_rows(rows: Mapping[str, Mapping[int, Row]]) -> list[Judged]:
    """Judge every repair by the seeds that all arms have.

    Args:
        rows: arm (`all`, `none`, or the repair that is left out) -> seed -> row.
    """
    seeds = sorted(set.intersection(*map(set, rows.values())))
    judged = []
    for name, by_seed in rows.items():
        cells = [[by_seed[n][key] for key in ("returns", "last_50", "success")] for n in seeds]
        values, difference = np.array(cells, float).reshape(-1, 3), None
        if name in REPAIRS and len(seeds) >= MIN_SEEDS:
            every = np.array([float(rows["all"][n]["returns"]) for n in seeds])
            difference = effect([Stratum(values[:, 0], every, paired=False)], CONFIDENCE)
        judged.append(Judged(name, values, difference))
    return judged


@dataclasses.dataclass(frozen=True, kw_only=True)
class RepairsStudy(Program):
    """Run or resume the ablation of the repairs, and write its rows and page: docs/studies.md."""

    root: Path = Path("runs/repairs")
    """Folder of the run folders."""

    @property
    def every(self) -> Grid:
        """All trainings and their tests, whether they are published or not."""
        trials = tuple(trial for name in REPAIRS for trial in without(name).trials.values())
        return Grid(self.root, trials, lambda _: range(self.seeds))

    @property
    def grid(self) -> Grid:
        """Trainings that are not published, from each arm's first missing seed on."""
        published, first = read_rows(self.out / FOLDER), dict[str, int]()
        for arm in map(without, REPAIRS):
            missing = (n for n in range(self.seeds) if identity(arm, n) not in published)
            first[arm.name] = next(missing, self.seeds)
        seeds_of = {name: range(seed, self.seeds) for name, seed in first.items()}
        return dataclasses.replace(self.every, seeds_of=lambda arm: seeds_of[arm.name])

    def rows(self) -> dict[str, dict[int, Row]]:
        """Return the rows of all arms by name and seed, new ones and published ones."""
        collected, rows = self.every.collect(), dict[str, dict[int, Row]]()
        arms = {"all": reference("repaired"), "none": reference("paper")}
        for name, arm in (arms | {name: without(name) for name in REPAIRS}).items():
            before = read_rows(self.out / (FOLDER if name in REPAIRS else REPRODUCTION))
            trained = read_trained(arm, collected) if name in REPAIRS else {}
            by_seed = arm_rows(arm, trained, before)
            rows[name] = {seed: by_seed[seed][-1] for seed in sorted(by_seed)}
        return rows

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write rows and page of all available results; return files and failures."""
        rows, page, table = self.rows(), self.out / PAGE, self.out / FOLDER / RUNS
        judged, new = judge_rows(rows), [row for name in REPAIRS for row in rows[name].values()]
        write_csv(table, new)
        hours = sum(float(row["seconds"]) for row in new) / 3600
        header = ("repairs", "return in test", "last 50 episodes", "learn", "minus *all* [99 %]")
        parts = [
            "# Which repairs does the continuous Mountain Car need?\n",
            _ABOUT,
            markdown_table([*header, "verdict"], [item.cells() for item in judged]),
            f"{len(judged[0].values)} seeds of every arm are judged. The {len(new)} trainings took"
            f" {hours:.1f} hours of one core; {len(self.grid.cells)} are missing.\n",
        ]
        write_page(page, parts)
        return [page, table], self.every.collect().failures


if __name__ == "__main__":
    sys.exit(main(RepairsStudy))
