"""The command line: parses, calls the package, prints. Nothing imports it."""

import contextlib
import importlib
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
from codrl_mj.cli.parsing import parse, understood
from codrl_mj.runs.files import check_file, check_page, check_writable

VERBS: dict[str, tuple[str, str, str]] = {
    # verb: its class, what it does in a sentence, and an example
    "train": ("train:Train", "Train an agent through an actuator.", "cartpole --actuator weaker"),
    "evaluate": ("evaluate:Evaluate", "Measure a policy on any actuator.", "runs/mine --actuator lag"),
    "runs": ("runs:Runs", "List the runs of a folder, or compare some.", "runs --sort return"),
    "render": ("render:Render", "Film one episode.", "runs/mine --out balance.mp4"),
    "replay": ("replay:Replay", "Write one episode as a page in three dimensions.", "runs/mine --out balance.html"),
    "view": ("view:LiveView", "Watch a simulation live in a browser, and set its motor.", "cartpole"),
    "report": ("report:Report", "Write a report of a run as one HTML file.", "runs/mine --out mine.html"),
    "motor": ("motor:MotorTools", "List off-the-shelf motors, look at one, design its loop, choose one.", "list"),
    "advise": ("advise:Advise", "Say whether to train through an actuator or do something else.", "weak pendulum"),
    "identify": ("identify:Identify", "Identify a motor from its bench logs.", "check swing.csv --columns time=t:s"),
    "data": ("data:Data", "List or fetch measurements of real motors that others have published.", "dfki_pendulum"),
    "cache": ("cache:Cache", "Show or clear the compiled code that is kept on disk.", "--clear"),
    "export": ("export:Export", "Take a policy out: ONNX, and all that it assumes.", "runs/mine --out mine"),
    "board": ("board:BoardTools", "Run the exported C as a controller, or check its log.", "test mine"),
    "validate": ("validate:Validate", "Certify that the port is right.", "cartpole --out certificate"),
}
"""The verbs by name; the module of one is imported when it is called."""
_ABOUT = (
    "Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a motor. Each verb has "
    "its own --help; -h leaves descriptions out; --version; --traceback shows where an error arose."
)


_FILES: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(("Evaluate", "Runs", "SimulateLog"), check_file),
    **dict.fromkeys(("Replay", "Report"), check_page),
    "Render": lambda path: check_writable(path.parent),  # a film or a folder, which it checks itself
}
"""Verbs whose `--out` is a file and no folder -> its check."""


def find_verb(name: str) -> Any:
    """The class of a verb."""
    module, _, kind = VERBS[name][0].partition(":")
    return getattr(importlib.import_module(f"codrl_mj.cli.{module}"), kind)


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
        if words[:1] and words[0] in VERBS:
            kind = find_verb(words[0])  # or the one that it makes for a line on which its flags depend
            kind = kind.for_line(words[1:]) if hasattr(kind, "for_line") else kind
            verb = parse(kind, f"codrl-mj {words[0]}", words[1:])
        else:
            helped = {name: f"{says}\n\nExample: codrl-mj {name} {line}" for name, (_, says, line) in VERBS.items()}
            verb = parse(helped, "codrl-mj", words, _ABOUT)
        _check_outputs(getattr(verb, "verb", verb))
        return verb.run()
    except BrokenPipeError:  # whoever read the output has enough of it, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left is flushed at exit
        return 141
    except (Exception, KeyboardInterrupt) as error:
        if (stopped_by := getattr(error, "signal_number", None)) is not None:  # of a TrainingStoppedError
            print(f"codrl-mj: {error}", file=sys.stderr)
            return int(128 + stopped_by)
        if traced:
            traceback.print_exc()
        if _interrupted(error):
            again = "goes on where it was" if arguments[:1] == ["advise"] else "begins anew"
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
