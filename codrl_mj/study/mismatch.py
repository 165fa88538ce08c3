"""The mismatch study: what it costs to train on another actuator than the one that there will be. docs/studies.md."""

import collections
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import read_json
from codrl_mj.study.arrivals import Arrivals, ends_at_goal, read_arrivals
from codrl_mj.study.conditions import check_condition
from codrl_mj.study.experiments import EXPERIMENTS
from codrl_mj.study.grid import Deployment, cell_folder, check_chosen, deploy_cells, read_failure, train_cells
from codrl_mj.study.parallel import Workers
from codrl_mj.study.plan import AGENTS, Plan, Trial
from codrl_mj.training import EVALUATION_SEED, TrainConfig, finished


@dataclasses.dataclass(frozen=True)
class MismatchConfig:
    """What the study computes, and where.

    Raises:
        ValueError: an unknown task, experiment or condition (the nearest known one is suggested), or a number below 1.
    """

    root: Path = Path("runs/mismatch")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = tuple(AGENTS)
    """Tasks: some of cartpole, pendulum, acrobot."""
    experiments: tuple[str, ...] = tuple(EXPERIMENTS)
    """Experiments: some of matrix, ladder, action, observation, randomised, reward, agents."""
    seeds: int = 5
    """Training runs of each kind, >= 1, with seeds from 0. Below 4 no comparison can be decided."""
    episodes: int = 100
    """Test episodes of each policy on each actuator, >= 1."""
    conditions: tuple[str, ...] | None = None
    """Only these actuators to train and test on, by name; None: all."""
    total_steps: int | None = None
    """Environment steps of every training, >= 1; None: the agents' own budgets."""

    def __post_init__(self) -> None:
        """Validate."""
        for field, known in (("tasks", AGENTS), ("experiments", EXPERIMENTS)):
            check_chosen(field, getattr(self, field), known)
        for name in self.conditions or ():
            check_condition(name, self.tasks)
        for field in ("seeds", "episodes", "total_steps"):
            value = getattr(self, field)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if (not whole or value < 1) and not (field == "total_steps" and value is None):
                raise ValueError(f"{field} = {value!r}: must be an integer >= 1")


def plans(config: MismatchConfig) -> dict[str, dict[str, Plan]]:
    """What is done: experiment -> task -> plan, without those that have nothing to do."""
    every = {
        name: {task: plan for task in config.tasks if (plan := EXPERIMENTS[name].plan(task)) is not None}
        for name in config.experiments
    }
    if config.conditions is not None:
        every = {name: {task: plan.only(config.conditions) for task, plan in of.items()} for name, of in every.items()}
    return {name: {task: plan for task, plan in of.items() if plan.trials} for name, of in every.items()}


def trials(config: MismatchConfig) -> dict[str, Trial]:
    """Every trial once, by name."""
    return {trial.name: trial for of in plans(config).values() for plan in of.values() for trial in plan.trials}


def cells(config: MismatchConfig) -> dict[str, TrainConfig]:
    """Every training once, by name; all first seeds, then all second ones, so that a part says something of all."""
    arms = {(trial.arm.task, trial.arm.name): trial.arm for trial in trials(config).values()}
    return {
        cell_name(arm.task, arm.name, seed): arm.config(seed, config.total_steps)
        for seed in range(config.seeds)
        for arm in arms.values()
    }


def cell_name(task: str, arm: str, seed: int) -> str:
    """What a training is called."""
    return f"{task}: {arm}, seed {seed}"


def deployments(config: MismatchConfig) -> dict[str, dict[int, Deployment]]:
    """Name of the trial -> training seed -> the test of the policy, whether it is trained or not."""
    folders = {name: cell_folder(config.root, cell) for name, cell in cells(config).items()}
    return {
        name: {
            seed: Deployment(
                folders[cell_name(trial.arm.task, trial.arm.name, seed)],
                trial.test.env,
                config.episodes,
                EVALUATION_SEED,
            )
            for seed in range(config.seeds)
        }
        for name, trial in trials(config).items()
    }


