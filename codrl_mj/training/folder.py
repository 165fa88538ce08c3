"""A run folder: what is in it under which name, what it was made with, and whose it is while it grows."""

import contextlib
import functools
import hashlib
import importlib.metadata
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from codrl_mj.actuators import label_of, set_display_name, trusting
from codrl_mj.fields import command, differing
from codrl_mj.runs import (
    BEST,
    CHECKPOINT,
    CHECKPOINTS,
    CONFIG,
    CURVE,
    EPISODES,
    EVALUATION,
    LOCK,
    POLICY_FILES,
    PROGRESS,
    RESULT,
    TENSORBOARD,
    find_checkpoints,
    finished,
)
from codrl_mj.runs.files import check_writable, temporary_files, read_json
from codrl_mj.training.config import TrainConfig

_FILES = {CONFIG, RESULT, EVALUATION, PROGRESS, EPISODES, CURVE, *POLICY_FILES}
_PACKAGES = ("codrl-mj", "gymnasium", "mujoco", "numba", "numpy", "stable-baselines3", "torch")


class RunInUseError(RuntimeError):
    """Another process trains in a run folder."""


class TrainingStoppedError(Exception):
    """A training was asked to stop by a signal; it can be continued."""

    def __init__(self, message: str, signal_number: int) -> None:
        """Keep the signal, for the exit status."""
        super().__init__(message)
        self.signal_number = signal_number


def load_config(run: Path, trust: bool = False) -> TrainConfig:
    """The configuration of a run folder.

    Args:
        run: the folder.
        trust: whether to import the module of an actuator that is none of ours, which executes it.

    Raises:
        FileNotFoundError: the folder is no run folder.
        ValueError: its configuration is damaged.
    """
    content = read_json(run / CONFIG, "run configuration")
    try:
        with trusting(trust):
            config = TrainConfig.from_mapping(content["train"], whole=True)
        for actuator, label in zip(config.actuators, content.get("labels", ()), strict=False):
            set_display_name(actuator, label)
        return config
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run / CONFIG}: not a run configuration: {error}") from None


def admit(
    run: Path, config: TrainConfig, resume: bool, accept_changes: bool
) -> dict[str, Any] | None:
    """Refuse, before anything is made or compiled, a folder in which a training can neither begin nor go on.

    What a new run is, to be written once it begins; None where there is one to go on with, finished
    or not.
    """
    check_writable(run)
    if (run / LOCK).exists():
        with owned(run):
            pass
    exists, made_with = (run / CONFIG).exists(), provenance(config)
    if resume and exists:
        check_same(run, config, made_with, accept_changes)
        return None
    if run.exists() and not unused(run):
        remedy = "continue it with --resume, " if exists and not finished(run) else ""
        raise FileExistsError(
            f"run folder {run} exists already: {remedy}choose another --out, or delete it"
        )
    labels = [label_of(one) for one in config.actuators]
    return {
        "train": config.as_mapping(),
        **made_with,
        **({"labels": labels} if any(labels) else {}),
    }


def unused(run: Path) -> bool:
    """Whether no training has begun in a folder: it is empty, or who was to begin was killed before."""
    return {path.name for path in run.iterdir()} <= {LOCK, *(path.name for path in _leftovers(run))}


def needs_trust(run: Path) -> bool:
    """Return True if loading a run imports the module of somebody's own task, agent or actuator."""
    try:
        load_config(run)
    except (ValueError, OSError):  # also of a damaged run, which says so when it is loaded
        return True
    return False


def resuming(run: Path) -> str:
    """Return the command that continues a training."""
    return command("train", "--resume", run, trust=needs_trust(run))


def standing(run: Path) -> str:
    """What there is to go on from in the folder of a training that was broken off, and how."""
    if kept := find_checkpoints(run / CHECKPOINTS):
        step = max(int(named["step"]) for named in kept.values())
        return f"Its last checkpoint is of step {step:,}: continue with {resuming(run)}"
    if (run / BEST / EVALUATION).exists():
        return (
            f"It has no checkpoint to continue from, only its best policy so far, in {run / BEST}:"
            " start it anew"
        )
    return "It had no checkpoint yet, and nothing of it is left: start it anew"


def _leftovers(place: Path) -> list[Path]:
    """Half-written files of a training."""
    return [path for path, name in temporary_files(place) if name in _FILES or CHECKPOINT.fullmatch(name)]


