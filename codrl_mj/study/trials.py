"""Elements of a study: arms that are trained with many seeds, and trials that test their policies.

A study is defined by its trials. Every training is a run folder named by its configuration, and
every test is a file in it, so available results are never computed twice. Run folders may be
temporary: a published table has a row for every test, with the name of its run, and replaces run
folders that are no longer available.
"""

import collections
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import mapping_of
from codrl_mj.boundary import Json
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.measures import bootstrap_mean
from codrl_mj.runs import RESULT
from codrl_mj.runs.files import read_json
from codrl_mj.study.grid import PolicyTest, cell_folder, read_failure, run_tests, train_runs
from codrl_mj.study.pages import read_csv
from codrl_mj.study.parallel import Workers
from codrl_mj.training import EVALUATION_SEED, TrainConfig, finished

TEST_SECONDS = 1.0
"""Approximate time of a test [s of one core]."""
FAILURE_MARGIN = 0.1
"""A policy counts as failed if its score is lower than 1 by more than this margin."""
RUNS, TOTALS = "runs.csv", "totals.json"
"""Published files of a study: a row for every policy and test; totals of its trainings."""
MEASURES = (
    "success",
    "tracking_percent",
    "saturated_percent",
    "rms_current",
    "peak_current",
    "energy_drawn",
    "copper_loss",
    "mechanical_work",
    "torque_rms",
    "reversals",
)
"""Published measures of a test besides its return: fields of `codrl_mj.evaluation.Evaluation`."""


@dataclasses.dataclass(frozen=True)
class Arm:
    """Training configuration that is repeated with every seed."""

    name: str
    """Unique name within the study."""
    config: TrainConfig
    """Training with seed 0; the others differ only in the seed."""
    seconds: float
    """Estimated time of a training [s of one core], used until a training has finished."""

    @property
    def task(self) -> str:
        """Task name."""
        return self.config.task

    def training(self, seed: int) -> TrainConfig:
        """Return the training configuration with a seed."""
        return dataclasses.replace(self.config, seed=seed)


@dataclasses.dataclass(frozen=True)
class Trial:
    """Test of all policies of an arm."""

    arm: Arm
    """Arm that trained the policies."""
    test: str
    """Name of the test, unique within the task."""
    env: EnvConfig
    """Environment of the test, but with the actions and observations of the training."""
    seeds: range | None = None
    """Seeds of the tested policies; None: all seeds of the arm."""
    episodes: int | None = None
    """Number of episodes, >= 1; None: that of the grid."""
    first_seed: int = EVALUATION_SEED
    """Seed of the first episode; another value gives other initial states."""

    @property
    def name(self) -> str:
        """Unique name of the trial."""
        return f"{self.arm.name} on {self.test}"

    @property
    def definition(self) -> tuple[EnvConfig, range | None, int | None, int]:
        """Environment, policies, number of episodes and first seed; equal for equal tests."""
        return self.env, self.seeds, self.episodes, self.first_seed


class Cost(NamedTuple):
    """Computing time of an arm."""

    arm: Arm
    """Arm whose time is estimated."""
    finished: tuple[int, ...]
    """Seeds whose training is finished."""
    missing: tuple[int, ...]
    """Seeds whose training is not finished."""
    seconds: float
    """Time of a training [s of one core]: mean of the finished ones, or an estimate."""
    tests: int
    """Number of missing tests."""

    @property
    def remaining_seconds(self) -> float:
        """Estimated time of the missing trainings and tests [s of one core]."""
        return len(self.missing) * self.seconds + self.tests * TEST_SECONDS