@dataclasses.dataclass(frozen=True)
class Result:
    """The policies of a trial and what they came to."""

    trial: Trial
    """Who was trained on what, and tested on what."""
    evaluations: Mapping[int, Mapping[str, Any]]
    """`Evaluation.as_mapping()` by training seed, in their order; those that are missing are left out."""

    @property
    def returns(self) -> np.ndarray:
        """Mean return of each policy, shape (seeds,)."""
        return np.array([evaluation["returns"]["mean"] for evaluation in self.evaluations.values()], dtype=float)


@dataclasses.dataclass(frozen=True)
class Results:
    """All that is computed so far."""

    config: MismatchConfig
    """What was asked for."""
    plans: Mapping[str, Mapping[str, Plan]]
    """What it consists of: experiment -> task -> plan."""
    trials: Mapping[str, Result]
    """The results by trial, also those without any run yet."""
    untrained: tuple[str, ...]
    """Trainings that are not finished, by name."""
    untested: tuple[str, ...]
    """Tests of finished trainings that are not there, by name."""
    failures: Mapping[str, str]
    """What went wrong, by the names of those of them that were tried."""
    runs: int
    """Finished trainings."""
    seconds: float
    """What they took, each on one core [s]."""
    arrivals: Mapping[str, Arrivals]
    """The finished trainings' arrivals at the goal, by name; of tasks whose episodes end there."""
    codes: Mapping[str, int]
    """How many of them each version of the code has trained, by its digest."""


def compute(
    config: MismatchConfig,
    workers: Workers = Workers(),  # noqa: B008 - frozen
    accept_changes: bool = False,
    on_cell: Callable[[str, str], None] | None = None,
) -> None:
    """Train and test whatever is not there yet. What fails is recorded in `root/failures` and stops nothing else.

    Args:
        config: what to compute.
        workers: what computes it.
        accept_changes: continue begun trainings even if code or packages have changed since.
        on_cell: called with (`training` or `test`, name) when one is finished or has failed.

    Raises:
        ValueError: Ray is asked for and not installed.
    """
    report = on_cell or (lambda *_: None)
    train_cells(cells(config), config.root, workers, accept_changes, lambda name: report("training", name))
    waiting = {
        f"{name}, seed {seed}": deployment
        for name, by_seed in deployments(config).items()
        for seed, deployment in by_seed.items()
        if finished(deployment.run)
    }
    deploy_cells(waiting, workers, lambda name: report("test", name))


def collect(config: MismatchConfig) -> Results:
    """All that is there, without computing anything.

    Raises:
        ValueError: a file of a run is damaged.
    """
    every, tests = cells(config), deployments(config)
    folders = {name: cell_folder(config.root, cell) for name, cell in every.items()}
    done = [name for name, folder in folders.items() if finished(folder)]
    waiting = {
        f"{name}, seed {seed}": deployment
        for name, by_seed in tests.items()
        for seed, deployment in by_seed.items()
        if finished(deployment.run) and not deployment.record.is_file()
    }
    missing: dict[str, Path | Deployment] = {name: folders[name] for name in every if name not in done}
    failures = {name: read_failure(cell) for name, cell in (missing | waiting).items()}
    return Results(
        config=config,
        plans=plans(config),
        trials={
            name: Result(
                trial,
                {
                    seed: read_json(deployment.record, "evaluation")
                    for seed, deployment in tests[name].items()
                    if deployment.record.is_file()
                },
            )
            for name, trial in trials(config).items()
        },
        untrained=tuple(name for name in every if name not in done),
        untested=tuple(waiting),
        failures={name: failure.error for name, failure in failures.items() if failure is not None},
        runs=len(done),
        seconds=sum(read_json(folders[name] / "result.json", "result of a run")["seconds"] for name in done),
        arrivals={name: read_arrivals(every[name], folders[name]) for name in done if ends_at_goal(every[name].task)},
        codes=collections.Counter(
            str(read_json(folders[name] / "config.json", "run configuration").get("code"))[:8] for name in done
        ),
    )
