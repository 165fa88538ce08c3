"""Of motors that are drawn: what is said to be identified is within its interval, and what no log tells is not said."""

import pytest

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
        identified = {name: inside for name, (status, _, inside) in numbers.items() if status == "identified"}
        assert all(identified.values()), numbers
        assert not identified.keys() & set(SILENT[row])
        assert "R" in SILENT[row] or "R" in identified
