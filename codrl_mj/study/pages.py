"""How a study's page is written: tables in CSV and Markdown, figures as SVG on white, conclusions of a person."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.runs.files import writing

COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
"""Of Okabe and Ito's palette, which the colour-blind can tell apart."""
MARKERS = ("o", "s", "^", "D", "v", "P")
TITLES: Mapping[str, str] = {
    "pendulum": "Pendulum",
    "cartpole": "CartPole",
    "acrobot": "Acrobot",
    "furuta": "Furuta pendulum",
    "mountain_car": "Mountain Car",
    "mountain_car_continuous": "Continuous Mountain Car",
}
"""What tasks are called."""
_SVG = {
    "svg.hashsalt": "codrl_mj",
    "svg.fonttype": "none",
    "font.sans-serif": ["DejaVu Sans", "sans-serif"],
}
"""The same bytes for the same figure; text as text, which a reader can search and edit."""


def write_page(path: Path, parts: Iterable[str]) -> None:
    """Write a page of sections, whole or not at all; empty ones are left out."""
    with writing(path) as temporary:
        temporary.write_text("\n".join(part for part in parts if part), encoding="utf-8")


def conclusions(page: Path) -> str:
    """A page's conclusions, which a person writes: what its file says, or that there is none yet.

    Args:
        page: the page; the file of `actuators.md` is `actuators_conclusions.md` beside it, which
            nothing here writes.
    """
    file = page.with_name(f"{page.stem}_conclusions.md")
    if file.is_file():
        return file.read_text(encoding="utf-8").strip() + "\n"
    return (
        f"No conclusions are written yet: they belong into `{file.name}` beside this page, which"
        " includes them.\n"
    )


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """A table in Markdown; the last columns, as many as are `numbers`, are aligned to the right."""
    marks = ["---"] * (len(header) - numbers) + ["---:"] * numbers
    lines = [header, marks, *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a table, whole or not at all.

    Args:
        path: the file.
        rows: by the columns' names, which are the first row's; NaN and None are empty cells.
    """

    def known(value: Any) -> Any:
        return "" if value is None or (isinstance(value, float) and math.isnan(value)) else value

    with writing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, rows[0] if rows else [], lineterminator="\n")
        out.writeheader()
        out.writerows({name: known(value) for name, value in row.items()} for row in rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a table by the columns' names; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def legend(figure: Any, columns: int) -> None:
    """One legend below all of a figure's panels, each label once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        entries |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=columns,
        fontsize="small",
    )


def save(figure: Any, path: Path) -> None:
    """Write a figure on white as SVG; the same bytes for the same figure."""
    import matplotlib

    figure.set_facecolor("white")
    with writing(path) as temporary, matplotlib.rc_context(_SVG):
        figure.savefig(temporary, format="svg", metadata={"Date": None})
