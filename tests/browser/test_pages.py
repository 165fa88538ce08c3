"""Pages in Chromium: film and plots on one clock, zoom, keyboard, themes, and screen sizes."""

from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup

from codrl_mj.plots import Curve, Plot
from codrl_mj.sizing import find_drive, find_entry
from codrl_mj.viz.pages import page as builder
from codrl_mj.viz.pages.motor import motor_page
from codrl_mj.viz.pages.report import replay_parts, report
from tests.browser.waiting import until

pytestmark = pytest.mark.browser
RUN = Path(__file__).parents[1] / "fixtures" / "runs" / "pendulum"
AXE = Path(__file__).parents[2] / "node_modules" / "axe-core" / "axe.min.js"


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Write a report with a clocked part, a report of two runs, a motor page, and odd names.

    The names contain markup.
    """
    folder = tmp_path_factory.mktemp("pages")
    clocked_part = builder.clocked_part(
        "a replay",
        '<button id="scrub" type="button">scrub</button> <span id="at"></span>',
        """element.querySelector("#scrub").addEventListener("click", () => seek(1.5));
        function setTime(time) { element.querySelector("#at").textContent = time.toFixed(2); }""",
    )
    report(
        [RUN],
        folder / "report.html",
        extra_parts=lambda shown: (*replay_parts(shown), clocked_part),
    )
    report([RUN, RUN.parent / "cartpole"], folder / "two.html")
    motor_page(
        "qube",
        find_drive("quanser-qube-servo-2"),
        find_entry("quanser-qube-servo-2"),
        folder / "motor.html",
    )
    evil = "<img src=http://there/x onerror=alert(1)>" + "x" * 90
    plot = Plot(evil, f"{evil} [s]", evil, (Curve(evil, np.arange(9.0), np.arange(9.0)),))
    section = builder.Section(
        "s", evil, builder.plot(plot) + builder.table(evil, (evil,), [(evil,)])
    )
    builder.write(folder / "evil.html", builder.page(evil, evil, Markup(), [section]))
    return folder


def drawn(page, title):
    """Return a plot by its title, scrolled into view and drawn."""
    figure = page.locator("figure.uplotted", has=page.locator("figcaption", has_text=title)).first
    figure.scroll_into_view_if_needed()
    figure.locator(".u-over").wait_for()
    return figure


def span(figure):
    """Return the visible range of a plot's horizontal axis."""
    return figure.locator(".plot").evaluate(
        "box => [box.plot.u.scales.x.min, box.plot.u.scales.x.max]"
    )


def now(page):
    return page.evaluate("codrl.clock.time")


def line(figure):
    """Return the time at which a plot draws its line of the present."""
    return figure.locator(".plot").evaluate(
        "box => box.plot.u.posToVal(new DOMMatrix(getComputedStyle(box.plot.line).transform).e,"
        " 'x')"
    )


@pytest.mark.parametrize("name", ["report", "two", "motor", "evil"])
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_pages_fit_laptop_and_phone_in_light_and_dark(opened, pages, name, width, scheme):
    page = opened((pages / f"{name}.html").as_uri(), width, scheme=scheme)
    for figure in page.locator("figure.uplotted").all():
        figure.scroll_into_view_if_needed()
        figure.locator("canvas").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    light = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert light is (scheme == "light")
    page.click("#theme")
    assert (
        page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    ) is not light


def test_the_plots_follow_the_film(opened, pages):
    page = opened((pages / "report.html").as_uri())
    torque = drawn(page, "Torque at the shaft")
    # The first frame has replaced the poster, which is a later one.
    until(page, "document.querySelector('video').currentTime > 0")
    assert page.evaluate("codrl.clock.time") == 0.0
    page.get_by_role("button", name="Play").click()
    until(page, "codrl.clock.time > 0.6")
    page.get_by_role("button", name="Pause").click()
    time = now(page)
    assert 0.6 < time < 5.0
    assert line(torque) == pytest.approx(time, abs=0.02)
    video = page.evaluate("document.querySelector('video').currentTime")
    assert video == pytest.approx(time, abs=0.15)
    assert f"{time:.2f} /" in page.locator(".transport output").inner_text()
    assert page.locator("#at").inner_text() == f"{time:.2f}"


