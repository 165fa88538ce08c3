"""The command line: parses, calls the package, prints. Nothing imports it."""

import contextlib
import functools
import os
import re
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco

import codrl_mj
from codrl_mj.cli.advise import Advise
from codrl_mj.cli.cache import Cache
from codrl_mj.cli.data import Data
from codrl_mj.cli.evaluate import Evaluate
from codrl_mj.cli.fields import with_environment
from codrl_mj.cli.identify import Identify, identify_verb
from codrl_mj.cli.motor import MotorTools
from codrl_mj.cli.parsing import parse, understood
from codrl_mj.cli.render import Render
from codrl_mj.cli.replay import Replay
from codrl_mj.cli.report import Report
from codrl_mj.cli.runs import Runs
from codrl_mj.cli.train import Train, train_verb
from codrl_mj.cli.validate import Validate
from codrl_mj.cli.view import LiveView
from codrl_mj.runs.files import check_file, check_page, check_writable
from codrl_mj.training import TrainingStoppedError

VERBS: dict[str, Any] = {
    "train": Train,
    "evaluate": Evaluate,
    "runs": Runs,
    "render": Render,
    "replay": Replay,
    "view": LiveView,
    "report": Report,
    "motor": MotorTools,
    "advise": Advise,
    "identify": Identify,
    "data": Data,
    "cache": Cache,
    "validate": Validate,
}
"""The verbs by name."""
_MADE: dict[str, Callable[[list[str]], Any]] = {
    "train": train_verb,
    "identify": identify_verb,
    "evaluate": functools.partial(with_environment, Evaluate),
    "render": functools.partial(with_environment, Render),
    "replay": functools.partial(with_environment, Replay),
    "view": functools.partial(with_environment, LiveView),
}
"""Those whose flags depend on the rest of the command line."""


_FILES: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(("Evaluate", "Runs", "Simulate"), check_file),
    **dict.fromkeys(("Replay", "Report"), check_page),
    "Render": lambda path: check_writable(path.parent),  # a film or a folder, which it checks itself
}
"""Verbs whose `--out` is a file and no folder -> its check."""


def main(arguments: list[str] | None = None) -> int:
    """Run `codrl-mj`.

    Args:
        arguments: the command line without the program's name; None takes the process's.

    Returns:
        Exit status: 0, 1 when a validation fails, 2 for bad input and whatever else fails, 130 after Ctrl-C, 141 if
            nobody reads on, 143 after SIGTERM.
    """
    if signal.getsignal(signal.SIGINT) is codrl_mj._stopped_early:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["--version"]:
        print(f"codrl-mj {codrl_mj.__version__}")
        return 0
    with warnings.catch_warnings(), _engine_warnings():
        warnings.showwarning = _show_warning
        return _run([word for word in given if word != "--traceback"], "--traceback" in given)


def _run(arguments: list[str], traced: bool) -> int:
    verb: Any = None
    try:
        words = understood(arguments)
        made = {verb: make(words[1:]) for verb, make in _MADE.items() if words[:1] == [verb]}
        verb = parse(VERBS | made, words)
        _check_outputs(getattr(verb, "verb", verb))
        return verb.run()
    except BrokenPipeError:  # whoever read the output has enough of it, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left is flushed at exit
        return 141
    except TrainingStoppedError as stopped:
        print(f"codrl-mj: {stopped}", file=sys.stderr)
        return 128 + stopped.signal_number
    except (Exception, KeyboardInterrupt) as error:
        if traced:
            traceback.print_exc()
        if _interrupted(error):
            again = "goes on where it was" if isinstance(verb, Advise) else "begins anew"
            told = isinstance(error, KeyboardInterrupt) and str(error)
            print(f"codrl-mj: {told or f'stopped: the same command {again}'}", file=sys.stderr)
            return 130
        print(f"codrl-mj: error: {_sentence(error)}", file=sys.stderr)
        return 2


def _check_outputs(verb: Any) -> None:
    """Refuse what cannot be written before anything is computed."""
    kind = type(verb).__name__
    checks = {"out": _FILES.get(kind, check_writable), "html": check_page, "trajectory": check_file}
    for name, check in checks.items():
        if (path := getattr(verb, name, None)) is not None:
            check(path)


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is what an error comes from: libraries that are just imported turn it into errors of their own."""
    return error is not None and (isinstance(error, KeyboardInterrupt) or _interrupted(error.__context__))


def _sentence(error: BaseException) -> str:
    """What is wrong, in one line."""
    text = " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError):
        return (
            f"{text}. Training and evaluation need the extra 'train', videos and pictures the extra 'render', "
            "certificates and margins the extra 'validate': pip install 'codrl-mj[all]'"
        )
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, ValueError | OSError | RuntimeError | ArithmeticError | gymnasium.error.Error):
        return text
    return f"{type(error).__name__}: {textwrap.shorten(text, 300)} (--traceback shows where)"


@contextlib.contextmanager
def _engine_warnings() -> Iterator[None]:
    """Show MuJoCo's warnings as ours, each kind once, for it would write MUJOCO_LOG.TXT; not if somebody else has them.

    That a simulation diverged is left out, which ends in an error.
    """
    shown = {"Nan, Inf or huge value in "}

    def show(text: str) -> None:
        if not any(text.startswith(kind) for kind in shown):
            shown.add(re.split(r"\d", text)[0])
            _show_warning(f"MuJoCo: {text}")

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(show)
    try:
        yield
    finally:
        if mujoco.get_mju_user_warning() is show:
            mujoco.set_mju_user_warning(None)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"codrl-mj: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
