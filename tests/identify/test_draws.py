"""Of motors that are drawn: what is said to be identified is within its interval, and what no log tells is not said."""

import itertools

import pytest

from codrl_mj.identify import identify
from codrl_mj.identify.result import USABLE
from tests.identify import draws

DRAWS = 2
"""As many as a test has time for; `python -m tests.identify.draws --draws 100` has more."""
SILENT = {
    "prbs 5 kHz": (),
    "prbs 5 kHz, jitter 10 %": (),
    "chirp 5 kHz": ("J", "Coulomb", "viscous"),
    "slow_sine 5 kHz": ("L",),
    "locked_prbs 5 kHz": ("kE", "J", "Coulomb", "viscous"),
    "locked_prbs 1 kHz": ("R", "L", "kE", "J", "Coulomb", "viscous"),
}
"""Excitation -> what it does not tell."""


@pytest.mark.matrix
@pytest.mark.parametrize("row", SILENT)
def test_what_is_identified_is_within_its_interval(row):
    for draw in range(DRAWS):
        numbers, _ = draws.tried(lambda draw: draws.logged(draw, **draws.ROWS[row]), draw)
        identified = {
            name: inside for name, (status, _, inside) in numbers.items() if status == "identified"
        }
        assert all(identified.values()), numbers
        assert not identified.keys() & set(SILENT[row])
        assert "R" in SILENT[row] or "R" in identified


def narrower(one, other):
    return one.high - one.low <= other.high - other.low


@pytest.mark.matrix
@pytest.mark.parametrize("draw", [0, 1])
def test_a_column_or_a_log_more_turns_no_narrower_interval_into_a_refusal(draw):
    """With an encoder of 64 steps, from voltage and position to the current beside them and to a second log."""
    motor, known = draws.motor_of(draw), {"resistance": draws.motor_of(draw).resistance}
    whole = [draws.logged(draw, kind, encoder=64) for kind in ("prbs", "square")]
    fewer = [draws.only(log, "voltage", "position") for log in whole]
    found = [
        identify(logs, "free", known, seed=draw) for logs in (fewer[:1], fewer, whole[:1], whole)
    ]
    for less, more in itertools.combinations(found, 2):
        if (less, more) == (found[1], found[2]):
            continue  # a log less and a column more
        told = {one.name: one for one in less.estimates if one.status in USABLE}
        taken = [one for one in more.estimates if one.name in told and one.status not in USABLE]
        assert not [one for one in taken if narrower(one, told[one.name])]
    for one in found:
        named = {number.name: number for number in one.estimates}
        for name in ("back_emf_constant", "inertia", "friction_torque"):
            if named[name].status in USABLE:
                assert named[name].low <= draws._truth(motor, named, name) <= named[name].high, (
                    named[name]
                )


@pytest.mark.matrix
def test_a_current_does_not_take_away_what_the_voltage_alone_tells():
    """At 1 kHz, 2 to 3 rows in L/R, the current tells no back-EMF constant: it was refused with all that follows."""
    motor, log = draws.motor_of(0), draws.logged(0, rate=1000.0, encoder=64)
    known = {
        "resistance": motor.resistance,
        "viscous_friction": motor.viscous_friction,
        "load_inertia": 0.0,
    }
    fewer = identify([draws.only(log, "voltage", "position")], "free", known)
    more = identify([log], "free", known)
    for name in ("back_emf_constant", "torque_constant", "rotor_inertia", "coulomb_friction"):
        assert fewer[name] == more[name]
        assert more[name].status in USABLE
        truth = draws._truth(motor, {}, "coulomb_friction" if name == "coulomb_friction" else name)
        assert more[name].low <= truth <= more[name].high
    assert {one.part for one in more.traces} == {"winding", "shaft"}
    assert any("fitted under the voltage" in text for text in more.warnings)


@pytest.mark.matrix
def test_a_moving_log_without_current_does_not_take_away_what_a_locked_one_tells():
    """The shaft under the voltage takes the resistance from the winding, and does not fit another one."""
    motor, locked = draws.motor_of(1), draws.logged(1, "locked_prbs")
    moving = draws.only(draws.logged(1, "square"), "voltage", "position")
    alone, both = identify([locked]), identify([locked, moving], "free", {"load_inertia": 0.0})
    assert alone["resistance"] == both["resistance"]
    for name in ("resistance", "torque_constant", "rotor_inertia"):
        assert both[name].low <= getattr(motor, name) <= both[name].high
        assert both[name].status in USABLE
