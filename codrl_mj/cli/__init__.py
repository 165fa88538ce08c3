"""Command line, which parses words, calls the package and prints results; no module imports it."""

import contextlib
import contextvars
import dataclasses
import importlib
import io
import json
import math
import os
import re
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NoReturn, Protocol, cast

import codrl_mj
from codrl_mj.boundary import Json
from codrl_mj.cli.parsing import Output, normalize_arguments, parse
from codrl_mj.requirements import (
    MissingPackageError,
    missing_module_message,
    simulation_problem,
)
from codrl_mj.runs.files import check_file, check_page, check_writable
from codrl_mj.user_code import FILES_TRUSTED

VERB_HELP: dict[str, tuple[str, str]] = {
    # Verb, or first word of a group of verbs -> one sentence, and an example.
    "train": ("Train an agent through an actuator.", "cartpole --actuator weaker"),
    "evaluate": ("Measure a policy on any actuator.", "runs/mine --actuator lag"),
    "runs": ("List the runs of a folder, or compare some.", "runs --sort return"),
    "render": ("Film one episode.", "runs/mine --out balance.mp4"),
    "replay": ("Write one episode as a web page in 3D.", "runs/mine --out balance.html"),
    "view": ("Watch a simulation live in a browser, and change its motor.", "cartpole"),
    "report": ("Write a report of a run as one HTML file.", "runs/mine --out mine.html"),
    "motor": ("List off-the-shelf motors, show one, design its loop, choose one.", "list"),
    "advise": (
        "Recommend what to do about an actuator before you train.",
        "weak pendulum",
    ),
    "identify": ("Identify a motor from its bench logs.", "check swing.csv --columns time=t:s"),
    "data": (
        "List or download published measurements of real motors.",
        "dfki_pendulum",
    ),
    "cache": ("Show or clear the cache of compiled code.", "--clear"),
    "export": ("Export a policy as ONNX and C, with all its assumptions.", "runs/mine --out mine"),
    "board": ("Run exported C code as a controller, or check its log.", "test mine"),
    "validate": (
        "Check the simulation against independent references.",
        "cartpole --out certificate",
    ),
}
VERBS = {
    "train": "train:Train",
    "evaluate": "evaluate:Evaluate",
    "runs": "runs:Runs",
    "render": "see:Render",
    "replay": "see:Replay",
    "view": "see:LiveView",
    "report": "see:Report",
    "motor list": "motor:List",
    "motor new": "motor:New",
    "motor show": "motor:Show",
    "motor design": "motor:Design",
    "motor step": "motor:Step",
    "motor write": "motor:Write",
    "motor feasible": "motor_choice:Feasible",
    "motor choose": "motor_choice:Choose",
    "advise": "advise:Advise",
    "identify": "identify:Identify",
    "identify check": "identify:CheckLogs",
    "identify columns": "identify:ProposeColumns",
    "identify plan": "identify:PlanExperiment",
    "identify servo": "identify_servo:IdentifyServo",
    "identify simulate": "identify:SimulateLog",
    "identify compare": "deploy:CompareLog",
    "data": "runs:Data",
    "cache": "runs:Cache",
    "export": "deploy:Export",
    "board test": "deploy:Test",
    "board check": "deploy:CheckLog",
    "board run": "deploy:RunBoard",
    "validate": "validate:Validate",
}
"""Words of every verb -> its module, which is imported when the verb is called, and its class."""
_DESCRIPTION = (
    "Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a motor."
    " Every verb has its own --help; -h prints a shorter help. --version prints the version."
    " With --traceback, an error prints its traceback."
)


_OUTPUT_FILE_CHECKS: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(
        ("Evaluate", "Runs", "SimulateLog", "CompareLog", "RunBoard", "Write"), check_file
    ),
    **dict.fromkeys(("Replay", "Report"), check_page),
    # The file of `render` may also be a folder of frames, which `check_film` checks itself.
    "Render": lambda path: check_writable(path.parent),
}
"""Verbs whose `--out` is a file instead of a folder -> the check of that path."""