class Totals(NamedTuple):
    """Totals of a study's trainings."""

    trainings: int
    """Number of finished trainings."""
    missing: int
    """Number of missing trainings and tests."""
    seconds: float
    """Total time of the finished trainings [s of one core]."""
    codes: Mapping[str, int]
    """Digest of a code version -> number of trainings with it."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Arms, their seeds, and their trials.

    Raises:
        ValueError: different arms, or different tests of an arm, have the same name.
    """

    root: Path
    """Folder of the run folders."""
    trials: tuple[Trial, ...]
    """All trials, without duplicates."""
    seeds_of: Callable[[Arm], range]
    """Function that returns the seeds of an arm."""
    episodes: int = 100
    """Test episodes of every policy, >= 1."""
    published: Path | None = None
    """Folder of the published rows, which replace run folders that are not available."""

    def __post_init__(self) -> None:
        """Validate."""
        for kind, definitions in (
            ("arm", {(trial.arm.name, repr(trial.arm.config)) for trial in self.trials}),
            ("trial", {(trial.name, repr(trial.definition)) for trial in self.trials}),
        ):
            duplicates = [
                name
                for name, count in collections.Counter(name for name, _ in definitions).items()
                if count > 1
            ]
            if duplicates:
                raise ValueError(
                    f"{kind} {duplicates[0]!r}: is the name of several: give each a different name"
                )

    def restricted_to(self, seeds: Mapping[str, range]) -> "Grid":
        """Return the grid of some arms, each with some of its seeds, by the name of the arm."""
        trials = tuple(trial for trial in self.trials if trial.arm.name in seeds)
        return dataclasses.replace(self, trials=trials, seeds_of=lambda arm: seeds[arm.name])

    @functools.cached_property
    def arms(self) -> tuple[Arm, ...]:
        """All arms, without duplicates."""
        return tuple({trial.arm.name: trial.arm for trial in self.trials}.values())

    @functools.cached_property
    def cells(self) -> dict[tuple[str, int], TrainConfig]:
        """Trainings by arm and seed, sorted by seed and then by descending time."""
        # Low seeds come first, so that an interrupted study has results of every arm. Within a seed
        # long trainings come first, so that all workers finish at about the same time.
        all_cells = [(arm, seed) for arm in self.arms for seed in self.seeds_of(arm)]
        all_cells.sort(key=lambda cell: (cell[1], -cell[0].seconds))
        return {(arm.name, seed): arm.training(seed) for arm, seed in all_cells}

    @functools.cached_property
    def folders(self) -> dict[tuple[str, int], Path]:
        """Run folders by arm and seed."""
        return {cell: cell_folder(self.root, config) for cell, config in self.cells.items()}

    @functools.cached_property
    def policy_tests(self) -> dict[tuple[str, int], PolicyTest]:
        """Tests by trial and seed, including those of policies that are not trained yet."""
        folders = self.folders
        return {
            (trial.name, seed): PolicyTest(
                folders[trial.arm.name, seed],
                trial.env,
                self.episodes if trial.episodes is None else trial.episodes,
                trial.first_seed,
            )
            for trial in self.trials
            for seed in self.seeds_of(trial.arm)
            if trial.seeds is None or seed in trial.seeds
        }

    @functools.cached_property
    def published_rows(self) -> dict[tuple[str, int], dict[str, float | None]]:
        """Published measures by trial and seed, if the run's configuration is still the same."""
        tests, rows = self.policy_tests, {}
        for row in [] if self.published is None else read_csv(self.published / RUNS):
            key = f"{row['task']}: {row['trained']} on {row['tested']}", int(row["seed"])
            if key in tests and tests[key].run.name == row["run"]:
                rows[key] = {
                    name: float(row[name]) if row[name] else None for name in ("returns", *MEASURES)
                }
        return rows

    def _untested(self) -> dict[tuple[str, int], PolicyTest]:
        """Return the tests that have neither a file nor a published row."""
        tests = self.policy_tests
        return {
            key: test
            for key, test in tests.items()
            if key not in self.published_rows and not test.record.is_file()
        }

    def compute(
        self,
        workers: Workers = Workers(),  # noqa: B008 - frozen
        accept_changes: bool = False,
        on_cell: Callable[[str], None] = lambda _: None,
        on_seed: Callable[[], None] = lambda: None,
    ) -> None:
        """Compute missing trainings and tests; failures are recorded in `root/failures`.

        Args:
            workers: settings of the worker processes.
            accept_changes: True to continue started trainings even if code or packages changed.
            on_cell: called with `training` or `test` when one has finished or failed.
            on_seed: called after each group of seeds (one seed, or as many as occupy every core)
                that produced a result.

        Raises:
            ValueError: the backend is Ray, which is not installed.
            TrainingStoppedError: a signal requested a stop.
        """
        cells, folders, tests = self.cells, self.folders, self._untested()
        needed = {test.run for test in tests.values()}
        missing_seeds = [
            cell[1] for cell, folder in folders.items() if folder in needed and not finished(folder)
        ]
        rounds: list[list[int]] = [[]]
        # Seeds are trained and tested in groups, so that an interrupted study has complete seeds.
        for seed in sorted({seed for _, seed in cells}):
            rounds[-1].append(seed)
            if sum(map(missing_seeds.count, rounds[-1])) >= workers.cores:
                rounds.append([])
        for seeds in filter(None, rounds):
            runs = {folders[cell]: config for cell, config in cells.items() if cell[1] in seeds}
            for _ in set(runs) - needed:
                on_cell("training")
            unfinished = {folder: config for folder, config in runs.items() if folder in needed}
            train_runs(
                unfinished,
                workers,
                lambda _: on_cell("training"),
                accept_changes=accept_changes,
                tensorboard=False,
            )
            ready = {
                cell_name(*key): test
                for key, test in tests.items()
                if key[1] in seeds and finished(test.run)
            }
            run_tests(ready, workers, lambda _: on_cell("test"))
            if any(map(finished, unfinished)) or any(
                test.record.is_file() for test in ready.values()
            ):
                on_seed()

    def collect(self) -> "StudyResults":
        """Return the available results, without computing anything.

        Raises:
            ValueError: a file of a run is damaged.
        """
        folders, tests = self.folders, self.policy_tests
        local_folders = {cell: folder for cell, folder in folders.items() if finished(folder)}
        arm_of = {trial.name: trial.arm.name for trial in self.trials}
        finished_cells = local_folders | {
            cell: folders[cell]
            for trial, seed in self.published_rows
            if (cell := (arm_of[trial], seed))
        }
        evaluations: dict[str, dict[int, Mapping[str, Json]]] = {
            trial.name: {} for trial in self.trials
        }
        missing: dict[str, Path | PolicyTest] = {
            cell_name(*cell): folder
            for cell, folder in folders.items()
            if cell not in finished_cells
        }
        for (trial, seed), test in tests.items():
            if test.record.is_file():
                evaluations[trial][seed] = read_json(test.record, "evaluation")
            elif (trial, seed) in self.published_rows:
                evaluations[trial][seed] = self.published_rows[trial, seed]
            elif finished(test.run):
                missing[cell_name(trial, seed)] = test
        failures = {name: read_failure(cell) for name, cell in missing.items()}
        return StudyResults(
            grid=self,
            folders={cell: finished_cells[cell] for cell in folders if cell in finished_cells},
            evaluations=evaluations,
            missing=tuple(missing),
            failures={name: failure for name, failure in failures.items() if failure is not None},
            totals=self._totals(local_folders, len(finished_cells), len(missing)),
        )

    def _totals(
        self, local_folders: Mapping[tuple[str, int], Path], finished_count: int, missing: int
    ) -> "Totals":
        """Return the published totals, plus those of trainings that are not in them yet."""
        tests = self.policy_tests
        published_totals = Totals(0, 0, 0.0, {})
        file = (self.published or self.root) / TOTALS
        published_runs = {tests[key].run for key in self.published_rows}
        tested = {test.run for test in tests.values() if test.record.is_file()}
        if (
            self.published_rows
            and file.is_file()
            and len(read_csv(file.with_name(RUNS))) == len(self.published_rows)
        ):
            published_totals = Totals(**read_json(file, "totals of a study"))
        new_folders = [
            folder
            for folder in local_folders.values()
            if folder in tested and not (published_totals.trainings and folder in published_runs)
        ]
        if published_totals.trainings and not new_folders:
            return published_totals
        codes = [
            str(read_json(folder / "config.json", "run configuration").get("code"))[:8]
            for folder in new_folders
        ]
        seconds = published_totals.seconds + sum(training_seconds(folder) for folder in new_folders)
        return Totals(
            finished_count,
            missing,
            seconds,
            dict(collections.Counter(published_totals.codes) + collections.Counter(codes)),
        )

    def costs(self) -> list[Cost]:
        """Return the computing time of every arm.

        Raises:
            ValueError: a file of a finished run is damaged.
        """
        folders = self.folders
        untested = collections.Counter(test.run for test in self._untested().values())
        costs = []
        for arm in self.arms:
            arm_folders = {seed: folders[arm.name, seed] for seed in self.seeds_of(arm)}
            measured_seconds = {
                seed: training_seconds(folder)
                for seed, folder in arm_folders.items()
                if finished(folder)
            }
            seconds = (
                float(np.mean(list(measured_seconds.values()))) if measured_seconds else arm.seconds
            )
            missing_tests = sum(untested[folder] for folder in arm_folders.values())
            finished_seeds = tuple(
                seed
                for seed, folder in arm_folders.items()
                if seed in measured_seconds or not untested[folder]
            )
            costs.append(
                Cost(
                    arm,
                    finished_seeds,
                    tuple(seed for seed in arm_folders if seed not in finished_seeds),
                    seconds,
                    missing_tests,
                )
            )
        return costs


