"""Run folders: their files, the record of the software versions, and the lock during training."""

import contextlib
import functools
import hashlib
import importlib.metadata
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypedDict

from filelock import FileLock, Timeout

from codrl_mj.actuators import allow_imports, display_label, set_display_name
from codrl_mj.boundary import JsonObject
from codrl_mj.fields import command, differences
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
from codrl_mj.runs.files import check_writable, read_json, temporary_files
from codrl_mj.training.config import TrainConfig
from codrl_mj.user_code import UntrustedCodeError, asset_folder

_FILES = {CONFIG, RESULT, EVALUATION, PROGRESS, EPISODES, CURVE, *POLICY_FILES}
_PACKAGES = ("codrl-mj", "gymnasium", "mujoco", "numba", "numpy", "stable-baselines3", "torch")


class Software(TypedDict):
    """Software on which the result of a run depends."""

    versions: dict[str, str]
    """Version of Python and of each package."""
    code: str
    """SHA-256 digest of the code."""


class RunInUseError(RuntimeError):
    """Error: another process trains in the run folder."""


class TrainingStoppedError(Exception):
    """Raised if a signal, such as Ctrl-C, stops a training before its end; it can be resumed."""

    def __init__(self, message: str, signal_number: int) -> None:
        """Store the signal's number for the exit status."""
        super().__init__(message)
        self.signal_number = signal_number


def load_config(run: Path, trust: bool = False) -> TrainConfig:
    """Return the configuration of a run folder.

    Args:
        run: the folder.
        trust: import, and thereby execute, the module of a custom task, agent or actuator.

    Raises:
        FileNotFoundError: the folder is not a run folder.
        ValueError: its configuration is damaged.
    """
    content = read_json(run / CONFIG, "run configuration")
    try:
        with allow_imports(trust):
            config = TrainConfig.from_mapping(content["train"], whole=True)
        for actuator, label in zip(config.actuators, content.get("labels", ()), strict=False):
            set_display_name(actuator, label)
        return config
    except UntrustedCodeError as error:
        raise ValueError(f"{run / CONFIG}: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run / CONFIG}: not a run configuration: {error}") from None


def prepare_run(
    run: Path, config: TrainConfig, resume: bool, accept_changes: bool
) -> JsonObject | None:
    """Check a run folder before a training, and return the content of a new `config.json`.

    The check comes before anything is created or compiled.

    Returns:
        The content, to be written when training begins; None if the folder has a run to continue,
        which may be finished already.

    Raises:
        FileExistsError: the folder has other files, or a run, and `resume` is False.
        OSError: the folder cannot be written.
        RunInUseError: another process trains in it.
        ValueError: its run has another configuration, or was started with other software.
    """
    check_writable(run)
    if (run / LOCK).exists():
        with locked(run):
            pass
    exists, software = (run / CONFIG).exists(), provenance(config)
    if resume and exists:
        check_resumable(run, config, software, accept_changes)
        return None
    if run.exists() and not is_unused(run):
        remedy = "continue it with --resume, " if exists and not finished(run) else ""
        raise FileExistsError(
            f"run folder {run} exists already: {remedy}choose another --out, or delete it"
        )
    labels = [display_label(actuator) for actuator in config.actuators]
    return {
        "train": config.as_mapping(),
        **software,
        **({"labels": labels} if any(labels) else {}),
    }


def is_unused(run: Path) -> bool:
    """Return True if no training has started in a folder.

    Such a folder is empty, or has only temporary files of a process that was killed early.
    """
    return {path.name for path in run.iterdir()} <= {LOCK, *(path.name for path in _leftovers(run))}


def needs_trust(run: Path) -> bool:
    """Return True if loading a run imports the module of a custom task, agent or actuator."""
    try:
        load_config(run)
    except (ValueError, OSError):
        # A damaged run counts, too: the verb that loads it reports the damage.
        return True
    return False


def resume_command(run: Path) -> str:
    """Return the command that continues a training."""
    return command("train", "--resume", run, trust=needs_trust(run))


def describe_resumption(run: Path) -> str:
    """Return a sentence on how to continue a training that was interrupted."""
    if existing := find_checkpoints(run / CHECKPOINTS):
        step = max(int(parts["step"]) for parts in existing.values())
        return f"The last checkpoint is from step {step:,}: continue with {resume_command(run)}"
    if (run / BEST / EVALUATION).exists():
        return (
            f"It has no checkpoint to continue from. The best policy so far is in {run / BEST}."
            " Start it again"
        )
    return "It had no checkpoint yet, so its files were deleted: start it again"


def _leftovers(folder: Path) -> list[Path]:
    """Return the temporary files in which a killed training was writing."""
    return [
        path
        for path, name in temporary_files(folder)
        if name in _FILES or CHECKPOINT.fullmatch(name)
    ]


