"""Compiled functions on disk: the first process compiles, later processes load the machine code.

Machine code is valid only for one CPU, and for the code and the constants that it was compiled
from. The key of a file therefore contains: bytecode, constants, closure values and globals of every
function that is reached, and the source files of users' functions; all of this package's source;
MuJoCo's memory layout, whose offsets are constants in the code; versions, CPU and numba's settings.
A function with a value that cannot be hashed is not stored. Addresses differ between processes, so
compiled code refers to them by the names of symbols (`register_symbol`).

The folder is the user's cache folder, or CODRL_MJ_CACHE; with `off` nothing is stored. numba
unpickles parts of the files, so folder and files are only used if they belong to the user and no
other user may write to them. A file is written completely or not at all; a damaged file counts as
missing.
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
import types as python_types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, cast, overload

import llvmlite
import mujoco
import numba
import numpy as np
from llvmlite import binding
from numba.core import serialize, sigutils, types
from numba.core.base import BaseContext
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import _Cache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.types import containers
from numba.core.typing import Signature
from numba.extending import _Intrinsic

P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
F = TypeVar("F", bound=Callable[..., object])
"""A function; the decorators here return it with its own type, because it is called the same."""


class CompiledCallback(Protocol[P, R_co]):
    """A function with a C address, as `cfunc` returns it."""

    @property
    def address(self) -> int:
        """Address of the machine code; it is valid as long as this object exists."""

    @property
    def ctypes(self) -> Callable[P, R_co]:
        """The function for Python, called through ctypes."""


class Digest(Protocol):
    """An object that computes a hash, such as that of `hashlib.sha256`."""

    def update(self, data: bytes, /) -> None:
        """Append bytes to the hashed text."""


MAX_BYTES = 500_000_000
"""Maximum size of the folder [bytes]; beyond it, the least recently used files are deleted."""
_PACKAGE = Path(__file__).parent
_VERSIONED_PACKAGES = {
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
"""Packages whose version identifies their code."""
_PLAIN_TYPES = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), np.generic)
_SYMBOLS: dict[str, int] = {}


class _UnhashableError(Exception):
    """The value cannot be hashed into a cache key."""


def cache_folder() -> Path | None:
    """Return the folder of compiled code; None if nothing is stored."""
    setting = os.environ.get("CODRL_MJ_CACHE")
    if setting in ("off", "0", ""):
        return None
    if setting is not None:
        return Path(setting)
    import platformdirs

    return Path(platformdirs.user_cache_path("codrl_mj")) / "compiled"


def _randomize_function_ids() -> None:
    """Make numba's names for functions unique among all processes.

    numba counts functions, and the count is part of the symbol of each function. If two processes
    gave the same symbol to different functions, the linker would confuse these functions in a
    process that loads both from the cache.
    """
    FunctionIdentity._unique_ids = itertools.count(secrets.randbits(60))


_randomize_function_ids()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_randomize_function_ids)


def register_symbol(name: str, address: int) -> str:
    """Register an address of this process under a symbol's name, by which compiled code finds it.

    If the name already has another address, as after a copy of a module, a new name is returned.
    """
    while _SYMBOLS.setdefault(name, address) != address:
        name += "_"
    binding.add_symbol(name, address)
    return name


# The signature has the types of arguments and result, but as objects of numba, not of Python.
ExternalFunction = Callable[..., Any]
"""A C function for compiled code; assign it to a name with a more precise type to have it checked.
"""


def external_function(
    name: str, function: Callable[..., object] | ctypes.c_void_p, signature: Signature
) -> ExternalFunction:
    """Declare a C function of ctypes for compiled code."""
    # ctypes has no public name for the class of its functions.
    address = ctypes.cast(function, ctypes.c_void_p).value or 0  # type: ignore[arg-type]
    declared: ExternalFunction = types.ExternalFunction(register_symbol(name, address), signature)
    return declared


@overload
def njit(function: F, **options: object) -> F: ...
@overload
def njit(function: None = None, **options: object) -> Callable[[F], F]: ...


def njit(function: F | None = None, **options: object) -> F | Callable[[F], F]:
    """Compile a function that Python calls, as `numba.njit` does, with the cache on disk."""
    if function is None:
        return functools.partial(njit, **options)
    compiled: F = numba.njit(function, **options)
    vars(compiled)["_cache"] = _FunctionCache("njit", function, options)
    return compiled


def cfunc(
    signature: Signature, **options: object
) -> Callable[[Callable[P, R]], CompiledCallback[P, R]]:
    """Compile a function as `numba.cfunc` does, with the cache on disk."""

    def compiled(function: Callable[P, R]) -> CompiledCallback[P, R]:
        compiled_callback = CFunc(
            function, sigutils.normalize_signature(signature), locals={}, options=options
        )
        vars(compiled_callback)["_cache"] = _FunctionCache("cfunc", function, options)
        compiled_callback.compile()
        return cast(CompiledCallback[P, R], compiled_callback)

    return compiled


class VerifiedMarker:
    """Empty file that records a passed check of values, such as a function and types."""

    def __init__(self, label: str, *values: object) -> None:
        """Identify the check by a label and the values that it depends on."""
        self._path = _path(label, values)

    def exists(self) -> bool:
        """Return True if the check has passed before."""
        return self._path is not None and _read(self._path) is not None

    def write(self) -> None:
        """Record that the check has passed."""
        if self._path is not None:
            _write(self._path, b"")


class _FunctionCache(_Cache):
    """Cache of one function's overloads, one for each signature, with the interface of numba."""

    def __init__(
        self, kind: str, function: Callable[..., object], options: Mapping[str, object]
    ) -> None:
        self._name = function.__name__
        self._key_values = (kind, tuple(sorted(options.items())), function)

    @property
    def cache_path(self) -> str:
        """Folder of the overloads."""
        return str(cache_folder())

    def enable(self) -> None:
        """Do nothing: the cache is always enabled; numba's interface requires the method."""

    def disable(self) -> None:
        """Do nothing: only CODRL_MJ_CACHE disables the cache."""

    def flush(self) -> None:
        """Do nothing: files are written at once."""

    def load_overload(
        self, sig: Signature | tuple[types.Type, ...], target_context: BaseContext
    ) -> CompileResult | None:
        """Load the overload for a signature; None if there is no usable file."""
        path = self._overload_path(sig)
        payload = None if path is None else _read(path)
        if payload is None:
            return None
        # As in numba's own cache: the context must know all registrations before code is rebuilt.
        target_context.refresh()
        try:
            return CompileResult._rebuild(target_context, *pickle.loads(payload))
        except Exception:
            # An entry that numba cannot rebuild counts as missing: the function is compiled again.
            return None

    def save_overload(self, sig: Signature | tuple[types.Type, ...], data: CompileResult) -> None:
        """Store an overload, unless it has parts that only this process can use."""
        path = self._overload_path(sig)
        if path is not None and not data.library.has_dynamic_globals and not data.lifted:
            try:
                payload = serialize.dumps(data._reduce())
            except Exception:
                # The function can be used, but not stored, if a part of it cannot be pickled.
                return
            _write(path, payload)

    def _overload_path(self, sig: Signature | tuple[types.Type, ...]) -> Path | None:
        """Return the file for a signature."""
        return _path(self._name, (*self._key_values, tuple(getattr(sig, "args", sig))))