@dataclasses.dataclass(frozen=True)
class StudyResults:
    """Available results of a grid."""

    grid: Grid
    """Grid of the results."""
    folders: Mapping[tuple[str, int], Path]
    """Run folders of the finished trainings, by arm and seed."""
    evaluations: Mapping[str, Mapping[int, Mapping[str, Json]]]
    """`Evaluation.as_mapping()` by trial and seed, without missing ones."""
    missing: tuple[str, ...]
    """Names of unfinished trainings, and of missing tests of finished ones."""
    failures: Mapping[str, str]
    """Name -> error, for trainings and tests in `missing` that have failed."""
    totals: Totals
    """Totals of the trainings."""

    @property
    def complete(self) -> bool:
        """True if every test of the grid has a result."""
        return sum(map(len, self.evaluations.values())) == len(self.grid.policy_tests)

    def scores(self, trial: Trial, measure: str = "returns") -> dict[int, float]:
        """Return a measure of a trial's policies by seed, as a number; see `to_scalar`.

        Policies without a value are left out. A trial outside the grid has no values.
        """
        tested = self.evaluations.get(trial.name, {})
        values = {seed: to_scalar(evaluation[measure]) for seed, evaluation in tested.items()}
        return {seed: float(value) for seed, value in values.items() if value is not None}


