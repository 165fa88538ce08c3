"""Output on a terminal: lines, tables and progress bars."""

import contextlib
import math
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console, JustifyMethod, RenderableType
from rich.markup import escape
from rich.table import Column, Table
from rich.text import Text

from codrl_mj.boundary import Argument

Progress = Any
"""Rich's `Progress`, which is imported only where one is shown."""


def console() -> Console:
    """Return a console on standard output; 110 columns wide in a file, unless COLUMNS is set."""
    return Console() if sys.stdout.isatty() or "COLUMNS" in os.environ else Console(width=110)


def print_text(*texts: str, style: str | None = None) -> None:
    """Print each nonempty text, wrapped at the width of the terminal."""
    for text in filter(None, texts):
        console().print(text, markup=False, highlight=False, style=style)


def print_table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Iterable[RenderableType]],
    right: Collection[str] = (),
    whole: Collection[str] = (),
    styles: Sequence[str] = (),
    **table_options: Argument,
) -> None:
    """Print a table; texts are printed as they are, without rich's markup.

    Args:
        title: text above the table.
        columns: headers.
        rows: cells of each row.
        right: columns that are aligned to the right.
        whole: columns that are never wrapped.
        styles: rich style of each row.
        table_options: further options of `rich.table.Table`.
    """
    defaults: dict[str, Argument] = {
        "title_justify": "left",
        "box": box.SIMPLE_HEAD,
        "pad_edge": False,
    }
    table = Table(
        title=escape(title) or None,
        row_styles=styles,
        **{**defaults, "padding": (0, 1, 0, 0), **table_options},
    )
    for name in columns:
        justify: JustifyMethod = "right" if name in right else "left"
        table.add_column(
            escape(name),
            justify=justify,
            no_wrap=name in whole,
            overflow="ellipsis" if name in whole else "fold",
        )
    for row in rows:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in row))
    console().print(table)


def format_number(value: object, digits: int = 3) -> str:
    """Format a number with some significant digits, and – for None or NaN.

    A tuple or mapping of a mean or median and its interval becomes "mean [low, high]". Numbers from
    1,000 to a million are shown without decimals.
    """
    if isinstance(value, Mapping | tuple):
        middle, *ends = (
            format_number(part, digits)
            for part in (value.values() if isinstance(value, Mapping) else value)
        )
        return f"{middle} [{', '.join(ends)}]"
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    return (
        f"{value:,.0f}" if 1e3 <= abs(float(f"{value:.{digits}g}")) < 1e6 else f"{value:.{digits}g}"
    )


def progress_bar(*columns: str) -> Progress:
    """Return a progress display with the given text columns, elapsed and remaining time.

    Each text is on one line, and empty while its numbers are unknown. If all do not fit on a line,
    the bar and the description are shortened. The display goes to standard error, and is disabled
    if that is not a terminal.
    """
    from rich import progress

    class Line(progress.TextColumn):
        def render(self, task: progress.Task) -> Text:
            text = super().render(task)
            # A total or a measure that is not known yet is formatted as None or nan. Hide the text
            # until then.
            text = Text() if "/None" in text.plain or " nan" in f" {text.plain}" else text
            text.no_wrap, text.overflow = True, "ellipsis"
            return text

    stderr_console = Console(stderr=True)
    return progress.Progress(
        Line("{task.description}", table_column=Column()),
        progress.BarColumn(),
        *(Line(column) for column in columns if column),
        progress.TimeElapsedColumn(table_column=Column(no_wrap=True)),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=stderr_console,
        disable=not stderr_console.is_terminal,
    )


@contextlib.contextmanager
def any_key() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True if a key was pressed; always False without a terminal."""
    if not sys.stdin.isatty():
        yield lambda: False
        return
    import select
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    # Without cbreak mode the terminal delivers keys only after Enter.
    tty.setcbreak(sys.stdin)
    try:
        yield lambda: bool(select.select([sys.stdin], [], [], 0.0)[0])
    finally:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
