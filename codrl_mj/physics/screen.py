"""Quick proof that a current loop is stable, or is not, for many at once: it saves nearly all of the eigenvalues."""

import functools
from typing import Any

import numba
import numpy as np

from codrl_mj.callbacks import kernels  # noqa: F401 - makes the loop's functions known to numba
from codrl_mj.motor.current_loop import advance
from codrl_mj.motor.parameters import KD, KI, MAX_VOLTAGE, SUBSTEPS
from codrl_mj.motor.stability import spectral_radii

MARGIN = 1e-9
"""By how much, relative to their terms, Jury's conditions must hold or not: far above the rounding of either method."""


def stability_radii(vectors: np.ndarray, timestep: float) -> np.ndarray:
    """`codrl_mj.motor.stability.spectral_radii`, with 0 and infinity instead of the radii of clear cases.

    Args:
        vectors: parameter vectors, shape (m, p).
        timestep: mechanical step [s].

    Returns:
        Shape (m,): below 1 exactly where the spectral radii are.
    """
    radii = _compiled()(np.ascontiguousarray(vectors), timestep)
    doubtful = np.isnan(radii)
    if doubtful.any():
        radii[doubtful] = spectral_radii(vectors[doubtful], timestep)
    return radii


@functools.cache
def _compiled() -> Any:
    """Compile on first use, in about a second; the matrix is that of `codrl_mj.motor.stability`, read off the loop."""
    loop = numba.njit(advance)

    @numba.njit("float64[::1](float64[:,::1], float64)", error_model="numpy")
    def judge(vectors: np.ndarray, timestep: float) -> np.ndarray:
        radii = np.empty(len(vectors))
        matrix = np.empty((3, 3))
        for row in range(len(vectors)):
            parameters = vectors[row].copy()
            dt = timestep / parameters[SUBSTEPS]
            parameters[SUBSTEPS], parameters[MAX_VOLTAGE] = 1.0, np.inf
            for state in range(3):
                unit = np.zeros(3)
                unit[state] = 1.0
                after = loop(parameters, dt, unit[0], unit[1], unit[2], 0.0, 0.0)
                matrix[0, state], matrix[1, state], matrix[2, state] = after[0], after[1], after[2]
            for state, gain in ((1, KI), (2, KD)):
                if not parameters[gain] > 0.0:
                    matrix[state] = 0.0
                    matrix[:, state] = 0.0
            (a, b, c), (d, e, f), (g, h, i) = matrix[0], matrix[1], matrix[2]
            # z^3 + two z^2 + one z + zero
            two = -(a + e + i)
            one = (a * e - b * d) + (a * i - c * g) + (e * i - f * h)
            zero = -(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
            margin = MARGIN * (1.0 + abs(two) + abs(one) + abs(zero)) ** 2
            least = min(1.0 + two + one + zero, 1.0 - two + one - zero, 1.0 - abs(zero))
            least = min(least, 1.0 - zero * zero - abs(one - zero * two)) if least > margin else least
            radii[row] = 0.0 if least > margin else np.inf if least < -margin else np.nan
        return radii

    return judge
