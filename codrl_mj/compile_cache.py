"""Compiled functions, kept on disk: the first process compiles, the next ones load what it made.

What is kept is machine code for one CPU, so its key has everything that was compiled in: the
bytecode, constants, closure values and globals of every function that is reached, somebody's own
too, and the files that these stand in; all of this package's source; MuJoCo's layout, whose offsets
are among the constants; versions, CPU and numba's settings. What has a value that is not known here
is not kept. Addresses of this process are known to it by name (`linked`).

The folder is the user's cache folder, or what CODRL_MJ_CACHE names; `off` keeps nothing. numba
unpickles what is around the code: so folder and files must belong to the user, with nobody else
allowed to write them, or they are not used. A file is written whole or not at all, and one that is
damaged counts as none.
"""

import ctypes
import functools
import hashlib
import itertools
import os
import pickle
import platform
import secrets
import sys
import tempfile
import types as python
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import mujoco
import numba
import numpy as np
from llvmlite import binding
from numba.core import serialize, sigutils, types
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import _Cache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.types import containers
from numba.extending import _Intrinsic

MOST = 500_000_000
"""Bytes that the folder may hold; beyond, what was not used for the longest time goes."""
_PACKAGE = Path(__file__).parent
_OTHERS = {
    "builtins",
    "math",
    "numba",
    "numpy",
    "llvmlite",
    "mujoco",
    "typing",
    "functools",
    "operator",
    "ctypes",
}
"""Packages of which a version says all."""
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), np.generic)
_SYMBOLS: dict[str, int] = {}


class _NotKnownError(Exception):
    """A value of which it cannot be said what it makes of compiled code."""


def folder() -> Path | None:
    """Where compiled code is kept; None: nowhere."""
    given = os.environ.get("CODRL_MJ_CACHE")
    if given in ("off", "0", ""):
        return None
    if given is not None:
        return Path(given)
    import platformdirs

    return platformdirs.user_cache_path("codrl_mj") / "compiled"


def _count_anew() -> None:
    """Let numba's names for functions be like those of no other process.

    It tells functions of one name apart by a count, in what the linker sees too: of two functions
    that two processes called alike it would take the one for the other, wherever both are loaded.
    """
    FunctionIdentity._unique_ids = itertools.count(secrets.randbits(60))  # type: ignore[attr-defined]


_count_anew()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_count_anew)


def linked(name: str, address: int) -> str:
    """The name by which compiled code, of this process and of those to come, finds what is at an address here.

    Where something else has the name, as in a copy of a module, it is another one.
    """
    while _SYMBOLS.setdefault(name, address) != address:
        name += "_"
    binding.add_symbol(name, address)
    return name


def external(name: str, function: Any, signature: Any) -> Any:
    """A C function of ctypes', for compiled code."""
    return types.ExternalFunction(
        linked(name, ctypes.cast(function, ctypes.c_void_p).value or 0), signature
    )


def njit(function: Any = None, **options: Any) -> Any:
    """`numba.njit` of a function that Python calls, kept on disk."""
    if function is None:
        return functools.partial(njit, **options)
    compiled = numba.njit(function, **options)
    compiled._cache = _Kept("njit", function, options)
    return compiled


def cfunc(signature: Any, **options: Any) -> Callable[[Any], Any]:
    """`numba.cfunc`, kept on disk."""

    def compiled(function: Any) -> Any:
        made: Any = CFunc(
            function, sigutils.normalize_signature(signature), locals={}, options=options
        )
        made._cache = _Kept("cfunc", function, options)
        made.compile()
        return made

    return compiled


class Note:
    """That something was found to hold of values, such as a function and types: a file without content."""

    def __init__(self, what: str, *about: Any) -> None:
        """What holds, and of what."""
        self._path = _path(what, about)

    def is_there(self) -> bool:
        """Whether it was found before."""
        return self._path is not None and _read(self._path) is not None

    def leave(self) -> None:
        """Say so."""
        if self._path is not None:
            _write(self._path, b"")


