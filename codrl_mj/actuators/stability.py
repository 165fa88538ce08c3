"""Stability of discrete closed loops: of controller and winding, and of actuators with the joints that they move."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators.model import Inputs, UnstableError
from codrl_mj.actuators.parameters import parameters_type


def parameter_columns(family: Any, numbers: np.ndarray) -> Any:
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


def _closed_loops(
    family: Any, numbers: np.ndarray, timestep: float
) -> tuple[np.ndarray, np.ndarray]:
    """What an electrical step makes of (current, integral, error), (to, from, actuator), and how many are in a step."""
    parameters = parameter_columns(family, numbers)
    dt = timestep / parameters.substeps
    current, integral, error = np.eye(3)[
        :, :, np.newaxis
    ]  # all states of all actuators at once: (state, actuator)
    after = family.electrical_step(
        parameters, dt, current, integral, error, 0.0, 0.0, 0.0, _Unlimited()
    )[:3]
    matrices = np.stack([np.broadcast_to(entry, (3, len(numbers))) for entry in after])
    # what no gain reads is no part of the loop: 0 instead of the eigenvalue of a state of its own
    read = np.stack([np.ones(len(numbers), dtype=bool), parameters.ki > 0, parameters.kd > 0])
    return np.where(read[:, np.newaxis] & read, matrices, 0.0), parameters.substeps


def spectral_radii(family: Any, numbers: np.ndarray, timestep: float) -> np.ndarray:
    """`spectral_radius` of many actuators at once.

    Args:
        family: `codrl_mj.actuators.DCMotorActuator`, or one with its fields.
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
        least = np.minimum(
            np.minimum(1.0 + two + linear + zero, 1.0 - two + linear - zero), 1.0 - abs(zero)
        )
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
    return float(spectral_radii(type(actuator), np.array([actuator.parameter_values]), timestep)[0])


def check_stable(actuator: Any, timestep: float) -> None:
    """Refuse an actuator whose closed loop is unstable at this step.

    Args:
        actuator: motor and gains.
        timestep: mechanical step [s].

    Raises:
        ValueError: the spectral radius is 1 or more; the message has the number and a remedy that
            was checked.
    """
    radius = spectral_radius(actuator, timestep)
    if radius < 1.0:
        return
    gains = actuator.controller
    remedy = (
        f"Lower the gains (kp = {gains.kp:g}, ki = {gains.ki:g}, kd = {gains.kd:g}): more substeps"
        " do not help"
    )
    for substeps in (gains.substeps * 2**doubling for doubling in range(1, 11)):
        finer = dataclasses.replace(
            actuator, controller=dataclasses.replace(gains, substeps=substeps)
        )
        if spectral_radius(finer, timestep) < 1.0:
            remedy = f"Set controller.substeps = {substeps}, lower the gains, or shorten the step"
            break
    raise UnstableError(
        f"actuator: the current loop is unstable at a step of {timestep:g} s: spectral radius"
        f" {radius:.4g}, must be < 1. {remedy}, or pass allow_unstable=True to study it as it is"
    )


class Joints(NamedTuple):
    """Joints and shafts at rest, linearized without gravity, springs, contacts and limits.

    `inertia` (v, v) and `damping` (v,) are of the degrees of freedom, `moments` (n, v) the speeds
    of shafts for theirs. The `integrator` is `euler`, which moves positions by the old speeds,
    `semi-implicit` or `rk4`; unless by RK4, `explicit_damping` damps the old speeds.
    """

    inertia: np.ndarray
    damping: np.ndarray
    moments: np.ndarray
    integrator: str
    explicit_damping: bool

    def transition(self, timestep: float) -> np.ndarray:
        """Return speeds and shafts' positions after a step, for speeds, positions and held torques: (v + n, v + 2n)."""
        shafts, freedoms = self.moments.shape
        speeds, positions = slice(freedoms), slice(freedoms, freedoms + shafts)
        after, drag = np.eye(freedoms + 2 * shafts), np.diag(self.damping)
        if self.integrator == "rk4":
            rate = np.zeros_like(after)
            rate[speeds] = np.linalg.solve(
                self.inertia, np.hstack([-drag, 0.0 * self.moments.T, self.moments.T])
            )
            rate[positions, speeds] = self.moments
            for order in (4, 3, 2, 1):  # Of a linear system RK4 is the Taylor series of order 4.
                after = np.eye(len(rate)) + timestep / order * rate @ after
        else:
            implicit, explicit = (0.0, timestep) if self.explicit_damping else (timestep, 0.0)
            pushes = np.hstack(
                [self.inertia - explicit * drag, 0.0 * self.moments.T, timestep * self.moments.T]
            )
            after[speeds] = np.linalg.solve(self.inertia + implicit * drag, pushes)
            moving = np.eye(len(after))[speeds] if self.integrator == "euler" else after[speeds]
            after[positions] += timestep * self.moments @ moving
        return after[: positions.stop]


