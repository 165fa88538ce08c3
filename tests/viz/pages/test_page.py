"""Builder of pages: text is escaped, media are embedded, and nothing is fetched."""

import base64

import numpy as np
import pytest
from markupsafe import Markup

from codrl_mj.plots import Curve, Plot
from codrl_mj.viz.pages import page
from tests.viz.pages.parsed import check_self_contained

EVIL = "<img src=http://there/x onerror='x()'> & \"y\""


def small(*parts, title="t"):
    return page.page(title, "k", Markup(""), [page.Section("s", "S", page.join(parts))])


def test_names_with_markup_show_as_text_everywhere():
    plot = Plot(EVIL, EVIL, EVIL, (Curve(EVIL, np.arange(3.0), np.arange(3.0)),), clock=True)
    parts = [builder(EVIL) for builder in (page.paragraph, page.note, page.heading)]
    parts += [
        page.mark_verdict(True, EVIL, "p", "verdict"),
        page.plot(plot),
        page.definitions([(EVIL, EVIL)]),
    ]
    parts += [
        page.details(EVIL, page.paragraph("p")),
        page.table(EVIL, (EVIL, "b"), [(EVIL, EVIL)], cards=True),
    ]
    parts += [
        page.render_part("selector", EVIL, "run", [EVIL], None),
        page.render_part("film", EVIL, b"film", 20.0, None),
    ]
    parts += [
        page.render_part("image", b"image", EVIL),
        page.render_part("transport", "1", "0.1"),
        EVIL,
    ]
    text = page.page(
        EVIL, EVIL, page.paragraph(EVIL), [page.Section("s", EVIL, page.join(parts), EVIL)]
    )
    parsed = check_self_contained(text)
    assert "<img src=http" not in text
    assert parsed.text.count("<img src=http://there/x onerror='x()'> & \"y\"") > 20
    assert parsed.data[0]["title"] == EVIL


def test_a_page_embeds_its_media_and_licenses():
    text = small(
        page.render_part("film", "a film", b"bytes of a film", 25.0, b"poster"),
        page.render_part("image", b"picture", "about"),
    )
    check_self_contained(text)
    for content in (b"bytes of a film", b"poster", b"picture"):
        assert base64.b64encode(content).decode() in text
    assert 'data-frame="0.04"' in text
    assert "Permission is hereby granted" in text
    assert "Leon Sorokin" in text


def test_a_section_without_a_body_is_left_out():
    assert 'id="s"' not in small()
    assert 'id="s"' in small("x")


def test_a_plot_is_a_picture_without_scripts():
    text = small(
        page.plot(Plot("t", "x [s]", "y [V]", (Curve("a", np.arange(3.0), np.arange(3.0)),)))
    )
    picture = text.partition("<noscript>")[2].partition("</noscript>")[0]
    encoded = picture.partition("base64,")[2].partition('"')[0]
    assert b"<svg" in base64.b64decode(encoded)
    assert 'alt="t. y [V] over x [s]. a: 0 to 2, at last 2."' in picture


def test_tables_have_captions_and_headings():
    text = page.table("what", ("a", "b"), [("x", 1), ("y", 2)], numbers=(1,), failed=(1,))
    assert "<caption>what</caption>" in text
    assert text.count('scope="col"') == 2
    assert text.count('scope="row"') == 2
    assert 'class="failed"' in text


def test_a_clocked_part_is_inserted_unchanged():
    part = page.clocked_part(
        "a replay", "<canvas></canvas>", "function setTime(t) { element.title = t; }"
    )
    assert "<canvas></canvas>" in part
    assert (
        "codrl.clocked(own, (element, seek) => {\nfunction setTime(t) { element.title = t;"
        " }\nreturn setTime;" in part
    )
    check_self_contained(small(part))


def test_only_html_files_are_written(tmp_path):
    with pytest.raises(ValueError, match=r"the suffix is '.pdf', must be .html"):
        page.write(tmp_path / "page.pdf", "x")
    assert page.write(tmp_path / "new" / "page.html", "x").read_text() == "x"


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (0.0001234567, "0.0001235"), (-2.5, "\N{MINUS SIGN}2.5"),
     (12345.6, "12,350"), (float("inf"), "∞"), (3, "3"), ("V", "V")],
)  # fmt: skip
def test_numbers_are_formatted_briefly(value, text):
    assert page.format_number(value) == text
