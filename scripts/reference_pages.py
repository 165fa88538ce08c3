"""Writes docs/reference/: the command line, a page a verb; every public name, a page a room; every field of a setting.

All of it comes from docstrings, the fields' own bounds and units, and `--help`. `make docs` runs
this; what it writes is not kept. Only python.md is written by hand.
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
"""Of the help [characters]."""
ROOMS = (
    *(
        "actuators",
        "agents",
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
"""Rooms with an `__all__`."""
ALONE = {
    "viz.films": ("film.film", "film.Panel", "film.record"),
    "external_envs": (
        "building.motors_added",
        "dm_control.make_dm_control",
        "world.GymnasiumEnvSource",
    ),
    "viz.pages": (
        *(
            "report.report",
            "report.replays",
            "motor.motor_page",
            "identification.identification_page",
        ),
        *("certificate.write", "page.clocked"),
    ),
    "runs": (
        *(
            "policies.load_policy",
            "policies.save_policy",
            "summaries.find_runs",
            "summaries.read_run",
        ),
        *("summaries.compare", "files.writing"),
    ),
    "viz.view": ("session.Session",),
}
"""Rooms that are imported by their modules -> names for others."""


def help_of(*words: str) -> str:
    """What `codrl-mj WORDS --help` prints, without its frames."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    lines = [re.sub(r"^╭─ (.*?) ─*╮$", r"\n\1:", line) for line in printed.getvalue().splitlines()]
    kept = [
        line.strip("│").rstrip() for line in lines if not re.fullmatch(r"[│ ]*[╰─]+[╯│ ]*", line)
    ]
    long = int(WIDTH) + 5
    return "\n".join(
        textwrap.fill(one, int(WIDTH)) if len(one) > long and one[0] != " " else one for one in kept
    ).strip()


def verbs() -> list[str]:
    """The first words of command lines."""
    return list(dict.fromkeys(name.split()[0] for name in cli.VERBS))


def verb_page(verb: str) -> str:
    """A verb, and each that it has below it."""
    text = help_of(verb)
    named = re.match(rf"usage: codrl-mj {verb} \[-h\] \{{(.*?)\}}", text)
    below = [name.split()[1] for name in cli.VERBS if name.startswith(f"{verb} ")]
    below = below or (named[1].split(",") if named else [])
    parts = [f"# codrl-mj {verb}", fenced(text)]
    parts += [f"## {verb} {name}\n\n{fenced(help_of(verb, name))}" for name in below]
    return "\n\n".join(parts)


def fenced(text: str) -> str:
    """As it stands."""
    return f"```text\n{text}\n```"


def verbs_page() -> str:
    """The first sentence of every verb."""
    rows = []
    for verb in verbs():
        sentence = help_of(verb).split("\n\n")[1]
        rows.append((f"[`{verb}`](command_line/{verb}.md)", " ".join(sentence.split())))
    return (
        "# Command line\n\n`codrl-mj VERB --help` says the"
        f" same.\n\n{table(('verb', 'does'), rows)}"
    )


def room_page(room: str) -> str:
    """Every public name of a room: what is called, and a table of the others."""
    module = importlib.import_module(f"codrl_mj.{room}")
    called, others = [], []
    for name in ALONE.get(room) or module.__all__:
        home, _, last = f"{module.__name__}.{name}".rpartition(".")
        found = getattr(importlib.import_module(home), last)
        made = inspect.unwrap(found) if callable(found) else found
        if (inspect.isclass(made) or inspect.isfunction(made)) and made.__module__.startswith(
            "codrl_mj."
        ):
            called.append(f"::: {made.__module__}.{made.__qualname__}")
        else:
            others.append((f"`{last}`", shortened(found), said_of(module.__name__, last, found)))
    parts = [f"# codrl_mj.{room}", (inspect.getdoc(module) or "").partition("\n\n")[0], *called]
    return "\n\n".join(
        [*parts, *(["## Constants", table(("name", "value", "is"), others)] if others else [])]
    )


