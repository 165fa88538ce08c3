"""Code and files of users: loading of modules and models by name, and checks of functions.

Users' functions are called once in plain Python before they are compiled, because numba's errors
are hard to read. An error in a user's code is reported in one sentence, with file and line.
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
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

import numpy as np

from codrl_mj import fields

Form: TypeAlias = "str | tuple[Form, ...]"
"""Expected structure of a return value: the name of a number, or a tuple of such structures."""


# A user's function returns anything; `check_form` checks it.
UserFunction = Callable[..., Any]
"""A function that a user wrote."""
Value = TypeVar("Value")
# A user's file or module may contain anything; the functions that load it check it.
Loaded = Any
"""The content of a file, or an object that was loaded by its name or returned by a function."""


def call(name: str, function: UserFunction, *arguments: object) -> Loaded:
    """Call a user's function; errors name it as `name`."""
    if not inspect.isfunction(function):
        raise ValueError(f"{name} = {function!r}: must be a function in plain Python")
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except Exception as error:
        own_frames = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if frame.filename == function.__code__.co_filename
        ]
        location = source_location(function, own_frames[-1].lineno if own_frames else None)
        raise ValueError(f"{location}: {type(error).__name__}: {error}") from error


def source_location(function: UserFunction, line: int | None = None) -> str:
    """Return file, line (default: its first) and name of a function, for messages."""
    code = function.__code__
    return f"{Path(code.co_filename).name}:{line or code.co_firstlineno}, in {code.co_name}"


def check_form(function: UserFunction, value: Value, form: Form, declared: str) -> Value:
    """Return a function's return value, after checking that it has the expected form.

    Args:
        function: the function.
        value: its return value, or the type that numba inferred for it.
        form: the expected form.
        declared: documentation of the form, for the message, such as `Task.state_names`.
    """
    if not _fits(value, form):
        raise ValueError(
            f"{source_location(function)}: returns {_describe_value(value)}, must return"
            f" {_describe_form(form)}: see {declared}"
        )
    return value


def _fits(value: object, form: Form) -> bool:
    if isinstance(form, str):
        # Functions such as np.where return arrays without dimensions.
        scalar = isinstance(value, np.ndarray) and value.shape == () and value.dtype.kind in "biuf"
        return scalar or isinstance(value, numbers.Real | np.bool_)
    return isinstance(value, tuple) and len(value) == len(form) and all(map(_fits, value, form))


def _describe_value(value: object) -> str:
    """Describe a returned value, or a type that numba inferred, by its name."""
    if isinstance(value, tuple):
        flat = _fits(value, ("",) * len(value))
        return f"a tuple of {len(value)}" if flat else f"({', '.join(map(_describe_value, value))})"
    return "a number" if _fits(value, "") else str(getattr(value, "name", type(value).__name__))


def _describe_form(form: Form) -> str:
    if isinstance(form, str):
        return "a number"
    names = [entry for entry in form if isinstance(entry, str)]
    return (
        f"a tuple of {len(form)} ({', '.join(names)})"
        if len(names) == len(form)
        else f"({', '.join(map(_describe_form, form))})"
    )


def compile_error_message(function: UserFunction, error: Exception) -> str:
    """Return numba's error about a function that it cannot compile, as one sentence."""
    text = str(error)
    lines = [
        line.strip()
        for line in text.splitlines()
        if line.strip() and not line.strip().startswith("Failed in")
    ]
    causes = [
        cause for cause in re.findall(r"\w*Error: (.+)", text) if not cause.startswith("Failed in")
    ]
    last_cause = (
        causes[-1] if causes else " ".join(lines[:2] if lines[0].endswith(":") else lines[:1])
    )
    line = re.search(r'(?m)^\s*File ".+", line (\d+):', text)
    return (
        f"{source_location(function, int(line[1]) if line else None)}: numba cannot compile it:"
        f" {last_cause.strip()}"
    )


