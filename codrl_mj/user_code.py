"""What users write: modules and model files that names stand for, and functions, called once before they are compiled.

Errors in them are one sentence.
"""

import codecs
import contextlib
import contextvars
import functools
import importlib
import inspect
import itertools
import numbers
import re
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj import fields

Form = Any
"""What a function is to return: the name of a number, or a tuple of forms."""


def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function of a user's, known by a name in messages, returns."""
    if not inspect.isfunction(function):
        raise ValueError(f"{name} = {function!r}: must be a function in plain Python")
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except Exception as error:
        own = [
            f
            for f in traceback.extract_tb(error.__traceback__)
            if f.filename == function.__code__.co_filename
        ]
        where = place(function, own[-1].lineno if own else None)
        raise ValueError(f"{where}: {type(error).__name__}: {error}") from error


def place(function: Callable[..., Any], line: int | None = None) -> str:
    """File, line (where it begins, unless told otherwise) and name of a function, for messages."""
    code = function.__code__
    return f"{Path(code.co_filename).name}:{line or code.co_firstlineno}, in {code.co_name}"


def check_form(function: Callable[..., Any], value: Any, form: Form, declared: str) -> Any:
    """What a function returns (or numba says that it does), which has to be of a form; `declared` says where."""
    if not _fits(value, form):
        raise ValueError(
            f"{place(function)}: returns {_said(value)}, must return {_wanted(form)}: see"
            f" {declared}"
        )
    return value


def _fits(value: Any, form: Form) -> bool:
    if isinstance(form, str):
        scalar = (
            isinstance(value, np.ndarray) and value.shape == () and value.dtype.kind in "biuf"
        )  # of np.where
        return scalar or isinstance(value, numbers.Real | np.bool_)
    return isinstance(value, tuple) and len(value) == len(form) and all(map(_fits, value, form))


def _said(value: Any) -> str:
    """What was returned, in words; numba's types have names."""
    if isinstance(value, tuple):
        flat = _fits(value, ("",) * len(value))
        return f"a tuple of {len(value)}" if flat else f"({', '.join(map(_said, value))})"
    return "a number" if _fits(value, "") else str(getattr(value, "name", type(value).__name__))


def _wanted(form: Form) -> str:
    if isinstance(form, str):
        return "a number"
    flat = all(isinstance(one, str) for one in form)
    return (
        f"a tuple of {len(form)} ({', '.join(form)})"
        if flat
        else f"({', '.join(map(_wanted, form))})"
    )


def not_compiled(function: Callable[..., Any], error: Exception) -> str:
    """What numba says of a function that it does not compile, as a sentence."""
    text = str(error)
    lines = [
        line.strip()
        for line in text.splitlines()
        if line.strip() and not line.strip().startswith("Failed in")
    ]
    causes = [
        cause for cause in re.findall(r"\w*Error: (.+)", text) if not cause.startswith("Failed in")
    ]
    said = causes[-1] if causes else " ".join(lines[:2] if lines[0].endswith(":") else lines[:1])
    line = re.search(r'(?m)^\s*File ".+", line (\d+):', text)
    return (
        f"{place(function, int(line[1]) if line else None)}: numba does not compile it:"
        f" {said.strip()}"
    )


def asset_folder() -> Path:
    """The folder of our MJCF files and of `motors/`: in a checkout `assets/`, in a wheel inside the package."""
    package = Path(__file__).parent
    for folder in (package / "_assets", package.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"no models beside codrl_mj in {package}: the installation is incomplete"
    )


def asset_path(name: str) -> Path:
    """Path of an MJCF file: somebody's own, or of ours the one of that name."""
    for path in (Path(name), asset_folder() / name):
        if path.is_file():
            return path
    if Path(name).parent == Path():
        raise FileNotFoundError(
            f"no model {name!r} in {Path.cwd()}, nor among codrl_mj's: give the whole path"
        )
    raise FileNotFoundError(f"no model file {name}")


def read_text(path: Path) -> str:
    """Return the text of a file, without the byte order mark that some editors put in front.

    Raises:
        ValueError: it is not UTF-8; the message has the line, and the character if it was saved in
            Windows-1252.
    """
    content = path.read_bytes()
    try:
        wide = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        return (
            content.decode("utf-16" if wide else "utf-8-sig")
            .replace("\r\n", "\n")
            .replace("\r", "\n")
        )
    except UnicodeDecodeError as error:
        line, byte = (
            content.count(b"\n", 0, error.start) + 1,
            content[error.start : error.start + 1],
        )
        meant = byte.decode("cp1252", "replace")
        raise ValueError(
            f"line {line} has the byte 0x{byte.hex()} ({meant} in Windows-1252), which is not"
            " UTF-8: save the file as UTF-8"
        ) from None