class Verb(Protocol):
    """Parsed command line."""

    def run(self) -> int | Output:
        """Return the exit status; a verb with --json also returns the content to print."""


def find_verb(name: str) -> type[Verb]:
    """Return the class of a verb."""
    module, _, kind = VERBS[name].partition(":")
    verb: type[Verb] = getattr(importlib.import_module(f"codrl_mj.cli.{module}"), kind)
    return verb


def main(arguments: list[str] | None = None) -> int:
    """Run `codrl-mj`.

    Args:
        arguments: the command line without the program's name; None: that of the process.

    Returns:
        Exit status: 0; 1 if a validation fails; 2 for bad input and all other errors; 130 after
            Ctrl-C; 141 if the reader of the output has closed it; 143 after SIGTERM.
    """
    # During the import of the package Ctrl-C ends the process with one line. From here on it raises
    # KeyboardInterrupt, so that a training can write its checkpoint.
    if signal.getsignal(signal.SIGINT) is codrl_mj._exit_on_interrupt:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command_line = sys.argv[1:] if arguments is None else arguments
    if command_line[:1] == ["--version"]:
        print(f"codrl-mj {codrl_mj.__version__}")
        return 0
    with warnings.catch_warnings(), _engine_warnings():
        warnings.showwarning = _show_each_once()
        words = [word for word in command_line if word != "--traceback"]
        # `FILES_TRUSTED` is a context variable: a copy of the context keeps it from callers of
        # `main`.
        return contextvars.copy_context().run(_run, words, "--traceback" in command_line)


def _run(arguments: list[str], traced: bool) -> int:
    try:
        FILES_TRUSTED.set("--trust" in arguments)
        words = normalize_arguments(arguments)
        name = next(
            (candidate for candidate in (" ".join(words[:2]), *words[:1]) if candidate in VERBS),
            None,
        )
        if name is None:
            _print_help(words)
        rest = words[1 + name.count(" ") :]
        # The flags of some verbs depend on other words of the line (agent, task, actuator). Such a
        # class builds the dataclass for that line in `for_line`.
        kind = find_verb(name)
        verb = parse(
            kind.for_line(rest) if hasattr(kind, "for_line") else kind, f"codrl-mj {name}", rest
        )
        _check_outputs(verb)
        return _run_verb(verb)
    except BrokenPipeError:
        # The reader of the output, such as `head`, has closed the pipe. Python flushes stdout at
        # exit and would print an error, so the rest goes to /dev/null.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (Exception, KeyboardInterrupt) as error:
        # Only a `TrainingStoppedError` has a signal number; it has written a checkpoint already.
        if (stopped_by := getattr(error, "signal_number", None)) is not None:
            print(f"codrl-mj: {error}", file=sys.stderr)
            return int(128 + stopped_by)
        if traced:
            traceback.print_exc()
        if _is_interrupt(error):
            effect = "continues" if arguments[:1] == ["advise"] else "starts from the beginning"
            message = isinstance(error, KeyboardInterrupt) and str(error)
            print(f"codrl-mj: {message or f'stopped: the same command {effect}'}", file=sys.stderr)
            return 130
        print(f"codrl-mj: error: {_format_error(error)}", file=sys.stderr)
        return 2


def _print_help(words: Sequence[str]) -> NoReturn:
    """Print the help of all verbs, or of the group that the first word names, and exit."""
    description: str | None = _DESCRIPTION
    group = words[0] if words[:1] and words[0] in VERB_HELP else ""
    descriptions: dict[str, str | None] = {
        name: f"{sentence}\n\nExample: codrl-mj {name} {example}"
        for name, (sentence, example) in VERB_HELP.items()
    }
    if group:
        description = descriptions[group]
        descriptions = {
            name.split()[1]: find_verb(name).__doc__
            for name in VERBS
            if name.startswith(f"{group} ")
        }
    parse(descriptions, f"codrl-mj {group}".strip(), words[1:] if group else words, description)
    raise SystemExit


