"""Stability of discrete closed loops: current loops, and actuators with their joints."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, cast

import numpy as np

from codrl_mj.actuators.model import ActuatorModel, Advance, Inputs, UnstableError
from codrl_mj.actuators.parameters import FieldValue, parameters_type

# The function is written for numbers, and computes with arrays here.
ElectricalStep = Callable[..., tuple[Any, ...]]
"""Step of a current loop: see `codrl_mj.actuators.current_loop.electrical_step`."""


class Gains(Protocol):
    """Gains and electrical steps of a current loop, such as `CurrentLoop`."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[FieldValue]]]

    @property
    def kp(self) -> float:
        """Proportional gain [V/A]."""

    @property
    def ki(self) -> float:
        """Integral gain [V/(A*s)]."""

    @property
    def kd(self) -> float:
        """Derivative gain [V*s/A]."""

    @property
    def substeps(self) -> int:
        """Electrical steps per mechanical step."""


class LoopActuator(Protocol):
    """Actuator with a current loop that takes electrical steps, such as `DCMotorActuator`."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[FieldValue]]]
    electrical_step: ClassVar[ElectricalStep]

    @property
    def controller(self) -> Gains:
        """The current loop."""

    @property
    def parameter_values(self) -> tuple[float, ...]:
        """Parameters, as in `ActuatorModel.parameter_values`."""


class ParameterColumns(Protocol):
    """Parameters of several actuators, each an array with a number for each actuator."""

    def __getattr__(self, name: str) -> np.ndarray: ...


def parameter_columns(family: type, parameter_values: np.ndarray) -> ParameterColumns:
    """Return the parameters of m actuators, each as an array (m,), from rows of values (m, p)."""
    return cast(ParameterColumns, parameters_type(family)(*parameter_values.T))


class _Unlimited:
    """Voltage limit that is never reached: it is neither above nor below any number or array."""

    def __neg__(self) -> "_Unlimited":
        return self

    def __lt__(self, value: object) -> bool:
        return False

    def __gt__(self, value: object) -> bool:
        return False


def _closed_loops(
    family: type[LoopActuator], parameter_values: np.ndarray, timestep: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the transition matrices of an electrical step, and the number of steps.

    Matrices have the shape (state after, state before, actuator); the states are current, integral
    and error. There are `substeps` electrical steps in a mechanical step.
    """
    parameters = parameter_columns(family, parameter_values)
    # A unit matrix of states, for all actuators at once, shape (state, state, actuator): linear
    # equations map it to their own matrix.
    dt = timestep / parameters.substeps
    current, integral, error = np.eye(3)[:, :, np.newaxis]
    state_after = family.electrical_step(
        parameters, dt, current, integral, error, 0.0, 0.0, 0.0, _Unlimited()
    )[:3]
    matrices = np.stack(
        [np.broadcast_to(entry, (3, len(parameter_values))) for entry in state_after]
    )
    # A state that no gain uses is not part of the loop: its entries become 0, so that its own
    # eigenvalue does not count.
    is_used = np.stack(
        [np.ones(len(parameter_values), dtype=bool), parameters.ki > 0, parameters.kd > 0]
    )
    return np.where(is_used[:, np.newaxis] & is_used, matrices, 0.0), parameters.substeps


def spectral_radii(
    family: type[LoopActuator], parameter_values: np.ndarray, timestep: float
) -> np.ndarray:
    """Return the spectral radii of many actuators; see `spectral_radius`.

    Args:
        family: `codrl_mj.actuators.DCMotorActuator`, or a family with its fields.
        parameter_values: shape (m, p), rows as in `ActuatorModel.parameter_values`.
        timestep: mechanical step [s].

    Returns:
        Shape (m,); each radius is independent of the other actuators, to the last bit.
    """
    with np.errstate(all="ignore"):
        loops, substeps = _closed_loops(family, parameter_values, timestep)
        matrices = np.moveaxis(loops, 2, 0)
        finite = np.isfinite(matrices).all(axis=(1, 2))
        values = np.linalg.eigvals(np.where(finite[:, np.newaxis, np.newaxis], matrices, 0.0))
        radii = np.abs(values.astype(np.complex128)).max(axis=1)
        radii = np.where(finite, radii, np.inf)
        # The radius is raised to the power, because a power of the matrix could overflow into NaN.
        powers: np.ndarray = radii**substeps
        return powers