def test_dragging_in_a_plot_seeks_the_film_and_the_other_plots(opened, pages):
    page = opened((pages / "report.html").as_uri())
    torque, reward = drawn(page, "Torque at the shaft"), drawn(page, "Reward of each step")
    torque.scroll_into_view_if_needed()
    box, end = torque.locator(".u-over").bounding_box(), page.evaluate("codrl.clock.end")
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.2 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=5)
    page.mouse.up()
    assert now(page) == pytest.approx(0.6 * end, abs=0.02 * end)
    assert line(reward) == pytest.approx(now(page), abs=1e-2 * end)
    time = now(page)
    until(page, f"Math.abs(document.querySelector('video').currentTime - {time}) < 0.06")
    assert span(torque) == [0.0, pytest.approx(end)]


def test_a_clocked_part_follows_the_clock_and_can_seek(opened, pages):
    page = opened((pages / "report.html").as_uri())
    torque = drawn(page, "Torque at the shaft")
    page.click("#scrub")
    assert now(page) == pytest.approx(1.5)
    assert line(torque) == pytest.approx(1.5, abs=0.01)
    slider = page.get_by_role("slider", name="Time")
    slider.fill("2")
    assert page.locator("#at").inner_text() == "2.00"


def test_plots_zoom_pan_and_reset(opened, pages):
    page = opened((pages / "motor.html").as_uri())
    figure = drawn(page, "A small step of the current")
    low, high = whole = span(figure)
    figure.get_by_role("button", name="Zoom in").click()
    assert span(figure)[1] - span(figure)[0] == pytest.approx((high - low) / 2, rel=1e-3)
    before = span(figure)
    figure.get_by_role("button", name="Pan left").click()
    assert span(figure)[0] < before[0]
    figure.get_by_role("button", name="Show all").click()
    assert span(figure) == whole
    box = figure.locator(".u-over").bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 60, steps=4)
    page.mouse.up()
    assert span(figure) == pytest.approx(
        [0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high], rel=0.05
    )
    page.mouse.dblclick(box["x"] + 0.5 * box["width"], box["y"] + 50)
    assert span(figure) == whole
    page.mouse.move(box["x"] + box["width"] - 2, box["y"] + 50)
    assert figure.locator(".legend .value").first.inner_text().startswith(("1", "0.99"))


def test_the_keyboard_reads_zooms_and_seeks(opened, pages):
    page = opened((pages / "report.html").as_uri())
    figure = drawn(page, "Torque at the shaft")
    figure.locator(".plot").focus()
    page.keyboard.press("ArrowRight")
    assert now(page) > 0.0
    assert "desired" in figure.locator("output").inner_text()
    page.keyboard.press("+")
    other_span = span(drawn(page, "Reward of each step"))
    assert other_span[1] - other_span[0] == pytest.approx(
        page.evaluate("codrl.clock.end") / 2, rel=1e-3
    )
    figure.locator(".plot").focus()
    page.keyboard.press("0")
    assert span(figure)[1] == pytest.approx(page.evaluate("codrl.clock.end"))


def test_runs_can_be_hidden(opened, pages):
    page = opened((pages / "two.html").as_uri())
    figure = drawn(page, "Torque at the shaft")
    assert figure.locator(".legend button:visible").count() == 4
    page.get_by_label("cartpole", exact=True).uncheck()
    assert figure.locator(".legend button:visible").count() == 2
    series = figure.locator(".plot").evaluate(
        "box => box.plot.u.series.slice(1).map((one) => one.show)"
    )
    assert series == [True, True, False, False]


def test_without_scripts_there_are_pictures_and_native_film_controls(opened, pages):
    page = opened((pages / "report.html").as_uri(), java_script_enabled=False)
    assert (
        page.locator("figure.uplotted noscript img").count()
        == page.locator("figure.uplotted").count()
        > 5
    )
    assert page.locator("video").get_attribute("controls") is not None


@pytest.mark.parametrize("name", ["report", "two", "motor"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(opened, pages, name, scheme):
    if not AXE.is_file():
        pytest.fail("no axe-core: npm install --no-save axe-core", pytrace=False)
    page = opened((pages / f"{name}.html").as_uri(), scheme=scheme, bypass_csp=True)
    page.add_script_tag(path=AXE)
    violations = page.evaluate("axe.run().then((result) => result.violations)")
    details = [
        (violation["id"], [node["html"][:150] for node in violation["nodes"]][:3])
        for violation in violations
    ]
    assert [
        violation["id"]
        for violation in violations
        if violation["impact"] in ("serious", "critical")
    ] == [], details
