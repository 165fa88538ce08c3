"""A grid of trainings and tests: every cell an ordinary run folder, found again by its configuration, trained once.

A grid that was killed goes on where it was: what is finished is left alone, trainings that were begun continue
from their checkpoints.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from codrl_mj.envs.config import EnvConfig
from codrl_mj.runs.files import read_json, write_json
from codrl_mj.training import RunInUseError, TrainConfig, TrainingStoppedError, finished, load_config, train

BACKENDS = ("local", "ray")
"""Where cells are computed: in processes of this machine, or on a Ray cluster."""
_FAILURES, _DEPLOYMENTS = "failures", "deployments"
_PATIENCE = 120.0  # s to wait for a run folder that a dying process of a killed grid still holds


@dataclasses.dataclass(frozen=True)
class Workers:
    """What computes the cells.

    Raises:
        ValueError: unknown backend, or an impossible number of jobs.
    """

    jobs: int = -1
    """Cells at once, >= 1; -1 for one on each CPU (of the cluster)."""
    backend: str = "local"
    """`local`: processes of this machine; `ray`: a Ray cluster, whose machines all see the run folders."""
    address: str | None = None
    """Of the Ray cluster, such as `auto` or `ray://head:10001`; None starts Ray on this machine."""

    def __post_init__(self) -> None:
        """Validate."""
        if self.backend not in BACKENDS:
            raise ValueError(f"backend = {self.backend!r}: must be one of {', '.join(BACKENDS)}")
        if isinstance(self.jobs, bool) or not isinstance(self.jobs, int) or (self.jobs < 1 and self.jobs != -1):
            raise ValueError(f"jobs = {self.jobs!r}: must be an integer >= 1, or -1 for one on each CPU")


@dataclasses.dataclass(frozen=True)
class Failure:
    """A cell that could not be computed."""

    error: str
    """What went wrong, in a line."""
    record: Path
    """JSON file with the traceback and the configuration."""


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
    def _identity(self) -> dict[str, Any]:
        return {**vars(self), "env": self.env.as_mapping(), "run": None}

    @property
    def record(self) -> Path:
        """The JSON file of the result, in the run folder."""
        return self.run / _DEPLOYMENTS / f"{_digest(self._identity)}.json"


def cell_folder(root: Path, config: TrainConfig) -> Path:
    """The run folder of a configuration: readable, and different for any other configuration."""
    return root / f"{config.task}-{config.agent.name}-s{config.seed}-{_digest(config.as_mapping())}"


def read_failure(cell: Path | Deployment) -> Failure | None:
    """Why a cell was not finished when it was tried last; None if it did not fail.

    Args:
        cell: run folder of a training, or a test.
    """
    record = _failure_record(cell)
    return Failure(read_json(record, "record of a failure")["error"], record) if record.is_file() else None


def _failure_record(cell: Path | Deployment) -> Path:
    if isinstance(cell, Deployment):
        return cell.run.parent / _FAILURES / f"{cell.run.name}-{cell.record.stem}.json"
    return cell.parent / _FAILURES / f"{cell.name}.json"


def _note(cell: Path | Deployment, error: Exception | None, about: dict[str, Any]) -> Failure | None:
    """Keep a record of what went wrong with a cell; forget the last one if nothing did."""
    record = _failure_record(cell)
    if error is None:
        record.unlink(missing_ok=True)
        return None
    line = " ".join(str(error).split()) or type(error).__name__
    write_json(record, {"error": line, "traceback": "".join(traceback.format_exception(error)), **about})
    return Failure(line, record)


def train_cells(
    cells: Mapping[str, TrainConfig],
    root: Path,
    workers: Workers = Workers(),
    accept_changes: bool = False,
    on_cell: Callable[[str], None] | None = None,
) -> tuple[dict[str, Path], dict[str, Failure]]:
    """Train every cell that is not finished; one that fails does not stop the others.

    Args:
        cells: configurations by name; equal configurations are one cell.
        root: folder of the run folders.
        workers: what computes them.
        accept_changes: continue begun cells even if code or packages have changed since.
        on_cell: called with a cell's name when it is finished or has failed; those finished before come first, those of
            a Ray cluster when all are done.

    Returns:
        The run folders of the finished cells, and the failures; both by name. A failure's record stays in
        `root/failures` until the cell is finished.

    Raises:
        ValueError: Ray is asked for and not installed.
        TrainingStoppedError: a signal asked to stop.
    """
    folders = {name: cell_folder(root, config) for name, config in cells.items()}
    called: dict[Path, list[str]] = {}
    for name, folder in folders.items():
        called.setdefault(folder, []).append(name)
    waiting = [folder for folder in called if not finished(folder)]
    report = on_cell or (lambda _: None)
    for name, folder in folders.items():
        if folder not in waiting:
            report(name)
    parent = os.getpid() if workers.backend == "local" else None
    work = [(cells[called[folder][0]], folder, accept_changes, parent) for folder in waiting]
    failures: dict[Path, Failure] = {}
    for folder, failure in _compute(_train_cell, work, workers):
        if failure is not None:
            failures[folder] = failure
        for name in called[folder]:
            report(name)
    return (
        {name: folder for name, folder in folders.items() if folder not in failures},
        {name: failures[folder] for name, folder in folders.items() if folder in failures},
    )


def deploy_cells(
    deployments: Mapping[str, Deployment],
    workers: Workers = Workers(),
    on_cell: Callable[[str], None] | None = None,
) -> tuple[dict[str, dict[str, Any]], dict[str, Failure]]:
    """Evaluate policies; what was evaluated before is not evaluated again, and one that fails does not stop the others.

    Args:
        deployments: by name.
        workers: what computes them.
        on_cell: called with a deployment's name when it is evaluated or has failed; those evaluated before come first.

    Returns:
        `Evaluation.as_mapping()` of those that succeeded, and the failures; both by name. A failure's record stays in
        `failures` beside the run folders until the evaluation succeeds.

    Raises:
        ValueError: Ray is asked for and not installed, or a record of a result is damaged.
    """
    report = on_cell or (lambda _: None)
    waiting = {name: deployment for name, deployment in deployments.items() if not deployment.record.is_file()}
    for name in deployments:
        if name not in waiting:
            report(name)
    failures = {}
    for name, failure in _compute(_deploy_cell, list(waiting.items()), workers):
        if failure is not None:
            failures[name] = failure
        report(name)
    return {
        name: read_json(deployment.record, "evaluation")
        for name, deployment in deployments.items()
        if name not in failures
    }, failures


def _train_cell(
    config: TrainConfig, folder: Path, accept_changes: bool, parent: int | None
) -> tuple[Path, Failure | None]:
    """Train one cell: its folder, and what went wrong, of which a record is kept."""
    error = _try_to_train(config, folder, accept_changes, parent)
    return folder, _note(folder, error, {"train": config.as_mapping()})


def _try_to_train(config: TrainConfig, folder: Path, accept_changes: bool, parent: int | None) -> Exception | None:
    """Train, waiting for a folder that somebody else holds; what went wrong."""

    def stop_if_orphaned(_: Any) -> None:
        if parent is not None and os.getppid() != parent and os.getpid() != parent:
            os._exit(1)  # the grid was killed: another one may want to go on

    start = time.monotonic()
    while True:
        try:
            train(config, folder, stop_if_orphaned, resume=True, accept_changes=accept_changes, tensorboard=False)
            return None
        except TrainingStoppedError:
            raise
        except RunInUseError as error:
            if time.monotonic() - start > _PATIENCE:
                return error
            time.sleep(1.0)
        except Exception as error:
            return error


def _deploy_cell(name: str, deployment: Deployment) -> tuple[str, Failure | None]:
    """Evaluate one policy: its name, and what went wrong, of which a record is kept."""
    try:
        _deploy(deployment)
    except Exception as error:
        return name, _note(deployment, error, {"test": name, "run": deployment.run.name})
    return name, _note(deployment, None, {})


def _deploy(deployment: Deployment) -> None:
    from codrl_mj.evaluation import evaluate
    from codrl_mj.runs.policies import load_policy

    config = load_config(deployment.run, trust=True)  # ours: found by its configuration
    result = evaluate(
        load_policy(deployment.run),
        deployment.env.seen_as(config.env),
        deployment.episodes,
        deployment.seed,
    )
    write_json(deployment.record, result.as_mapping())


def _compute(function: Callable[..., Any], work: Iterable[tuple[Any, ...]], workers: Workers) -> Iterator[Any]:
    """Results of calls, as they come."""
    calls = list(work)
    if not calls:
        return
    import joblib

    with _backend(workers) as backend:
        # joblib hands results of Ray over when all are there
        order = "list" if backend == "ray" else "generator_unordered"
        parallel = joblib.Parallel(n_jobs=workers.jobs, backend=backend, batch_size=1, return_as=order)
        yield from parallel(joblib.delayed(function)(*call) for call in calls)


@contextlib.contextmanager
def _backend(workers: Workers) -> Iterator[str]:
    """The name in joblib of the backend, which is up while the block runs.

    Raises:
        ValueError: Ray is asked for and not installed.
    """
    if workers.backend == "local":
        yield "loky"
        return
    try:
        import ray
        from ray.util.joblib import register_ray
    except ModuleNotFoundError:
        raise ValueError("backend = 'ray': Ray is not installed: pip install 'codrl-mj[ray]'") from None
    ours = not ray.is_initialized()
    if ours:
        ray.init(address=workers.address, log_to_driver=False)
    register_ray()
    try:
        yield "ray"
    finally:
        if ours:
            ray.shutdown()


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
