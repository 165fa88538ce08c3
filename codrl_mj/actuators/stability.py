"""Stability of the discrete closed loop of controller and winding, without the mechanics."""

import dataclasses
from typing import Any

import numpy as np

from codrl_mj.actuators.model import UnstableError
from codrl_mj.actuators.parameters import parameters_type


def columns(family: Any, numbers: np.ndarray) -> Any:
    """Parameters of m actuators at once, each an array (m,), from rows of numbers (m, p)."""
    return parameters_type(family)(*numbers.T)


class _Unlimited:
    """A voltage limit that no voltage reaches, be it a number or an array: it compares as neither above nor below."""

    def __neg__(self) -> "_Unlimited":
        return self

    def __lt__(self, other: object) -> bool:
        return False

    def __gt__(self, other: object) -> bool:
        return False


def _closed_loops(family: Any, numbers: np.ndarray, timestep: float) -> tuple[np.ndarray, np.ndarray]:
    """What an electrical step makes of (current, integral, error), (to, from, actuator), and how many are in a step."""
    parameters = columns(family, numbers)
    dt = timestep / parameters.substeps
    current, integral, error = np.eye(3)[:, :, np.newaxis]  # all states of all actuators at once: (state, actuator)
    after = family.electrical_step(parameters, dt, current, integral, error, 0.0, 0.0, 0.0, _Unlimited())[:3]
    matrices = np.stack([np.broadcast_to(entry, (3, len(numbers))) for entry in after])
    # what no gain reads is no part of the loop: 0 instead of the eigenvalue of a state of its own
    read = np.stack([np.ones(len(numbers), dtype=bool), parameters.ki > 0, parameters.kd > 0])
    return np.where(read[:, np.newaxis] & read, matrices, 0.0), parameters.substeps


def spectral_radii(family: Any, numbers: np.ndarray, timestep: float) -> np.ndarray:
    """`spectral_radius` of many actuators at once.

    Args:
        family: `codrl_mj.actuators.Actuator`, or one with its fields.
        numbers: shape (m, p), rows as `ActuatorModel.numbers` has them.
        timestep: mechanical step [s].

    Returns:
        Shape (m,); the radius of each does not depend on the others, to the last bit.
    """
    with np.errstate(all="ignore"):
        loops, substeps = _closed_loops(family, numbers, timestep)
        matrices = np.moveaxis(loops, 2, 0)
        finite = np.isfinite(matrices).all(axis=(1, 2))
        values = np.linalg.eigvals(np.where(finite[:, np.newaxis, np.newaxis], matrices, 0.0))
        radii = np.abs(values.astype(np.complex128)).max(axis=1)
        radii = np.where(finite, radii, np.inf)
        return radii**substeps  # a power of the matrix itself would overflow into NaN


MARGIN = 1e-9
"""By how much, relative to their terms, Jury's conditions must hold or not: far above the rounding of either method."""


def stability_radii(family: Any, numbers: np.ndarray, timestep: float) -> np.ndarray:
    """`spectral_radii`, but 0 or infinity in clear cases, which saves nearly all of the eigenvalues.

    Returns:
        Shape (m,): below 1 exactly where the spectral radii are.
    """
    with np.errstate(all="ignore"):
        (a, b, c), (d, e, f), (g, h, i) = _closed_loops(family, numbers, timestep)[0]
        # z^3 + two z^2 + one z + zero
        two = -(a + e + i)
        linear = (a * e - b * d) + (a * i - c * g) + (e * i - f * h)
        zero = -(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
        margin = MARGIN * (1.0 + abs(two) + abs(linear) + abs(zero)) ** 2
        least = np.minimum(np.minimum(1.0 + two + linear + zero, 1.0 - two + linear - zero), 1.0 - abs(zero))
        last = np.minimum(least, 1.0 - zero * zero - abs(linear - zero * two))
        least = np.where(least > margin, last, least)
        radii = np.where(least > margin, 0.0, np.where(least < -margin, np.inf, np.nan))
    doubtful = np.isnan(radii)
    if doubtful.any():
        radii[doubtful] = spectral_radii(family, numbers[doubtful], timestep)
    return radii


def spectral_radius(actuator: Any, timestep: float) -> float:
    """Largest absolute eigenvalue of the closed loop over one mechanical step: below 1 the loop is stable.

    Args:
        actuator: motor and gains.
        timestep: mechanical step [s].
    """
    return float(spectral_radii(type(actuator), np.array([actuator.numbers]), timestep)[0])


def check_stable(actuator: Any, timestep: float) -> None:
    """Refuse an actuator whose closed loop is unstable at this step.

    Args:
        actuator: motor and gains.
        timestep: mechanical step [s].

    Raises:
        ValueError: the spectral radius is 1 or more; the message has the number and a remedy that was checked.
    """
    radius = spectral_radius(actuator, timestep)
    if radius < 1.0:
        return
    gains = actuator.controller
    remedy = f"Lower the gains (kp = {gains.kp:g}, ki = {gains.ki:g}, kd = {gains.kd:g}): more substeps do not help"
    for substeps in (gains.substeps * 2**doubling for doubling in range(1, 11)):
        finer = dataclasses.replace(actuator, controller=dataclasses.replace(gains, substeps=substeps))
        if spectral_radius(finer, timestep) < 1.0:
            remedy = f"Set controller.substeps = {substeps}, lower the gains, or shorten the step"
            break
    raise UnstableError(
        f"actuator: the current loop is unstable at a step of {timestep:g} s: spectral radius {radius:.4g}, must be "
        f"< 1. {remedy}, or pass allow_unstable=True to study it as it is"
    )
