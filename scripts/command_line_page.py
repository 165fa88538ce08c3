"""Writes docs/reference/command_line.md: what every verb of `codrl-mj` says with --help. `make docs` runs it."""

import contextlib
import io
import os
import re
import sys
from pathlib import Path

from codrl_mj import cli
from codrl_mj.runs.files import writing

PAGE = Path(__file__).parent.parent / "docs" / "reference" / "command_line.md"
WIDTH = "100"
"""Of the help [characters]."""


def help_of(*words: str) -> str:
    """What `codrl-mj WORDS --help` prints, without its frames."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        cli.main([*words, "--help"])
    lines = [re.sub(r"^╭─ (.*?) ─*╮$", r"\n\1:", line) for line in printed.getvalue().splitlines()]
    return "\n".join(line.strip("│").rstrip() for line in lines if not re.fullmatch(r"[│ ]*[╰─]+[╯│ ]*", line))


def page() -> str:
    """The Markdown page: a section for each verb, and for each that it has below it."""
    parts = ["# Command line\n\n`codrl-mj VERB --help` says the same."]
    for verb in cli.SAYS:
        text = help_of(verb)
        named = re.match(rf"usage: codrl-mj {verb} \[-h\] \{{(.*?)\}}", text)
        below = [name.split()[1] for name in cli.VERBS if name.startswith(f"{verb} ")]
        below = below or (named[1].split(",") if named else [])
        parts.append(f"## {verb}\n\n```text\n{text.strip()}\n```")
        parts += [f"### {verb} {name}\n\n```text\n{help_of(verb, name).strip()}\n```" for name in below]
    return "\n\n".join(parts) + "\n"


def main() -> int:
    """Write the page."""
    os.environ["COLUMNS"] = WIDTH
    PAGE.parent.mkdir(exist_ok=True)
    with writing(PAGE) as temporary:
        temporary.write_text(page())
    print(f"wrote {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
