"""The two rigs whose logs others have published."""

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
"""Of the pendulum, by its authors."""


def servo_log(time):
    return read_log(published_folder("bam_xl330") / f"2026-01-15_{time}.json", bench.SERVO)


@pytest.mark.matrix
def test_the_published_pendulum_foretells_its_own_logs_badly():
    """All numbers given, so nothing is fitted; half a second is off by 0.1 rad and more."""
    logs = [bench.pendulum_log(name) for name in ("ddp", "ilqr", "sysid")]
    found = identify(logs, "pendulum", PUBLISHED)
    assert {one.status for one in found.estimates} == {"given"}
    assert all(one.open_loop > 0.1 for one in found.fitted)


def test_the_bad_log_is_said_to_be_bad_and_nothing_of_it_is_used():
    found = identify([bench.pendulum_log("sysid")], "pendulum")
    assert any("log sysid: residuals are" in text for text in found.warnings)
    assert "identified" not in {one.status for one in found.estimates}


@pytest.mark.matrix
def test_the_pendulum_is_identified_and_foretells_what_it_was_not_fitted_to():
    """Weight and inertia are what single logs of the rig have said; friction what its authors did."""
    logs = [bench.pendulum_log(name) for name in ("ddp", "ilqr")]
    found = identify(logs, "pendulum", held_out=[bench.pendulum_log("sysid")])
    assert found.problem() is None or "say nothing of" in found.problem()
    assert found["inertia"].status == found["mgl"].status == "identified"
    assert 0.17 < found["inertia"].value < 0.21
    assert 3.5 < found["mgl"].value < 3.8
    assert (
        found["coulomb_friction"].low
        < PUBLISHED["coulomb_friction"]
        < found["coulomb_friction"].high
    )
    assert max(one.open_loop for one in (*found.fitted, *found.held_out)) < 0.07


@pytest.mark.matrix
def test_a_servo_without_a_current_sensor_tells_ratios_and_friction_that_depends_on_the_load():
    logs = [
        servo_log(time) for time in ("10h28m10", "10h28m24", "10h29m47", "10h30m02")
    ]  # gains of 100 and 800
    held_out = [servo_log(time) for time in ("10h28m42", "10h28m57")]  # 200
    known = {"mgl": 0.49 * 9.81 * 0.1}
    plain, loaded = (
        identify(logs, "pendulum", known, kind, held_out) for kind in ("coulomb", "load")
    )
    errors = [np.mean([one.closed_loop for one in found.held_out]) for found in (plain, loaded)]
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.06
    assert plain["resistance"].status in ("ratio", "refused")
    assert loaded["inertia"].low > 0.49 * 0.1**2  # of the mass alone
