"""Functions that users write for tasks and families: called once before they are compiled, errors in one sentence."""

import inspect
import numbers
import re
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Form = Any
"""What a function is to return: the name of a number, or a tuple of forms."""


def call(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function of a user's, known by a name in messages, returns.

    Raises:
        ValueError: it is no function, or raises an error: its file, line, name and error.
    """
    if not inspect.isfunction(function):
        raise ValueError(f"{name} = {function!r}: must be a function in plain Python")
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except Exception as error:
        own = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == function.__code__.co_filename]
        where = place(function, own[-1].lineno if own else None)
        raise ValueError(f"{where}: {type(error).__name__}: {error}") from error


def place(function: Callable[..., Any], line: int | None = None) -> str:
    """File, line (where it begins, unless told otherwise) and name of a function, for messages."""
    code = function.__code__
    return f"{Path(code.co_filename).name}:{line or code.co_firstlineno}, in {code.co_name}"


def check_form(function: Callable[..., Any], value: Any, form: Form, declared: str) -> Any:
    """What a function returns (or numba says that it does), which has to be of a form; `declared` says where."""
    if not _fits(value, form):
        raise ValueError(f"{place(function)}: returns {_said(value)}, must return {_wanted(form)}: see {declared}")
    return value


def _fits(value: Any, form: Form) -> bool:
    if isinstance(form, str):
        scalar = isinstance(value, np.ndarray) and value.shape == () and value.dtype.kind in "biuf"  # of np.where
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
    return f"a tuple of {len(form)} ({', '.join(form)})" if flat else f"({', '.join(map(_wanted, form))})"


def not_compiled(function: Callable[..., Any], error: Exception) -> str:
    """What numba says of a function that it does not compile, as a sentence."""
    text = str(error)
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("Failed in")]
    causes = [cause for cause in re.findall(r"\w*Error: (.+)", text) if not cause.startswith("Failed in")]
    said = causes[-1] if causes else " ".join(lines[:2] if lines[0].endswith(":") else lines[:1])
    line = re.search(r'(?m)^\s*File ".+", line (\d+):', text)
    return f"{place(function, int(line[1]) if line else None)}: numba does not compile it: {said.strip()}"
