"""Write docs/reference/: pages of the commands, of public names, and of all settings' fields.

Everything comes from docstrings, the fields' bounds and units, and `--help`. `make docs` runs this
script, and its output is not committed. Only python.md is written by hand.
"""

import ast
import contextlib
import dataclasses
import importlib
import inspect
import io
import itertools
import os
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from codrl_mj import cli
from codrl_mj.actuators import Inputs
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import field_docs
from codrl_mj.runs.files import atomic_write
from codrl_mj.tasks import TASKS, Task
from codrl_mj.training import TrainConfig

FOLDER = Path(__file__).parent.parent / "docs" / "reference"
WIDTH = "80"
"""Width of the help texts [characters]."""
ROOMS = (
    *(
        "actuators",
        "agents",
        "arrays",
        "catalogue",
        "deploy",
        "disturbances",
        "sizing",
        "engine",
        "envs",
        "evaluation",
        "identify",
    ),
    *("physics", "study", "tasks", "training", "validation", "viz.replay"),
)
"""Subpackages with an `__all__`."""
MODULE_NAMES = {
    "viz.films": ("film.film", "film.Panel", "film.record"),
    "external_envs": (
        "building.motors_added",
        "dm_control.make_dm_control",
        "sources.ExternalEnvSource",
        "sources.GymnasiumEnvSource",
    ),
    "viz.pages": (
        *(
            "report.report",
            "report.replay_parts",
            "motor.motor_page",
            "identification.identification_page",
        ),
        *("certificate.write", "page.clocked_part"),
    ),
    "runs": (
        *(
            "policies.load_policy",
            "policies.save_policy",
            "summaries.find_runs",
            "summaries.read_run",
        ),
        *("summaries.compare", "files.atomic_write"),
    ),
    "viz.view": ("session.Session",),
}
"""Subpackages that are imported by their modules -> public names."""