def _sweep(run: Path) -> None:
    """Delete what a killed process left half-written. Only for who owns the folder: others' are in use."""
    for path in [*_leftovers(run), *_leftovers(run / BEST), *_leftovers(run / CHECKPOINTS)]:
        path.unlink(missing_ok=True)


def check_same(
    run: Path, config: TrainConfig, now: Mapping[str, Any], accept_changes: bool
) -> None:
    """Raise unless a run folder's training can be continued to the result that it would have had uninterrupted."""
    begun = load_config(run, trust=True)  # as its caller does, who names it
    if other := differing(begun.as_mapping(), config.as_mapping()):
        told = "; ".join(
            f"{name}: {there!r} and {asked!r}" for name, (there, asked) in other.items()
        )
        raise ValueError(
            f"{run} was started with another configuration (there, and asked for): {told}. A run"
            " continues as it began: choose another run folder for other settings"
        )
    then = read_json(run / CONFIG, "run configuration")
    versions = then.get("versions")
    if not isinstance(versions, Mapping):
        raise ValueError(
            f"{run / CONFIG}: not a run configuration: versions = {versions!r}: must be a mapping"
        )
    changed = [
        f"{name} was {was}, is {is_now}"
        for name, (was, is_now) in differing(versions, now["versions"]).items()
    ]
    if then.get("code") != now["code"]:
        changed.append(
            f"the code of codrl_mj was {str(then.get('code'))[:8]}, is {now['code'][:8]}"
        )
    if changed and not accept_changes:
        raise ValueError(
            f"{run} was started with other software: {'; '.join(changed)}. Its result might differ"
            " from that of one uninterrupted run: go back to that software, or accept it with"
            " --accept-changes"
        )


def provenance(config: TrainConfig) -> dict[str, Any]:
    """What a run's result depends on besides its configuration: package versions, and a digest of code.

    The code is ours, and the files of task, model, agent and family of actuators where these are
    somebody's own.
    """
    versions = {package: importlib.metadata.version(package) for package in _PACKAGES}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "code": _code_digest(*sorted(config.env.code | {type(config.agent).__module__}, key=str)),
    }


@functools.cache
def _code_digest(*others: str | Path) -> str:
    """SHA-256 over the package's Python files and models, and those modules and model files that are none of these."""
    from codrl_mj.user_code import asset_folder

    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for root, pattern in ((package, "*.py"), (asset_folder(), "*.xml")):
        for path in sorted(root.rglob(pattern)):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    for other in others:
        file = (
            getattr(sys.modules[other], "__file__", None) if isinstance(other, str) else other
        )  # a notebook has none
        if file is not None and not any(
            Path(file).is_relative_to(ours) for ours in (package, asset_folder())
        ):
            digest.update(Path(file).read_bytes())
    return digest.hexdigest()


@contextlib.contextmanager
def taken(run: Path, exists: bool) -> Iterator[None]:
    """Own a run folder while the block runs, and leave no new one in which nothing was learned when it raises."""
    made = [path for path in (run, *run.parents) if not path.exists()]
    with owned(run):
        if finished(run) or not ((run / CONFIG).exists() if exists else unused(run)):
            raise RunInUseError(
                f"{run}: another process trained in it in the meantime; start again"
            )
        _sweep(run)
        try:
            yield
        except BaseException as error:
            if exists or isinstance(
                error, TrainingStoppedError
            ):  # else all of it is this training's
                raise
            _sweep(run)
            if not [*run.glob(f"{CHECKPOINTS}/*"), *run.glob(f"{BEST}/*")]:
                for name in (CONFIG, PROGRESS, EPISODES, LOCK):
                    (run / name).unlink(missing_ok=True)
                shutil.rmtree(run / TENSORBOARD, ignore_errors=True)
                for path in (run / CHECKPOINTS, run / BEST, *made):
                    with contextlib.suppress(OSError):  # a folder that others use by now stays
                        path.rmdir()
            raise


@contextlib.contextmanager
def owned(run: Path) -> Iterator[None]:
    """Hold a run folder for oneself while the block runs; the system lets go of it if the process dies."""
    run.mkdir(parents=True, exist_ok=True)
    lock = FileLock(run / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise RunInUseError(
            f"{run}: another process is training in it; wait for it, or stop it"
        ) from None
    try:
        yield
    finally:
        lock.release()