def _run_verb(verb: Verb) -> int:
    """Run a verb; with --json, print only the content that it returns beside its exit status."""
    if not getattr(verb, "as_json", False):
        result = verb.run()
        return int(result[0] if isinstance(result, tuple) else result)
    # Tables that the verb prints for people are discarded.
    with contextlib.redirect_stdout(io.StringIO()):
        # Verbs with this flag return content too.
        status, content = cast(Output, verb.run())
    print(json.dumps(_to_json_value(content), indent=2, allow_nan=False))
    return int(status)


def _to_json_value(content: object) -> Json:
    """Convert a value to JSON types: objects to mappings, and NaN and infinity to null."""
    for method in ("as_mapping", "summary", "_asdict"):
        if hasattr(content, method):
            return _to_json_value(getattr(content, method)())
    if isinstance(content, Mapping) or dataclasses.is_dataclass(content):
        fields = content if isinstance(content, Mapping) else vars(content)
        return {str(name): _to_json_value(value) for name, value in fields.items()}
    if isinstance(content, list | tuple):
        return [_to_json_value(value) for value in content]
    if isinstance(content, float):
        return float(content) if math.isfinite(content) else None
    return str(content) if isinstance(content, Path) else content


def _check_outputs(verb: Verb) -> None:
    """Raise an error if an output path cannot be written, before anything is computed."""
    kind = type(verb).__name__
    checks = {
        "out": _OUTPUT_FILE_CHECKS.get(kind, check_writable),
        "html": check_page,
        "trajectory": check_file,
    }
    for name, check in checks.items():
        if (path := getattr(verb, name, None)) is not None:
            check(path)


def _is_interrupt(error: BaseException | None) -> bool:
    """Return True if an error was caused by Ctrl-C.

    A library that is being imported may turn a KeyboardInterrupt into an error of its own.
    """
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or _is_interrupt(error.__context__)
    )


def _format_error(error: BaseException) -> str:
    """Return the message of an error as one line."""
    text = " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError):
        return missing_module_message(error)
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    # Verbs that need no simulation also work where Gymnasium is not installed.
    is_from_gymnasium = any(kind.__module__ == "gymnasium.error" for kind in type(error).__mro__)
    known = ValueError | OSError | RuntimeError | ArithmeticError | MissingPackageError
    if is_from_gymnasium or isinstance(error, known):
        return text
    return f"{type(error).__name__}: {textwrap.shorten(text, 300)} (--traceback shows where)"


@contextlib.contextmanager
def _engine_warnings() -> Iterator[None]:
    """Print each kind of MuJoCo's warnings once, in our format, instead of in MUJOCO_LOG.TXT.

    A handler that the user has installed is left in place. Two warnings are not shown: a simulation
    diverged, which ends in an error anyway; and Gymnasium's cheetah model uses a deprecated
    attribute.
    """
    seen_kinds = {"Nan, Inf or huge value in ", "compiler attribute 'settotalmass' is deprecated"}

    def show(text: str) -> None:
        if not any(text.startswith(prefix) for prefix in seen_kinds):
            # Warnings of one kind differ in numbers such as the time: the text before the first
            # digit identifies the kind.
            seen_kinds.add(re.split(r"\d", text)[0])
            _show_warning(f"MuJoCo: {text}")

    if simulation_problem():
        yield
        return
    import mujoco

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(show)
    try:
        yield
    finally:
        if mujoco.get_mju_user_warning() is show:
            mujoco.set_mju_user_warning(None)


def _show_each_once() -> Callable[..., None]:
    """Return a `warnings.showwarning` that shows each text once.

    Otherwise, every environment that a command creates would repeat the same warning.
    """
    shown = set()

    def show(message: Warning | str, *_: object, **__: object) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            _show_warning(message)

    return show


def _show_warning(message: Warning | str) -> None:
    print(f"codrl-mj: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
