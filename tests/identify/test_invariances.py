"""Parameters that no log determines, because the shaft moves in the same way with others."""

import numpy as np
import pytest

from codrl_mj.identify import Log, identify
from codrl_mj.identify.parameters import ShaftParameters
from codrl_mj.identify.simulation import simulate_shaft

RESISTANCE, CONSTANT, INERTIA, COULOMB, VISCOUS = 2.0, 0.05, 2e-4, 2e-3, 1e-5
TRUTH = {"torque_constant": CONSTANT, "inertia": INERTIA, "coulomb_friction": COULOMB}


def voltage_log():
    """Return a log of voltage and position of a free motor, with an encoder's step of 1 mrad."""
    time = 5e-4 * np.arange(8001)
    jumps = np.random.default_rng(0).choice([-3.0, 3.0], 81)[(time / 0.05 + 1e-9).astype(int)]
    volts = 3.0 * np.sin(4.4 * time) + jumps
    gain = CONSTANT / RESISTANCE
    shaft = ShaftParameters(
        INERTIA, 0.0, 0.0, COULOMB, VISCOUS, 1.0, 0.0, 1.0, 2.0, 0.0, gain, gain * CONSTANT
    )
    position = simulate_shaft(time, volts, 0.0 * time, 0.0, 0.0, shaft)[0][::4]
    signals = {"voltage": volts[::4], "position": np.round(position / 1e-3) * 1e-3}
    return Log("volts", time[::4], signals, {"position": 1e-3})


def statuses(result, *names):
    """Return the statuses of parameters."""
    return {result[name].status for name in names}


@pytest.mark.matrix
@pytest.mark.parametrize(
    ("known", "ambiguous"),
    [
        ({}, ("resistance", "torque_constant", "inertia", "coulomb_friction")),
        # With less viscous friction and a larger constant, inertia and friction are larger, too.
        ({"resistance": RESISTANCE}, ("torque_constant", "inertia", "coulomb_friction")),
        # All torques and the conductance have a common factor.
        ({"torque_constant": CONSTANT}, ("resistance", "inertia", "coulomb_friction")),
    ],
)
def test_a_common_factor_of_parameters_is_a_ratio(known, ambiguous):
    result = identify([voltage_log()], "free", known)
    assert statuses(result, *ambiguous, "viscous_friction", "friction_torque") == {"ratio"}
    assert "the fit is equally good if these change together" in result[ambiguous[0]].why


@pytest.mark.matrix
def test_a_known_resistance_and_viscous_friction_leave_no_common_factor():
    """Without a known torque the first guess of the constant is the viscous term per volt."""
    result = identify(
        [voltage_log()], "free", {"resistance": RESISTANCE, "viscous_friction": VISCOUS}
    )
    assert statuses(result, "torque_constant", "inertia") == {"identified"}
    assert statuses(result, "coulomb_friction") <= {"identified", "rough"}
    for name, value in TRUTH.items():
        assert result[name].value == pytest.approx(value, rel=0.1)
        assert result[name].low <= value <= result[name].high


def test_a_free_swing_shows_only_the_ratio_of_weight_and_inertia():
    """A small swing has the period 2 pi sqrt(J/mgl), which depends only on the ratio of J and mgl."""
    time = 2e-3 * np.arange(1500)
    shaft = ShaftParameters(0.05, 3.2, 0.0, 0.0, 0.01, 1.0, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0)
    position = simulate_shaft(time, 0.0 * time, 0.0 * time, 1.0, 0.0, shaft)[0]
    signals = {"position": np.round(position / 1e-3) * 1e-3, "torque": 0.0 * time}
    result = identify([Log("swing", time, signals, {"position": 1e-3})], "pendulum")
    names = "inertia", "mgl", "viscous_friction", "friction_torque"
    assert statuses(result, *names) == {"ratio"}
    assert result["mgl"].value / result["inertia"].value == pytest.approx(64.0, rel=0.005)
