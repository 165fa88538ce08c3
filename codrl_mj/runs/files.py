"""Atomic writing of files, and reading with digests."""

import contextlib
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypeVar

from codrl_mj.boundary import Json, JsonObject

Entry = TypeVar("Entry")
"""Value in a mapping."""
_DIGEST_KEY = "sha256"
# Temporary names that tempfile makes from the prefix and suffix of `atomic_write`.
_TEMPORARY = re.compile(r"\.(.+)-[a-z0-9_]{8}(\.[^.]+)?")


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` after the block, or is deleted if it raises.

    A missing folder is created. The temporary name keeps the suffix, because some encoders choose
    the format by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp creates private files; a new file normally has the mode 0666 minus the umask.
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def temporary_files(folder: Path) -> list[tuple[Path, str]]:
    """Return temporary files left by a killed `atomic_write`, with their final names."""
    matches = ((path, _TEMPORARY.fullmatch(path.name)) for path in folder.glob("*"))
    return [(path, match[1] + (match[2] or "")) for path, match in matches if match is not None]


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` after the block, or is deleted if it raises.

    Raises:
        OSError: `path` exists and is not an empty folder.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        temporary.replace(path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _umask() -> int:
    # The umask can only be read by setting it.
    mask = os.umask(0)
    os.umask(mask)
    return mask


def check_writable(folder: Path) -> None:
    """Raise if `folder` cannot be written to.

    Verbs call it before hours of work. It creates nothing.
    """
    existing = folder.absolute()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise NotADirectoryError(f"cannot write to {folder}: {existing} is not a folder")
    try:
        # Permission bits are not reliable (root, read-only file systems), so a temporary file
        # without a name is created.
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        raise PermissionError(
            f"cannot write to {folder}: no permission to write in {existing} ({error.strerror})"
        ) from None


def check_file(path: Path) -> None:
    """Raise if the file `path` cannot be written; nothing is created."""
    if path.is_dir():
        raise IsADirectoryError(
            f"cannot write {path}: it is a folder: name a file, such as {path}/NAME"
        )
    check_writable(path.parent)


def check_page(path: Path) -> None:
    """Raise if an HTML page has the wrong suffix or cannot be written."""
    if path.suffix not in (".html", ".htm"):
        raise ValueError(
            f"page {path}: the suffix is {path.suffix!r}, must be .html; write {path.stem}.html"
        )
    check_file(path)


def write_json(path: Path, content: Json) -> None:
    """Write `content` atomically as indented JSON."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")


def with_digest(content: Mapping[str, Json]) -> JsonObject:
    """Return the content with its digest as the entry `sha256`, which `read_json` checks."""
    # Hash the content as it is after a round trip through JSON: keys are strings, tuples are lists.
    json_content = json.loads(json.dumps(content))
    return {
        _DIGEST_KEY: hashlib.sha256(json.dumps(json_content, sort_keys=True).encode()).hexdigest(),
        **json_content,
    }


def check_digest(path: Path, content: bytes, expected: object, description: str) -> None:
    """Raise if a file's content does not have the expected SHA-256; None accepts any content.

    Args:
        path: the file.
        content: its content.
        expected: the recorded digest.
        description: name of the file that records the digest.
    """
    if expected is not None and hashlib.sha256(content).hexdigest() != expected:
        raise ValueError(
            f"{path} is truncated or damaged, or it and {description} do not belong together: its"
            " sha256 differs from the recorded one. Copy both files again from their source; if the"
            " training was killed, resume it, which repairs the files"
        )


def select_prefix(prefix: str, content: Mapping[str, Entry]) -> dict[str, Entry]:
    """Return the entries whose names have a prefix, without the prefix."""
    return {
        name.removeprefix(prefix): value
        for name, value in content.items()
        if name.startswith(prefix)
    }


def read_json(path: Path, kind: str) -> Json:
    """Read JSON; check and remove the digest of `with_digest`, if any.

    Args:
        path: the file.
        kind: description of the file for error messages.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the file is truncated or was edited.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} at {path}")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a {kind}: it is truncated or not JSON ({error})") from None
    if not isinstance(content, dict) or _DIGEST_KEY not in content:
        return content
    json_content = {name: value for name, value in content.items() if name != _DIGEST_KEY}
    if content[_DIGEST_KEY] != with_digest(json_content)[_DIGEST_KEY]:
        raise ValueError(
            f"{path} is not the {kind} that was written: its content does not match its entry"
            f" {_DIGEST_KEY}. It was damaged or edited: copy it again from its source, or delete"
            f" the entry {_DIGEST_KEY} if you edited it on purpose"
        )
    return json_content
