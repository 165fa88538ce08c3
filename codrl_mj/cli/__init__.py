"""The command line: parses, calls the package, prints. Nothing imports it."""

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
from typing import Any, NoReturn

import gymnasium
import mujoco

import codrl_mj
from codrl_mj.cli.extras import missing_module_message
from codrl_mj.cli.parsing import parse, understood
from codrl_mj.runs.files import check_file, check_page, check_writable
from codrl_mj.user_code import FILES_TRUSTED

SAYS: dict[str, tuple[str, str]] = {
    # verb, or the word before several: what it does in a sentence, and an example
    "train": ("Train an agent through an actuator.", "cartpole --actuator weaker"),
    "evaluate": ("Measure a policy on any actuator.", "runs/mine --actuator lag"),
    "runs": ("List the runs of a folder, or compare some.", "runs --sort return"),
    "render": ("Film one episode.", "runs/mine --out balance.mp4"),
    "replay": ("Write one episode as a page in three dimensions.", "runs/mine --out balance.html"),
    "view": ("Watch a simulation live in a browser, and set its motor.", "cartpole"),
    "report": ("Write a report of a run as one HTML file.", "runs/mine --out mine.html"),
    "motor": ("List off-the-shelf motors, look at one, design its loop, choose one.", "list"),
    "advise": ("Say whether to train through an actuator or do something else.", "weak pendulum"),
    "identify": ("Identify a motor from its bench logs.", "check swing.csv --columns time=t:s"),
    "data": (
        "List or fetch measurements of real motors that others have published.",
        "dfki_pendulum",
    ),
    "cache": ("Show or clear the compiled code that is kept on disk.", "--clear"),
    "export": ("Take a policy out: ONNX, and all that it assumes.", "runs/mine --out mine"),
    "board": ("Run the exported C as a controller, or check its log.", "test mine"),
    "validate": ("Certify that the port is right.", "cartpole --out certificate"),
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
    "motor feasible": "motor_choice:Feasible",
    "motor choose": "motor_choice:Choose",
    "advise": "advise:Advise",
    "identify": "identify:Identify",
    "identify check": "identify:CheckLogs",
    "identify columns": "identify:ProposeColumns",
    "identify plan": "identify:PlanExperiment",
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
"""The words of every verb -> its module, which is imported when it is called, and its class."""
_ABOUT = (
    "Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a motor."
    " Each verb has its own --help; -h leaves descriptions out; --version; --traceback shows where"
    " an error arose."
)


_FILES: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(("Evaluate", "Runs", "SimulateLog", "CompareLog", "RunBoard"), check_file),
    **dict.fromkeys(("Replay", "Report"), check_page),
    "Render": lambda path: check_writable(
        path.parent
    ),  # a film or a folder, which it checks itself
}
"""Verbs whose `--out` is a file and no folder -> its check."""


def find_verb(name: str) -> Any:
    """The class of a verb."""
    module, _, kind = VERBS[name].partition(":")
    return getattr(importlib.import_module(f"codrl_mj.cli.{module}"), kind)


def main(arguments: list[str] | None = None) -> int:
    """Run `codrl-mj`.

    Args:
        arguments: the command line without the program's name; None takes the process's.

    Returns:
        Exit status: 0, 1 when a validation fails, 2 for bad input and whatever else fails, 130
        after Ctrl-C, 141 if
            nobody reads on, 143 after SIGTERM.
    """
    if signal.getsignal(signal.SIGINT) is codrl_mj._exit_on_interrupt:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["--version"]:
        print(f"codrl-mj {codrl_mj.__version__}")
        return 0
    with warnings.catch_warnings(), _engine_warnings():
        warnings.showwarning = _show_each_once()
        words = [word for word in given if word != "--traceback"]
        return contextvars.copy_context().run(_run, words, "--traceback" in given)