class _Kept(_Cache):  # type: ignore[misc]
    """What numba asks for the compiled forms of one function."""

    def __init__(self, kind: str, function: Any, options: Any) -> None:
        self._name, self._about = (
            function.__name__,
            (kind, tuple(sorted(options.items())), function),
        )

    @property
    def cache_path(self) -> str:
        """Where they are."""
        return str(folder())

    def enable(self) -> None:
        """They are."""

    def disable(self) -> None:
        """By CODRL_MJ_CACHE alone."""

    def flush(self) -> None:
        """Nothing is held back."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled form for a signature; None where there is none that may be used."""
        path = self._place(sig)
        payload = None if path is None else _read(path)
        if payload is None:
            return None
        target_context.refresh()
        try:
            return CompileResult._rebuild(target_context, *pickle.loads(payload))
        except Exception:  # of another making: compiled anew
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, if it may run in any process of the user's on this machine."""
        path = self._place(sig)
        if path is not None and not data.library.has_dynamic_globals and not data.lifted:
            try:
                payload = serialize.dumps(data._reduce())
            except Exception:  # something in it cannot be written
                return
            _write(path, payload)

    def _place(self, sig: Any) -> Path | None:
        return _path(self._name, (*self._about, tuple(getattr(sig, "args", sig))))


def _path(name: str, about: Any) -> Path | None:
    """The file for values; None where nothing is kept, or nothing can be said of one of them."""
    try:
        place, key = folder(), hashlib.sha256(_foundation())
        if place is None:
            return None
        _tell(key, about, (), {})
    except (
        Exception
    ):  # whatever somebody's value does when it is looked at: then it is compiled in every process
        return None
    return place / f"{name}-{key.hexdigest()}.code"


def _usable(status: os.stat_result) -> bool:
    """Whether a file or folder is the user's, and nobody else may write it."""
    return not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o022
    )


def _read(path: Path) -> bytes | None:
    """The content of a file that may be used, and is whole."""
    try:
        if not _usable(path.parent.stat()):
            return None
        with path.open("rb") as file:
            if not _usable(os.fstat(file.fileno())):
                return None
            digest, payload = file.read(32), file.read()
        os.utime(path)
    except OSError:
        return None
    return payload if hashlib.sha256(payload).digest() == digest else None


def _write(path: Path, payload: bytes) -> None:
    """Write a file whole, or not at all; what was not used for long makes room."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _usable(path.parent.stat()):
            return
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(payload).digest() + payload)
            Path(temporary).replace(path)
        except OSError:
            Path(temporary).unlink(missing_ok=True)
            return
        files = sorted(
            ((one.stat().st_mtime, one.stat().st_size, one) for one in path.parent.iterdir()),
            reverse=True,
        )
        total = 0
        for _, size, one in files:
            total += size
            if total > MOST:
                one.unlink(missing_ok=True)
    except OSError:  # no room, no right: it is compiled anew next time
        return


@functools.cache
def _foundation() -> bytes:
    """What every key begins with: versions, CPU, numba's settings, this package's source."""
    key = hashlib.sha256()
    for one in (numba, llvmlite, np, mujoco):
        key.update(f"{one.__name__} {one.__version__}\n".encode())
    cpu = (
        binding.get_host_cpu_name(),
        binding.get_host_cpu_features().flatten(),
        platform.machine(),
        sys.version,
    )
    # The module's own names, such as its file's, are no settings: two installations of one version
    # share what is kept.
    named = (
        (name, value) for name, value in vars(numba.config).items() if not name.startswith("__")
    )
    settings = sorted((name, repr(value)) for name, value in named if isinstance(value, _PLAIN))
    key.update(repr((cpu, settings)).encode())
    sources = sorted(_PACKAGE.rglob("*.py"))
    if not sources:
        raise _NotKnownError("this package's source")
    for path in sources:
        key.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return key.digest()


@functools.cache
def _file(module: str) -> bytes:
    """The content of a module's file; of one without a file nothing."""
    path = getattr(sys.modules.get(module), "__file__", None)
    return Path(path).read_bytes() if path and Path(path).is_file() else b""


