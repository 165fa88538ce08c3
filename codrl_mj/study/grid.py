"""Grid of trainings and tests; each cell is a run folder, named by its configuration.

A grid that was killed can be run again: finished cells are skipped, and started trainings continue
from their checkpoints.
"""

import dataclasses
import functools
import hashlib
import json
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar, TypeVarTuple

from codrl_mj.boundary import Argument, Json
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.fields import did_you_mean
from codrl_mj.runs.files import read_json, write_json
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.parallel import Workers, call_in_parallel
from codrl_mj.training import (
    RunInUseError,
    TrainConfig,
    TrainingStoppedError,
    finished,
    load_config,
    train,
)

Cell = TypeVar("Cell")
"""Name of a cell: a run folder, or the name of a test."""
Arguments = TypeVarTuple("Arguments")
_FAILURES, _DEPLOYMENTS = "failures", "deployments"
# Time [s] to wait for a run folder that a terminating process of a killed grid still locks.
_LOCK_TIMEOUT = 120.0


@dataclasses.dataclass(frozen=True)
class PolicyTest:
    """Test of a run's last policy in another environment, usually with another actuator."""

    run: Path
    """Finished run folder."""
    env: EnvConfig
    """Environment of the test, but with the actions and observations of the training."""
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode."""

    @functools.cached_property
    def record(self) -> Path:
        """JSON file of the result, in the run folder."""
        identity = {**vars(self), "env": self.env.as_mapping(), "run": None}
        return self.run / _DEPLOYMENTS / f"{_digest(identity)}.json"


def check_selection(field: str, names: Sequence[str], known: Iterable[str]) -> None:
    """Raise ValueError if a selection is empty or has an unknown name; suggest the nearest one."""
    known = list(known)
    for name in names:
        if name not in known:
            raise ValueError(
                f"{field}: unknown {name!r}: {did_you_mean(name, known)}Known are"
                f" {', '.join(known)}"
            )
    if not names:
        raise ValueError(f"{field}: empty: name one or more of {', '.join(known)}")


def cell_folder(root: Path, config: TrainConfig) -> Path:
    """Return the run folder of a configuration; its name ends with the configuration's digest."""
    return root / f"{config.task}-{config.agent.name}-s{config.seed}-{_digest(config.as_mapping())}"


def read_failure(cell: Path | PolicyTest) -> str | None:
    """Return the error of the last attempt of a cell (run folder or test), in one line, or None."""
    record = failure_record(cell)
    return str(read_json(record, "record of a failure")["error"]) if record.is_file() else None


def failure_record(cell: Path | PolicyTest) -> Path:
    """Return the JSON file of a cell's failure: error, traceback and configuration."""
    if isinstance(cell, PolicyTest):
        return cell.run.parent / _FAILURES / f"{cell.run.name}-{cell.record.stem}.json"
    return cell.parent / _FAILURES / f"{cell.name}.json"


def train_runs(
    runs: Mapping[Path, TrainConfig],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    on_run: Callable[[Path], None] = lambda _: None,
    **options: Argument,
) -> dict[Path, str]:
    """Train every run that is not finished.

    Args:
        runs: run folder -> configuration.
        workers: settings of the worker processes.
        on_run: called with a folder when its training has finished or failed, and first with each
            run that was already finished.
        **options: further arguments of `training.train`.

    Returns:
        Run folder -> error, for failed trainings.
    """
    work = {
        folder: (folder, {"train": config.as_mapping()}, _train, config, folder, options)
        for folder, config in runs.items()
        if not finished(folder)
    }
    return _compute(runs, work, workers, on_run)


def run_tests(
    policy_tests: Mapping[str, PolicyTest],
    workers: Workers = Workers(),  # noqa: B008 - frozen
    on_cell: Callable[[str], None] = lambda _: None,
) -> None:
    """Run every test that has no record yet, and write its record, an `Evaluation.as_mapping()`.

    Args:
        policy_tests: name of the test -> test.
        workers: settings of the worker processes.
        on_cell: called with a name when its test has finished or failed, and first with each test
            that was already finished.
    """
    work = {
        name: (test, {"test": name, "run": test.run.name}, _run_test, test)
        for name, test in policy_tests.items()
        if not test.record.is_file()
    }
    _compute(policy_tests, work, workers, on_cell)


def _compute(
    cells: Iterable[Cell],
    work: Mapping[Cell, tuple[object, ...]],
    workers: Workers,
    on_cell: Callable[[Cell], None],
) -> dict[Cell, str]:
    """Call `_attempt` for each cell with work; return the errors by cell."""
    for cell in cells:
        if cell not in work:
            on_cell(cell)
    failures: dict[Cell, str] = {}
    for cell, failure in call_in_parallel(
        _attempt, ((cell, *arguments) for cell, arguments in work.items()), workers
    ):
        if failure is not None:
            failures[cell] = failure
        on_cell(cell)
    return failures


def _attempt(
    name: Cell,
    cell: Path | PolicyTest,
    context: Mapping[str, Json],
    function: Callable[[*Arguments], None],
    *arguments: *Arguments,
) -> tuple[Cell, str | None]:
    """Call a function, and record its error; return the name and the error in one line, or None."""
    record = failure_record(cell)
    try:
        function(*arguments)
    except TrainingStoppedError:
        raise
    except Exception as error:
        line = " ".join(str(error).split()) or type(error).__name__
        write_json(
            record,
            {"error": line, "traceback": "".join(traceback.format_exception(error)), **context},
        )
        return name, line
    record.unlink(missing_ok=True)
    return name, None


def _train(config: TrainConfig, folder: Path, options: Mapping[str, Argument]) -> None:
    """Train one run, waiting while another process locks its folder."""
    start = time.monotonic()
    while True:
        try:
            train(config, folder, resume=True, **options)
            return
        except RunInUseError:
            if time.monotonic() - start > _LOCK_TIMEOUT:
                raise
            time.sleep(1.0)


def _run_test(test: PolicyTest) -> None:
    """Evaluate one policy."""
    # The folder is trusted: its name is the digest of a configuration that this process made.
    config = load_config(test.run, trust=True)
    env = dataclasses.replace(test.env, **config.env.policy_fields)
    result = evaluate(load_policy(test.run), env, test.episodes, test.seed)
    write_json(test.record, result.as_mapping())


def _digest(content: Json) -> str:
    """Return a short digest of JSON-serializable content."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