def _delete_leftovers(run: Path) -> None:
    """Delete incomplete files that a killed process has left in a run folder.

    The caller must have the folder's lock, because another process may be writing such files.
    """
    for path in [*_leftovers(run), *_leftovers(run / BEST), *_leftovers(run / CHECKPOINTS)]:
        path.unlink(missing_ok=True)


def check_resumable(
    run: Path, config: TrainConfig, software: Software, accept_changes: bool
) -> None:
    """Raise if continuing a training might not give the result of an uninterrupted training.

    Args:
        run: the run folder.
        config: configuration of the training.
        software: result of `provenance` for it.
        accept_changes: accept a run that was started with other software.

    Raises:
        ValueError: the configuration or the software differs.
    """
    # The caller has named the same configuration, and has thereby imported the same modules.
    started_config = load_config(run, trust=True)
    if changes := differences(started_config.as_mapping(), config.as_mapping()):
        description = "; ".join(
            f"{name}: {started!r} and {requested!r}"
            for name, (started, requested) in changes.items()
        )
        raise ValueError(
            f"{run} was started with another configuration (stored and requested values):"
            f" {description}. A run keeps its settings: choose another run folder for other"
            " settings"
        )
    record = read_json(run / CONFIG, "run configuration")
    versions = record.get("versions")
    if not isinstance(versions, Mapping):
        raise ValueError(
            f"{run / CONFIG}: not a run configuration: versions = {versions!r}: must be a mapping"
        )
    changed = [
        f"{name} was {stored}, is {current}"
        for name, (stored, current) in differences(versions, software["versions"]).items()
    ]
    if record.get("code") != software["code"]:
        changed.append(
            f"the code of codrl_mj was {str(record.get('code'))[:8]}, is {software['code'][:8]}"
        )
    if changed and not accept_changes:
        raise ValueError(
            f"{run} was started with other software: {'; '.join(changed)}. The result might differ"
            " from that of an uninterrupted run: install that software again, or accept the change"
            " with --accept-changes"
        )


def provenance(config: TrainConfig) -> Software:
    """Return the versions of packages and the digest of code on which a run's result depends.

    The code is that of this package, and the files of custom tasks, models, agents and families of
    actuators.
    """
    versions = {package: importlib.metadata.version(package) for package in _PACKAGES}
    return {
        "versions": {"python": platform.python_version(), **versions},
        "code": _code_digest(*sorted(config.env.code | {type(config.agent).__module__}, key=str)),
    }


@functools.cache
def _code_digest(*extra: str | Path) -> str:
    """Return the SHA-256 digest of the package's Python files and models, and of other files."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for root, pattern in ((package, "*.py"), (asset_folder(), "*.xml")):
        for path in sorted(root.rglob(pattern)):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    for source in extra:
        # The module of a notebook has no file.
        file = getattr(sys.modules[source], "__file__", None) if isinstance(source, str) else source
        if file is not None and not any(
            Path(file).is_relative_to(folder) for folder in (package, asset_folder())
        ):
            digest.update(Path(file).read_bytes())
    return digest.hexdigest()


@contextlib.contextmanager
def locked_for_training(run: Path, exists: bool) -> Iterator[None]:
    """Lock a run folder in a `with` block; delete a new folder if the block fails without results.

    Results are a checkpoint or a best policy. `exists` is True if the folder has a run to continue.
    """
    new_folders = [path for path in (run, *run.parents) if not path.exists()]
    with locked(run):
        if finished(run) or not ((run / CONFIG).exists() if exists else is_unused(run)):
            raise RunInUseError(
                f"{run}: another process has trained in it in the meantime; start again"
            )
        _delete_leftovers(run)
        try:
            yield
        except BaseException as error:
            # A folder is kept if it existed before, or if a stopped training can continue in it.
            # Otherwise all its files come from this training, and are deleted.
            if exists or isinstance(error, TrainingStoppedError):
                raise
            _delete_leftovers(run)
            if not [*run.glob(f"{CHECKPOINTS}/*"), *run.glob(f"{BEST}/*")]:
                for name in (CONFIG, PROGRESS, EPISODES, LOCK):
                    (run / name).unlink(missing_ok=True)
                shutil.rmtree(run / TENSORBOARD, ignore_errors=True)
                for path in (run / CHECKPOINTS, run / BEST, *new_folders):
                    # `rmdir` fails for a folder into which another process has written; it is kept.
                    with contextlib.suppress(OSError):
                        path.rmdir()
            raise


@contextlib.contextmanager
def locked(run: Path) -> Iterator[None]:
    """Lock a run folder in a `with` block; the system releases the lock if the process dies."""
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
