"""Files that appear whole or not at all."""

import contextlib
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_SEAL = "sha256"
_TEMPORARY = re.compile(
    r"\.(.+)-[a-z0-9_]{8}(\.[^.]+)?"
)  # what tempfile makes of the names that `atomic_write` asks for


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` when the block ends, and disappears if it raises.

    The folder is made if it is missing. The temporary name keeps the suffix, which some encoders go
    by.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())  # mkstemp's files are private
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def temporary_files(folder: Path) -> list[tuple[Path, str]]:
    """What `atomic_write` leaves in a folder if its process is killed, and the names that it was to become."""
    found = ((path, _TEMPORARY.fullmatch(path.name)) for path in folder.glob("*"))
    return [(path, match[1] + (match[2] or "")) for path, match in found if match is not None]


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path` that becomes `path` when the block ends, and disappears if it raises.

    It raises where `path` exists and is not an empty folder.
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
    mask = os.umask(0)
    os.umask(mask)
    return mask


def check_writable(folder: Path) -> None:
    """Find out before hours of work whether `folder` can hold results; makes nothing."""
    present = folder.absolute()
    while not present.exists():
        present = present.parent
    if not present.is_dir():
        raise NotADirectoryError(f"cannot write to {folder}: {present} is not a folder")
    try:
        tempfile.TemporaryFile(
            dir=present
        ).close()  # has no name; not even root may write everywhere
    except OSError as error:
        raise PermissionError(
            f"cannot write to {folder}: no permission to write in {present} ({error.strerror})"
        ) from None


def check_file(path: Path) -> None:
    """Find out before hours of work whether the file `path` can be written; makes nothing."""
    if path.is_dir():
        raise IsADirectoryError(
            f"cannot write {path}: it is a folder: name a file, such as {path}/NAME"
        )
    check_writable(path.parent)


def check_page(path: Path) -> None:
    """Refuse a page's file by its suffix, or where it cannot be written."""
    if path.suffix not in (".html", ".htm"):
        raise ValueError(
            f"page {path}: the suffix is {path.suffix!r}, must be .html; write {path.stem}.html"
        )
    check_file(path)


def write_json(path: Path, content: Any) -> None:
    """Write `content` as indented JSON, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")


def with_digest(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content and, as its entry `sha256`, a digest of all the rest, which `read_json` checks and takes off."""
    plain = json.loads(
        json.dumps(content)
    )  # what a reader will see: names that are text, lists for tuples
    return {_SEAL: hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest(), **plain}


def check_digest(path: Path, content: bytes, expected: Any, beside: str) -> None:
    """Refuse a file's content that has not the SHA-256 which the file `beside` it names; none where that is None."""
    if expected is not None and hashlib.sha256(content).hexdigest() != expected:
        raise ValueError(
            f"{path} is truncated or damaged, or it and {beside} do not belong together: its sha256"
            " is not the one there. Copy both files anew from where they came; a training that was"
            " killed mends its own when it is resumed"
        )


def select_prefix(prefix: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """What the names with that prefix name, by the rest of them: a file's arrays stand side by side."""
    return {
        name.removeprefix(prefix): value
        for name, value in content.items()
        if name.startswith(prefix)
    }


def read_json(path: Path, what: str) -> Any:
    """Read JSON; of what is `with_digest`, the content alone. `what` the file is goes into the error.

    A missing file is a FileNotFoundError, a truncated or edited one a ValueError.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no {what} at {path}")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a {what}: it is truncated or not JSON ({error})") from None
    if not isinstance(content, dict) or _SEAL not in content:
        return content
    plain = {name: value for name, value in content.items() if name != _SEAL}
    if content[_SEAL] != with_digest(plain)[_SEAL]:
        raise ValueError(
            f"{path} is not the {what} that was written: its content does not have the {_SEAL} that"
            " it names. It was damaged or edited: copy it anew from where it came, or delete its"
            f" entry {_SEAL} if you meant to edit it"
        )
    return plain
