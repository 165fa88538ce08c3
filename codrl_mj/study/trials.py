"""What studies consist of: arms that are trained with many seeds, and trials that test their policies.

A study is its trials. Every training is a run folder that is found again by its configuration,
every test of a policy a file in it; so whatever is there is never computed again, whoever computed
it. Run folders do not outlive a machine: a row of every test, with the name of its run, is
published, and stands for a run folder that is not at hand.
"""

import collections
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import mapping_of
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.measures import bootstrap_mean
from codrl_mj.runs.files import read_json
from codrl_mj.study.grid import Deployment, cell_folder, deploy_cells, read_failure, train_runs
from codrl_mj.study.pages import read_csv
from codrl_mj.study.parallel import Workers
from codrl_mj.training import EVALUATION_SEED, TrainConfig, finished
from codrl_mj.training.folder import RESULT

TEST_SECONDS = 1.0
"""What a test takes [s of one core], about."""
FAILED = 0.1
"""A policy that scores less than one by more than this has failed."""
RUNS, TOTALS = "runs.csv", "totals.json"
"""What is published of a study: a row for every policy and test; what its trainings took in all."""
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
"""What is published of a test besides its return: fields of `codrl_mj.evaluation.Evaluation`."""


@dataclasses.dataclass(frozen=True)
class Arm:
    """A way to train, to be repeated with every seed."""

    name: str
    """A name that no other arm of the study has."""
    config: TrainConfig
    """The training with seed 0; others differ by the seed alone."""
    seconds: float
    """What a training takes [s of one core], about; where some are finished, they are gone by."""

    @property
    def task(self) -> str:
        """Task name."""
        return self.config.task

    def training(self, seed: int) -> TrainConfig:
        """The training with a seed."""
        return dataclasses.replace(self.config, seed=seed)


@dataclasses.dataclass(frozen=True)
class Trial:
    """The policies of an arm, tested."""

    arm: Arm
    """How they were trained."""
    test: str
    """What they are tested on: a name that no other test of the task has."""
    env: EnvConfig
    """The same, complete but for actions and observations, which are those of the training."""

    @property
    def name(self) -> str:
        """What sets it apart from all others."""
        return f"{self.arm.name} on {self.test}"


class Cost(NamedTuple):
    """What an arm takes."""

    arm: Arm
    """The arm."""
    finished: tuple[int, ...]
    """Seeds whose training is finished."""
    missing: tuple[int, ...]
    """Seeds whose training is not."""
    seconds: float
    """A training's computing time [s of one core]: the mean of the finished ones, or an estimate."""
    tests: int
    """Tests of its policies that are not there."""

    @property
    def left(self) -> float:
        """What is missing takes [s of one core]."""
        return len(self.missing) * self.seconds + self.tests * TEST_SECONDS


