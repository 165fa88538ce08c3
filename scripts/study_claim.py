"""Test of the paper's central claim, that training through the actuator improves performance.

docs/results/claim_plan.md has the hypotheses and the rules, and was written before the first run.

Example: python scripts/study_claim.py --dry-run, or --only-page to judge the existing rows
"""

import collections
import dataclasses
import functools
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL, DCMotorActuator
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import integer
from codrl_mj.runs.files import write_json
from codrl_mj.study.axes import FLOORS
from codrl_mj.study.grid import check_selection
from codrl_mj.study.pages import TITLES, markdown_table, write_csv, write_page
from codrl_mj.study.program import Program, main
from codrl_mj.study.questions import (
    ComparisonVerdict,
    Contrast,
    Scores,
    TrialComparison,
    judge_comparisons,
)
from codrl_mj.study.trials import FAILURE_MARGIN, RUNS, TOTALS, Arm, Grid, StudyResults, Trial
from codrl_mj.study.trials import run_rows as study_rows
from codrl_mj.tasks import find_task
from reproduction.arms import ARMS, CENTRE, TEST, PaperArm

SETTINGS: Mapping[str, str] = {
    "pendulum": "repaired",
    "cartpole": "paper",
    "acrobot": "paper",
    "mountain_car": "paper",
    "mountain_car_continuous": "repaired",
}
"""Task -> settings of the agent: the printed ones, or repaired ones where those do not learn."""
VOLTAGES = (24.0, 12.0, 5.0)
"""Supplies of the tests [V]; the first is that of the trainings."""
LOW_VOLTAGE_TASKS = ("mountain_car", "mountain_car_continuous")
"""Tasks whose motor stays below the lowest supply, so that all supplies are the same test."""
SEEDS_FACTOR = {"mountain_car": 5}
"""Task -> factor of the number of seeds; SARSA's trainings take seconds, and scatter most."""
SECONDS: Mapping[str, float] = {
    "pendulum": 300.0,
    "cartpole": 100.0,
    "acrobot": 75.0,
    "mountain_car": 6.0,
    "mountain_car_continuous": 60.0,
}
"""Task -> approximate time of a training [s of one core]."""
IDEAL_KIND, THROUGH_KIND = "ideal", "through"
PAGE, FOLDER, HYPOTHESES = "claim.md", "claim", "hypotheses.csv"


def paper_arm(task: str, motor: str) -> PaperArm:
    """Return the reproduction's training of a task's agent with a motor."""
    (paper_arm,) = (
        candidate
        for candidate in ARMS
        if (candidate.task, candidate.settings) == (task, SETTINGS[task])
        and (candidate.motor, candidate.physics) == (motor, "mujoco")
    )
    return paper_arm


@functools.cache
def arm(task: str, kind: str) -> Arm:
    """Return the training on ideal forces, or through the paper's motor."""
    trained = paper_arm(task, "ideal" if kind == IDEAL_KIND else "paper gains")
    return Arm(f"{task}: {kind}", trained.config, SECONDS[task])


def motor_at(task: str, volts: float) -> DCMotorActuator:
    """Return a task's motor of the paper on a supply."""
    paper = find_task(task).paper[0]
    return dataclasses.replace(
        paper, controller=dataclasses.replace(paper.controller, max_voltage=volts)
    )


@functools.cache
def evaluation_envs(task: str) -> dict[str, EnvConfig]:
    """Return the environments of the tests by name."""
    paper_trials = paper_arm(task, "ideal").trials
    ideal = paper_trials.get(CENTRE, paper_trials[TEST]).env
    envs = {"ideal": ideal}
    definition = find_task(task)
    # With a motor, three tasks are integrated in smaller steps. This test has the small steps and
    # no motor, and separates the effect of the steps from that of the motor.
    if definition.motor_inner_steps > 1:
        envs["ideal, small steps"] = dataclasses.replace(
            ideal, actuator=IDEAL, inner_steps=definition.motor_inner_steps
        )
    for volts in VOLTAGES:
        envs[f"{volts:g} V"] = dataclasses.replace(ideal, actuator=motor_at(task, volts))
    return envs


def trial(task: str, kind: str, test: str) -> Trial:
    """Return the test of a kind of policies."""
    return Trial(arm(task, kind), test, evaluation_envs(task)[test])


def trials() -> tuple[Trial, ...]:
    """Return all tests of all policies."""
    return tuple(
        trial(task, kind, test)
        for task in SETTINGS
        for kind in (IDEAL_KIND, THROUGH_KIND)
        for test in evaluation_envs(task)
    )


class Cell(NamedTuple):
    """Comparison of both kinds of policies on a task's motor on a supply."""

    task: str
    volts: float

    @property
    def contrast(self) -> Contrast:
        """Policies trained through the motor over ideal-trained ones."""
        test = f"{self.volts:g} V"
        return Contrast(trial(self.task, THROUGH_KIND, test), trial(self.task, IDEAL_KIND, test))

    @property
    def comparison(self) -> TrialComparison:
        """Comparison with its hypotheses of a difference and of equivalence."""
        name = f"{TITLES[self.task]}, {self.volts:g} V"
        return TrialComparison(name, "claim", "training through", self.contrast)


def cells() -> tuple[Cell, ...]:
    """Return the comparisons that are tested, in the order of tasks and then of supplies."""
    return tuple(
        Cell(task, volts)
        for task in SETTINGS
        for volts in (VOLTAGES[:1] if task in LOW_VOLTAGE_TASKS else VOLTAGES)
    )