MARGIN = 1e-9
"""Relative margin by which Jury's conditions must hold or fail to decide a case. It is far above
the rounding errors of either method.
"""


def stability_radii(
    family: type[LoopActuator], parameter_values: np.ndarray, timestep: float
) -> np.ndarray:
    """Return 0 for stable loops, infinity for unstable ones, and the spectral radius if in doubt.

    Jury's criterion decides all clear cases, which saves nearly all of the eigenvalues.

    Returns:
        Shape (m,): below 1 exactly where the spectral radii are.
    """
    with np.errstate(all="ignore"):
        (a, b, c), (d, e, f), (g, h, i) = _closed_loops(family, parameter_values, timestep)[0]
        # The characteristic polynomial is z^3 + quadratic*z^2 + linear*z + constant.
        quadratic = -(a + e + i)
        linear = (a * e - b * d) + (a * i - c * g) + (e * i - f * h)
        constant = -(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
        margin = MARGIN * (1.0 + abs(quadratic) + abs(linear) + abs(constant)) ** 2
        smallest = np.minimum(
            np.minimum(1.0 + quadratic + linear + constant, 1.0 - quadratic + linear - constant),
            1.0 - abs(constant),
        )
        all_conditions = np.minimum(
            smallest, 1.0 - constant * constant - abs(linear - constant * quadratic)
        )
        smallest = np.where(smallest > margin, all_conditions, smallest)
        radii = np.where(smallest > margin, 0.0, np.where(smallest < -margin, np.inf, np.nan))
    doubtful = np.isnan(radii)
    if doubtful.any():
        radii[doubtful] = spectral_radii(family, parameter_values[doubtful], timestep)
    return radii


def spectral_radius(actuator: LoopActuator, timestep: float) -> float:
    """Return the largest absolute eigenvalue of the closed loop over one mechanical step.

    The loop is stable if it is below 1.

    Args:
        actuator: motor and gains.
        timestep: mechanical step [s].
    """
    return float(spectral_radii(type(actuator), np.array([actuator.parameter_values]), timestep)[0])


def check_stable(actuator: LoopActuator, timestep: float) -> None:
    """Raise if an actuator's closed loop is unstable at this step.

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
        # The remedy is tried before it is proposed: some loops are unstable at any number of
        # substeps.
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

    `inertia` (v, v) and `damping` (v,) are those of the degrees of freedom; `moments` (n, v)
    convert their speeds to shaft speeds. The `integrator` is `euler`, which moves positions by the
    old speeds, `semi-implicit` or `rk4`. Except with RK4, `explicit_damping` applies damping to the
    old speeds.
    """

    inertia: np.ndarray
    damping: np.ndarray
    moments: np.ndarray
    integrator: str
    explicit_damping: bool

    def transition(self, timestep: float) -> np.ndarray:
        """Return the map from speeds, positions and torques to new speeds and positions.

        Its shape is (v + n, v + 2n).
        """
        shafts, freedoms = self.moments.shape
        speeds, positions = slice(freedoms), slice(freedoms, freedoms + shafts)
        after, drag = np.eye(freedoms + 2 * shafts), np.diag(self.damping)
        if self.integrator == "rk4":
            rate = np.zeros_like(after)
            rate[speeds] = np.linalg.solve(
                self.inertia, np.hstack([-drag, 0.0 * self.moments.T, self.moments.T])
            )
            rate[positions, speeds] = self.moments
            # For a linear system, RK4 is the Taylor series of order 4.
            for order in (4, 3, 2, 1):
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
"""Perturbation added to each state in turn. It is negative, so a counter that is due stays due."""
WITHOUT_FRICTION = {
    "stribeck_friction": 0.0,
    "gear_efficiency": 1.0,
    "deadband": 0.0,
    "start_duty": 0.0,
    "encoder_counts": 0.0,
}
"""Parameter values without friction, dead zone and resolution, which would hide small motions."""


def linearize(
    actuator: ActuatorModel,
    advance: Advance,
    timestep: float,
    inertia: float,
    change: float = PERTURBATION,
) -> np.ndarray:
    """Linearize an actuator's `advance` at rest, for each mechanical step of a sample period.

    Args:
        actuator: the actuator.
        advance: `advance` of its family, compiled or not.
        timestep: mechanical step [s].
        inertia: inertia [kg*m^2] passed to `advance`; `inf` if unknown.
        change: perturbation added to each state in turn.

    Returns:
        Shape (steps, s + 1, s + 2): the new states and the torque, for the states, the position and
        the speed.
    """
    family = type(actuator)
    period = actuator.steps_per_sample(timestep)
    parameters = parameters_type(family)(*actuator.parameter_values)
    count = len(family.State._fields)
    parameters = parameters._replace(
        **{name: WITHOUT_FRICTION[name] for name in WITHOUT_FRICTION.keys() & {*parameters._fields}}
    )
    maps, state = [], np.zeros(count)

    def advanced(point: np.ndarray, time: float) -> np.ndarray:
        *states, position, speed = point.tolist()
        inputs = Inputs(0.0, position, speed, time, 0.0, inertia)
        after, torque, _ = advance(parameters, timestep, family.State._make(states), inputs)
        return np.array([*after, torque])

    # The first period is not recorded: it only makes counters and times periodic.
    for step in range(2 * period):
        time, point = step * timestep, np.append(state, [0.0, 0.0])
        rest = advanced(point, time)
        if step >= period:
            changed = [advanced(point + row, time) - rest for row in change * np.eye(count + 2)]
            maps.append(np.stack(changed, axis=1) / change)
        state = rest[:count]
    return np.array(maps)


def loop_radius(joints: Joints, loops: Sequence[np.ndarray], timestep: float) -> float:
    """Return the spectral radius of actuators and joints together over a sample period.

    Args:
        joints: the joints, with a shaft for each actuator.
        loops: the actuators, as `linearize` returns them.
        timestep: mechanical step [s].
    """
    shafts, freedoms = joints.moments.shape
    starts = np.cumsum([freedoms + shafts, *(len(loop[0]) - 1 for loop in loops)])
    state, transition = np.eye(starts[-1]), joints.transition(timestep)
    product = state
    for step in range(math.lcm(*map(len, loops))):
        torques, matrix = np.zeros((shafts, len(state))), np.zeros_like(state)
        for index, (loop, start, end) in enumerate(
            zip(loops, starts[:-1], starts[1:], strict=True)
        ):
            inputs = np.vstack(
                [
                    state[start:end],
                    state[freedoms + index],
                    joints.moments[index] @ state[:freedoms],
                ]
            )
            matrix[start:end], torques[index] = np.split(loop[step % len(loop)] @ inputs, [-1])
        matrix[: starts[0]] = transition @ np.vstack([state[: starts[0]], torques])
        product = matrix @ product
    if not np.isfinite(product).all():
        return math.inf
    # States that no other state reads, or that no other state changes, are not part of a loop and
    # are removed. Speeds always remain.
    live = np.ones(len(product), dtype=bool)
    coupled = (product != 0.0) & ~np.eye(len(product), dtype=bool)
    coupled[:freedoms, :freedoms] = True
    while (
        remaining := live & coupled[live].any(axis=0) & coupled[:, live].any(axis=1)
    ).sum() < live.sum():
        live = remaining
    return float(np.abs(np.linalg.eigvals(product[np.ix_(live, live)])).max(initial=0.0))
