"""How figures look: SVG on white, so that they read alike in print, on a light and on a dark page."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codrl_mj.runs.files import writing

COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9")
"""Of Okabe and Ito's palette, which the colour-blind can tell apart."""
TITLES: Mapping[str, str] = {
    "pendulum": "Pendulum",
    "cartpole": "CartPole",
    "acrobot": "Acrobot",
    "furuta": "Furuta pendulum",
    "mountain_car": "Mountain Car",
    "mountain_car_continuous": "Continuous Mountain Car",
}
"""What tasks are called."""
MARKERS = ("o", "s", "^", "D", "v", "P")
_SVG = {"svg.hashsalt": "codrl_mj", "svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans", "sans-serif"]}
"""The same bytes for the same figure; text as text, which a reader can search and edit."""


def legend(figure: Any, columns: int) -> None:
    """One legend below all of a figure's panels, each label once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        entries |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, fontsize="small")


def save(figure: Any, path: Path) -> None:
    """Write a figure on white as SVG; the same bytes for the same figure."""
    import matplotlib

    figure.set_facecolor("white")
    with writing(path) as temporary, matplotlib.rc_context(_SVG):
        figure.savefig(temporary, format="svg", metadata={"Date": None})
