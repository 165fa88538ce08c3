"""What a person sees in a terminal: lines, tables and progress bars."""

import contextlib
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column, Table
from rich.text import Text


def console() -> Console:
    """A console on standard output; 110 columns where it goes to a file, which has no width of its own."""
    return Console() if sys.stdout.isatty() else Console(width=110)


def say(*texts: str, style: str | None = None) -> None:
    """Print each text that is not empty, as wide as the terminal."""
    for text in filter(None, texts):
        console().print(text, markup=False, highlight=False, style=style)


def titled_table(
    title: str,
    columns: Sequence[str] = (),
    rows: Iterable[Iterable[Any]] = (),
    right: Collection[str] = (),
    whole: Collection[str] = (),
    **look: Any,
) -> Table:
    """A table of texts, not markup, and rich's; some columns to the right, some never wrapped; titles may be empty."""
    usual = {"title_justify": "left", "box": box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
    table = Table(title=escape(title) or None, **usual | look)  # type: ignore[arg-type]
    for name in columns:
        justify: Any = "right" if name in right else "left"
        table.add_column(
            escape(name), justify=justify, no_wrap=name in whole, overflow="ellipsis" if name in whole else "fold"
        )
    for row in rows:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def print_table(*content: Any, **look: Any) -> None:
    """Print a `titled_table`."""
    console().print(titled_table(*content, **look))


class _Line(TextColumn):
    """Text in one line; nothing while numbers in it are not known, such as of how many a count is."""

    def render(self, task: Task) -> Text:
        """The text of a task."""
        text = super().render(task)
        text = Text() if "/None" in text.plain or " nan" in f" {text.plain}" else text
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


def progress_bar(*columns: str) -> Progress:
    """A progress display with the given text columns, the time elapsed and the time left.

    Where all is too long for a line, the bar and the description give way.
    """
    return Progress(
        _Line("{task.description}", table_column=Column()),
        BarColumn(),
        *(_Line(column) for column in columns if column),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TextColumn("left"),
        TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=console(),
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
