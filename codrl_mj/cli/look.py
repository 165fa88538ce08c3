"""How tables look in a terminal."""

from rich import box
from rich.markup import escape
from rich.table import Table


def titled_table(title: str) -> Table:
    """A table without columns yet; its title is text, not markup, and may be empty."""
    return Table(
        title=escape(title) or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )
