"""The command line: parses, calls the package, prints. Nothing imports it."""

import contextlib
import functools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import mujoco
import tyro

from codrl_mj.cli.advise import Advise
from codrl_mj.cli.evaluate import Evaluate
from codrl_mj.cli.fields import with_environment
from codrl_mj.cli.identify import Identify, identify_verb
from codrl_mj.cli.motor import Motor
from codrl_mj.cli.render import Render
from codrl_mj.cli.replay import Replay
from codrl_mj.cli.report import Report
from codrl_mj.cli.reproduce import Reproduce
from codrl_mj.cli.runs import Runs
from codrl_mj.cli.study import Study
from codrl_mj.cli.train import Train, train_verb
from codrl_mj.cli.validate import Validate
from codrl_mj.cli.view import View
from codrl_mj.training import TrainingStoppedError

VERBS: dict[str, Any] = {
    "train": Train,
    "evaluate": Evaluate,
    "runs": Runs,
    "render": Render,
    "replay": Replay,
    "view": View,
    "report": Report,
    "motor": Motor,
    "advise": Advise,
    "identify": Identify,
    "validate": Validate,
    "study": Study,
    "reproduce": Reproduce,
}
"""The verbs by name."""
_MADE: dict[str, Callable[[list[str]], Any]] = {
    "train": train_verb,
    "identify": identify_verb,
    "evaluate": functools.partial(with_environment, Evaluate),
    "render": functools.partial(with_environment, Render),
    "replay": functools.partial(with_environment, Replay),
    "view": functools.partial(with_environment, View),
}
"""Those whose flags depend on the rest of the command line."""


def main(arguments: list[str] | None = None) -> int:
    """Run `codrl-mj`.

    Args:
        arguments: the command line without the program's name; None takes the process's.

    Returns:
        Exit status: 0, 1 when a validation fails, 2 for bad input, 130 after Ctrl-C, 141 if nobody
            reads on, 143 after SIGTERM.
    """
    given = sys.argv[1:] if arguments is None else arguments
    with warnings.catch_warnings(), _engine_warnings():
        warnings.showwarning = _show_warning
        return _run(given)


def _run(arguments: list[str]) -> int:
    try:
        verb: Any = tyro.extras.subcommand_cli_from_dict(
            VERBS | {verb: make(arguments[1:]) for verb, make in _MADE.items() if arguments[:1] == [verb]},
            prog="codrl-mj",
            description="Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a motor.",
            args=arguments,
        )
        return verb.run()
    except BrokenPipeError:  # whoever read the output has enough of it, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left is flushed at exit
        return 141
    except (ValueError, OSError, RuntimeError, ArithmeticError, gymnasium.error.Error) as error:
        print(f"codrl-mj: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        print(
            f"codrl-mj: error: {error}. Training and evaluation need the extra 'train', videos and "
            "pictures the extra 'render', certificates and margins the extra 'validate': pip install 'codrl-mj[all]'",
            file=sys.stderr,
        )
        return 2
    except TrainingStoppedError as stopped:
        print(f"codrl-mj: {stopped}", file=sys.stderr)
        return 128 + stopped.signal_number
    except KeyboardInterrupt:
        return 130


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
