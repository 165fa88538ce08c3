"""Directions in which a shaft's parameters can change without any change of its motion.

The motion depends on the parameters only through accelerations per input, per speed and so on:
torques divided by the inertia. If several sets of parameters have the same quotients, then no log
distinguishes them, no matter how long or accurate it is. For example, a shaft under a voltage moves
in the same way with a tenfold inertia, weight and friction and a tenth of the resistance. A
numerical search misses such a direction if a parameter is at its bound or if dry friction makes the
cost rough. The quotients show it exactly, before any data.
"""

import math

import numpy as np

from codrl_mj.identify.estimate import Fit
from codrl_mj.identify.models import ShaftModel

_DIFFERENCE_STEP = 1e-5
"""Step of finite differences, in the parameters' scales."""
# Central differences have a relative error of about 1e-10.
_MAX_RATIO = 1e-7
"""Largest ratio of a singular value to the largest one that counts as zero."""
_MAX_SHARE = 1e-6
"""Largest share of a parameter in a direction that counts as zero."""


def invariant_directions(fit: Fit[ShaftModel], scales: np.ndarray) -> np.ndarray:
    """Return the directions that change no quotient on which the motion depends, shape (d, p).

    Entries are changes in units of the scales. Each direction has a parameter of its own, by which
    it changes by 1, and which no other direction changes.

    Args:
        fit: fit of a shaft.
        scales: scales of the parameters, shape (p,).
    """
    values = fit.values
    has_input = any(np.any(segment.inputs) for segment in fit.segments)
    quotients = _quotients(fit.model, values, values, has_input)
    # A change is relative to the quotient itself, because their units differ.
    sizes = np.maximum(np.abs(quotients), 1e-12 * np.abs(quotients).max())
    columns = []
    for change in np.diag(_DIFFERENCE_STEP * scales):
        after, before = (
            _quotients(fit.model, values + sign * change, values, has_input) for sign in (1.0, -1.0)
        )
        columns.append((after - before) / sizes / (2.0 * _DIFFERENCE_STEP))
    return _reduced(_null_space(np.stack(columns, axis=1)))


def _quotients(
    model: ShaftModel, values: np.ndarray, fitted: np.ndarray, has_input: bool
) -> np.ndarray:
    """Return the numbers on which the motion depends, with the free parameters (p,).

    The fitted parameters (p,) decide which numbers those are.
    """
    shaft, fitted_shaft = model.shaft_parameters(values), model.shaft_parameters(fitted)
    torques = [
        shaft.gravity,
        shaft.constant_torque,
        shaft.coulomb,
        shaft.stribeck_friction,
    ]
    inputs = model.input_quotients(values) if has_input else []
    # A gear's loss and Stribeck friction depend on the motor's torque, which back-EMF reduces and
    # viscous friction does not. Without them only the sum of both acts on the shaft.
    if fitted_shaft.gear_efficiency < 1.0 or fitted_shaft.stribeck_friction > 0.0:
        damping = [shaft.viscous, shaft.braking]
    else:
        damping = [shaft.viscous + shaft.braking]
    dimensionless = [shaft.gear_efficiency, math.log(shaft.stribeck_speed)]
    by_motion, by_speed = (
        [torque / shaft.inertia for torque in group] for group in (torques, damping)
    )
    return np.array([*by_motion, *inputs, *by_speed, *dimensionless])


def _null_space(matrix: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the null space of a matrix (q, p), shape (d, p)."""
    # Columns of equal norm make the limit of small singular values independent of the scales.
    norms = np.linalg.norm(matrix, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    _, singular_values, vectors = np.linalg.svd(matrix / norms)
    singular_values = np.append(
        singular_values, np.zeros(max(matrix.shape[1] - len(singular_values), 0))
    )
    is_null = singular_values <= _MAX_RATIO * max(float(singular_values.max(initial=0.0)), 1e-300)
    return np.asarray(vectors[is_null] / norms)


def _reduced(directions: np.ndarray) -> np.ndarray:
    """Return a basis of the same space in which each direction has a parameter of its own."""
    reduced = directions.copy()
    for row in range(len(reduced)):
        reduced[row:] /= np.linalg.norm(reduced[row:], axis=1, keepdims=True)
        remaining = np.abs(reduced[row:])
        pivot_row, pivot = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
        reduced[[row, row + int(pivot_row)]] = reduced[[row + int(pivot_row), row]]
        reduced[row] /= reduced[row, pivot]
        others = np.arange(len(reduced)) != row
        reduced[others] -= np.outer(reduced[others, pivot], reduced[row])
    reduced[np.abs(reduced) < _MAX_SHARE] = 0.0
    return reduced