def conclude(outcomes: Sequence[str]) -> str:
    """Return the verdict on the claim that training through is better in every comparison."""
    if "not judged" in outcomes:
        return "not judged"
    if all(outcome == "better" for outcome in outcomes):
        return "confirmed"
    if any(outcome in ("worse", "equivalent") for outcome in outcomes):
        return "not confirmed"
    return "open"


def conclusion_text(outcomes: Sequence[str]) -> str:
    """Format the verdict on the claim with the number of each verdict."""
    counts = collections.Counter(outcomes)
    return f"**{conclude(outcomes)}** ({', '.join(f'{n} {name}' for name, n in counts.items())})"


def result_table(
    collected: StudyResults, scores: Scores, judged: Sequence[ComparisonVerdict]
) -> str:
    """Return the table of all tests; those that are not compared have no verdict."""
    judged_by_test = {item.comparison.contrast.treatment.name: item for item in judged}
    rows = []
    for task in SETTINGS:
        for test in evaluation_envs(task):
            pair = [trial(task, kind, test) for kind in (IDEAL_KIND, THROUGH_KIND)]
            item = judged_by_test.get(pair[1].name)
            rows.append(
                [
                    *(TITLES[task], test),
                    *(_score_text(list(scores.by_seed(half).values())) for half in pair),
                    *(_mean_text(collected, half, "success", 100.0) for half in pair),
                    *(_mean_text(collected, half, "saturated_percent", 1.0) for half in pair),
                    *(("–",) * 4 if item is None else item.table_cells),
                ]
            )
    pairs = ("score; failed", "success [%]", "saturated steps [%]")
    header = [
        *("task", "test"),
        *(f"{name}, {kind}" for name in pairs for kind in ("ideal-trained", "trained through")),
        *("difference [95 %]", "p, difference", "p, equivalence", "verdict"),
    ]
    return markdown_table(header, rows)


def _score_text(scores: Sequence[float]) -> str:
    """Format a mean score with the number of policies that failed."""
    failed = sum(score < 1.0 - FAILURE_MARGIN for score in scores)
    return f"{np.mean(scores):.3f}; {failed} of {len(scores)}" if scores else "–"


def _mean_text(collected: StudyResults, test: Trial, measure: str, factor: float) -> str:
    """Format the mean of a measure over policies, or a dash without values."""
    values = list(collected.scores(test, measure).values())
    return f"{factor * float(np.mean(values)):.3g}" if values else "–"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClaimStudy(Program):
    """Run or resume the test of the paper's claim, and write its rows and page.

    Finished results are not computed again: docs/studies.md. Example: python scripts/study_claim.py
    --dry-run
    """

    PUBLISH_EACH_TRAINING: ClassVar[bool] = True

    root: Path = Path("runs/claim")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = tuple(SETTINGS)
    """Tasks to compute; the page always has all of them."""
    seeds: int = integer(20, minimum=1)
    """Training runs of every arm, with seeds from 0; mountain_car has five times as many."""
    episodes: int = integer(200, minimum=1)
    """Test episodes of every policy."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_selection("tasks", self.tasks, SETTINGS)

    @property
    def grid(self) -> Grid:
        """Trainings and tests of the study."""
        chosen = tuple(test for test in trials() if test.arm.task in self.tasks)
        return Grid(self.root, chosen, self._seeds, self.episodes, self.out / FOLDER)

    def _seeds(self, training_arm: Arm) -> range:
        return range(self.seeds * SEEDS_FACTOR.get(training_arm.task, 1))

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write rows, verdicts and page of all existing results; return files and failures."""
        collected = dataclasses.replace(self, tasks=tuple(SETTINGS)).grid.collect()
        scores = Scores(collected, FLOORS, [trial(task, IDEAL_KIND, "ideal") for task in SETTINGS])
        judged = judge_comparisons(
            scores, [cell.comparison for cell in cells()], collected.complete
        )
        folder, page = self.out / FOLDER, self.out / PAGE
        write_csv(folder / RUNS, list(study_rows(collected, scores.by_seed)))
        verdicts = [verdict for item in judged for verdict in item[1:]]
        write_csv(folder / HYPOTHESES, [verdict.row(len(verdicts)) for verdict in verdicts])
        write_json(folder / TOTALS, collected.totals._asdict())
        totals, outcomes = collected.totals, [item.outcome for item in judged]
        at_trained_voltage = [
            item.outcome
            for cell, item in zip(cells(), judged, strict=True)
            if cell.volts == VOLTAGES[0]
        ]
        parts = [
            "# Does training through the motor improve the paper's results?\n",
            result_table(collected, scores, judged),
            f"The claim at {VOLTAGES[0]:g} V: {conclusion_text(at_trained_voltage)}."
            f" The claim at all supplies: {conclusion_text(outcomes)}.\n",
            f"The study follows [its plan](claim_plan.md). It has {totals.trainings} trainings"
            f" ({totals.seconds / 3600:.1f} hours of one core); {totals.missing} trainings and"
            " tests are missing.\n",
        ]
        write_page(page, parts)
        return [page, *(folder / name for name in (RUNS, HYPOTHESES, TOTALS))], collected.failures


if __name__ == "__main__":
    sys.exit(main(ClaimStudy))