def run_rows(
    collected: StudyResults, score: Callable[[Trial], Mapping[int, float]]
) -> Iterable[dict[str, object]]:
    """Yield a row for every policy and test; `score` returns a trial's scores by seed.

    The units are those of docs/evaluation.md.
    """
    for trial in collected.grid.trials:
        scores = score(trial)
        measured = {name: collected.scores(trial, name) for name in ("returns", *MEASURES)}
        for seed in collected.evaluations[trial.name]:
            yield {
                "task": trial.arm.task,
                "trained": trial.arm.name.partition(": ")[2],
                "tested": trial.test,
                "seed": seed,
                "score": scores.get(seed),
                **{name: values.get(seed) for name, values in measured.items()},
                "run": collected.folders[trial.arm.name, seed].name,
            }


def trial_rows(
    collected: StudyResults, score: Callable[[Trial], Mapping[int, float]]
) -> Iterable[dict[str, object]]:
    """Yield a row for every trial: mean score with bootstrap interval, means of the measures."""
    for trial in collected.grid.trials:
        scores = np.array(list(score(trial).values()))
        if not scores.size:
            continue
        mean = bootstrap_mean(scores)
        measured = {
            name: list(collected.scores(trial, name).values()) for name in ("returns", *MEASURES)
        }
        env = trial.env
        yield {
            "task": trial.arm.task,
            "trained": trial.arm.name.partition(": ")[2],
            "tested": trial.test,
            "policies": len(scores),
            "score": mean.mean,
            "low": mean.low,
            "high": mean.high,
            "median": np.median(scores),
            "failed": np.mean(scores < 1.0 - FAILURE_MARGIN),
            "worst": scores.min(),
            "best": scores.max(),
            **{name: np.mean(values) if values else None for name, values in measured.items()},
            "actuator": mapping_of(env.actuators[0]) or "ideal",
            "joint": env.joint.friction,
            "command_delay": env.disturbances.command_delay,
        }


def cell_name(name: str, seed: int) -> str:
    """Return the name of a training or test with a seed."""
    return f"{name}, seed {seed}"


def to_scalar(value: Json) -> Json:
    """Return a measure as a number: the mean of an interval, or the median of quartiles."""
    return value.get("mean", value.get("median")) if isinstance(value, Mapping) else value


def training_seconds(folder: Path) -> float:
    """Return the time of a finished training [s]."""
    return float(read_json(folder / RESULT, "result of a run")["seconds"])


def format_ranges(numbers: Sequence[int]) -> str:
    """Return integers as text; consecutive integers are written as ranges, such as `0 to 4`."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in parts)
