"""Parsing of a command line into a verb, with error messages of one sentence."""

import contextlib
import dataclasses
import io
import itertools
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union

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
_MOTOR_FLAGS = {"--gear-ratio": "gear ratio", "--voltage": "supply voltage"}

Output = tuple[int, object]
"""Exit status of a verb, and the content that `--json` prints."""
Verb = TypeVar("Verb")
"""Dataclass of a verb."""
# The flags of some verbs depend on the line, so their types are built at run time.
Annotation = Any
"""Type of a flag's values for tyro, such as `str | None` or `Annotated[...]`."""
ParseEvent = Any
"""Error of tyro's parser, or an argument in it; tyro's classes for them are private."""

AsJson = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(
        name="json",
        help="Print only JSON, in SI units unless the output states another unit.",
    ),
]
"""Type of a field whose verb returns the exit status and the content to print as JSON."""
Trust = Annotated[
    bool,
    tyro.conf.arg(
        help=(
            "Import the custom modules of a task, agent or actuator that a run folder, a contract"
            " or an actuator's file names. This executes the code of their authors."
        )
    ),
]
"""Type of a field that allows a verb to import the custom modules that a run folder names."""


def parse_named_numbers(flag: str, texts: Sequence[str], example: str) -> dict[str, float]:
    """Return the numbers of a flag that takes NAME=NUMBER, each name once."""
    numbers: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name in numbers:
            raise ValueError(f"{flag} {name}: given twice; give it one value")
        try:
            numbers[name] = float(value)
        except ValueError:
            raise ValueError(f"{flag} {text}: must be NAME=NUMBER, such as {example}") from None
    return numbers


def parse(
    kind: type[Verb] | Mapping[str, str | None],
    program: str,
    words: Sequence[str],
    description: str | None = None,
) -> Verb:
    """Parse words into an instance of a verb's dataclass; a help flag raises SystemExit.

    A mapping of verbs to descriptions is parsed only to print its help.
    """
    # The union of verbs is built at run time, which the annotations of `tyro.cli` do not cover.
    cli: Any = tyro.cli
    form: Annotation = kind
    if isinstance(kind, Mapping):
        verbs = [
            dataclasses.make_dataclass(name, [], namespace={"__doc__": text})
            for name, text in kind.items()
        ]
        form = Union[tuple(Annotated[verb, tyro.conf.subcommand(verb.__name__)] for verb in verbs)]  # noqa: UP007
    # tyro has no public hook for parse errors. If a later version has no `_errors`, its errors are
    # printed in its own boxes.
    errors: Any = getattr(tyro, "_errors", None)
    hook = errors and errors.on_parse_error(lambda event: _raise_parse_error(event, form, program))
    with hook or contextlib.nullcontext():
        verb: Verb = cli(
            form,
            prog=program,
            description=description,
            args=words,
            compact_help=not {"-h", "-H", "--help-verbose"}.isdisjoint(words),
        )
        return verb


def _raise_parse_error(event: ParseEvent, kind: Annotation, program: str) -> None:
    """Raise ValueError with one sentence for a parser error; tyro prints unknown kinds in a box."""
    match type(event).__name__:
        case "MissingSubcommand":
            choices = ", ".join(event.subcommand_spec.parser_from_name)
            hint = (
                f"try {program} motor list, or {program} train cartpole first; "
                if program == "codrl-mj"
                else ""
            )
            raise ValueError(
                f"{program} needs a verb: {hint}verbs are {choices}; {program} --help"
                " describes them"
            )
        case "MissingArgs":
            missing = [
                _argument_name(missing_argument.arg) for missing_argument in event.missing_arguments
            ]
            raise ValueError(f"{program} needs {', '.join(missing)}; {program} --help says more")
        case "BadValue" if event.reason == "too_few_values":
            raise ValueError(
                f"{_argument_name(event.argument)} needs a value: {_expected_type(event.argument)}"
            )
        case "InvalidChoice":
            suggestion = did_you_mean(event.value, event.choices)
            choices = ", ".join(event.choices)
            raise ValueError(
                f"{_argument_name(event.argument)} {event.value}: {suggestion}must be one of"
                f" {choices}"
            )
        case "InstantiationFailure" if event.argument is not None:
            value = re.search(r"'([^']*)'", event.message)
            value_text = f" {value[1]}" if value else ""
            raise ValueError(
                f"{_argument_name(event.argument)}{value_text}: must be"
                f" {_expected_type(event.argument)}"
            )
        case "UnrecognizedArgs":
            # The event does not list the flags of the verb, but its help does: print the help into
            # a string and search it.
            with (
                contextlib.redirect_stdout(io.StringIO()) as printed,
                contextlib.suppress(SystemExit),
            ):
                parse(kind, program, ["--help"])
            _raise_unknown_words(event.tokens, printed.getvalue(), program)


