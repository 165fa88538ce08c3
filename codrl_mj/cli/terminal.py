"""What a person sees in a terminal: lines, tables and progress bars."""

import contextlib
import math
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table
from rich.text import Text


def console() -> Console:
    """A console on standard output; 110 columns where it goes to a file, unless COLUMNS has another number."""
    return Console() if sys.stdout.isatty() or "COLUMNS" in os.environ else Console(width=110)


def say(*texts: str, style: str | None = None) -> None:
    """Print each text that is not empty, as wide as the terminal."""
    for text in filter(None, texts):
        console().print(text, markup=False, highlight=False, style=style)


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Iterable[Any]],
    right: Collection[str] = (),
    whole: Collection[str] = (),
    styles: Sequence[str] = (),
    **look: Any,
) -> None:
    """Print a table of texts, not markup, and rich's: some columns to the right, some never wrapped, rows in styles."""
    usual: dict[str, Any] = {"title_justify": "left", "box": box.SIMPLE_HEAD, "pad_edge": False}
    table = Table(
        title=escape(title) or None, row_styles=styles, **{**usual, "padding": (0, 1, 0, 0), **look}
    )
    for name in columns:
        justify: Any = "right" if name in right else "left"
        table.add_column(
            escape(name),
            justify=justify,
            no_wrap=name in whole,
            overflow="ellipsis" if name in whole else "fold",
        )
    for row in rows:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in row))
    console().print(table)


def number(value: Any, digits: int = 3) -> str:
    """A number with so many digits, thousands whole; – where there is none; a mean or a median with its interval."""
    if isinstance(value, Mapping | tuple):
        middle, *ends = (
            number(one, digits) for one in (value.values() if isinstance(value, Mapping) else value)
        )
        return f"{middle} [{', '.join(ends)}]"
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    return (
        f"{value:,.0f}" if 1e3 <= abs(float(f"{value:.{digits}g}")) < 1e6 else f"{value:.{digits}g}"
    )


def progress_bar(*columns: str) -> Any:
    """A progress display with the given text columns, the time elapsed and the time left.

    Text is in one line; nothing while numbers in it are not known, such as of how many a count is.
    Where all is too long for a line, the bar and the description give way. It goes to standard
    error, and nowhere where that is no terminal.
    """
    from rich.progress import (
        BarColumn,
        Progress,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    class Line(TextColumn):
        def render(self, task: Task) -> Text:
            text = super().render(task)
            text = Text() if "/None" in text.plain or " nan" in f" {text.plain}" else text
            text.no_wrap, text.overflow = True, "ellipsis"
            return text

    errors = Console(stderr=True)
    return Progress(
        Line("{task.description}", table_column=Column()),
        BarColumn(),
        *(Line(column) for column in columns if column),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TextColumn("left"),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=errors,
        disable=not errors.is_terminal,
    )


@contextlib.contextmanager
def any_key() -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether a key was pressed since; never, where there is no terminal."""
    if not sys.stdin.isatty():
        yield lambda: False
        return
    import select
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield lambda: bool(select.select([sys.stdin], [], [], 0.0)[0])
    finally:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