PERTURBATION = -1e-6
"""Added to each state in turn. It is negative so that counters and times stay on the side where a sample is due."""
WITHOUT_FRICTION = {"stribeck_friction": 0.0, "gear_efficiency": 1.0, "deadband": 0.0}
"""Parameters of families that have them -> values without friction and dead zone, which hide small motions."""


def linearize(
    actuator: Any,
    advance: Callable[..., Any],
    timestep: float,
    inertia: float,
    change: float = PERTURBATION,
) -> np.ndarray:
    """Linearize an actuator's `advance` at rest, for each mechanical step until its samples repeat.

    Args:
        actuator: the actuator.
        advance: its family's `advance`, compiled or not.
        timestep: mechanical step [s].
        inertia: inertia [kg*m^2] that it is told; `inf` where it is told none.
        change: what is added to each state in turn.

    Returns:
        Shape (steps, s + 1, s + 2): the new states and the torque, for the states, the position and
            the speed.
    """
    family: Any = type(actuator)
    period = actuator.steps_per_sample(timestep)
    parameters, count = parameters_type(family)(*actuator.parameter_values), len(family.State._fields)
    parameters = parameters._replace(
        **{name: WITHOUT_FRICTION[name] for name in WITHOUT_FRICTION.keys() & {*parameters._fields}}
    )
    maps, state = [], np.zeros(count)

    def advanced(point: np.ndarray, time: float) -> np.ndarray:
        *states, position, speed = point.tolist()
        inputs = Inputs(0.0, position, speed, time, 0.0, inertia)
        after, torque, _ = advance(parameters, timestep, family.State(*states), inputs)
        return np.array([*after, torque])

    # The first period only brings counters and times to where they repeat.
    for step in range(2 * period):
        time, point = step * timestep, np.append(state, [0.0, 0.0])
        rest = advanced(point, time)
        if step >= period:
            changed = [advanced(point + row, time) - rest for row in change * np.eye(count + 2)]
            maps.append(np.stack(changed, axis=1) / change)
        state = rest[:count]
    return np.array(maps)


def loop_radius(joints: Joints, loops: Sequence[np.ndarray], timestep: float) -> float:
    """Return the spectral radius of actuators and joints together, over the steps after which their samples repeat.

    Args:
        joints: the joints, with a shaft for each actuator.
        loops: the actuators, as `linearize` returns them.
        timestep: mechanical step [s].
    """
    shafts, freedoms = joints.moments.shape
    starts = np.cumsum([freedoms + shafts, *(len(loop[0]) - 1 for loop in loops)])
    now, transition = np.eye(starts[-1]), joints.transition(timestep)
    product = now
    for step in range(math.lcm(*map(len, loops))):
        torques, matrix = np.zeros((shafts, len(now))), np.zeros_like(now)
        for index, (loop, start, end) in enumerate(
            zip(loops, starts[:-1], starts[1:], strict=True)
        ):
            seen = np.vstack(
                [now[start:end], now[freedoms + index], joints.moments[index] @ now[:freedoms]]
            )
            matrix[start:end], torques[index] = np.split(loop[step % len(loop)] @ seen, [-1])
        matrix[: starts[0]] = transition @ np.vstack([now[: starts[0]], torques])
        product = matrix @ product
    if not np.isfinite(product).all():
        return math.inf
    # A state, other than a speed, that nothing else reads, or that nothing else changes, is no part
    # of a loop.
    live, coupled = (
        np.ones(len(product), dtype=bool),
        (product != 0.0) & ~np.eye(len(product), dtype=bool),
    )
    coupled[:freedoms, :freedoms] = True
    while (
        left := live & coupled[live].any(axis=0) & coupled[:, live].any(axis=1)
    ).sum() < live.sum():
        live = left
    return float(np.abs(np.linalg.eigvals(product[np.ix_(live, live)])).max(initial=0.0))