def read_yaml(path: Path) -> Any:
    """Return what a YAML or JSON file holds, with numbers as in YAML 1.2 and JSON: 3e-4, Infinity; 20:1 is a text.

    Raises:
        ValueError: it is not YAML, or one mapping has a key twice.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [key.value for key, _ in node.value]
            for key, _ in node.value[::-1]:
                if keys.count(key.value) > 1 and key.value != "<<":
                    raise ValueError(
                        f"line {key.start_mark.line + 1}: {key.value} is given twice: leave one out"
                    )
            return super().construct_mapping(node, deep)

    kinds = {
        "int": r"[-+]?(0|[1-9][\d_]*)$|0x[\da-fA-F]+$",
        "float": r"[-+]?(\d[\d_]*(\.\d*)?|\.\d+)([eE][-+]?\d+)?$",
    }
    kinds["float"] += r"|[-+]?(\.(inf|Inf|INF)|Infinity)$|\.?(nan|NaN|NAN)$"
    tags = {f"tag:yaml.org,2002:{kind}": re.compile(text) for kind, text in kinds.items()}
    Loader.yaml_implicit_resolvers = {
        start: [one for one in several if one[0] not in tags]
        for start, several in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for tag, pattern in tags.items():
        Loader.add_implicit_resolver(tag, pattern, list("-+.0123456789INn"))
    try:
        return yaml.load(read_text(path), Loader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


class UntrustedCodeError(ValueError):
    """A module that a file names, and that nobody said to trust."""


_TRUSTED = contextvars.ContextVar("trusted", default=True)
FILES_TRUSTED = contextvars.ContextVar("files_trusted", default=True)
"""Whether actuator files may name modules; the command line sets it to its `--trust`."""


@contextlib.contextmanager
def trusting(trust: bool) -> Iterator[None]:
    """While the block runs, let `module:NAME` import modules, or refuse it."""
    token = _TRUSTED.set(trust)
    try:
        yield
    finally:
        _TRUSTED.reset(token)


def trusting_files() -> contextlib.AbstractContextManager[None]:
    """While the block runs, let `module:NAME` of an actuator file import modules only if files are trusted."""
    return trusting(_TRUSTED.get() and FILES_TRUSTED.get())


def load_module(text: str) -> Any:
    """The module of `module:NAME`."""
    module = text.partition(":")[0]
    if not _TRUSTED.get():
        raise UntrustedCodeError(
            f"{text!r}: needs the module {module}, and importing it executes whatever its author"
            " put there. Pass --trust (in Python: trust=True) if that author is you, or somebody"
            " whose programs you would run"
        )
    try:
        return importlib.import_module(module)
    except Exception as error:
        if not module or (
            isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")
        ):
            raise ValueError(
                f"{text!r}: {error}; must be module:NAME of a module that is installed or in the"
                f" present folder, {Path.cwd()}; on the command line FILE.py:NAME does as well"
            ) from None
        where, ours = _origin(error)
        said = str(error) if ours else f"importing {module} failed: {type(error).__name__}: {error}"
        raise ValueError(f"{text!r}: {said} ({where})") from error


def _origin(error: Exception) -> tuple[str, bool]:
    """Return the user's file and line that an error comes from, and whether it is one that this package raised."""
    frames, package = traceback.extract_tb(error.__traceback__), Path(__file__).parent
    places = [
        (frame.filename, frame.lineno) for frame in frames if not frame.filename.startswith("<")
    ]
    if (
        isinstance(error, SyntaxError) and error.filename
    ):  # no frame is in the file that is not parsed
        places.append((error.filename, error.lineno))
    installed = [
        Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")
    ]
    others = [place for place in places if not Path(place[0]).is_relative_to(package)]
    users = [
        one
        for one in others
        if not any(Path(one[0]).is_relative_to(folder) for folder in installed)
    ]
    file, line = (users or others)[-1]
    return f"{file}, line {line}", Path(frames[-1].filename).is_relative_to(package)


def load_object(text: str) -> Any:
    """What stands at `module:NAME`."""
    module, name = load_module(text), text.partition(":")[2]
    try:
        return functools.reduce(getattr, name.split("."), module)
    except AttributeError as error:
        hint = fields.did_you_mean(name, vars(module)).rstrip() or "see"
        raise ValueError(
            f"{text!r}: {error}; must be module:NAME; {hint} {getattr(module, '__file__', '')}"
        ) from None


def look_up(
    name: str,
    known: Mapping[str, Any],
    what: str,
    anybodys: bool = True,
    of: type | None = None,
    others: Mapping[str, Iterable[str]] | None = None,
) -> Any:
    """What a name stands for: a value of `known`, which are ours, or, if `anybodys`, what stands at `module:NAME`.

    Messages call it `what`. What is not ours has to be a subclass `of` a class, if one is given.
    `others` are names that are known elsewhere, to be suggested but not listed, by what lists them.
    """
    if isinstance(name, str) and name in known:
        return known[name]
    if anybodys and ":" in str(name):
        found = load_object(name)
        if of is None or (isinstance(found, type) and issubclass(found, of)):
            return found
        raise ValueError(f"{what} {name!r}: {found!r} is no subclass of codrl_mj's {of.__name__}")
    hint = fields.did_you_mean(name, [*known, *itertools.chain(*(others or {}).values())])
    listed = hint + "It can be" if hint else f"Known: {', '.join([*known, *(others or {})])}, or"
    own = f"{listed} module:NAME of your own" if anybodys else hint or listed.removesuffix(", or")
    raise ValueError(f"unknown {what} {name!r}: {own.rstrip()}")
