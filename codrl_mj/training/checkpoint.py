"""Checkpoints: states as files that appear whole, prove themselves intact, and hold nothing executable."""

import hashlib
import json
import re
import warnings
from pathlib import Path

from safetensors import safe_open
from safetensors.numpy import load, save

from codrl_mj.files import writing
from codrl_mj.training.state import State

KEPT = 2
"""Checkpoints that are kept: the last, and the one before in case the last is damaged."""
_NAME = re.compile(r"step-(\d{12})-([0-9a-f]{16})\.safetensors")


def save_checkpoint(folder: Path, state: State) -> Path:
    """Write a checkpoint and delete the oldest ones.

    Args:
        folder: of checkpoints.
        state: what to write; its step goes into the name, and so does a digest of the content.

    Returns:
        The file.

    Raises:
        OSError: it could not be written; those before are still there.
    """
    content = save(state.arrays, metadata={"facts": json.dumps(state.facts)})
    path = folder / f"step-{state.facts['num_timesteps']:012d}-{_digest(content)}.safetensors"
    with writing(path) as temporary:
        temporary.write_bytes(content)
    for old in _checkpoints(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def load_checkpoint(folder: Path) -> State | None:
    """The last checkpoint that is intact; None if there is none. Damaged ones are warned about and passed over."""
    for path in reversed(_checkpoints(folder)):
        try:
            return _read(path)
        except (ValueError, OSError) as error:
            warnings.warn(f"checkpoint {path} is damaged ({error}): going back to the one before", stacklevel=2)
    return None


def _read(path: Path) -> State:
    """Read one checkpoint.

    Raises:
        ValueError: it is not what was written.
    """
    content = path.read_bytes()
    match = _NAME.fullmatch(path.name)
    if match is None or _digest(content) != match[2]:
        raise ValueError("its content does not have the digest in its name")
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    return State(load(content), json.loads(metadata["facts"]))


def _checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a folder, the oldest first."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