def _raise_unknown_words(tokens: Sequence[str], help_text: str, program: str) -> None:
    """Raise ValueError for words that the parser left over, with hints from the verb's help."""
    verbs = re.match(r"usage: [^\n]*\{([\w,]+)\}\n", help_text)
    flag = next((token.partition("=")[0] for token in tokens if token.startswith("-")), None)
    if flag is None or (verbs and not tokens[0].startswith("-")):
        choice = verbs[1].split(",") if verbs else []
        remedy = (
            f"verbs are {', '.join(choice)}" if choice else f"{program} --help lists its arguments"
        )
        problem = "unknown verb" if choice else "unexpected"
        raise ValueError(f"{problem} {tokens[0]!r}: {did_you_mean(tokens[0], choice)}{remedy}")
    known_flags = [
        known_flag
        for known_flag in dict.fromkeys(
            re.findall(r"(?<![\w-])--[a-z][\w-]*(?:\.[\w-]+)*", help_text)
        )
        if known_flag != flag
    ]
    nested_hints = [
        f"did you mean {known_flag!r}? "
        for known_flag in known_flags
        if known_flag.rpartition(".")[2] == flag.lstrip("-")
    ]
    hint = "".join(nested_hints[:1]) or did_you_mean(flag, known_flags)
    if flag in _MOTOR_FLAGS and "--actuator" in known_flags:
        raise ValueError(
            f"{flag}: the actuator has no {_MOTOR_FLAGS[flag]}; motors of codrl-mj motor list have"
            " one"
        )
    if "--actuator" in known_flags and (owners := _families_with(flag)):
        hint = f"this actuator has no such field; a {' or a '.join(owners)} has; "
        hint += (
            f"add --actuator.family {owners[0]} to make a motor a servo; "
            if {*owners} <= {"servo", "pwm_servo"}
            else ""
        )
    raise ValueError(f"unknown flag {flag}: {hint}{program} --help lists them")


def _families_with(flag: str) -> list[str]:
    """Return the families of actuators that have the field of an `--actuator.` flag."""
    from codrl_mj.actuators import FAMILIES, field_paths

    path = flag.removeprefix("--actuator.").replace("-", "_")
    return [name for name, family in FAMILIES.items() if path in field_paths(family)]


def _argument_name(argument: ParseEvent) -> str:
    """Return the name of an argument for messages: its flag, or its name in capitals."""
    if argument.is_positional():
        return str(argument.field.intern_name.upper())
    # All names of a flag are shown. The short one, such as --voltage, comes first, and users who
    # typed the long one would not recognize it.
    return "/".join(name for name in argument.lowered.name_or_flags if not name.startswith("--no-"))


def _expected_type(argument: ParseEvent) -> str:
    """Return a description of the values that an argument takes."""
    kind = str(argument.lowered.metavar).replace("{None}|", "None or ")
    return kind.replace("INT", "a whole number").replace("FLOAT", "a number")


def normalize_arguments(arguments: Sequence[str]) -> list[str]:
    """Rewrite words: 1e5 and 20:1 as plain numbers, and FILE.py:NAME as module:NAME.

    If the line names a module of the current folder, or has `--trust`, that folder is appended to
    `sys.path`. Modules that only a file names are still refused without `--trust`.
    """
    folder, words = Path.cwd(), []
    for previous, word in itertools.pairwise(["", *arguments]):
        # Values of flags that take paths stay as they are: a folder may be called 1e5.
        flag = word if word.startswith("--") else previous
        is_number_flag = flag.startswith("--") and flag.partition("=")[0] not in _PATHS
        number = re.fullmatch(r"(--[\w.-]+=)?(\d+(?:\.\d+)?)(?::1|(e\+?\d{1,2}))", word)
        if is_number_flag and number:
            value = float(number[2] + (number[3] or ""))
            word = f"{number[1] or ''}{int(value) if value.is_integer() else value}"
        elif file := re.fullmatch(r"(.*=)?([^=:]+\.py):([\w./-]+)", word):
            word = f"{file[1] or ''}{_module_name(Path(file[2]), folder)}:{file[3]}"
        words.append(word)
    module_names = re.findall(r"^(?:.*=)?(\w+)[\w.]*:[\w./-]+$", "\n".join(words), re.MULTILINE)
    if "--trust" in words or any(
        (folder / name).is_dir() or (folder / f"{name}.py").is_file() for name in module_names
    ):
        sys.path += [str(folder)] if str(folder) not in sys.path and "" not in sys.path else []
    return words


def _module_name(file: Path, folder: Path) -> str:
    """Return the importable module name of a file, relative to the current folder.

    A run folder stores this name, so the same line finds the module again later.
    """
    path = Path(os.path.normpath(folder / file)).with_suffix("")
    if not file.is_file():
        raise ValueError(f"{file}: there is no such file; must be FILE.py:NAME or module:NAME")
    parts = path.relative_to(folder).parts if path.is_relative_to(folder) else ("..",)
    if not all(part.isidentifier() for part in parts):
        raise ValueError(
            f"{file}: must be in the current folder {folder} or below it, and the names of the"
            " file and its folders must be valid module names (letters, digits, _); otherwise"
            f" change to {path.parent} and name {file.name}"
        )
    return ".".join(parts)
