"""Trains and tests what is missing, and gathers what there is: from run folders alone, whoever computed them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.runs.files import read_json
from codrl_mj.study.grid import Deployment, cell_folder, check_chosen, deploy_cells, read_failure, train_cells
from codrl_mj.study.parallel import Workers
from codrl_mj.study.reproduction.arms import TASKS, Arm, arms_of
from codrl_mj.study.reproduction.claims import Claim, Evidence, claims_of
from codrl_mj.study.reproduction.series import Series, Trained, read_trained
from codrl_mj.study.reproduction.value_iteration import DISCOUNTS, Grid, Model, Optimum, optimum, values_over
from codrl_mj.study.reproduction.value_iteration import TASK as VALUE_TASK
from codrl_mj.study.reproduction.verdicts import Verdict
from codrl_mj.training import TrainConfig, finished
from codrl_mj.training.folder import RESULT

VALUE_DISCOUNTS = tuple(1 - 0.2 * 0.8**step for step in range(24))
"""Discount factors of the curve of values, from 0.8 to 0.999."""


@dataclasses.dataclass(frozen=True)
class Reproduction:
    """What is to be done again, and where.

    Raises:
        ValueError: an unknown task (the nearest known one is suggested), or a number below 1.
    """

    root: Path = Path("runs/paper")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = TASKS
    """Tasks."""
    seeds: int = 5
    """Runs of every arm, >= 1, with seeds from 0."""
    sarsa_seeds: int = 30
    """Runs of every arm of SARSA, >= 1, which takes seconds."""
    episodes: int | None = None
    """Training episodes, >= 1, for trying things out; None: the paper's budgets."""
    test_episodes: int = 100
    """Test episodes of every policy, >= 1."""
    grid: Grid = Grid()
    """Of value iteration."""

    def __post_init__(self) -> None:
        """Validate."""
        check_chosen("tasks", self.tasks, TASKS)
        for name in ("seeds", "sarsa_seeds", "test_episodes", "episodes"):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if (not whole or value < 1) and not (name == "episodes" and value is None):
                raise ValueError(f"{name} = {value!r}: must be an integer >= 1")

    @property
    def arms(self) -> list[Arm]:
        """The arms."""
        return arms_of(self.tasks)

    def seeds_of(self, arm: Arm) -> range:
        """The seeds of an arm."""
        return range(self.sarsa_seeds if arm.agent == "sarsa" else self.seeds)

    def cells(self) -> dict[tuple[str, int], TrainConfig]:
        """The trainings by arm and seed: all arms' first seeds first, and of each seed the longest first."""
        every = [(arm, seed) for arm in self.arms for seed in self.seeds_of(arm)]
        every.sort(key=lambda cell: (cell[1], -cell[0].seconds))
        return {(arm.name, seed): arm.config(seed, self.episodes) for arm, seed in every}

    def folders(self) -> dict[tuple[str, int], Path]:
        """The run folders by arm and seed."""
        return {cell: cell_folder(self.root, config) for cell, config in self.cells().items()}

    def deployments(self, unfinished: bool = False) -> dict[tuple[str, int, str], Deployment]:
        """The tests of finished runs by arm, seed and name; with `unfinished`, of all runs."""
        arms = {arm.name: arm for arm in self.arms}
        return {
            (name, seed, test): deployment
            for (name, seed), folder in self.folders().items()
            if unfinished or finished(folder)
            for test, deployment in arms[name].deployments(folder, self.test_episodes).items()
        }


@dataclasses.dataclass(frozen=True)
class Findings:
    """What there is, and what it says."""

    plan: Reproduction
    """What was to be done."""
    evidence: Evidence
    """All that is judged by."""
    claims: Sequence[tuple[Claim, Verdict]]
    """Every claim and its verdict."""
    values: Mapping[float, float]
    """Discount factor -> value of the start of the continuous mountain car; empty without that task."""


def compute(
    plan: Reproduction,
    workers: Workers = Workers(),  # noqa: B008 - frozen
    accept_changes: bool = False,
    on_cell: Callable[[str], None] | None = None,
) -> None:
    """Train and test what is missing; what fails is recorded in the root and does not stop the rest.

    Args:
        plan: what to do.
        workers: what computes it.
        accept_changes: continue begun runs even if code or packages have changed since.
        on_cell: called with `training` or `test` when one is finished or has failed.

    Raises:
        ValueError: Ray is asked for and not installed.
        TrainingStoppedError: a signal asked to stop.
    """
    report = on_cell or (lambda _: None)
    named = {f"{arm}, seed {seed}": config for (arm, seed), config in plan.cells().items()}
    train_cells(named, plan.root, workers, accept_changes, lambda _: report("training"))
    tests = {", ".join(map(str, key)): deployment for key, deployment in plan.deployments().items()}
    deploy_cells(tests, workers, lambda _: report("test"))


def gather(plan: Reproduction) -> Findings:
    """Read what is finished, and judge every claim by it; runs nothing but value iteration.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    folders = plan.folders()
    series = {arm.name: _series(plan, arm, folders) for arm in plan.arms}
    optima, values = _value_iteration(plan.grid) if VALUE_TASK in plan.tasks else ([], {})
    evidence = Evidence(series, optima)
    return Findings(plan, evidence, [(claim, claim.judge(evidence)) for claim in claims_of(plan.tasks)], values)


def _series(plan: Reproduction, arm: Arm, folders: Mapping[tuple[str, int], Path]) -> Series:
    """The runs of an arm that are finished and tested."""
    runs: dict[int, Trained] = {}
    failures: dict[int, str] = {}
    for seed in plan.seeds_of(arm):
        folder = folders[arm.name, seed]
        tests = arm.deployments(folder, plan.test_episodes)
        if finished(folder) and all(test.record.is_file() for test in tests.values()):
            runs[seed] = read_trained(
                folder, {name: read_json(test.record, "evaluation") for name, test in tests.items()}
            )
            continue
        cells: list[Path | Deployment] = [folder, *tests.values()]
        if failed := [failure for failure in map(read_failure, cells) if failure is not None]:
            failures[seed] = failed[0].error
    return Series(arm, runs, tuple(seed for seed in plan.seeds_of(arm) if seed not in runs), failures)


def _value_iteration(grid: Grid) -> tuple[list[Optimum], dict[float, float]]:
    """The best policies, and values over discount factors."""
    model = Model(grid)
    values = values_over(model, VALUE_DISCOUNTS)
    return [optimum(model, discount) for discount in DISCOUNTS], dict(zip(VALUE_DISCOUNTS, values, strict=True))


class Cost(NamedTuple):
    """What an arm takes."""

    arm: Arm
    """The arm."""
    finished: tuple[int, ...]
    """Seeds whose training is finished."""
    missing: tuple[int, ...]
    """Seeds whose training is not."""
    seconds: float
    """Computing time of one [s of one core]: the mean of the finished ones, or an estimate."""

    @property
    def left(self) -> float:
        """What is missing takes [s of one core]."""
        return len(self.missing) * self.seconds


def costs(plan: Reproduction) -> list[Cost]:
    """What every arm takes.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    folders = plan.folders()
    found = []
    for arm in plan.arms:
        took = {
            seed: float(read_json(folders[arm.name, seed] / RESULT, "result of a run")["seconds"])
            for seed in plan.seeds_of(arm)
            if finished(folders[arm.name, seed])
        }
        missing = tuple(seed for seed in plan.seeds_of(arm) if seed not in took)
        seconds = float(np.mean(list(took.values()))) if took else arm.seconds
        found.append(Cost(arm, tuple(took), missing, seconds))
    return found
