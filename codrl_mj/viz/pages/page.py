"""The builder of every page: sections of text, tables, plots and films, in one file that asks nothing of any server.

All text is escaped; what is to stand as markup is `markupsafe.Markup`, which only this builder
makes.
"""

import base64
import functools
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup

from codrl_mj import __version__
from codrl_mj.runs.files import check_page, atomic_write
from codrl_mj.viz.pages.plots import Plot, as_json, description, still

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; img-src data: blob:; media-src data: blob:; style-src 'unsafe-inline';"
    " script-src 'unsafe-inline' blob:; worker-src blob:; frame-src data: blob:; connect-src data:"
    " blob:"
)
"""What the browser itself holds the page to: nothing is fetched."""


class Section(NamedTuple):
    """A part of a page with a heading."""

    id: str
    title: str
    body: Markup
    mark: Any = ""
    """Beside its entry in the contents."""


@functools.cache
def _template(name: str) -> jinja2.Template:
    options: Any = {
        "autoescape": True,
        "undefined": jinja2.StrictUndefined,
        "trim_blocks": True,
        "lstrip_blocks": True,
    }
    templates = jinja2.Environment(loader=jinja2.FileSystemLoader(_HERE), **options)
    templates.filters["data"] = _data
    return templates.get_template(name)


def part(name: str, *arguments: Any) -> Markup:
    """A macro of `parts.html.jinja`, filled in, which says there what it takes."""
    return Markup(getattr(_template("parts.html.jinja").module, name)(*arguments))


def _text(name: str) -> Markup:
    return Markup((_HERE / name).read_text(encoding="utf-8"))


def _data(content: bytes, kind: str) -> Markup:
    return Markup("data:{};base64,{}").format(kind, base64.b64encode(content).decode())


def page(title: str, kicker: str, top: Markup, sections: Sequence[Section]) -> str:
    """A page: above its heading what kind it is, `top` before the first section; those without a body are left out."""
    return _template("page.html.jinja").render(
        title=title,
        kicker=kicker,
        top=top,
        sections=[section for section in sections if section.body],
        policy=Markup(_POLICY),
        style=_text("uplot/uPlot.min.css") + _text("page.css"),
        uplot=Markup("/* uPlot. {} */\n").format(_text("uplot/LICENSE").strip())
        + _text("uplot/uPlot.iife.min.js"),
        script=_text("page.js"),
        version=__version__,
        made=time.strftime("%Y-%m-%d, %H:%M UTC", time.gmtime()),
    )


def write(path: Path, text: str) -> Path:
    """Write a page, whole or not at all, to a file with the suffix of one."""
    check_page(path)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def joined(parts: Iterable[Any]) -> Markup:
    """Parts one after the other; what is no markup is escaped."""
    return Markup().join(parts)


def paragraph(text: Any, kind: str = "") -> Markup:
    """A paragraph, with a CSS class."""
    return Markup('<p class="{}">{}</p>' if kind else "<p>{1}</p>").format(kind, text)


def note(text: Any, bad: bool = False) -> Markup:
    """What is to be noticed."""
    return paragraph(text, "note bad" if bad else "note")


def heading(text: Any) -> Markup:
    """A heading within a section."""
    return Markup("<h3>{}</h3>").format(text)


def definitions(entries: Iterable[tuple[Any, Any]]) -> Markup:
    """Names and what they are."""
    return Markup("<dl>{}</dl>").format(
        joined(Markup("<dt>{}</dt><dd>{}</dd>").format(*entry) for entry in entries)
    )


def folded(summary: Any, body: Markup) -> Markup:
    """Something to be unfolded."""
    return Markup("<details><summary>{}</summary>{}</details>").format(summary, body)


def judged(good: bool, text: Any, element: str = "strong", kind: str = "") -> Markup:
    """A word in a table, or a paragraph, said to be good or bad not by colour alone."""
    word, sign = ("good", "✓") if good else ("bad", "✗")
    return Markup('<{0} class="{1}">{2} {3}</{0}>').format(
        element, f"{kind} {word}".strip(), sign, text
    )


def table(
    caption: str,
    columns: Sequence[Any],
    rows: Iterable[Sequence[Any]],
    numbers: Iterable[int] = (),
    cards: bool = False,
    failed: Iterable[int] = (),
) -> Markup:
    """A table of rows, which the first column names; some may have failed.

    Columns at the places `numbers` hold numbers. With `cards` a phone shows each row as a card;
    otherwise it scrolls.
    """
    return part("table", caption, columns, list(rows), cards, set(numbers), set(failed))


def plot(what: Plot, low: bool = False) -> Markup:
    """A plot; less high where it is `low`."""
    picture = _data(still(what, height=2.2 if low else 3.2).encode(), "image/svg+xml")
    axes = f"{what.y_label} over {what.x_label}" if what.clock else what.y_label
    return part(
        "plot", what.title, axes, description(what), Markup(as_json(what)), picture, what.clock, low
    )


def plots(several: Iterable[Plot]) -> Markup:
    """Plots side by side, where there is room."""
    drawn = [plot(one) for one in several]
    return Markup('<div class="plots">{}</div>').format(joined(drawn)) if drawn else Markup("")


def clocked(label: str, fragment: str, script: str) -> Markup:
    """Something that shares the page's clock with films and plots, such as a replay in three dimensions.

    Args:
        label: what it is.
        fragment: its HTML, taken as it is.
        script: JavaScript that defines a function `setTime(seconds)`, which shows that instant. It
            sees `element`, the fragment's parent, and `seek(seconds)`, to be called when the
            fragment itself is scrubbed.
    """
    return part("clocked", label, Markup(fragment), Markup(script))


def unit(text: str) -> str:
    """A unit as it is printed."""
    return text.replace("*", "·").replace("^2", "²").replace("ohm", "Ω").replace("degC", "°C")


def number(value: Any, digits: int = 4) -> str:
    """A number as text, or a mean or a median with its interval; a dash where there is none."""
    if isinstance(value, Mapping):
        middle, low, high = (
            number(one, digits)
            for one in (value.get("mean", value.get("median")), value.get("low"), value.get("high"))
        )
        return f"{middle} [{low}, {high}]"
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool) or not isinstance(value, float | int):
        return str(value)
    if math.isinf(value):
        return "∞" if value > 0 else "\N{MINUS SIGN}∞"
    rounded = float(f"{value:.{digits}g}")
    text = f"{rounded:,.0f}" if 1e3 <= abs(rounded) < 1e7 else f"{rounded:.{digits}g}"
    return text.replace("-", "\N{MINUS SIGN}")