def _tell(key: Any, value: Any, names: tuple[str, ...], told: dict[int, Any]) -> None:
    """Put a value into a key, and all that it reaches; of a module what has one of the names."""
    if isinstance(value, _PLAIN):
        key.update(f"{type(value).__qualname__} {value!r}\n".encode())
        return
    if isinstance(value, tuple | list | frozenset):
        key.update(f"{type(value).__qualname__} {len(value)}\n".encode())
        for one in sorted(value, key=repr) if isinstance(value, frozenset) else value:
            _tell(key, one, names, told)
        return
    if not isinstance(value, python.ModuleType):
        if id(value) in told:
            key.update(f"again {[*told].index(id(value))}\n".encode())
            return
        told[id(value)] = value
    root = str(getattr(value, "__module__", None) or "").partition(".")[0]
    match value:
        case Dispatcher():
            _tell(key, tuple(sorted(value.targetoptions.items(), key=repr)), names, told)
            _tell(key, value.py_func, names, told)
        case CFunc():
            _tell(key, tuple(getattr(value, name) for name in ("_sig", "_pyfunc")), names, told)
        case _Intrinsic():
            _tell(key, value._defn, names, told)
        case python.FunctionType():
            _tell_function(key, value, told)
        case python.CodeType():
            parts = (
                value.co_code,
                value.co_names,
                value.co_varnames,
                value.co_freevars,
                value.co_argcount,
            )
            _tell(
                key, (*parts, value.co_kwonlyargcount, value.co_flags, value.co_consts), names, told
            )
        case python.ModuleType():
            key.update(f"module {value.__name__}\n".encode())
            if value.__name__.partition(".")[0] not in _OTHERS:
                for name in names:
                    if hasattr(value, name):
                        key.update(f".{name} ".encode())
                        _tell(key, getattr(value, name), names, told)
        case np.ndarray():
            key.update(f"{value.dtype.str} {value.shape}\n".encode() + value.tobytes())
        case types.ExternalFunction():
            key.update(f"external {value.symbol} {value.sig}\n".encode())
        case containers.NamedTuple() | containers.NamedUniTuple():
            key.update(f"{value.name}\n".encode())
            _tell(key, (value.instance_class, tuple(value)), names, told)
        case types.Type():
            key.update(f"{type(value).__qualname__} {value.name}\n".encode())
        case type() if hasattr(value, "_fields") or root in (*_OTHERS, "codrl_mj"):
            key.update(
                f"class {value.__module__}.{value.__qualname__} {getattr(value, '_fields', ())}\n".encode()
            )
        case functools.partial():
            _tell(key, (value.func, value.args, tuple(sorted(value.keywords.items()))), names, told)
        case _ if isinstance(value, python.BuiltinFunctionType | np.ufunc) or root in (
            "numba",
            "numpy",
            "typing",
        ):
            key.update(f"{root} {getattr(value, '__qualname__', None) or repr(value)}\n".encode())
        case _:
            raise _NotKnownError(repr(value))


def _tell_function(key: Any, function: Any, told: dict[int, Any]) -> None:
    """A function: its code, its defaults, what it closes over, the globals that it names, the file that it is in."""
    code, scope, root = (
        function.__code__,
        function.__globals__,
        str(function.__module__).partition(".")[0],
    )
    key.update(f"function {function.__module__}.{function.__qualname__}\n".encode())
    if root not in (*_OTHERS, "codrl_mj"):
        key.update(hashlib.sha256(_file(function.__module__)).digest())
    if root in _OTHERS:
        return
    names = _named(code)
    _tell(key, code, names, told)
    _tell(
        key,
        (function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items()))),
        names,
        told,
    )
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        key.update(f"closure {name} ".encode())
        try:
            _tell(key, cell.cell_contents, names, told)
        except ValueError:
            raise _NotKnownError(name) from None
    for name in names:
        if name in scope:
            key.update(f"global {name} ".encode())
            _tell(key, scope[name], names, told)


def _named(code: Any) -> tuple[str, ...]:
    """Names of globals and attributes in a function and the functions in it."""
    inner = (one for one in code.co_consts if isinstance(one, python.CodeType))
    return (*code.co_names, *(name for one in inner for name in _named(one)))