def _run(arguments: list[str], traced: bool) -> int:
    try:
        FILES_TRUSTED.set("--trust" in arguments)
        words = understood(arguments)
        name = next((one for one in (" ".join(words[:2]), *words[:1]) if one in VERBS), None)
        if name is None:
            _help(words)
        rest = words[1 + name.count(" ") :]
        kind = find_verb(name)  # or the one that it makes for a line on which its flags depend
        verb = parse(
            kind.for_line(rest) if hasattr(kind, "for_line") else kind, f"codrl-mj {name}", rest
        )
        _check_outputs(verb)
        return _answer(verb)
    except BrokenPipeError:  # whoever read the output has enough of it, such as head
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # what is left is flushed at exit
        return 141
    except (Exception, KeyboardInterrupt) as error:
        if (
            stopped_by := getattr(error, "signal_number", None)
        ) is not None:  # of a TrainingStoppedError
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


def _help(words: Sequence[str]) -> NoReturn:
    """Say what verbs there are, all or those that begin with the first word; SystemExit."""
    about, group = _ABOUT, words[0] if words[:1] and words[0] in SAYS else ""
    helped = {
        name: f"{says}\n\nExample: codrl-mj {name} {line}" for name, (says, line) in SAYS.items()
    }
    if group:
        about = helped[group]
        helped = {
            name.split()[1]: find_verb(name).__doc__
            for name in VERBS
            if name.startswith(f"{group} ")
        }
    parse(helped, f"codrl-mj {group}".strip(), words[1:] if group else words, about)
    raise SystemExit


def _answer(verb: Any) -> int:
    """Run a verb. With --json nothing is printed but what it returns beside its exit status."""
    if not getattr(verb, "as_json", False):
        done = verb.run()
        return int(done[0] if isinstance(done, tuple) else done)
    with contextlib.redirect_stdout(io.StringIO()):
        status, content = verb.run()
    print(json.dumps(_plain(content), indent=2, allow_nan=False))
    return int(status)


def _plain(content: Any) -> Any:
    """As JSON has it: what has names as a mapping; null for numbers that are not finite, which it has no word for."""
    for how in ("as_mapping", "summary", "_asdict"):
        if hasattr(content, how):
            return _plain(getattr(content, how)())
    if isinstance(content, Mapping) or dataclasses.is_dataclass(content):
        named = content if isinstance(content, Mapping) else vars(content)
        return {str(name): _plain(value) for name, value in named.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if isinstance(content, float):
        return float(content) if math.isfinite(content) else None
    return str(content) if isinstance(content, Path) else content


def _check_outputs(verb: Any) -> None:
    """Refuse what cannot be written before anything is computed."""
    kind = type(verb).__name__
    checks = {"out": _FILES.get(kind, check_writable), "html": check_page, "trajectory": check_file}
    for name, check in checks.items():
        if (path := getattr(verb, name, None)) is not None:
            check(path)


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is what an error comes from: libraries that are just imported turn it into errors of their own."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or _interrupted(error.__context__)
    )


def _sentence(error: BaseException) -> str:
    """What is wrong, in one line."""
    text = " ".join(str(error).split())
    if isinstance(error, ModuleNotFoundError):
        return missing_module_message(error)
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    if isinstance(
        error, ValueError | OSError | RuntimeError | ArithmeticError | gymnasium.error.Error
    ):
        return text
    return f"{type(error).__name__}: {textwrap.shorten(text, 300)} (--traceback shows where)"


@contextlib.contextmanager
def _engine_warnings() -> Iterator[None]:
    """Show MuJoCo's warnings as ours, each kind once, for it would write MUJOCO_LOG.TXT; not if somebody else has them.

    That a simulation diverged is left out, which ends in an error, and what Gymnasium's model of a
    cheetah is old in.
    """
    shown = {"Nan, Inf or huge value in ", "compiler attribute 'settotalmass' is deprecated"}

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


def _show_each_once() -> Callable[..., None]:
    """Return a `warnings.showwarning` that shows each text once, for every environment of a command warns anew."""
    shown = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            _show_warning(message)

    return show


def _show_warning(message: Warning | str) -> None:
    print(f"codrl-mj: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
