"""Summaries and comparisons of run folders; damaged folders are listed as damaged."""

import contextlib
import csv
import dataclasses
import datetime
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from codrl_mj.actuators import actuator_from_mapping, allow_imports, display_name
from codrl_mj.boundary import Json, JsonObject
from codrl_mj.envs.patterns import pattern_mapping
from codrl_mj.fields import flatten
from codrl_mj.runs import (
    BEST,
    CONFIG,
    DESCRIPTION,
    DIGEST,
    EVALUATION,
    POLICY_FILES,
    PROGRESS,
    RESULT,
    WEIGHTS,
    finished,
)
from codrl_mj.runs.files import check_digest, read_json
from codrl_mj.tasks import TASKS


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """Summary of a run folder; values missing from its files are None."""

    path: Path
    """The folder."""
    name: str
    """Path relative to the searched folder."""
    state: Literal["finished", "unfinished", "damaged"]
    """State of the training; `damaged` if a file is missing or cannot be read."""
    problem: str | None = None
    """Description of the damage."""
    task: str | None = None
    """Task name."""
    agent: str | None = None
    """Name of the agent, such as `ppo`."""
    actuator: str | None = None
    """Name of the actuator in training; `custom` if it is not a named one of the task."""
    seed: int | None = None
    """Training seed."""
    steps: int | None = None
    """Completed environment steps."""
    total_steps: int | None = None
    """Planned environment steps."""
    mean_return: float | None = None
    """Mean return of the last training episodes, from the last report."""
    seconds: float | None = None
    """Wall-clock time of the training [s]."""
    modified: float | None = None
    """Time of the last change of a file [s since 1970]."""
    evaluation: Mapping[str, Json] | None = None
    """`Evaluation.as_mapping()` of the last policy."""
    configuration: Mapping[str, object] = dataclasses.field(default_factory=dict)
    """Fields of the training configuration and software versions, by dotted name."""

    @property
    def evaluation_return(self) -> float | None:
        """Mean return of the evaluation of the last policy."""
        returns = (self.evaluation or {}).get("returns")
        return _number(returns.get("mean")) if isinstance(returns, Mapping) else None

    def as_mapping(self) -> JsonObject:
        """Return the summary as JSON-serializable values; `modified` in ISO 8601, UTC."""
        modified = None
        if self.modified is not None:
            modified = datetime.datetime.fromtimestamp(self.modified, datetime.UTC).isoformat(
                timespec="seconds"
            )
        values = {**vars(self), "path": str(self.path), "modified": modified}
        return values | {"evaluation_return": self.evaluation_return}


def find_runs(root: Path) -> list[RunSummary]:
    """Return the runs in a folder and its subfolders, sorted by name; skip hidden folders."""
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root} to search for runs")
    runs = []
    for folder, subfolders, files in os.walk(root):
        if CONFIG in files:
            subfolders.clear()
            path = Path(folder)
            runs.append(read_run(path, path.relative_to(root).as_posix() if path != root else None))
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
    return sorted(runs, key=lambda run: run.name)