def shortened(value: Any) -> str:
    """A constant in a cell: of a mapping its keys, of others that are long the beginning."""
    if isinstance(value, Mapping):
        return "a mapping of " + ", ".join(f"`{key}`" for key in value)
    text = repr(value)
    return f"`{text}`" if len(text) <= 60 and "`" not in text else f"a `{type(value).__name__}`"


def said_of(room: str, name: str, value: Any) -> str:
    """The docstring below a constant, wherever in its room it is defined."""
    for home, module in list(sys.modules.items()):
        if f"{home}.".startswith(f"{room}.") and vars(module).get(name) is value:
            for line, doc in itertools.pairwise(ast.parse(inspect.getsource(module)).body):
                targets = (
                    line.targets
                    if isinstance(line, ast.Assign)
                    else [getattr(line, "target", None)]
                )
                named = [one.id for one in targets if isinstance(one, ast.Name)]
                if (
                    name in named
                    and isinstance(doc, ast.Expr)
                    and isinstance(doc.value, ast.Constant)
                ):
                    return " ".join(str(doc.value.value).split())
    return ""


def settings() -> dict[str, list[type]]:
    """Every configuration, by what it is of."""
    rooms = {
        room: importlib.import_module(f"codrl_mj.{room}")
        for room in ("actuators", "agents", "disturbances")
    }
    of = {
        room: [
            one
            for name in module.__all__
            if dataclasses.is_dataclass(one := getattr(module, name))
            and isinstance(one, type)
            and dataclasses.fields(one)
        ]
        for room, module in rooms.items()
    }
    options = [task.options for task in TASKS.values() if task.options._fields]
    bench = importlib.import_module("codrl_mj.identify.synthetic")
    return {
        "Environments": [EnvConfig, *of["disturbances"]],
        "Training": [TrainConfig, *of["agents"]],
        "Actuators": of["actuators"],
        "What an actuator is told": [Inputs],
        "A task of your own": [Task],
        "Options of tasks": options,
        "Synthetic logs": [bench.Excitation, bench.Load, bench.Sensor, bench.Sampler],
    }


def rows_of(kind: type) -> Iterator[tuple[str, ...]]:
    """Name, default, unit, bound and meaning of each field of a dataclass or a `NamedTuple`."""
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
        said = f"{bound} or none" if bound and optional else bound
        yield (
            f"`{field.name}`",
            shown(default),
            field.metadata.get("unit", ""),
            said,
            docs.get(field.name, ""),
        )


def shown(default: Any) -> str:
    """A default in a cell: of a part, that it is one."""
    if default is dataclasses.MISSING:
        return "required"
    if dataclasses.is_dataclass(default):
        return f"`{type(default).__name__}`"
    return f"`{default.__name__}`" if isinstance(default, type) else f"`{default!r}`"


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """In Markdown, without the columns that are empty."""
    columns = [
        column for column in zip(header, *rows, strict=True) if any(column[1:])
    ]  # those that say something
    head, *rest = zip(*columns, strict=True)
    lines = [head, ["---"] * len(head), *rest]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def settings_page() -> str:
    """Every field of every configuration."""
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
            told = (inspect.getdoc(kind) or "").partition("\n\n")[0]
            parts += [f"### {name}", " ".join(told.split())]
            parts.append(table(("field", "default", "unit", "bound", "is"), rows_of(kind)))
    return "\n\n".join(parts)


def pages() -> dict[str, str]:
    """Path below docs/reference -> text."""
    os.environ["COLUMNS"] = WIDTH
    made = {"command_line.md": verbs_page(), "settings.md": settings_page()}
    made |= {f"command_line/{verb}.md": verb_page(verb) for verb in verbs()}
    return made | {f"rooms/{room}.md": room_page(room) for room in sorted((*ROOMS, *ALONE))}


def main() -> int:
    """Write them."""
    for name, text in pages().items():
        path = FOLDER / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            temporary.write_text(f"{text}\n")
    print(f"wrote {FOLDER}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
