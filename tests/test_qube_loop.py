"""The controller of a real rig in our simulation, for targets that do not change."""

import numpy as np
import pytest

import qube_loop

RESOLUTION = 2.0 * np.pi / 2048


@pytest.mark.parametrize("name", qube_loop.MODELS)
def test_the_rigs_controller_balances_the_rod_at_constant_targets(name):
    """The voltage of the rig is on the motor's side of the sign: a rod that leans is caught."""
    steps = 400
    targets = qube_loop.Targets(np.zeros((steps, 2)), np.full(steps, 0.3))
    angles, volts = qube_loop.balance(
        qube_loop.make_rig(qube_loop.MODELS[name]), targets, RESOLUTION
    )
    assert len(angles) == steps
    assert 0.01 < np.abs(angles[:, 0]).max() < 0.6
    assert np.abs(angles[:, 1]).max() < 0.2
    assert np.abs(volts).max() < qube_loop.MAX_VOLTAGE


def test_a_row_has_the_means_of_the_runs_that_did_not_fall():
    spreads = [qube_loop.Spread(0.1, 0.07, 1.5), qube_loop.Spread(0.12, 0.08, 1.7)]
    assert qube_loop.row("rig", spreads, []) == "| rig | 0 of 6 | 110 | 75.0 | 1.60 |"
    assert qube_loop.row("ideal", [], [4.7, 4.9]) == "| ideal | 2 of 6, at 4.7 s | - | - | - |"


def test_the_spread_is_that_about_the_targets():
    rows = qube_loop.FIRST_ROW + 1000
    wave = np.sin(0.1 * np.arange(rows))
    targets = qube_loop.Targets(np.column_stack([wave, 0.0 * wave]), 0.0 * wave)
    angles = np.column_stack([1.2 * wave, 0.1 * wave])
    result = qube_loop.spread(angles, 3.0 * wave, targets)
    deviation = np.std(wave[qube_loop.FIRST_ROW :])
    assert result == pytest.approx((0.2 * deviation, 0.1 * deviation, 3.0 * deviation))
