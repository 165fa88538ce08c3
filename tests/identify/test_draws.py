"""Identification of random motors: intervals contain the truth."""

import itertools

import pytest

from codrl_mj.identify import identify
from codrl_mj.identify.result import USABLE
from tests.identify import draws

DRAWS = 2
"""Number of motors, few to keep the test fast; `python -m tests.identify.draws` has more."""
INVISIBLE = {
    "prbs 5 kHz": (),
    "prbs 5 kHz, jitter 10 %": (),
    "chirp 5 kHz": ("J", "Coulomb", "viscous"),
    "slow_sine 5 kHz": ("L",),
    "locked_prbs 5 kHz": ("kE", "J", "Coulomb", "viscous"),
    "locked_prbs 1 kHz": ("R", "L", "kE", "J", "Coulomb", "viscous"),
}
"""Excitation -> parameters that it does not show."""


@pytest.mark.matrix
@pytest.mark.parametrize("row", INVISIBLE)
def test_intervals_of_identified_parameters_contain_the_truth(row):
    for draw in range(DRAWS):
        numbers, _ = draws.identify_draw(lambda draw: draws.make_log(draw, **draws.ROWS[row]), draw)
        identified = {
            name: inside for name, (status, _, inside) in numbers.items() if status == "identified"
        }
        assert all(identified.values()), numbers
        assert not identified.keys() & set(INVISIBLE[row])
        assert "R" in INVISIBLE[row] or "R" in identified


def is_narrower(estimate, reference):
    """Return True if an interval is at most as wide as another one."""
    return estimate.high - estimate.low <= reference.high - reference.low


@pytest.mark.matrix
@pytest.mark.parametrize("draw", [0, 1])
def test_more_data_does_not_refuse_a_narrower_interval(draw):
    """With an encoder of 64 steps, a current or a second log is added to voltage and position."""
    motor, known = draws.random_motor(draw), {"resistance": draws.random_motor(draw).resistance}
    whole = [draws.make_log(draw, kind, encoder=64) for kind in ("prbs", "square")]
    fewer = [draws.select_signals(log, "voltage", "position") for log in whole]
    results = [
        identify(logs, "free", known, seed=draw) for logs in (fewer[:1], fewer, whole[:1], whole)
    ]
    for less, more in itertools.combinations(results, 2):
        # One has a second log, the other a current: neither has more data.
        if (less, more) == (results[1], results[2]):
            continue
        usable = {
            estimate.name: estimate for estimate in less.estimates if estimate.status in USABLE
        }
        refused = [
            estimate
            for estimate in more.estimates
            if estimate.name in usable and estimate.status not in USABLE
        ]
        assert not [
            estimate for estimate in refused if is_narrower(estimate, usable[estimate.name])
        ]
    for result in results:
        by_name = {number.name: number for number in result.estimates}
        for name in ("back_emf_constant", "inertia", "friction_torque"):
            if by_name[name].status in USABLE:
                assert (
                    by_name[name].low
                    <= draws._true_value(motor, by_name, name)
                    <= by_name[name].high
                ), by_name[name]


@pytest.mark.matrix
def test_a_logged_current_does_not_refuse_parameters_that_the_voltage_determines():
    """At 1 kHz, 2 to 3 rows in L/R, the current alone does not show the back-EMF constant."""
    motor, log = draws.random_motor(0), draws.make_log(0, rate=1000.0, encoder=64)
    known = {
        "resistance": motor.resistance,
        "viscous_friction": motor.viscous_friction,
        "load_inertia": 0.0,
    }
    fewer = identify([draws.select_signals(log, "voltage", "position")], "free", known)
    more = identify([log], "free", known)
    for name in ("back_emf_constant", "torque_constant", "rotor_inertia", "coulomb_friction"):
        assert fewer[name] == more[name]
        assert more[name].status in USABLE
        truth = draws._true_value(
            motor, {}, "coulomb_friction" if name == "coulomb_friction" else name
        )
        assert more[name].low <= truth <= more[name].high
    assert {trace.part for trace in more.traces} == {"winding", "shaft"}
    assert any("fitted with the voltage as its input" in text for text in more.warnings)


@pytest.mark.matrix
def test_a_moving_log_without_current_keeps_the_resistance_of_a_locked_log():
    """The shaft under the voltage uses the resistance of the winding, and does not fit its own."""
    motor, locked = draws.random_motor(1), draws.make_log(1, "locked_prbs")
    moving = draws.select_signals(draws.make_log(1, "square"), "voltage", "position")
    # Back-EMF and viscous friction brake alike, so that one of them has to be known.
    known = {"load_inertia": 0.0, "viscous_friction": motor.viscous_friction}
    locked_only, both = identify([locked]), identify([locked, moving], "free", known)
    assert locked_only["resistance"] == both["resistance"]
    for name in ("resistance", "torque_constant", "rotor_inertia"):
        assert both[name].low <= getattr(motor, name) <= both[name].high
        assert both[name].status in USABLE