def asset_folder() -> Path:
    """Return the folder of MJCF files, `motors/`, `joints/`: `assets/`, in a wheel `_assets/`."""
    package = Path(__file__).parent
    for folder in (package / "_assets", package.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"no model files next to {package}: the installation of codrl_mj is incomplete"
    )


def asset_path(name: str) -> Path:
    """Return the path of an MJCF file: a user's, or the package's file of this name."""
    for path in (Path(name), asset_folder() / name):
        if path.is_file():
            return path
    if Path(name).parent == Path():
        raise FileNotFoundError(
            f"no model {name!r} in {Path.cwd()} or among the models of codrl_mj: give the full path"
        )
    raise FileNotFoundError(f"no model file {name}")


def read_text(path: Path) -> str:
    """Return the text of a file, without the byte order mark that some editors write.

    Raises:
        ValueError: the file is not UTF-8; the message has the line, and the character if it was
            saved in Windows-1252.
    """
    content = path.read_bytes()
    try:
        is_utf16 = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        return (
            content.decode("utf-16" if is_utf16 else "utf-8-sig")
            .replace("\r\n", "\n")
            .replace("\r", "\n")
        )
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start : error.start + 1]
        character = byte.decode("cp1252", "replace")
        raise ValueError(
            f"line {line} has the byte 0x{byte.hex()} ({character} in Windows-1252), which is not"
            " UTF-8: save the file as UTF-8"
        ) from None


def read_yaml(path: Path) -> Loaded:
    """Read a YAML or JSON file, with the numbers of YAML 1.2 and JSON, such as 3e-4 and Infinity.

    For example, 20:1 is text here; YAML 1.1 would read it as the number 1201.

    Raises:
        ValueError: the file is not YAML, or a mapping has a key twice.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(
            self, node: yaml.MappingNode, deep: bool = False
        ) -> dict[object, object]:
            keys = [key.value for key, _ in node.value]
            for key, _ in node.value[::-1]:
                if keys.count(key.value) > 1 and key.value != "<<":
                    raise ValueError(
                        f"line {key.start_mark.line + 1}: {key.value} is given twice: leave one out"
                    )
            mapping: dict[object, object] = super().construct_mapping(node, deep)
            return mapping

    patterns = {
        "int": r"[-+]?(0|[1-9][\d_]*)$|0x[\da-fA-F]+$",
        "float": r"[-+]?(\d[\d_]*(\.\d*)?|\.\d+)([eE][-+]?\d+)?$",
    }
    patterns["float"] += r"|[-+]?(\.(inf|Inf|INF)|Infinity)$|\.?(nan|NaN|NAN)$"
    tags = {f"tag:yaml.org,2002:{kind}": re.compile(text) for kind, text in patterns.items()}
    Loader.yaml_implicit_resolvers = {
        start: [resolver for resolver in resolvers if resolver[0] not in tags]
        for start, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for tag, pattern in tags.items():
        Loader.add_implicit_resolver(tag, pattern, list("-+.0123456789INn"))
    try:
        return yaml.load(read_text(path), Loader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


class UntrustedCodeError(ValueError):
    """Error: a file names a module that was not imported, because the user has not trusted it."""


_IMPORTS_ALLOWED = contextvars.ContextVar("trusted", default=True)
FILES_TRUSTED = contextvars.ContextVar("files_trusted", default=True)
"""True if actuator files may name modules; the command line sets it from `--trust`."""


@contextlib.contextmanager
def allow_imports(trust: bool) -> Iterator[None]:
    """Allow or refuse imports by `module:NAME` while the block runs."""
    token = _IMPORTS_ALLOWED.set(trust)
    try:
        yield
    finally:
        _IMPORTS_ALLOWED.reset(token)


def allow_imports_from_files() -> contextlib.AbstractContextManager[None]:
    """Allow imports named in actuator files while the block runs, if files are trusted."""
    return allow_imports(_IMPORTS_ALLOWED.get() and FILES_TRUSTED.get())


def load_module(text: str) -> ModuleType:
    """Import the module of `module:NAME`."""
    module = text.partition(":")[0]
    if not _IMPORTS_ALLOWED.get():
        raise UntrustedCodeError(
            f"{text!r}: needs the module {module}, and importing it executes its code. Pass --trust"
            " (in Python: trust=True) if you are its author, or if you trust the author"
        )
    try:
        return importlib.import_module(module)
    except Exception as error:
        if not module or (
            isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")
        ):
            raise ValueError(
                f"{text!r}: {error}; must be module:NAME, where the module is installed or in the"
                f" current folder, {Path.cwd()}; the command line also accepts FILE.py:NAME"
            ) from None
        location, is_package_error = _origin(error)
        description = (
            str(error)
            if is_package_error
            else f"importing {module} failed: {type(error).__name__}: {error}"
        )
        raise ValueError(f"{text!r}: {description} ({location})") from error


def _origin(error: Exception) -> tuple[str, bool]:
    """Return the user's file and line of an error, and True if this package raised it."""
    frames, package = traceback.extract_tb(error.__traceback__), Path(__file__).parent
    locations = [
        (frame.filename, frame.lineno) for frame in frames if not frame.filename.startswith("<")
    ]
    # A file that cannot be parsed has no frame in the traceback.
    if isinstance(error, SyntaxError) and error.filename:
        locations.append((error.filename, error.lineno))
    installed = [
        Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")
    ]
    outside_package = [
        location for location in locations if not Path(location[0]).is_relative_to(package)
    ]
    user_locations = [
        candidate
        for candidate in outside_package
        if not any(Path(candidate[0]).is_relative_to(folder) for folder in installed)
    ]
    file, line = (user_locations or outside_package)[-1]
    return f"{file}, line {line}", Path(frames[-1].filename).is_relative_to(package)


