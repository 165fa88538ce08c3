"""Run folders: finding them, what they came to, and what differs between them. A damaged one is listed as such."""

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

from codrl_mj.actuators import actuator_from_mapping, name_of, trusting
from codrl_mj.envs.worlds import patterns_of
from codrl_mj.fields import leaves
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
    """One run folder. What its files do not say is None."""

    path: Path
    """The folder."""
    name: str
    """The folder relative to the one that was searched."""
    state: Literal["finished", "unfinished", "damaged"]
    """Whether the training was finished. Damaged: a file cannot be read, or is missing."""
    problem: str | None = None
    """What is damaged."""
    task: str | None = None
    """Task name."""
    agent: str | None = None
    """Name of the agent, such as `ppo`."""
    actuator: str | None = None
    """Name of the actuator trained through; `custom` if it is none of the task's named ones."""
    seed: int | None = None
    """Training seed."""
    steps: int | None = None
    """Environment steps done."""
    total_steps: int | None = None
    """Environment steps to do."""
    mean_return: float | None = None
    """Mean return of the last training episodes, as training reported it last."""
    seconds: float | None = None
    """Wall-clock time of the training [s]."""
    modified: float | None = None
    """When one of its files was written last [s since 1970]."""
    evaluation: Mapping[str, Any] | None = None
    """`Evaluation.as_mapping()` of the last policy."""
    configuration: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What it was made with: fields of the training's configuration and of the software, by dotted names."""

    @property
    def evaluation_return(self) -> float | None:
        """Mean return of the evaluation of the last policy."""
        returns = (self.evaluation or {}).get("returns")
        return _number(returns.get("mean")) if isinstance(returns, Mapping) else None

    def as_mapping(self) -> dict[str, Any]:
        """The summary as JSON-serialisable values; `modified` in ISO 8601, UTC."""
        modified = None
        if self.modified is not None:
            modified = datetime.datetime.fromtimestamp(self.modified, datetime.UTC).isoformat(
                timespec="seconds"
            )
        values = {**vars(self), "path": str(self.path), "modified": modified}
        return values | {"evaluation_return": self.evaluation_return}


def find_runs(root: Path) -> list[RunSummary]:
    """Every run folder at or below a folder, by name. Hidden folders and folders within runs are passed over."""
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root} to look for runs in")
    found = []
    for folder, below, files in os.walk(root):
        if CONFIG in files:
            below.clear()
            path = Path(folder)
            found.append(
                read_run(path, path.relative_to(root).as_posix() if path != root else None)
            )
        below[:] = [name for name in below if not name.startswith(".")]
    return sorted(found, key=lambda run: run.name)


