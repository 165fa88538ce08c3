"""Voltages that make a motor show what it is: pure functions of time, of amplitude 1.

What each shows: slow turning shows resistance, back-EMF and friction; only what changes within the winding's time
constant L/R shows the inductance. PRBS: a pseudo-random binary sequence, white up to its clock.
Source: Ljung, *System Identification* (2nd ed. 1999), sec. 13.3.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np

from codrl_mj.fields import check, check_names, real


@dataclasses.dataclass(frozen=True)
class Excitation:
    """A voltage over time.

    Raises:
        ValueError: a field is out of bounds, or the kind is unknown.
    """

    kind: str = "prbs"
    """One of `KINDS`."""
    amplitude: float = real(1.0, above=0.0, unit="V")
    """The largest voltage [V], > 0."""
    duration: float = real(4.0, above=0.0, unit="s")
    """[s], > 0."""
    frequency: float = real(0.5, above=0.0, unit="Hz")
    """Of the slow sine, and of the square [Hz], > 0."""
    highest: float = real(200.0, above=0.0, unit="Hz")
    """Where the chirp ends [Hz], > 0; it begins at `frequency`."""
    clock: float = real(2.0e-3, above=0.0, unit="s")
    """Least time [s] between the changes of a PRBS, > 0; about 4 L/R."""

    def __post_init__(self) -> None:
        """Validate."""
        check(self)
        check_names([self.kind], KINDS, "excitation")

    @property
    def locked(self) -> bool:
        """Whether the shaft is to be held."""
        return self.kind == "locked_prbs"

    def voltage(self, time: np.ndarray) -> np.ndarray:
        """[V], of the shape of time [s]; 0 after the duration."""
        time = np.asarray(time, dtype=float)
        return self.amplitude * np.where(time < self.duration, KINDS[self.kind](self, time), 0.0)


def _slow_sine(excitation: Excitation, time: np.ndarray) -> np.ndarray:
    return np.sin(2.0 * math.pi * excitation.frequency * time)


def _bits(excitation: Excitation, time: np.ndarray) -> np.ndarray:
    bits = _sequence()
    return bits[np.floor(time / excitation.clock + 1e-9).astype(int) % len(bits)]


KINDS: dict[str, Callable[[Excitation, np.ndarray], np.ndarray]] = {
    "slow_sine": _slow_sine,
    # reverses at once
    "square": lambda one, time: np.where((one.frequency * time) % 1.0 < 0.5, 1.0, -1.0),
    # its frequency grows in proportion to time
    "chirp": lambda one, time: np.sin(
        2.0 * math.pi * (one.frequency + 0.5 * (one.highest - one.frequency) * time / one.duration) * time
    ),
    "prbs": lambda one, time: 0.5 * _bits(one, time) + 0.5 * _slow_sine(one, time),
    "locked_prbs": _bits,  # with the shaft held
}
"""Kind -> function of amplitude 1."""


@functools.cache
def _sequence() -> np.ndarray:
    """-1 and 1 in a sequence of 2^13 - 1 by a shift register, shape (8191,)."""
    from scipy.signal import max_len_seq

    return 2.0 * max_len_seq(13)[0].astype(float) - 1.0
