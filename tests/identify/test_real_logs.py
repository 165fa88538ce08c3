"""Identification from the published logs of two real rigs."""

import numpy as np
import pytest

from codrl_mj.identify import identify, read_log
from tests.identify import bench
from tests.published import published_folder

PUBLISHED = {
    "inertia": 0.0626,
    "mgl": 1.003,
    "viscous_friction": 0.0471,
    "coulomb_friction": 0.1839,
}
"""Parameters of the pendulum by its authors."""


def servo_log(time):
    return read_log(published_folder("bam_xl330") / f"2026-01-15_{time}.json", bench.SERVO)


@pytest.mark.matrix
def test_published_parameters_of_the_pendulum_predict_its_logs_badly():
    """With all parameters known nothing is fitted; the error in half a second exceeds 0.1 rad."""
    logs = [bench.pendulum_log(name) for name in ("ddp", "ilqr", "sysid")]
    result = identify(logs, "pendulum", PUBLISHED)
    assert {estimate.status for estimate in result.estimates} == {"given"}
    assert all(prediction.open_loop > 0.1 for prediction in result.fitted)


def test_a_bad_log_gives_a_warning_and_no_identified_parameter():
    result = identify([bench.pendulum_log("sysid")], "pendulum")
    assert any("log sysid: mean residuals are" in text for text in result.warnings)
    assert "identified" not in {estimate.status for estimate in result.estimates}


@pytest.mark.matrix
def test_the_pendulum_is_identified_and_predicts_a_log_held_out():
    """Weight and inertia agree with fits of single logs, friction with the authors' value."""
    logs = [bench.pendulum_log(name) for name in ("ddp", "ilqr")]
    result = identify(logs, "pendulum", held_out=[bench.pendulum_log("sysid")])
    assert result.problem() is None or "do not determine" in result.problem()
    assert result["inertia"].status == result["mgl"].status == "identified"
    assert 0.17 < result["inertia"].value < 0.21
    assert 3.5 < result["mgl"].value < 3.8
    assert (
        result["coulomb_friction"].low
        < PUBLISHED["coulomb_friction"]
        < result["coulomb_friction"].high
    )
    assert max(prediction.open_loop for prediction in (*result.fitted, *result.held_out)) < 0.07


@pytest.mark.matrix
def test_a_servo_without_a_current_sensor_shows_ratios_and_load_dependent_friction():
    # The gains are 100 and 800 in the fitted logs, and 200 in those held out.
    logs = [servo_log(time) for time in ("10h28m10", "10h28m24", "10h29m47", "10h30m02")]
    held_out = [servo_log(time) for time in ("10h28m42", "10h28m57")]
    known = {"mgl": 0.49 * 9.81 * 0.1}
    plain, loaded = (
        identify(logs, "pendulum", known, kind, held_out) for kind in ("coulomb", "load")
    )
    errors = [
        np.mean([prediction.closed_loop for prediction in result.held_out])
        for result in (plain, loaded)
    ]
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.06
    assert plain["resistance"].status in ("ratio", "refused")
    # The inertia of the mass without the rotor's is a lower limit.
    assert loaded["inertia"].low > 0.49 * 0.1**2
