"""A grid of trainings and tests: every cell an ordinary run folder, found again by its configuration, trained once.

A grid that was killed goes on where it was: what is finished is left alone, trainings that were begun continue
from their checkpoints.
"""

import dataclasses
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
from codrl_mj.training import RunInUseError, TrainConfig, TrainingStoppedError, finished, load_config, train

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

    @property
    def record(self) -> Path:
        """The JSON file of the result, in the run folder."""
        identity = {**vars(self), "env": self.env.as_mapping(), "run": None}
        return self.run / _DEPLOYMENTS / f"{_digest(identity)}.json"


def check_chosen(field: str, given: Sequence[str], known: Iterable[str]) -> None:
    """Refuse a choice of nothing, or of what is not known.

    Args:
        field: what to call the choice.
        given: the names that were chosen.
        known: what they may be.

    Raises:
        ValueError: none is given, or one is unknown; the nearest known one is suggested.
    """
    known = list(known)
    for name in given:
        if name not in known:
            raise ValueError(f"{field}: unknown {name!r}: {did_you_mean(name, known)}Known are {', '.join(known)}")
    if not given:
        raise ValueError(f"{field}: none is named: name one or more of {', '.join(known)}")


def cell_folder(root: Path, config: TrainConfig) -> Path:
    """The run folder of a configuration: readable, and different for any other configuration."""
    return root / f"{config.task}-{config.agent.name}-s{config.seed}-{_digest(config.as_mapping())}"


def read_failure(cell: Path | Deployment) -> str | None:
    """Why a cell was not finished when it was tried last, in a line; None if it did not fail.

    Args:
        cell: run folder of a training, or a test.
    """
    record = failure_record(cell)
    return str(read_json(record, "record of a failure")["error"]) if record.is_file() else None


def failure_record(cell: Path | Deployment) -> Path:
    """The JSON file of what went wrong with a cell: the error, its traceback and the configuration."""
    if isinstance(cell, Deployment):
        return cell.run.parent / _FAILURES / f"{cell.run.name}-{cell.record.stem}.json"
    return cell.parent / _FAILURES / f"{cell.name}.json"


def _note(cell: Path | Deployment, error: Exception | None, about: dict[str, Any]) -> str | None:
    """Keep a record of what went wrong with a cell, and say it; forget the last one if nothing did."""
    record = failure_record(cell)
    if error is None:
        record.unlink(missing_ok=True)
        return None
    line = " ".join(str(error).split()) or type(error).__name__
    write_json(record, {"error": line, "traceback": "".join(traceback.format_exception(error)), **about})
    return line


def train_runs(
    runs: Mapping[Path, TrainConfig],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    on_run: Callable[[Path], None] = lambda _: None,
    **options: Any,
) -> dict[Path, str]:
    """Train every run that is not finished; one that fails does not stop the others.

    Args:
        runs: configurations by their run folders.
        workers: what computes them.
        on_run: called with a folder when it is finished or has failed; those finished before come first.
        **options: `accept_changes` and `tensorboard`, as for `codrl_mj.training.train`.

    Returns:
        What went wrong, by run folder. A failure's record stays in `failures` beside it until the run is finished.

    Raises:
        ValueError: Ray is asked for and not installed.
        TrainingStoppedError: a signal asked to stop.
    """
    waiting = [folder for folder in runs if not finished(folder)]
    for folder in runs:
        if folder not in waiting:
            on_run(folder)
    failures = {}
    for folder, failure in compute(_train_run, [(runs[folder], folder, options) for folder in waiting], workers):
        if failure is not None:
            failures[folder] = failure
        on_run(folder)
    return failures


def deploy_cells(
    deployments: Mapping[str, Deployment],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    on_cell: Callable[[str], None] = lambda _: None,
) -> None:
    """Evaluate policies; what was evaluated before is not evaluated again, and one that fails does not stop the others.

    The record of a result has `Evaluation.as_mapping()`; a failure's stays in `failures` beside the run folders until
    the evaluation succeeds.

    Args:
        deployments: by name.
        workers: what computes them.
        on_cell: called with a deployment's name when it is evaluated or has failed; those evaluated before come first.

    Raises:
        ValueError: Ray is asked for and not installed.
    """
    waiting = {name: deployment for name, deployment in deployments.items() if not deployment.record.is_file()}
    for name in deployments:
        if name not in waiting:
            on_cell(name)
    for name in compute(_deploy_cell, waiting.items(), workers):
        on_cell(name)


def _train_run(config: TrainConfig, folder: Path, options: Mapping[str, Any]) -> tuple[Path, str | None]:
    """Train one run: its folder, and what went wrong, of which a record is kept."""
    return folder, _note(folder, _try_to_train(config, folder, options), {"train": config.as_mapping()})


def _try_to_train(config: TrainConfig, folder: Path, options: Mapping[str, Any]) -> Exception | None:
    """Train, waiting for a folder that somebody else holds; what went wrong."""
    start = time.monotonic()
    while True:
        try:
            train(config, folder, resume=True, **options)
            return None
        except TrainingStoppedError:
            raise
        except RunInUseError as error:
            if time.monotonic() - start > _PATIENCE:
                return error
            time.sleep(1.0)
        except Exception as error:
            return error


def _deploy_cell(name: str, deployment: Deployment) -> str:
    """Evaluate one policy: its name. Of what goes wrong a record is kept."""
    from codrl_mj.evaluation import evaluate
    from codrl_mj.runs.policies import load_policy

    error = None
    try:
        config = load_config(deployment.run, trust=True)  # ours: found by its configuration
        env = deployment.env.seen_as(config.env)
        result = evaluate(load_policy(deployment.run), env, deployment.episodes, deployment.seed)
        write_json(deployment.record, result.as_mapping())
    except Exception as caught:
        error = caught
    _note(deployment, error, {"test": name, "run": deployment.run.name})
    return name


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
