"""Checkpoints: states as files that appear whole, prove themselves intact, and hold nothing executable."""

import hashlib
import json
import os
import re
import warnings
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save

from codrl_mj.runs.files import writing
from codrl_mj.runs.layout import CHECKPOINT
from codrl_mj.training.state import State

KEPT = 2
"""Checkpoints that are kept: the last, and the one before in case the last is damaged."""


def save_checkpoint(folder: Path, state: State, run: str) -> Path:
    """Write a checkpoint and delete those that are no longer needed; those before stay where it cannot be written.

    Its name has its step and a digest of its content. `run` says what the run is (its configuration), so that none is
    continued from another's checkpoint.
    """
    content = save(state.arrays, metadata={"run": run, "facts": json.dumps(state.facts)})
    step = f"{state.facts['num_timesteps']:012d}"
    path = folder / f"step-{step}-{_digest(content)}.safetensors"
    with writing(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())  # on the disk before the last but one is deleted
    there = _checkpoints(folder)
    before = [other for other, named in there.items() if named["step"] < step]
    # the rest is of the same step or, damaged, of a later one, from which the run fell back
    for superfluous in there.keys() - {path, *before[1 - KEPT :]}:
        superfluous.unlink(missing_ok=True)
    return path


def load_checkpoint(folder: Path, run: str) -> State | None:
    """The last checkpoint of a run that is intact; None if there is none. Of damaged ones it warns."""
    checkpoints = _checkpoints(folder)
    for left, (path, named) in reversed(list(enumerate(checkpoints.items()))):
        try:
            return _read(path, named["digest"], run)
        except (ValueError, OSError) as error:
            remedy = "going back to the one before" if left else "no other is left: starting anew"
            warnings.warn(f"checkpoint {path} cannot be used ({error}): {remedy}", stacklevel=2)
    return None


def _read(path: Path, digest: str, run: str) -> State:
    """Read one checkpoint, refused if it is not what was written, or another run's."""
    content = path.read_bytes()
    if _digest(content) != digest:
        raise ValueError("it is damaged: its content does not have the digest in its name")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
        if metadata["run"] != run:
            raise ValueError("it is another run's")
        return State(load(content), json.loads(metadata["facts"]))
    except (SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"it is no checkpoint: {error!r}") from None


def _checkpoints(folder: Path) -> dict[Path, re.Match[str]]:
    """The checkpoints of a folder, the oldest first, and what their names say."""
    named = {path: CHECKPOINT.fullmatch(path.name) for path in sorted(folder.glob("*"))}
    return {path: match for path, match in named.items() if match is not None}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