def _path(name: str, values: tuple[object, ...]) -> Path | None:
    """Return the file for values; None if nothing is stored, or a value cannot be hashed."""
    try:
        directory, key = cache_folder(), hashlib.sha256(_base_key())
        if directory is None:
            return None
        _hash_value(key, values, (), {})
    except Exception:
        # Attributes of users' objects may raise any exception when they are read. The function is
        # then not stored, and every process compiles it.
        return None
    return directory / f"{name}-{key.hexdigest()}.code"


def _is_trusted(status: os.stat_result) -> bool:
    """Return True if a file or folder belongs to the user, and only the user may write to it."""
    return not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o022
    )


def _read(path: Path) -> bytes | None:
    """Return the content of a file that is usable and complete; otherwise None."""
    try:
        if not _is_trusted(path.parent.stat()):
            return None
        with path.open("rb") as file:
            if not _is_trusted(os.fstat(file.fileno())):
                return None
            digest, payload = file.read(32), file.read()
        os.utime(path)
    except OSError:
        return None
    return payload if hashlib.sha256(payload).digest() == digest else None


def _write(path: Path, payload: bytes) -> None:
    """Write a file completely or not at all; then limit the folder's size to `MAX_BYTES`."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_trusted(path.parent.stat()):
            return
        # Readers never see an incomplete file, because renaming is atomic.
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(payload).digest() + payload)
            Path(temporary).replace(path)
        except OSError:
            Path(temporary).unlink(missing_ok=True)
            return
        files = sorted(
            (
                (entry.stat().st_mtime, entry.stat().st_size, entry)
                for entry in path.parent.iterdir()
            ),
            reverse=True,
        )
        total = 0
        for _, size, entry in files:
            total += size
            if total > MAX_BYTES:
                entry.unlink(missing_ok=True)
    except OSError:
        # No space or no permission: the function is compiled again next time.
        return


@functools.cache
def _base_key() -> bytes:
    """Return the common part of all keys: versions, CPU, numba's settings, the package's source."""
    key = hashlib.sha256()
    for library in (numba, llvmlite, np, mujoco):
        key.update(f"{library.__name__} {library.__version__}\n".encode())
    cpu = (
        binding.get_host_cpu_name(),
        binding.get_host_cpu_features().flatten(),
        platform.machine(),
        sys.version,
    )
    # `__file__` and similar names of the module are left out, because they are not settings: two
    # installations of the same versions can share their files.
    public_values = (
        (name, value) for name, value in vars(numba.config).items() if not name.startswith("__")
    )
    settings = sorted(
        (name, repr(value)) for name, value in public_values if isinstance(value, _PLAIN_TYPES)
    )
    key.update(repr((cpu, settings)).encode())
    sources = sorted(_PACKAGE.rglob("*.py"))
    if not sources:
        raise _UnhashableError("this package's source")
    for path in sources:
        key.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return key.digest()


@functools.cache
def _source_of(module: str) -> bytes:
    """Return the content of a module's file; empty if it has none."""
    path = getattr(sys.modules.get(module), "__file__", None)
    return Path(path).read_bytes() if path and Path(path).is_file() else b""


