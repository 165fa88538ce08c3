"""Stability of the discrete closed loop of controller and winding, without the mechanics."""

import dataclasses
from typing import Any

import numpy as np

from codrl_mj.motor.current_loop import advance
from codrl_mj.motor.parameters import KD, KI, MAX_VOLTAGE, SUBSTEPS, Actuator, to_vector


def closed_loop_matrix(actuator: Actuator, timestep: float) -> np.ndarray:
    """Transition matrix of the unsaturated loop over one mechanical step, at zero reference and speed.

    Only the states that some gain reads are part of the loop: the current always, the integral if ki > 0 and the
    previous error if kd > 0. The matrix is read off `advance` itself, a linear map while the voltage does not saturate.

    Args:
        actuator: motor and gains.
        timestep: mechanical step [s].

    Returns:
        Square matrix, shape (n, n) with n in 1..3.
    """
    linear = dataclasses.replace(actuator, controller=dataclasses.replace(actuator.controller, max_voltage=np.inf))
    parameters = to_vector(linear)
    states = [0]
    states += [1] if actuator.controller.ki > 0 else []
    states += [2] if actuator.controller.kd > 0 else []
    units = np.eye(3)[states]
    columns = [advance(parameters, timestep, i, integral, error, 0.0, 0.0)[:3] for i, integral, error in units]
    return np.array(columns).T[states]


class _Unlimited:
    """A voltage limit that no voltage reaches, be it a number or an array: it compares as neither above nor below."""

    def __neg__(self) -> "_Unlimited":
        return self

    def __lt__(self, other: object) -> bool:
        return False

    def __gt__(self, other: object) -> bool:
        return False


def spectral_radii(vectors: np.ndarray, timestep: float) -> np.ndarray:
    """`spectral_radius` of many actuators at once.

    Args:
        vectors: parameter vectors, shape (m, p), as `codrl_mj.motor.to_vector` makes them.
        timestep: mechanical step [s].

    Returns:
        Shape (m,); the radius of each does not depend on the others, to the last bit.
    """
    substeps = vectors[:, SUBSTEPS]
    columns: list[Any] = list(vectors.T)
    columns[SUBSTEPS], columns[MAX_VOLTAGE] = 1, _Unlimited()
    current, integral, error = np.eye(3)[:, :, np.newaxis]  # all states of all actuators at once: (state, actuator)
    with np.errstate(all="ignore"):
        after = advance(columns, timestep / substeps, current, integral, error, 0.0, 0.0)[:3]  # type: ignore[arg-type]
        matrices = np.stack([np.broadcast_to(entry, (3, len(vectors))) for entry in after])  # (to, from, actuator)
        # what no gain reads is no part of the loop: 0 instead of the eigenvalue of a state of its own
        read = np.stack([np.ones(len(vectors), dtype=bool), vectors[:, KI] > 0, vectors[:, KD] > 0])
        matrices = np.moveaxis(np.where(read[:, np.newaxis] & read, matrices, 0.0), 2, 0)
        finite = np.isfinite(matrices).all(axis=(1, 2))
        values = np.linalg.eigvals(np.where(finite[:, np.newaxis, np.newaxis], matrices, 0.0))
        radii = np.abs(values.astype(np.complex128)).max(axis=1)
        radii = np.where(finite, radii, np.inf)
        return radii**substeps  # a power of the matrix itself would overflow into NaN


def spectral_radius(actuator: Actuator, timestep: float) -> float:
    """Largest absolute eigenvalue of the closed loop over one mechanical step: below 1 the loop is stable.

    Args:
        actuator: motor and gains.
        timestep: mechanical step [s].
    """
    return float(spectral_radii(np.array([to_vector(actuator)]), timestep)[0])


def check_stable(actuator: Actuator, timestep: float) -> None:
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
    raise ValueError(
        f"actuator: the current loop is unstable at a step of {timestep:g} s: spectral radius {radius:.4g}, must be "
        f"< 1. {_remedy(actuator, timestep)}, or pass allow_unstable=True to study it as it is"
    )


def _remedy(actuator: Actuator, timestep: float) -> str:
    """The smallest power-of-two number of electrical substeps that stabilises the loop, else smaller gains."""
    for doubling in range(1, 11):
        substeps = actuator.controller.substeps * 2**doubling
        finer = dataclasses.replace(actuator.controller, substeps=substeps)
        if spectral_radius(dataclasses.replace(actuator, controller=finer), timestep) < 1.0:
            return f"Set controller.substeps = {substeps}, lower the gains, or shorten the step"
    gains = actuator.controller
    return f"Lower the gains (kp = {gains.kp:g}, ki = {gains.ki:g}, kd = {gains.kd:g}): more substeps do not help"
