"""Plots as data: the page gets the given values, and all values can be drawn."""

import base64
import json
import math

import numpy as np
import pytest

from codrl_mj.plots import MAX_POINTS, Curve, Plot, Shade, decimate, flagged_intervals, save_png
from codrl_mj.viz.pages.plots import describe, to_json, to_svg


def read(plot):
    """Return the content of a plot as the page's script reads it, with decoded arrays."""
    content = json.loads(to_json(plot))
    arrays = [np.frombuffer(base64.b64decode(text), "<f4") for text in content["arrays"]]
    return content, arrays


def line(*y):
    return Curve("c", np.arange(len(y)) + 1.0, np.array(y, dtype=float))


def test_the_page_gets_every_value_and_each_array_once():
    x = np.linspace(0.0, 1.0, 50)
    content, arrays = read(
        Plot("t", "x [s]", "y [V]", (Curve("a", x, np.sin(x)), Curve("b", x, np.cos(x))))
    )
    first, second = content["curves"]
    assert first["x"] == second["x"]
    assert len(arrays) == 3
    np.testing.assert_array_equal(arrays[first["y"]], np.sin(x).astype(np.float32))
    np.testing.assert_array_equal(arrays[second["y"]], np.cos(x).astype(np.float32))


def test_a_long_line_keeps_its_peaks_and_its_ends():
    y = np.zeros(100_000)
    y[51_234], y[77_777] = 5.0, -3.0
    x, values = decimate(np.arange(len(y)), y)
    assert len(x) <= MAX_POINTS + 2
    assert values.max() == 5.0
    assert values.min() == -3.0
    assert x[[0, -1]].tolist() == [0, len(y) - 1]
    assert x[values == 5.0].tolist() == [51_234]


def test_flagged_intervals_are_those_with_a_flag():
    times = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    assert flagged_intervals(times, np.array([1, 0, 1, 1])).tolist() == [[0.0, 0.1], [0.2, 0.4]]
    assert flagged_intervals(times, np.zeros(4)).shape == (0, 2)


@pytest.mark.parametrize(
    "y", [[0.0, 0.0], [np.nan, np.inf], [1.0, 1.0], [-3.0, 1e300], [1e-300, 1.0], []]
)
@pytest.mark.parametrize("log", [False, True])
def test_any_numbers_can_be_drawn(y, log):
    plot = Plot("t", "x [s]", "y [1]", (line(*y),), log, log)
    _, arrays = read(plot)
    finite = [
        value
        for value in y
        if math.isfinite(value) and abs(value) < 3e38 and (value > 1e-37 or not log)
    ]
    drawn = arrays[json.loads(to_json(plot))["curves"][0]["y"]]
    assert np.isfinite(drawn).sum() == len(finite)
    assert to_svg(plot).lstrip().startswith("<?xml")
    assert "nan" not in describe(plot)


def test_a_reference_may_leave_a_logarithmic_picture_and_a_result_may_not():
    far = Curve("bound", np.array([1.0, 2.0]), np.array([1e9, 1e30]), reference=True)
    content, _ = read(Plot("t", "x [1]", "y [1]", (line(1.0, 3.0), far), y_log=True))
    assert content["y"]["most"] == 3e6
    assert read(Plot("t", "x [1]", "y [1]", (line(1.0, 3.0),), y_log=True))[0]["y"]["most"] is None


def test_names_cannot_close_the_script_with_the_data():
    curves, shades = (Curve("<!--", np.zeros(1), np.zeros(1)),), (Shade("</", np.ones((1, 2))),)
    plot = Plot("</script><b>", "x", "y", curves, shades=shades)
    assert "<" not in to_json(plot)
    assert read(plot)[0]["title"] == "</script><b>"


def test_names_are_not_typeset_as_formulas(tmp_path):
    names = "$KP_$KD", "cost_$10_to_$20"
    plot = Plot(
        names[0], "x", "y", tuple(Curve(name, np.arange(3), np.arange(3)) for name in names)
    )
    assert all(name in to_svg(plot) for name in names)
    save_png(plot, tmp_path / "plot.png")


def test_the_description_has_the_range_of_each_curve():
    text = describe(Plot("t", "time [s]", "torque [N·m]", (line(1.0, -2.0, 0.5),)))
    assert text == "torque [N·m] over time [s]. c: -2 to 1, at last 0.5."


def test_the_svg_picture_is_small():
    x = np.linspace(0.0, 10.0, 5000)
    assert len(to_svg(Plot("t", "x [s]", "y [V]", (Curve("a", x, np.sin(50 * x)),)))) < 30_000