def median_seed(evaluation: Mapping[str, Json] | None) -> int | None:
    """Return the seed of the evaluated episode with the (lower) median return; None if unknown."""
    returns, conditions = (
        (evaluation or {}).get(name) for name in ("episode_returns", "conditions")
    )
    seed = conditions.get("seed") if isinstance(conditions, Mapping) else None
    if not isinstance(returns, list) or not returns or not isinstance(seed, int):
        return None
    if not all(isinstance(value, int | float) for value in returns):
        return None
    return seed + sorted(range(len(returns)), key=returns.__getitem__)[(len(returns) - 1) // 2]


def describe_rank(evaluation: Mapping[str, Json] | None, total: float) -> str:
    """Return a text that compares an episode's return with an evaluation; "" without evaluation."""
    if (seed := median_seed(evaluation)) is None or evaluation is None:
        return ""
    returns = evaluation["episode_returns"]
    median = returns[seed - evaluation["conditions"]["seed"]]
    num_lower = sum(value < total for value in returns)
    return (
        f"{num_lower} of {len(returns)} evaluated episodes had a lower return; the median is"
        f" {median:.3g} (seed {seed})"
    )


def read_evaluation(run: Path, best: bool) -> Mapping[str, Json] | None:
    """Return the evaluation of a run's last or best policy; None if missing or unreadable."""
    return _mapping((run / BEST if best else run) / EVALUATION, "policy evaluation", [])


def read_run(path: Path, name: str | None = None) -> RunSummary:
    """Summarize a run folder; the default name is that of the folder."""
    if not (path / CONFIG).is_file():
        raise FileNotFoundError(f"no run at {path}: there is no {CONFIG}")
    problems: list[str] = []
    content = _mapping(path / CONFIG, "run configuration", problems)
    config = content.get("train") if content is not None else {}
    if not isinstance(config, Mapping):
        problems.append(f"{CONFIG} is not a run configuration: it has no 'train'")
        config = {}
    env = config.get("env")
    env = env if isinstance(env, Mapping) else {}
    progress = next(reversed(read_progress(path / PROGRESS, problems)), None)
    result = _mapping(path / RESULT, "result of a run", problems)
    evaluation = _mapping(path / EVALUATION, "policy evaluation", problems)
    missing = [file for file in POLICY_FILES if not (path / file).is_file()]
    is_finished = finished(path)
    if is_finished and missing:
        problems.append(
            f"it is finished, but {' and '.join(missing)} is missing: copy the folder again"
        )
    for folder in (path, path / BEST):
        description = _mapping(folder / DESCRIPTION, "policy description", problems)
        try:
            if description is not None and (folder / WEIGHTS).is_file():
                check_digest(
                    folder / WEIGHTS,
                    (folder / WEIGHTS).read_bytes(),
                    description.get(DIGEST),
                    DESCRIPTION,
                )
        except (ValueError, OSError) as error:
            problems.append(str(error))
    reported, trained_steps = _first("steps", progress), _first("steps", result)
    if None not in (reported, trained_steps) and reported != trained_steps:
        problems.append(
            f"{path / PROGRESS} ends at step {reported:.0f} of {trained_steps:.0f}: copy it again"
        )
    agent = config.get("agent")
    task = env["task"] if isinstance(env.get("task"), str) else None
    steps, rate = _first("steps", result, progress), _first("steps_per_second", progress)
    uninterrupted = steps / rate if steps is not None and rate else None
    seconds = _first("seconds", result, progress)
    return RunSummary(
        path=path,
        name=path.resolve().name if name is None else name,
        state="damaged" if problems else "finished" if is_finished else "unfinished",
        problem="; ".join(problems) or None,
        task=task,
        agent=str(agent["name"]) if isinstance(agent, Mapping) and "name" in agent else None,
        actuator=_actuator_of(env, task, (content or {}).get("labels")),
        seed=_whole(config.get("seed")),
        steps=_whole(steps),
        total_steps=_whole(config.get("total_steps")),
        mean_return=_first("mean_return", progress, result),
        seconds=uninterrupted if seconds is None else seconds,
        modified=_modified(path),
        evaluation=evaluation,
        configuration=flatten(
            {
                **config,
                **{
                    key: value
                    for key, value in (content or {}).items()
                    if key not in ("train", "labels")
                },
            }
        ),
    )


def _mapping(path: Path, kind: str, problems: list[str]) -> Mapping[str, Json] | None:
    """Return the mapping in a JSON file; None if it is missing or damaged (added to `problems`)."""
    try:
        content = read_json(path, kind)
    except FileNotFoundError:
        return None
    except (ValueError, OSError, RecursionError) as error:
        problems.append(str(error))
        return None
    if not isinstance(content, Mapping):
        problems.append(f"{path} is not a {kind}: it is not a JSON object")
        return None
    return content


def read_progress(path: Path, problems: list[str]) -> list[Mapping[str, str]]:
    """Return the complete rows of a training's progress file, as text.

    A last row that is only partly written is skipped. If the table cannot be read, the error is
    added to `problems`.
    """
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError:
        return []
    except (ValueError, OSError, csv.Error) as error:
        problems.append(f"{path.name} cannot be read: {error}")
        return []
    if rows and "steps" not in rows[0]:
        problems.append(f"{path.name} has no column 'steps'")
    return [row for row in rows if None not in row and None not in row.values()]


def _number(value: Json) -> float | None:
    """Convert a value to a finite number; None if that is impossible."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _whole(value: Json) -> int | None:
    """Convert a value to an integer; None if that is impossible."""
    number = _number(value)
    return None if number is None else int(number)


def _modified(folder: Path) -> float | None:
    """Return the time of the last change of a file in a folder [s since 1970]."""
    times = []
    for file in folder.iterdir():
        # Another process may delete files meanwhile, such as temporary ones.
        with contextlib.suppress(FileNotFoundError):
            if file.is_file():
                times.append(file.stat().st_mtime)
    return max(times, default=None)


def _first(name: str, *sources: Mapping[str, Json] | None) -> float | None:
    """Return the first finite number among the mappings' values of a key; None if there is none."""
    numbers = (_number((source or {}).get(name)) for source in sources)
    return next((number for number in numbers if number is not None), None)


def _actuator_of(env: Mapping[str, Json], task: str | None, labels: object) -> str | None:
    """Return the names of an environment's actuators, by motor or by pattern of motors."""
    if "actuator" not in env:
        return None
    actuators, patterns = env["actuator"], pattern_mapping(env["actuator"])
    if patterns is not None:
        actuators = list(patterns.values())
    elif not isinstance(actuators, list):
        actuators = [actuators]
    labels = labels if isinstance(labels, list) else []
    papers = TASKS[task].paper if task in TASKS else ()
    names: list[str] = []
    for actuator, label, paper in itertools.zip_longest(
        actuators, labels[: len(actuators)], papers[: len(actuators)]
    ):
        if label or actuator is None or isinstance(actuator, str):
            names.append(str(label or actuator or "ideal"))
            continue
        try:
            with allow_imports(False):
                names.append(display_name(actuator_from_mapping(actuator), paper))
        # A custom family keeps its family name; an unreadable description is "custom".
        except (ValueError, TypeError, AttributeError):
            names.append(
                str(actuator.get("family", "custom")) if isinstance(actuator, Mapping) else "custom"
            )
    return ", ".join(dict.fromkeys(names))


SORT_KEYS = ("name", "task", "agent", "actuator", "state", "steps", "return", "seconds", "modified")
"""Keys for sorting runs."""
# Type checkers have no name for the types whose values can be compared with each other.
Comparable = Any
"""Value that sorting compares with other ones of its kind."""
_HIGHEST_FIRST = ("steps", "return", "seconds", "modified")


def sort_runs(runs: Sequence[RunSummary], key: str) -> list[RunSummary]:
    """Sort runs: names from A to Z, numbers and times descending, runs without a value last.

    The key `return` is the mean return of the evaluation, or of the training without evaluation.
    """
    if key not in SORT_KEYS:
        raise ValueError(f"sort = {key!r}: must be one of {', '.join(SORT_KEYS)}")

    def value(run: RunSummary) -> Comparable:
        if key != "return":
            return getattr(run, key)
        return run.mean_return if run.evaluation_return is None else run.evaluation_return

    known = sorted(
        (run for run in runs if value(run) is not None), key=value, reverse=key in _HIGHEST_FIRST
    )
    return known + [run for run in runs if value(run) is None]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Comparison of runs; every row has a value for each run, or None."""

    names: tuple[str, ...]
    """Names of the runs."""
    configuration: Mapping[str, tuple[Json, ...]]
    """Dotted name of a differing setting -> values."""
    results: Mapping[str, tuple[Json, ...]]
    """Name of a result -> values; a measure is a number, or a mapping with mean and interval."""
    units: Mapping[str, str]
    """Name of a result -> unit."""


def compare(runs: Sequence[RunSummary]) -> Comparison:
    """Return the differing settings and the results of two or more runs."""
    if len(runs) < 2:
        raise ValueError(f"runs: got {len(runs)}: a comparison needs two or more")
    named = [{**run.configuration, "env.actuator": run.actuator} for run in runs]
    # The ideal actuator has no fields, so only the names of the actuators are compared.
    if any(run.actuator == "ideal" for run in runs):
        named = [
            {key: value for key, value in entry.items() if not key.startswith("env.actuator.")}
            for entry in named
        ]
    settings = {
        key: tuple(entry.get(key) for entry in named)
        for key in dict.fromkeys(key for entry in named for key in entry)
    }
    results: dict[str, tuple[Json, ...]] = {
        name: tuple(getattr(run, name) for run in runs)
        for name in ("state", "problem", "steps", "mean_return", "seconds")
    }
    evaluations = [run.evaluation or {} for run in runs]
    units = [entry.get("units") for entry in evaluations]
    measures = {
        name: str(unit)
        for entry in units
        if isinstance(entry, Mapping)
        for name, unit in entry.items()
    }
    for measure in measures:
        results[f"evaluation.{measure}"] = tuple(entry.get(measure) for entry in evaluations)
    results = {
        name: values
        for name, values in results.items()
        if any(value is not None for value in values)
    }
    known_units = {f"evaluation.{measure}": unit for measure, unit in measures.items()}
    known_units |= {"seconds": "s", "mean_return": "reward"}
    return Comparison(
        names=tuple(run.name for run in runs),
        configuration={
            key: values
            for key, values in settings.items()
            if any(value != values[0] for value in values)
        },
        results=results,
        units={name: unit for name, unit in known_units.items() if name in results},
    )