class Totals(NamedTuple):
    """What the trainings of a study took."""

    trainings: int
    """Finished ones."""
    missing: int
    """Trainings and tests that are not there."""
    seconds: float
    """What the finished ones took, each on one core [s]."""
    codes: Mapping[str, int]
    """How many of them each version of the code has trained, by its digest."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Arms, their seeds, and their trials.

    Raises:
        ValueError: different arms, or different tests of an arm, have the same name.
    """

    root: Path
    """Folder of the run folders."""
    trials: tuple[Trial, ...]
    """Every trial once."""
    seeds_of: Callable[[Arm], range]
    """The seeds of an arm."""
    episodes: int = 100
    """Test episodes of every policy, >= 1."""
    published: Path | None = None
    """Folder of the published rows, which stand for run folders that are not at hand."""

    def __post_init__(self) -> None:
        """Validate."""
        for kind, named in (
            ("arm", {(trial.arm.name, repr(trial.arm.config)) for trial in self.trials}),
            ("trial", {(trial.name, repr(trial.env)) for trial in self.trials}),
        ):
            twice = [
                name
                for name, count in collections.Counter(name for name, _ in named).items()
                if count > 1
            ]
            if twice:
                raise ValueError(
                    f"{kind} {twice[0]!r}: stands for several: give each a name of its own"
                )

    @functools.cached_property
    def arms(self) -> tuple[Arm, ...]:
        """Every arm once."""
        return tuple({trial.arm.name: trial.arm for trial in self.trials}.values())

    @functools.cached_property
    def cells(self) -> dict[tuple[str, int], TrainConfig]:
        """The trainings by arm and seed: first seeds first, so that a part says something of all; the longest first."""
        every = [(arm, seed) for arm in self.arms for seed in self.seeds_of(arm)]
        every.sort(key=lambda cell: (cell[1], -cell[0].seconds))
        return {(arm.name, seed): arm.training(seed) for arm, seed in every}

    @functools.cached_property
    def folders(self) -> dict[tuple[str, int], Path]:
        """The run folders by arm and seed."""
        return {cell: cell_folder(self.root, config) for cell, config in self.cells.items()}

    @functools.cached_property
    def deployments(self) -> dict[tuple[str, int], Deployment]:
        """The tests by trial and seed, whether the policies are trained or not."""
        folders = self.folders
        return {
            (trial.name, seed): Deployment(
                folders[trial.arm.name, seed], trial.env, self.episodes, EVALUATION_SEED
            )
            for trial in self.trials
            for seed in self.seeds_of(trial.arm)
        }

    @functools.cached_property
    def rows(self) -> dict[tuple[str, int], dict[str, float | None]]:
        """Published measures of tests of these very trainings, by trial and seed."""
        tests, found = self.deployments, {}
        for row in [] if self.published is None else read_csv(self.published / RUNS):
            key = f"{row['task']}: {row['trained']} on {row['tested']}", int(row["seed"])
            if key in tests and tests[key].run.name == row["run"]:
                found[key] = {
                    name: float(row[name]) if row[name] else None for name in ("returns", *MEASURES)
                }
        return found

    def _untested(self) -> dict[tuple[str, int], Deployment]:
        """The tests of which there is neither a file nor a row."""
        tests = self.deployments
        return {
            key: test
            for key, test in tests.items()
            if key not in self.rows and not test.record.is_file()
        }

    def compute(
        self,
        workers: Workers = Workers(),  # noqa: B008 - frozen
        accept_changes: bool = False,
        on_cell: Callable[[str], None] = lambda _: None,
        on_seed: Callable[[], None] = lambda: None,
    ) -> None:
        """Train and test what is missing. What fails is recorded in `root/failures` and stops nothing else.

        Args:
            workers: what computes it.
            accept_changes: continue begun trainings even if code or packages have changed since.
            on_cell: called with `training` or `test` when one is finished or has failed.
            on_seed: called when all of a seed's are, or of the fewest seeds that occupy every core,
                unless nothing came of it.

        Raises:
            ValueError: Ray is asked for and not installed.
            TrainingStoppedError: a signal asked to stop.
        """
        cells, folders, tests = self.cells, self.folders, self._untested()
        needed = {test.run for test in tests.values()}
        left = [
            cell[1] for cell, folder in folders.items() if folder in needed and not finished(folder)
        ]
        rounds: list[list[int]] = [[]]
        for seed in sorted(
            {seed for _, seed in cells}
        ):  # trained and tested, so that a part says something of all
            rounds[-1].append(seed)
            if sum(map(left.count, rounds[-1])) >= workers.cores:
                rounds.append([])
        for seeds in filter(None, rounds):
            runs = {folders[cell]: config for cell, config in cells.items() if cell[1] in seeds}
            for _ in set(runs) - needed:
                on_cell("training")
            waiting = {folder: config for folder, config in runs.items() if folder in needed}
            train_runs(
                waiting,
                workers,
                lambda _: on_cell("training"),
                accept_changes=accept_changes,
                tensorboard=False,
            )
            ready = {
                called(*key): test
                for key, test in tests.items()
                if key[1] in seeds and finished(test.run)
            }
            deploy_cells(ready, workers, lambda _: on_cell("test"))
            if any(map(finished, waiting)) or any(test.record.is_file() for test in ready.values()):
                on_seed()

    def collect(self) -> "Collected":
        """All that is there, without computing anything.

        Raises:
            ValueError: a file of a run is damaged.
        """
        folders, tests = self.folders, self.deployments
        at_hand = {cell: folder for cell, folder in folders.items() if finished(folder)}
        arm_of = {trial.name: trial.arm.name for trial in self.trials}
        done = at_hand | {
            cell: folders[cell] for trial, seed in self.rows if (cell := (arm_of[trial], seed))
        }
        evaluations: dict[str, dict[int, Mapping[str, Any]]] = {
            trial.name: {} for trial in self.trials
        }
        missing: dict[str, Path | Deployment] = {
            called(*cell): folder for cell, folder in folders.items() if cell not in done
        }
        for (trial, seed), test in tests.items():
            if test.record.is_file():
                evaluations[trial][seed] = read_json(test.record, "evaluation")
            elif (trial, seed) in self.rows:
                evaluations[trial][seed] = self.rows[trial, seed]
            elif finished(test.run):
                missing[called(trial, seed)] = test
        failures = {name: read_failure(cell) for name, cell in missing.items()}
        return Collected(
            grid=self,
            folders={cell: done[cell] for cell in folders if cell in done},
            evaluations=evaluations,
            missing=tuple(missing),
            failures={name: failure for name, failure in failures.items() if failure is not None},
            totals=self._totals(at_hand, len(done), len(missing)),
        )

    def _totals(self, at_hand: Mapping[tuple[str, int], Path], done: int, missing: int) -> "Totals":
        """What trainings took: those at hand with tests, which get rows, beside what is published of all that have."""
        tests, before, file = (
            self.deployments,
            Totals(0, 0, 0.0, {}),
            (self.published or self.root) / TOTALS,
        )
        have_rows = {tests[key].run for key in self.rows}
        tested = {test.run for test in tests.values() if test.record.is_file()}
        if self.rows and file.is_file() and len(read_csv(file.with_name(RUNS))) == len(self.rows):
            before = Totals(**read_json(file, "totals of a study"))
        new = [
            one
            for one in at_hand.values()
            if one in tested and not (before.trainings and one in have_rows)
        ]
        if before.trainings and not new:
            return before
        codes = [
            str(read_json(folder / "config.json", "run configuration").get("code"))[:8]
            for folder in new
        ]
        seconds = before.seconds + sum(training_seconds(folder) for folder in new)
        return Totals(
            done,
            missing,
            seconds,
            dict(collections.Counter(before.codes) + collections.Counter(codes)),
        )

    def costs(self) -> list[Cost]:
        """What every arm takes.

        Raises:
            ValueError: a file of a finished run is damaged.
        """
        folders = self.folders
        untested = collections.Counter(test.run for test in self._untested().values())
        found = []
        for arm in self.arms:
            mine = {seed: folders[arm.name, seed] for seed in self.seeds_of(arm)}
            took = {
                seed: training_seconds(folder) for seed, folder in mine.items() if finished(folder)
            }
            seconds = float(np.mean(list(took.values()))) if took else arm.seconds
            waiting = sum(untested[folder] for folder in mine.values())
            done = tuple(
                seed for seed, folder in mine.items() if seed in took or not untested[folder]
            )
            found.append(
                Cost(arm, done, tuple(seed for seed in mine if seed not in done), seconds, waiting)
            )
        return found