def median_seed(evaluation: Mapping[str, Any] | None) -> int | None:
    """Return the seed of the evaluated episode with the median return (of two, the lower); None if none is known."""
    returns, conditions = (
        (evaluation or {}).get(name) for name in ("episode_returns", "conditions")
    )
    seed = conditions.get("seed") if isinstance(conditions, Mapping) else None
    if not isinstance(returns, list) or not returns or not isinstance(seed, int):
        return None
    if not all(isinstance(one, int | float) for one in returns):
        return None
    return seed + sorted(range(len(returns)), key=returns.__getitem__)[(len(returns) - 1) // 2]


def describe_rank(evaluation: Mapping[str, Any] | None, total: float) -> str:
    """Return in words how an episode's return compares with those of an evaluation; nothing where there is none."""
    if (seed := median_seed(evaluation)) is None or evaluation is None:
        return ""
    returns = evaluation["episode_returns"]
    median, worse = (
        returns[seed - evaluation["conditions"]["seed"]],
        sum(one < total for one in returns),
    )
    return (
        f"of {len(returns)} evaluated episodes {worse} returned less, the median {median:.3g} (seed"
        f" {seed})"
    )


def read_evaluation(run: Path, best: bool) -> Mapping[str, Any] | None:
    """Return the evaluation of a run's last policy, or of its best; None if there is none that can be read."""
    return _mapping((run / BEST if best else run) / EVALUATION, "policy evaluation", [])


def read_run(path: Path, name: str | None = None) -> RunSummary:
    """What a run folder says; it is called by its own name unless another is given."""
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
    progress = next(reversed(read_reports(path / PROGRESS, problems)), None)
    result = _mapping(path / RESULT, "result of a run", problems)
    evaluation = _mapping(path / EVALUATION, "policy evaluation", problems)
    missing = [file for file in POLICY_FILES if not (path / file).is_file()]
    done = finished(path)
    if done and missing:
        problems.append(
            f"it is finished, but {' and '.join(missing)} is missing: copy the folder anew"
        )
    for folder in (path, path / BEST):
        described = _mapping(folder / DESCRIPTION, "policy description", problems)
        try:
            if described is not None and (folder / WEIGHTS).is_file():
                check_digest(
                    folder / WEIGHTS,
                    (folder / WEIGHTS).read_bytes(),
                    described.get(DIGEST),
                    DESCRIPTION,
                )
        except (ValueError, OSError) as error:
            problems.append(str(error))
    reported, learned = _first("steps", progress), _first("steps", result)
    if None not in (reported, learned) and reported != learned:
        problems.append(
            f"{path / PROGRESS} ends at step {reported:.0f} of {learned:.0f}: copy it anew"
        )
    agent = config.get("agent")
    task = env["task"] if isinstance(env.get("task"), str) else None
    steps, pace = _first("steps", result, progress), _first("steps_per_second", progress)
    uninterrupted = steps / pace if steps is not None and pace else None
    seconds = _first("seconds", result, progress)
    return RunSummary(
        path=path,
        name=path.resolve().name if name is None else name,
        state="damaged" if problems else "finished" if done else "unfinished",
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
        configuration=leaves(
            {
                **config,
                **{
                    key: one
                    for key, one in (content or {}).items()
                    if key not in ("train", "labels")
                },
            }
        ),
    )


def _mapping(path: Path, what: str, problems: list[str]) -> Mapping[str, Any] | None:
    """A JSON file's mapping; None if there is no such file, or if it is damaged, which is then noted."""
    try:
        content = read_json(path, what)
    except FileNotFoundError:
        return None
    except (ValueError, OSError, RecursionError) as error:
        problems.append(str(error))
        return None
    if not isinstance(content, Mapping):
        problems.append(f"{path} is not a {what}: it is no JSON object")
        return None
    return content


def read_reports(path: Path, problems: list[str]) -> list[Mapping[str, str]]:
    """The whole rows of a training's progress, as text: the last may be half written.

    `problems` gets what is wrong with the table, of which there are then no rows.
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


def _number(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _whole(value: Any) -> int | None:
    """A whole number, or None."""
    number = _number(value)
    return None if number is None else int(number)


def _modified(folder: Path) -> float | None:
    """When a file of a folder was written last [s since 1970]; files may vanish meanwhile."""
    times = []
    for file in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):
            if file.is_file():
                times.append(file.stat().st_mtime)
    return max(times, default=None)


def _first(name: str, *sources: Mapping[str, Any] | None) -> float | None:
    """The first of some sources' numbers of that name; None if none has one."""
    numbers = (_number((source or {}).get(name)) for source in sources)
    return next((number for number in numbers if number is not None), None)


def _actuator_of(env: Mapping[str, Any], task: str | None, labels: Any) -> str | None:
    """What to call an environment's actuators: those of motors, in environments of others those of patterns."""
    if "actuator" not in env:
        return None
    each, patterns = env["actuator"], patterns_of(env["actuator"])
    if patterns is not None:
        each = list(patterns.values())
    elif not isinstance(each, list):
        each = [each]
    labels = labels if isinstance(labels, list) else []
    papers = TASKS[task].paper if task in TASKS else ()
    names: list[str] = []
    for actuator, label, paper in itertools.zip_longest(
        each, labels[: len(each)], papers[: len(each)]
    ):
        if label or actuator is None or isinstance(actuator, str):
            names.append(str(label or actuator or "ideal"))
            continue
        try:
            with trusting(False):
                names.append(name_of(actuator_from_mapping(actuator), paper))
        except (
            ValueError,
            TypeError,
            AttributeError,
        ):  # somebody's family is called so, what cannot be read is not
            names.append(
                str(actuator.get("family", "custom")) if isinstance(actuator, Mapping) else "custom"
            )
    return ", ".join(dict.fromkeys(names))


SORT_KEYS = ("name", "task", "agent", "actuator", "state", "steps", "return", "seconds", "modified")
"""What runs can be sorted by."""
_HIGHEST_FIRST = ("steps", "return", "seconds", "modified")


def sort_runs(runs: Sequence[RunSummary], key: str) -> list[RunSummary]:
    """The runs in another order: names from A, numbers and times from the highest. Runs without a value come last.

    `return`, of `SORT_KEYS`, is the evaluation's, or the training's where there was none.
    """
    if key not in SORT_KEYS:
        raise ValueError(f"sort = {key!r}: must be one of {', '.join(SORT_KEYS)}")

    def value(run: RunSummary) -> Any:
        if key != "return":
            return getattr(run, key)
        return run.mean_return if run.evaluation_return is None else run.evaluation_return

    known = sorted(
        (run for run in runs if value(run) is not None), key=value, reverse=key in _HIGHEST_FIRST
    )
    return known + [run for run in runs if value(run) is None]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Runs side by side. Every row has a value for each run, None where it has none."""

    names: tuple[str, ...]
    """Names of the runs."""
    configuration: Mapping[str, tuple[Any, ...]]
    """Dotted name of a setting that differs -> its values."""
    results: Mapping[str, tuple[Any, ...]]
    """Name of a result -> its values; measures of the evaluation are numbers, or mappings of a mean and an interval."""
    units: Mapping[str, str]
    """Name of a result -> its unit."""


def compare(runs: Sequence[RunSummary]) -> Comparison:
    """What differs in the configuration of two or more runs, and their results."""
    if len(runs) < 2:
        raise ValueError(f"runs: {len(runs)}: there must be two or more to compare")
    named = [{**run.configuration, "env.actuator": run.actuator} for run in runs]
    if any(run.actuator == "ideal" for run in runs):  # which has no fields that could differ
        named = [
            {key: value for key, value in one.items() if not key.startswith("env.actuator.")}
            for one in named
        ]
    settings = {
        key: tuple(one.get(key) for one in named)
        for key in dict.fromkeys(key for one in named for key in one)
    }
    results: dict[str, tuple[Any, ...]] = {
        name: tuple(getattr(run, name) for run in runs)
        for name in ("state", "problem", "steps", "mean_return", "seconds")
    }
    evaluations = [run.evaluation or {} for run in runs]
    units = [one.get("units") for one in evaluations]
    measures = {
        name: str(unit) for one in units if isinstance(one, Mapping) for name, unit in one.items()
    }
    for measure in measures:
        results[f"evaluation.{measure}"] = tuple(one.get(measure) for one in evaluations)
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
