"""A grid of trainings and tests: every cell an ordinary run folder, found again by its configuration, trained once.

A grid that was killed goes on where it was: what is finished is left alone, trainings that were
begun continue from their checkpoints.
"""

import dataclasses
import functools
import hashlib
import json
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import did_you_mean
from codrl_mj.runs.files import read_json, write_json
from codrl_mj.study.parallel import Workers, compute
from codrl_mj.training import (
    RunInUseError,
    TrainConfig,
    TrainingStoppedError,
    finished,
    load_config,
    train,
)

_FAILURES, _DEPLOYMENTS = "failures", "deployments"
_PATIENCE = 120.0  # s to wait for a run folder that a dying process of a killed grid still holds


@dataclasses.dataclass(frozen=True)
class Deployment:
    """The last policy of a run, put to work on an actuator."""

    run: Path
    """Finished run folder."""
    env: EnvConfig
    """Actuator and all else but actions and observations, which are those of the training."""
    episodes: int = 100
    """Episodes."""
    seed: int = 0
    """Seed of the first episode."""

    @functools.cached_property
    def record(self) -> Path:
        """The JSON file of the result, in the run folder."""
        identity = {**vars(self), "env": self.env.as_mapping(), "run": None}
        return self.run / _DEPLOYMENTS / f"{_digest(identity)}.json"


def check_chosen(field: str, given: Sequence[str], known: Iterable[str]) -> None:
    """Refuse a choice, called `field`, of nothing, or of what is not known: the nearest known one is suggested."""
    known = list(known)
    for name in given:
        if name not in known:
            raise ValueError(
                f"{field}: unknown {name!r}: {did_you_mean(name, known)}Known are"
                f" {', '.join(known)}"
            )
    if not given:
        raise ValueError(f"{field}: none is named: name one or more of {', '.join(known)}")


def cell_folder(root: Path, config: TrainConfig) -> Path:
    """The run folder of a configuration: readable, and different for any other configuration."""
    return root / f"{config.task}-{config.agent.name}-s{config.seed}-{_digest(config.as_mapping())}"


def read_failure(cell: Path | Deployment) -> str | None:
    """Why a cell (run folder or test) was not finished when it was tried last, in a line; None if it did not fail."""
    record = failure_record(cell)
    return str(read_json(record, "record of a failure")["error"]) if record.is_file() else None


def failure_record(cell: Path | Deployment) -> Path:
    """The JSON file of what went wrong with a cell: the error, its traceback and the configuration."""
    if isinstance(cell, Deployment):
        return cell.run.parent / _FAILURES / f"{cell.run.name}-{cell.record.stem}.json"
    return cell.parent / _FAILURES / f"{cell.name}.json"


def train_runs(
    runs: Mapping[Path, TrainConfig],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    on_run: Callable[[Path], None] = lambda _: None,
    **options: Any,
) -> dict[Path, str]:
    """Train every run that is not finished; what went wrong, by run folder. `options` are those of `training.train`.

    `on_run` is called with a folder when it is finished or has failed; those finished before come
    first.
    """
    work = {
        folder: (folder, {"train": config.as_mapping()}, _train, config, folder, options)
        for folder, config in runs.items()
        if not finished(folder)
    }
    return _compute(runs, work, workers, on_run)


def deploy_cells(
    deployments: Mapping[str, Deployment],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    on_cell: Callable[[str], None] = lambda _: None,
) -> None:
    """Evaluate policies, by names of their tests, that were not evaluated before: records of `Evaluation.as_mapping()`.

    `on_cell` is called with a name when its policy is evaluated or that failed; those evaluated
    before come first.
    """
    work = {
        name: (test, {"test": name, "run": test.run.name}, _deploy, test)
        for name, test in deployments.items()
        if not test.record.is_file()
    }
    _compute(deployments, work, workers, on_cell)


def _compute(
    cells: Iterable[Any],
    work: Mapping[Any, tuple[Any, ...]],
    workers: Workers,
    on_cell: Callable[[Any], None],
) -> dict[Any, str]:
    """Do the work that there is for cells, arguments of `_attempt`; what went wrong. A failure stops no other cell."""
    for cell in cells:
        if cell not in work:
            on_cell(cell)
    failures = {}
    for cell, failure in compute(
        _attempt, ((cell, *arguments) for cell, arguments in work.items()), workers
    ):
        if failure is not None:
            failures[cell] = failure
        on_cell(cell)
    return failures


def _attempt(
    name: Any,
    cell: Path | Deployment,
    about: Mapping[str, Any],
    function: Callable[..., None],
    *arguments: Any,
) -> tuple[Any, str | None]:
    """Call a function: the name, and what went wrong in a line, of which a record is kept until nothing does."""
    record = failure_record(cell)
    try:
        function(*arguments)
    except TrainingStoppedError:
        raise
    except Exception as error:
        line = " ".join(str(error).split()) or type(error).__name__
        write_json(
            record,
            {"error": line, "traceback": "".join(traceback.format_exception(error)), **about},
        )
        return name, line
    record.unlink(missing_ok=True)
    return name, None


def _train(config: TrainConfig, folder: Path, options: Mapping[str, Any]) -> None:
    """Train one run, waiting for a folder that somebody else holds."""
    start = time.monotonic()
    while True:
        try:
            train(config, folder, resume=True, **options)
            return
        except RunInUseError:
            if time.monotonic() - start > _PATIENCE:
                raise
            time.sleep(1.0)


def _deploy(test: Deployment) -> None:
    """Evaluate one policy."""
    from codrl_mj.evaluation import evaluate
    from codrl_mj.runs.policies import load_policy

    config = load_config(test.run, trust=True)  # ours: found by its configuration
    env = dataclasses.replace(test.env, **config.env.policy_fields)
    result = evaluate(load_policy(test.run), env, test.episodes, test.seed)
    write_json(test.record, result.as_mapping())


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
