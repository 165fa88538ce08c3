"""Page of an identification: fits, residuals, statuses, and advice."""

import dataclasses
import json

import numpy as np
import pytest

from codrl_mj.identify import identify
from codrl_mj.identify.log import Log
from codrl_mj.identify.result import Estimate
from codrl_mj.viz.pages.identification import identification_page
from tests.viz.pages.parsed import check_self_contained

R, L, NOISE = 2.0, 1e-3, 0.005


def locked(name, seed):
    """Return a log of a winding under voltage steps: exact solution, with noise on the current."""
    generator = np.random.default_rng(seed)
    time = np.arange(2000) * 1e-3
    volts = np.repeat(generator.choice([-3.0, 3.0], 200), 10)
    current, decay = np.zeros(2000), np.exp(-R * 1e-3 / L)
    for row in range(1999):
        current[row + 1] = volts[row] / R + (current[row] - volts[row] / R) * decay
    return Log(
        name, time, {"voltage": volts, "current": current + NOISE * generator.normal(size=2000)}
    )


@pytest.fixture(scope="module")
def result():
    """Return an identification of two logs."""
    return identify([locked("<one>", 1), locked("two", 2)])


def test_traces_have_the_measured_and_simulated_signals(result):
    """Compare with the noise: the fit deviates from the measured current by its amplitude."""
    assert [(trace.log, trace.part, trace.output) for trace in result.traces] == [
        ("<one>", "winding", "current"), ("two", "winding", "current"),
    ]  # fmt: skip
    log, trace = locked("<one>", 1), result.traces[0]
    np.testing.assert_array_equal(trace.time, log.time)
    np.testing.assert_allclose(trace.measured, log.signals["current"], atol=1e-12)
    assert np.std(trace.measured - trace.simulated) == pytest.approx(NOISE, rel=0.1)


def test_files_have_correlations_of_fitted_parameters_and_no_traces(result):
    content = json.loads(json.dumps(result.as_mapping()))
    assert "traces" not in content
    table = content["correlations"]["winding"]
    assert table["resistance"]["resistance"] == pytest.approx(1.0)
    assert table["resistance"]["inductance"] == pytest.approx(table["inductance"]["resistance"])
    assert abs(table["resistance"]["inductance"]) < 1.0


def test_the_page_has_fits_statuses_and_advice(result, tmp_path):
    refused = Estimate("coulomb_friction", 0.1, 0.0, 0.9, "refused", "too wide, <b>", {"logs": 0.4})
    rough = Estimate(
        "viscous_friction", 0.1, 0.0, 0.2, "rough", "its interval is 20 % of all friction"
    )
    bad = dataclasses.replace(
        result, estimates=(*result.estimates, refused, rough), warnings=("beware & see",)
    )
    parsed = check_self_contained(identification_page(bad, tmp_path / "r.html").read_text())
    titles = [data["title"] for data in parsed.data]
    traces = (
        "<one>: current",
        "two: current, residuals",
        "two: current, autocorrelation of residuals",
    )
    assert [title for title in traces if title not in titles] == []
    for fragment in (
        "✗ not to be used as an actuator",
        "too wide, <b>",
        "coulomb friction is refused: pass standstill often",
        "viscous friction is rough: hold several speeds",
        "3 of 4 parameters are reliable",
        "beware & see",
    ):
        assert fragment in parsed.text