@dataclasses.dataclass(frozen=True)
class Collected:
    """All that is computed so far."""

    grid: Grid
    """What was asked for."""
    folders: Mapping[tuple[str, int], Path]
    """Run folders of the finished trainings, by arm and seed."""
    evaluations: Mapping[str, Mapping[int, Mapping[str, Any]]]
    """`Evaluation.as_mapping()` by trial and seed; those that are missing are left out."""
    missing: tuple[str, ...]
    """Trainings that are not finished, and tests of finished ones that are not there, by name."""
    failures: Mapping[str, str]
    """What went wrong, by the names of those of them that were tried."""
    totals: Totals
    """What they took."""

    def scores(self, trial: Trial, measure: str = "returns") -> dict[int, float]:
        """A measure of every policy of a trial that has one, by seed: means of intervals, medians of quartiles.

        None of a trial that is not in the grid.
        """
        tested = self.evaluations.get(trial.name, {})
        found = {seed: plain(evaluation[measure]) for seed, evaluation in tested.items()}
        return {seed: float(value) for seed, value in found.items() if value is not None}


def run_rows(
    collected: Collected, score: Callable[[Trial], Mapping[int, float]]
) -> Iterable[dict[str, Any]]:
    """A row for every policy and test, units as in docs/evaluation.md; `score` gives those of a trial by seed."""
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
                **{name: found.get(seed) for name, found in measured.items()},
                "run": collected.folders[trial.arm.name, seed].name,
            }


def trial_rows(
    collected: Collected, score: Callable[[Trial], Mapping[int, float]]
) -> Iterable[dict[str, Any]]:
    """A row for every trial: mean score with its 95 % bootstrap interval over policies, and means of the measures."""
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
            "failed": np.mean(scores < 1.0 - FAILED),
            "worst": scores.min(),
            "best": scores.max(),
            **{name: np.mean(found) if found else None for name, found in measured.items()},
            "actuator": mapping_of(env.actuators[0]) or "ideal",
            "joint": env.joint.friction,
            "command_delay": env.disturbances.command_delay,
        }


def called(name: str, seed: int) -> str:
    """What a cell is called."""
    return f"{name}, seed {seed}"


def plain(value: Any) -> Any:
    """A measure as one number: of an interval the mean, of quartiles the median."""
    return value.get("mean", value.get("median")) if isinstance(value, Mapping) else value


def training_seconds(folder: Path) -> float:
    """What a finished training took [s]."""
    return float(read_json(folder / RESULT, "result of a run")["seconds"])


def numbers_as_text(numbers: Sequence[int]) -> str:
    """Numbers as text: runs of consecutive ones by their ends."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in parts)