def help_of(*words: str) -> str:
    """Return the output of `codrl-mj WORDS --help`, without frames."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    lines = [re.sub(r"^╭─ (.*?) ─*╮$", r"\n\1:", line) for line in printed.getvalue().splitlines()]
    content = [
        line.strip("│").rstrip() for line in lines if not re.fullmatch(r"[│ ]*[╰─]+[╯│ ]*", line)
    ]
    max_width = int(WIDTH) + 5
    return "\n".join(
        textwrap.fill(line, int(WIDTH)) if len(line) > max_width and line[0] != " " else line
        for line in content
    ).strip()


def verbs() -> list[str]:
    """Return the first words of all commands."""
    return list(dict.fromkeys(name.split()[0] for name in cli.VERBS))


def verb_page(verb: str) -> str:
    """Return the page of a command and its subcommands."""
    text = help_of(verb)
    subcommands = re.match(rf"usage: codrl-mj {verb} \[-h\] \{{(.*?)\}}", text)
    names = [name.split()[1] for name in cli.VERBS if name.startswith(f"{verb} ")]
    names = names or (subcommands[1].split(",") if subcommands else [])
    parts = [f"# codrl-mj {verb}", fenced(text)]
    parts += [f"## {verb} {name}\n\n{fenced(help_of(verb, name))}" for name in names]
    return "\n\n".join(parts)


def fenced(text: str) -> str:
    """Format a text as a code block."""
    return f"```text\n{text}\n```"


def verbs_page() -> str:
    """Return a table with the first sentence of every command."""
    rows = []
    for verb in verbs():
        sentence = help_of(verb).split("\n\n")[1]
        rows.append((f"[`{verb}`](command_line/{verb}.md)", " ".join(sentence.split())))
    return (
        "# Command line\n\n`codrl-mj VERB --help` says the"
        f" same.\n\n{table(('verb', 'does'), rows)}"
    )


def room_page(room: str) -> str:
    """Return the page of a subpackage: classes and functions, then a table of constants."""
    module = importlib.import_module(f"codrl_mj.{room}")
    directives, constants = [], []
    for name in MODULE_NAMES.get(room) or module.__all__:
        module_name, _, attribute = f"{module.__name__}.{name}".rpartition(".")
        value = getattr(importlib.import_module(module_name), attribute)
        unwrapped = inspect.unwrap(value) if callable(value) else value
        if (
            inspect.isclass(unwrapped) or inspect.isfunction(unwrapped)
        ) and unwrapped.__module__.startswith("codrl_mj."):
            directives.append(f"::: {unwrapped.__module__}.{unwrapped.__qualname__}")
        else:
            constants.append(
                (
                    f"`{attribute}`",
                    shortened(value),
                    constant_doc(module.__name__, attribute, value),
                )
            )
    parts = [f"# codrl_mj.{room}", (inspect.getdoc(module) or "").partition("\n\n")[0], *directives]
    return "\n\n".join(
        [
            *parts,
            *(["## Constants", table(("name", "value", "is"), constants)] if constants else []),
        ]
    )


def shortened(value: Any) -> str:
    """Format a constant for a table: a mapping by its keys, a long value by its type."""
    if isinstance(value, Mapping):
        return "a mapping of " + ", ".join(f"`{key}`" for key in value)
    text = repr(value)
    return f"`{text}`" if len(text) <= 60 and "`" not in text else f"a `{type(value).__name__}`"


def constant_doc(room: str, name: str, value: Any) -> str:
    """Return the docstring of a constant, from whichever module of the subpackage defines it."""
    for module_name, module in list(sys.modules.items()):
        if f"{module_name}.".startswith(f"{room}.") and vars(module).get(name) is value:
            for statement, next_statement in itertools.pairwise(
                ast.parse(inspect.getsource(module)).body
            ):
                targets = (
                    statement.targets
                    if isinstance(statement, ast.Assign)
                    else [getattr(statement, "target", None)]
                )
                names = [target.id for target in targets if isinstance(target, ast.Name)]
                if (
                    name in names
                    and isinstance(next_statement, ast.Expr)
                    and isinstance(next_statement.value, ast.Constant)
                ):
                    return " ".join(str(next_statement.value.value).split())
    return ""


def settings() -> dict[str, list[type]]:
    """Return all dataclasses of settings, by section title."""
    rooms = {
        room: importlib.import_module(f"codrl_mj.{room}")
        for room in ("actuators", "agents", "disturbances")
    }
    dataclasses_by_room = {
        room: [
            kind
            for name in module.__all__
            if dataclasses.is_dataclass(kind := getattr(module, name))
            and isinstance(kind, type)
            and dataclasses.fields(kind)
        ]
        for room, module in rooms.items()
    }
    options = [task.options for task in TASKS.values() if task.options._fields]
    bench = importlib.import_module("codrl_mj.identify.synthetic")
    return {
        "Environments": [EnvConfig, *dataclasses_by_room["disturbances"]],
        "Training": [TrainConfig, *dataclasses_by_room["agents"]],
        "Actuators": dataclasses_by_room["actuators"],
        "Inputs of an actuator": [Inputs],
        "A task of your own": [Task],
        "Options of tasks": options,
        "Synthetic logs": [bench.Excitation, bench.Load, bench.Sensor, bench.Sampler],
    }


def rows_of(kind: type) -> Iterator[tuple[str, ...]]:
    """Yield name, default, unit, bound and meaning of each field of a dataclass or `NamedTuple`."""
    docs = field_docs(kind)
    if not dataclasses.is_dataclass(kind):
        for name in kind._fields:  # type: ignore[attr-defined]
            default = kind._field_defaults.get(name, dataclasses.MISSING)  # type: ignore[attr-defined]
            yield f"`{name}`", shown(default), "", "", docs.get(name, "")
        return
    for field in dataclasses.fields(kind):
        _, bound, optional, _ = field.metadata.get("bound", (None, "", False, None))
        default = field.default
        if default is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        bound_text = f"{bound} or none" if bound and optional else bound
        yield (
            f"`{field.name}`",
            shown(default),
            field.metadata.get("unit", ""),
            bound_text,
            docs.get(field.name, ""),
        )


def shown(default: Any) -> str:
    """Format a default for a table; a part by its class."""
    if default is dataclasses.MISSING:
        return "required"
    if dataclasses.is_dataclass(default):
        return f"`{type(default).__name__}`"
    return f"`{default.__name__}`" if isinstance(default, type) else f"`{default!r}`"


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table without empty columns."""
    columns = [column for column in zip(header, *rows, strict=True) if any(column[1:])]
    head, *rest = zip(*columns, strict=True)
    lines = [head, ["---"] * len(head), *rest]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def settings_page() -> str:
    """Return the page of every field of every configuration."""
    parts = [
        "# Settings",
        (
            "Every field, with its default, unit and bound. The same names are keyword arguments in"
            " Python, keys in files and flags of the [command line](command_line.md): `max_voltage`"
            " is `--actuator.controller.max-voltage`."
        ),
    ]
    for title, kinds in settings().items():
        parts.append(f"## {title}")
        for kind in kinds:
            name = (
                f"{kind.__module__.rpartition('.')[2]}.Options"
                if kind.__name__ == "Options"
                else kind.__name__
            )
            summary = (inspect.getdoc(kind) or "").partition("\n\n")[0]
            parts += [f"### {name}", " ".join(summary.split())]
            parts.append(table(("field", "default", "unit", "bound", "is"), rows_of(kind)))
    return "\n\n".join(parts)


def pages() -> dict[str, str]:
    """Return all pages by their path below docs/reference."""
    # argparse and tyro take the width of the terminal from this variable.
    os.environ["COLUMNS"] = WIDTH
    pages_by_path = {"command_line.md": verbs_page(), "settings.md": settings_page()}
    pages_by_path |= {f"command_line/{verb}.md": verb_page(verb) for verb in verbs()}
    return pages_by_path | {
        f"rooms/{room}.md": room_page(room) for room in sorted((*ROOMS, *MODULE_NAMES))
    }


def main() -> int:
    """Write all pages."""
    for name, text in pages().items():
        path = FOLDER / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            temporary.write_text(f"{text}\n")
    print(f"wrote {FOLDER}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