def _hash_value(
    key: Digest, value: object, names: tuple[str, ...], visited: dict[int, object]
) -> None:
    """Hash a value and everything it reaches; for a module only the attributes with these names."""
    if isinstance(value, _PLAIN_TYPES):
        key.update(f"{type(value).__qualname__} {value!r}\n".encode())
        return
    if isinstance(value, tuple | list | frozenset):
        key.update(f"{type(value).__qualname__} {len(value)}\n".encode())
        for element in sorted(value, key=repr) if isinstance(value, frozenset) else value:
            _hash_value(key, element, names, visited)
        return
    if not isinstance(value, python_types.ModuleType):
        # A second visit, as of a recursive function, hashes only the number of the first visit.
        if id(value) in visited:
            key.update(f"again {[*visited].index(id(value))}\n".encode())
            return
        visited[id(value)] = value
    root = str(getattr(value, "__module__", None) or "").partition(".")[0]
    match value:
        case Dispatcher():
            _hash_value(key, tuple(sorted(value.targetoptions.items(), key=repr)), names, visited)
            _hash_value(key, value.py_func, names, visited)
        case CFunc():
            _hash_value(
                key, tuple(getattr(value, name) for name in ("_sig", "_pyfunc")), names, visited
            )
        case _Intrinsic():
            _hash_value(key, value._defn, names, visited)
        case python_types.FunctionType():
            _hash_function(key, value, visited)
        case python_types.CodeType():
            parts = (
                value.co_code,
                value.co_names,
                value.co_varnames,
                value.co_freevars,
                value.co_argcount,
            )
            _hash_value(
                key,
                (*parts, value.co_kwonlyargcount, value.co_flags, value.co_consts),
                names,
                visited,
            )
        case python_types.ModuleType():
            key.update(f"module {value.__name__}\n".encode())
            if value.__name__.partition(".")[0] not in _VERSIONED_PACKAGES:
                for name in names:
                    if hasattr(value, name):
                        key.update(f".{name} ".encode())
                        _hash_value(key, getattr(value, name), names, visited)
        case np.ndarray():
            key.update(f"{value.dtype.str} {value.shape}\n".encode() + value.tobytes())
        case types.ExternalFunction():
            key.update(f"external {value.symbol} {value.sig}\n".encode())
        case containers.NamedTuple() | containers.NamedUniTuple():
            key.update(f"{value.name}\n".encode())
            _hash_value(key, (value.instance_class, tuple(value)), names, visited)
        case types.Type():
            key.update(f"{type(value).__qualname__} {value.name}\n".encode())
        case type() if hasattr(value, "_fields") or root in (*_VERSIONED_PACKAGES, "codrl_mj"):
            key.update(
                f"class {value.__module__}.{value.__qualname__}"
                f" {getattr(value, '_fields', ())}\n".encode()
            )
        case functools.partial():
            _hash_value(
                key, (value.func, value.args, tuple(sorted(value.keywords.items()))), names, visited
            )
        case _ if isinstance(value, python_types.BuiltinFunctionType | np.ufunc) or root in (
            "numba",
            "numpy",
            "typing",
        ):
            key.update(f"{root} {getattr(value, '__qualname__', None) or repr(value)}\n".encode())
        case _:
            raise _UnhashableError(repr(value))


def _hash_function(
    key: Digest, function: python_types.FunctionType, visited: dict[int, object]
) -> None:
    """Hash a function's name and, outside `_VERSIONED_PACKAGES`, its code and all it refers to."""
    code = function.__code__
    scope = function.__globals__
    root = str(function.__module__).partition(".")[0]
    key.update(f"function {function.__module__}.{function.__qualname__}\n".encode())
    if root not in (*_VERSIONED_PACKAGES, "codrl_mj"):
        key.update(hashlib.sha256(_source_of(function.__module__)).digest())
    if root in _VERSIONED_PACKAGES:
        return
    names = _referenced_names(code)
    _hash_value(key, code, names, visited)
    _hash_value(
        key,
        (function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items()))),
        names,
        visited,
    )
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        key.update(f"closure {name} ".encode())
        try:
            _hash_value(key, cell.cell_contents, names, visited)
        except ValueError:
            raise _UnhashableError(name) from None
    for name in names:
        if name in scope:
            key.update(f"global {name} ".encode())
            _hash_value(key, scope[name], names, visited)


def _referenced_names(code: python_types.CodeType) -> tuple[str, ...]:
    """Return the names of globals and attributes in a function and the functions inside it."""
    inner = (constant for constant in code.co_consts if isinstance(constant, python_types.CodeType))
    return (*code.co_names, *(name for constant in inner for name in _referenced_names(constant)))
