"""How tables look in a terminal."""

from collections.abc import Collection, Iterable, Sequence
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table


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