def load_object(text: str) -> Loaded:
    """Load the object at `module:NAME`."""
    module, name = load_module(text), text.partition(":")[2]
    try:
        return functools.reduce(getattr, name.split("."), module)
    except AttributeError as error:
        hint = fields.did_you_mean(name, vars(module)).rstrip() or "check the name;"
        raise ValueError(
            f"{text!r}: {error}; must be module:NAME; {hint} the file is"
            f" {getattr(module, '__file__', '')}"
        ) from None


def look_up(
    name: str,
    known: Mapping[str, Value],
    label: str,
    allow_user_code: bool = True,
    base_class: type | None = None,
    suggestions: Mapping[str, Iterable[str]] | None = None,
) -> Value:
    """Return the value for a name: one of `known`, or the object at `module:NAME`.

    Args:
        name: the name.
        known: built-in names -> values.
        label: kind of the value, for messages.
        allow_user_code: False to refuse `module:NAME`.
        base_class: class that a user's object must be a subclass of; None for any object.
        suggestions: group -> names that are known elsewhere, which messages may suggest.
    """
    if isinstance(name, str) and name in known:
        return known[name]
    if allow_user_code and ":" in str(name):
        value: Value = load_object(name)
        if base_class is None or (isinstance(value, type) and issubclass(value, base_class)):
            return value
        raise ValueError(
            f"{label} {name!r}: {value!r} is not a subclass of codrl_mj's {base_class.__name__}"
        )
    hint = fields.did_you_mean(name, [*known, *itertools.chain(*(suggestions or {}).values())])
    choices = (
        hint + "It can also be"
        if hint
        else f"Known: {', '.join([*known, *(suggestions or {})])}, or"
    )
    remedy = (
        f"{choices} your own as module:NAME"
        if allow_user_code
        else hint or choices.removesuffix(", or")
    )
    raise ValueError(f"unknown {label} {name!r}: {remedy.rstrip()}")
