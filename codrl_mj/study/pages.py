"""Writers of a study's page: CSV and Markdown tables, SVG figures and hand-written conclusions."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from codrl_mj.boundary import Artist, Figure
from codrl_mj.runs.files import atomic_write

COLORS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
"""Colors of the Okabe-Ito palette, which color-blind readers can distinguish."""
MARKERS = ("o", "s", "^", "D", "v", "P")
TITLES: Mapping[str, str] = {
    "pendulum": "Pendulum",
    "cartpole": "CartPole",
    "acrobot": "Acrobot",
    "furuta": "Furuta pendulum",
    "mountain_car": "Mountain Car",
    "mountain_car_continuous": "Continuous Mountain Car",
}
"""Task -> title."""
_SVG = {
    "svg.hashsalt": "codrl_mj",
    "svg.fonttype": "none",
    "font.sans-serif": ["DejaVu Sans", "sans-serif"],
}
"""Settings for reproducible SVG files whose text can be searched and edited."""


def write_page(path: Path, parts: Iterable[str]) -> None:
    """Write a page of sections atomically; empty sections are skipped."""
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def read_conclusions(page: Path) -> str:
    """Return a page's hand-written conclusions, or a notice that they are missing.

    Args:
        page: path of the page. The conclusions of `actuators.md` are in the hand-written file
            `actuators_conclusions.md` beside it.
    """
    file = page.with_name(f"{page.stem}_conclusions.md")
    if file.is_file():
        return file.read_text(encoding="utf-8").strip() + "\n"
    return (
        f"No conclusions are written yet: they belong in `{file.name}` beside this page, which"
        " includes them.\n"
    )


def markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], numeric_columns: int = 0
) -> str:
    """Return a Markdown table; the last `numeric_columns` columns are right-aligned."""
    marks = ["---"] * (len(header) - numeric_columns) + ["---:"] * numeric_columns
    lines = [header, marks, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a CSV table atomically.

    Args:
        path: path of the file.
        rows: rows, as column name -> value; the first row defines the columns. NaN and None become
            empty.
    """

    def to_cell(value: object) -> object:
        return "" if value is None or (isinstance(value, float) and math.isnan(value)) else value

    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, rows[0] if rows else [], lineterminator="\n")
        out.writeheader()
        out.writerows({name: to_cell(value) for name, value in row.items()} for row in rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV table by column name; an empty list if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def add_legend(figure: Figure, columns: int) -> None:
    """Add one legend below all panels of a figure, with each label once."""
    entries: dict[str, Artist] = {}
    for axes in figure.axes:
        entries |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=columns,
        fontsize="small",
    )


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG on white; the file is byte-identical for the same figure."""
    import matplotlib

    figure.set_facecolor("white")
    with atomic_write(path) as temporary, matplotlib.rc_context(_SVG):
        figure.savefig(temporary, format="svg", metadata={"Date": None})
