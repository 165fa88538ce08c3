"""From the words of a command line to a verb: its own modules and numbers understood, errors in one plain sentence."""

import contextlib
import dataclasses
import io
import itertools
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Union

import tyro

from codrl_mj.fields import did_you_mean

_PATHS = (
    "--out",
    "--root",
    "--html",
    "--trajectory",
    "--config",
    "--resume",
    "--compare",
    "--policies",
)
_SHORT = {"--gear-ratio": "gear ratio", "--voltage": "supply voltage"}

AsJson = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(
        name="json",
        help="Print JSON and nothing else: in SI units, or with the unit beside the number.",
    ),
]
"""Type of a verb's field for which its `run` returns not only the exit status, but what to print as JSON."""
Trust = Annotated[
    bool,
    tyro.conf.arg(
        help=(
            "Import the modules that a run folder, a contract or an actuator's file names as task,"
            " agent or actuator if these are somebody's own, which executes them."
        )
    ),
]
"""Type of a verb's field that lets it import what a run folder names."""


def named_numbers(flag: str, texts: Sequence[str], example: str) -> dict[str, float]:
    """What a flag has: NAME=NUMBER, each once."""
    found: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name in found:
            raise ValueError(f"{flag} {name}: given twice; give it one value")
        try:
            found[name] = float(value)
        except ValueError:
            raise ValueError(f"{flag} {text}: must be NAME=NUMBER, such as {example}") from None
    return found


def parse(kind: Any, called: str, words: Sequence[str], about: str | None = None) -> Any:
    """A dataclass with its settings; of a mapping of verbs to what they do nothing but help; SystemExit after help."""
    cli: Any = tyro.cli  # of a union of as many kinds as there are
    if isinstance(kind, Mapping):
        verbs = [
            dataclasses.make_dataclass(name, [], namespace={"__doc__": says})
            for name, says in kind.items()
        ]
        kind = Union[tuple(Annotated[verb, tyro.conf.subcommand(verb.__name__)] for verb in verbs)]  # noqa: UP007
    errors: Any = getattr(
        tyro, "_errors", None
    )  # of no public name; without it errors come in boxes
    hook = errors and errors.on_parse_error(lambda event: _refuse(event, kind, called))
    with hook or contextlib.nullcontext():
        return cli(
            kind,
            prog=called,
            description=about,
            args=words,
            compact_help=not {"-h", "-H", "--help-verbose"}.isdisjoint(words),
        )


def _refuse(event: Any, kind: Any, called: str) -> None:
    """Say in a sentence what the parser would in a box; of kinds of errors that are not known here its box remains."""
    match type(event).__name__:
        case "MissingSubcommand":
            known = ", ".join(event.subcommand_spec.parser_from_name)
            first = (
                f"try {called} motor list, or {called} train cartpole first; "
                if called == "codrl-mj"
                else ""
            )
            raise ValueError(
                f"{called} needs a verb: {first}there are {known}; {called} --help says more"
            )
        case "MissingArgs":
            missing = [_called(one.arg) for one in event.missing_arguments]
            raise ValueError(f"{called} needs {', '.join(missing)}; {called} --help says more")
        case "BadValue" if event.reason == "too_few_values":
            raise ValueError(f"{_called(event.argument)} needs a value: {_kind(event.argument)}")
        case "InvalidChoice":
            hint = did_you_mean(event.value, event.choices)
            known = ", ".join(event.choices)
            raise ValueError(
                f"{_called(event.argument)} {event.value}: {hint}must be one of {known}"
            )
        case "InstantiationFailure" if event.argument is not None:
            value = re.search(r"'([^']*)'", event.message)
            given = f" {value[1]}" if value else ""
            raise ValueError(f"{_called(event.argument)}{given}: must be {_kind(event.argument)}")
        case "UnrecognizedArgs":
            with (
                contextlib.redirect_stdout(io.StringIO()) as printed,
                contextlib.suppress(SystemExit),
            ):
                parse(kind, called, ["--help"])
            _refuse_words(event.tokens, printed.getvalue(), called)


def _refuse_words(tokens: Sequence[str], text: str, shown: str) -> None:
    """Refuse words that the parser left over, by what the verb's help has."""
    verbs = re.match(r"usage: [^\n]*\{([\w,]+)\}\n", text)
    flag = next((token.partition("=")[0] for token in tokens if token.startswith("-")), None)
    if flag is None or (verbs and not tokens[0].startswith("-")):
        choice = verbs[1].split(",") if verbs else []
        listed = (
            f"verbs are {', '.join(choice)}" if choice else f"{shown} --help says what it takes"
        )
        what = "unknown verb" if choice else "unexpected"
        raise ValueError(f"{what} {tokens[0]!r}: {did_you_mean(tokens[0], choice)}{listed}")
    known = [
        one
        for one in dict.fromkeys(re.findall(r"(?<![\w-])--[a-z][\w-]*(?:\.[\w-]+)*", text))
        if one != flag
    ]
    inner = [
        f"did you mean {one!r}? " for one in known if one.rpartition(".")[2] == flag.lstrip("-")
    ]
    hint = "".join(inner[:1]) or did_you_mean(flag, known)
    if flag in _SHORT and "--actuator" in known:
        raise ValueError(
            f"{flag}: the actuator has no {_SHORT[flag]}; motors of codrl-mj motor list have one"
        )
    if "--actuator" in known and (owners := _families_with(flag)):
        hint = f"this actuator has no such field; a {' or a '.join(owners)} has; "
        hint += (
            "add --actuator.family servo to make a motor a servo; " if owners == ["servo"] else ""
        )
    raise ValueError(f"unknown flag {flag}: {hint}{shown} --help lists them")


def _families_with(flag: str) -> list[str]:
    """Return the families of actuators that have the field of an `--actuator.` flag."""
    from codrl_mj.actuators import FAMILIES, field_paths

    path = flag.removeprefix("--actuator.").replace("-", "_")
    return [name for name, family in FAMILIES.items() if path in field_paths(family)]


def _called(argument: Any) -> str:
    """What a person calls an argument: its flag, or its name in capitals."""
    if argument.is_positional():
        return str(argument.field.intern_name.upper())
    # A short name, such as --voltage, stands first; who typed the long one would look for it in
    # vain.
    return "/".join(name for name in argument.lowered.name_or_flags if not name.startswith("--no-"))


def _kind(argument: Any) -> str:
    """What an argument has to be."""
    kind = str(argument.lowered.metavar).replace("{None}|", "None or ")
    return kind.replace("INT", "a whole number").replace("FLOAT", "a number")


def understood(arguments: Sequence[str]) -> list[str]:
    """The words with 1e5 and 20:1 as plain numbers, and FILE.py:NAME as modules.

    Python finds the modules of the present folder from here on if the person who typed the words
    names one of them, or says `--trust`: what a file names stays to be refused.
    """
    here, found = Path.cwd(), []
    for before, word in itertools.pairwise(["", *arguments]):
        flag = word if word.startswith("--") else before  # a folder may be called 1e5
        counted = flag.startswith("--") and flag.partition("=")[0] not in _PATHS
        number = re.fullmatch(r"(--[\w.-]+=)?(\d+(?:\.\d+)?)(?::1|(e\+?\d{1,2}))", word)
        if counted and number:
            value = float(number[2] + (number[3] or ""))
            word = f"{number[1] or ''}{int(value) if value.is_integer() else value}"
        elif file := re.fullmatch(r"(.*=)?([^=:]+\.py):([\w./-]+)", word):
            word = f"{file[1] or ''}{_module(Path(file[2]), here)}:{file[3]}"
        found.append(word)
    typed = re.findall(r"^(?:.*=)?(\w+)[\w.]*:[\w./-]+$", "\n".join(found), re.MULTILINE)
    if "--trust" in found or any(
        (here / name).is_dir() or (here / f"{name}.py").is_file() for name in typed
    ):
        sys.path += [str(here)] if str(here) not in sys.path and "" not in sys.path else []
    return found


def _module(file: Path, here: Path) -> str:
    """The module that a file is, by which what is written here today finds it tomorrow."""
    path = Path(os.path.normpath(here / file)).with_suffix("")
    if not file.is_file():
        raise ValueError(f"{file}: there is no such file; must be FILE.py:NAME or module:NAME")
    parts = path.relative_to(here).parts if path.is_relative_to(here) else ("..",)
    if not all(part.isidentifier() for part in parts):
        raise ValueError(
            f"{file}: must be a file in the present folder {here} or below it, in folders whose"
            f" names Python takes for modules (letters, digits, _): go to {path.parent} and name"
            f" {file.name}"
        )
    return ".".join(parts)
