"""Builder of all pages: sections of text, tables, plots and films in one self-contained file.

All text is escaped. Markup is `markupsafe.Markup`, which only this builder creates.
"""

import base64
import functools
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jinja2
from markupsafe import Markup

from codrl_mj import __version__
from codrl_mj.plots import Plot
from codrl_mj.runs.files import atomic_write, check_page
from codrl_mj.viz.pages.plots import describe, to_json, to_svg

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; img-src data: blob:; media-src data: blob:; style-src 'unsafe-inline';"
    " script-src 'unsafe-inline' blob:; worker-src blob:; frame-src data: blob:; connect-src data:"
    " blob:"
)
"""Content security policy, by which the browser itself forbids the page to fetch anything."""


class Section(NamedTuple):
    """A part of a page with a heading."""

    id: str
    title: str
    body: Markup
    mark: str = ""
    """Markup beside the section's entry in the contents."""


@functools.cache
def _template(name: str) -> jinja2.Template:
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters["data"] = _data_url
    return templates.get_template(name)


def render_part(name: str, *arguments: object) -> Markup:
    """Render a macro of `parts.html.jinja`, where its arguments are documented."""
    return Markup(getattr(_template("parts.html.jinja").module, name)(*arguments))


def _read_markup(name: str) -> Markup:
    return Markup((_HERE / name).read_text(encoding="utf-8"))


def _data_url(content: bytes, kind: str) -> Markup:
    return Markup("data:{};base64,{}").format(kind, base64.b64encode(content).decode())


def page(title: str, kicker: str, top: Markup, sections: Sequence[Section]) -> str:
    """Return a page as HTML.

    Args:
        title: heading.
        kicker: kind of the page, above the heading.
        top: markup before the first section.
        sections: sections; those without a body are left out.
    """
    return _template("page.html.jinja").render(
        title=title,
        kicker=kicker,
        top=top,
        sections=[section for section in sections if section.body],
        policy=Markup(_POLICY),
        style=_read_markup("uplot/uPlot.min.css") + _read_markup("page.css"),
        uplot=Markup("/* uPlot. {} */\n").format(_read_markup("uplot/LICENSE").strip())
        + _read_markup("uplot/uPlot.iife.min.js"),
        script=_read_markup("page.js"),
        version=__version__,
        made=time.strftime("%Y-%m-%d, %H:%M UTC", time.gmtime()),
    )


def write(path: Path, text: str) -> Path:
    """Write a page to an .html file, which is replaced only when the page is complete."""
    check_page(path)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def join(parts: Iterable[str]) -> Markup:
    """Return parts one after the other; parts that are not markup are escaped."""
    return Markup().join(parts)


def paragraph(text: object, kind: str = "") -> Markup:
    """Return a paragraph, with a CSS class."""
    return Markup('<p class="{}">{}</p>' if kind else "<p>{1}</p>").format(kind, text)


def note(text: object, bad: bool = False) -> Markup:
    """Return a highlighted paragraph, for an error if `bad`."""
    return paragraph(text, "note bad" if bad else "note")


def heading(text: object) -> Markup:
    """Return a heading within a section."""
    return Markup("<h3>{}</h3>").format(text)


def definitions(entries: Iterable[tuple[object, object]]) -> Markup:
    """Return a definition list of names and their values."""
    return Markup("<dl>{}</dl>").format(
        join(Markup("<dt>{}</dt><dd>{}</dd>").format(*entry) for entry in entries)
    )


def details(summary: object, body: Markup) -> Markup:
    """Return a block that the reader can unfold."""
    return Markup("<details><summary>{}</summary>{}</details>").format(summary, body)


def mark_verdict(good: bool, text: object, element: str = "strong", kind: str = "") -> Markup:
    """Return a word or a paragraph marked as good or bad, by a sign as well as by color."""
    word, sign = ("good", "✓") if good else ("bad", "✗")
    return Markup('<{0} class="{1}">{2} {3}</{0}>').format(
        element, f"{kind} {word}".strip(), sign, text
    )


def table(
    caption: str,
    columns: Sequence[object],
    rows: Iterable[Sequence[object]],
    numbers: Iterable[int] = (),
    cards: bool = False,
    failed: Iterable[int] = (),
) -> Markup:
    """Return a table whose first column has the names of the rows.

    Args:
        caption: caption.
        columns: headers.
        rows: cells of each row.
        numbers: indices of columns that hold numbers.
        cards: show each row as a card on a phone; otherwise the table scrolls.
        failed: indices of rows that are marked as failed.
    """
    return render_part("table", caption, columns, list(rows), cards, set(numbers), set(failed))


def plot(content: Plot, low: bool = False) -> Markup:
    """Return a plot as markup; `low` reduces its height."""
    # Without JavaScript the page shows this picture instead of the interactive plot.
    picture = _data_url(to_svg(content, height=2.2 if low else 3.2).encode(), "image/svg+xml")
    axes = f"{content.y_label} over {content.x_label}" if content.clock else content.y_label
    return render_part(
        "plot",
        content.title,
        axes,
        describe(content),
        Markup(to_json(content)),
        picture,
        content.clock,
        low,
    )


def plots(contents: Iterable[Plot]) -> Markup:
    """Return plots side by side, if there is room."""
    figures = [plot(content) for content in contents]
    return Markup('<div class="plots">{}</div>').format(join(figures)) if figures else Markup("")


def clocked_part(label: str, fragment: str, script: str) -> Markup:
    """Return a part that shares the page's clock with films and plots, such as a replay in 3D.

    Args:
        label: description of the part.
        fragment: HTML of the part, inserted without escaping.
        script: JavaScript that defines a function `setTime(seconds)`, which shows that instant. It
            can use `element`, the parent of the fragment, and call `seek(seconds)` when the
            fragment itself is scrubbed.
    """
    return render_part("clocked", label, Markup(fragment), Markup(script))


def format_unit(text: str) -> str:
    """Return a unit with typographic signs."""
    return text.replace("*", "·").replace("^2", "²").replace("ohm", "Ω").replace("degC", "°C")


def format_number(value: object, digits: int = 4) -> str:
    """Return a number as text, with an interval if it has one; a dash for a missing value."""
    if isinstance(value, Mapping):
        middle, low, high = (
            format_number(part, digits)
            for part in (
                value.get("mean", value.get("median")),
                value.get("low"),
                value.get("high"),
            )
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
