"""Model of a position servo that is fitted to its commands and encoder."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple, Self

import numpy as np

from codrl_mj.identify.estimate import Simulate
from codrl_mj.identify.log import (
    BLOCK_DURATION,
    Log,
    Segment,
    ServoInputs,
    cut_segments,
    initial_state,
    sensor_deviation,
    smoothed_speeds,
)
from codrl_mj.identify.models import ShaftModel
from codrl_mj.identify.parameters import (
    FRICTION_PARAMETERS,
    PARAMETERS,
    ShaftParameters,
    shaft_parameters,
)
from codrl_mj.identify.servo_simulation import (
    ServoParameters,
    limit_rate,
    simulate_position_servo,
)

SERVO_SEGMENT = 1.0
"""Duration [s] of the segments of a servo."""
NO_LIMIT = PARAMETERS["stall_torque"].upper
"""Stall torque of a servo that never reaches its limit [N*m]."""
_DELAYS = (0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
"""Delays of the command [s] that are tried for an initial guess."""
_LIMITS = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Angle errors at the limit of the torque, over the largest error, that are tried."""
_WINDOW = 0.02
"""Duration [s] that positions are smoothed over for an initial guess."""
_SPREADS = (1.0, 0.6, 0.3, 0.15)
"""Standard deviations of the random search by round, in logarithms or in scales."""
_VARIATIONS = 60
"""Variations in a round of the random search."""
_CREEPING = 0.05
"""Speed, over the RMS of the speeds, below which friction may hold the shaft."""


class _Guess(NamedTuple):
    """Coefficients of a regression of the motion on a servo's torques, and their residual."""

    coefficients: np.ndarray  # inertia, damping, Coulomb friction, gravity, constant, over the gain
    residual: float  # RMS of the residuals over the RMS of the target
    delay: float  # [s]
    limit: float  # largest angle error that increases the torque [rad]


class _Candidate(NamedTuple):
    """All parameters of an initial guess."""

    start: dict[str, float]
    sizes: dict[str, float]  # typical size of each parameter, > 0


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ServoModel(ShaftModel):
    """Shaft under a proportional law: torque = clip(gain*(delayed command - position)) - damping.

    The damping is the sum of viscous friction, back-EMF kT*kE/R and a derivative gain: a log of
    commands and positions contains only their sum.
    """

    driven_by: str = "command"
    output: str = "position"
    segment: float = SERVO_SEGMENT
    supply_voltage: float = math.nan
    """Voltage [V] that position gain and stall torque refer to; not a number: none was logged."""
    gain: float = math.nan
    """Register that the position gain refers to; not a number: none was logged."""
    limits_torque: bool = False
    """True if the limit applies to the torque after the damping; False: to the duty, before it."""

    steps: ClassVar = np.array([1e-4, 1e-2])
    difference_step: ClassVar = 1e-3

    def shaft_parameters(self, values: np.ndarray) -> ShaftParameters:
        """Return the parameters of the shaft, from free parameters of shape (p,)."""
        parameters = self.all_values(values)
        if "inertia" not in parameters:
            parameters["inertia"] = parameters["armature"] + parameters["load_inertia"]
        # Only a limit of the torque tells the servo's own damping from the viscous friction.
        viscous = parameters.get("viscous_friction", 0.0) if self.limits_torque else 0.0
        parameters["viscous_friction"] = viscous
        # Friction that grows with the load applies to the torque that is left after the back-EMF.
        return shaft_parameters(parameters, 1.0, max(parameters["damping"] - viscous, 0.0))

    def servo_parameters(self, values: np.ndarray) -> ServoParameters:
        """Return the parameters of the control law, from free parameters of shape (p,)."""
        parameters = self.all_values(values)
        return ServoParameters(
            parameters["position_gain"],
            parameters.get("stall_torque", NO_LIMIT),
            parameters["command_delay"],
            parameters["zero"],
            float(self.limits_torque),
        )

    def input_quotients(self, values: np.ndarray) -> list[float]:
        """Return the numbers that tell how commands move the shaft, from free parameters (p,)."""
        shaft, servo = self.shaft_parameters(values), self.servo_parameters(values)
        torques = [servo.position_gain, servo.stall_torque]
        # A limit of the torque applies to the damping, but not to the viscous friction.
        torques += [shaft.viscous] if self.limits_torque else []
        others = [servo.command_delay, servo.zero, self.all_values(values)["max_velocity"]]
        return [torque / shaft.inertia for torque in torques] + others

    def simulator(self, values: np.ndarray) -> Simulate:
        """Return a function that simulates the positions [rad] of a segment."""
        shaft, servo = self.shaft_parameters(values), self.servo_parameters(values)
        undamped = shaft._replace(braking=0.0)
        max_velocity = self.all_values(values)["max_velocity"]

        def simulate(segment: Segment, state: np.ndarray) -> np.ndarray:
            inputs = segment.servo
            assert inputs is not None
            targets = inputs.targets
            if max_velocity < PARAMETERS["max_velocity"].upper:
                targets = limit_rate(inputs.times, targets, max_velocity)
            return simulate_position_servo(
                segment.times,
                inputs.times,
                targets,
                inputs.volts,
                inputs.gains,
                state[0],
                state[1],
                servo,
                shaft,
                undamped,
            )

        return simulate

    def segments(self, logs: Sequence[Log], min_step: float = 0.0) -> list[Segment]:  # noqa: ARG002
        """Cut logs into segments with the commands that lead to them; no rows are combined."""
        segments: list[Segment] = []
        block = -1
        for index, log in enumerate(logs):
            position, deviation = log.signals["position"], sensor_deviation(log, "position")
            targets = log.signals["command"]
            ones = np.ones(len(log.time))
            volts = log.signals["bus"] / self.supply_voltage if log.has("bus") else ones
            gains = log.signals["gain"] / self.gain if log.has("gain") else ones
            block_start = -math.inf
            for rows in cut_segments(log, self.segment):
                times = log.time[rows]
                if times[0] - block_start >= BLOCK_DURATION - 1e-3:
                    block, block_start = block + 1, times[0]
                until = slice(0, rows.stop)
                segments.append(
                    Segment(
                        index,
                        block,
                        rows,
                        times,
                        targets[rows],
                        np.zeros(len(times)),
                        np.zeros(len(times)),
                        position[rows],
                        deviation,
                        initial_state(log, rows),
                        ServoInputs(
                            log.time[until],
                            targets[until],
                            volts[rows],
                            gains[rows],
                        ),
                    )
                )
        return segments

    def half_rate_segments(self, logs: Sequence[Log]) -> list[Segment]:
        """Cut logs into segments of which every second position counts, but every command."""
        segments = []
        for segment in self.segments(logs):
            inputs = segment.servo
            assert inputs is not None
            half = inputs._replace(volts=inputs.volts[::2], gains=inputs.gains[::2])
            arrays = ("times", "inputs", "slopes", "speeds", "measured")
            thinned = {name: getattr(segment, name)[::2] for name in arrays}
            segments.append(segment._replace(servo=half, **thinned))
        return segments

    def driving_torque(self, values: np.ndarray, segments: Sequence[Segment]) -> float:
        """Return the RMS of the torque [N*m] that the control law asks for."""
        servo = self.servo_parameters(values)
        errors = [angle_errors(segment, servo.command_delay) for segment in segments]
        torque = servo.position_gain * np.concatenate(errors)
        return float(
            np.sqrt(np.mean(np.clip(torque, -servo.stall_torque, servo.stall_torque) ** 2))
        )

    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """Return the model with its free parameters set, and two initial guesses.

        Regressions differ in the delay of the command and in the error at which the torque reaches
        its limit; the best of them is improved by a random search.
        """
        known = self.known
        inertia = "armature" if "load_inertia" in known else "inertia"
        friction = [
            name for name in FRICTION_PARAMETERS[self.friction] if name != "viscous_friction"
        ]
        names = ["position_gain", "damping", inertia, *friction, "command_delay"]
        names += ["mgl", "zero"] if self.rig == "pendulum" else []
        names += self.estimated
        free = tuple(name for name in dict.fromkeys(names) if name not in known)
        regression = _Regression(segments, self.rig == "pendulum")
        guesses = [regression.solve(delay, share) for delay in _DELAYS for share in _LIMITS]
        candidates = [self._values_of(guess, segments) for guess in guesses]
        scales = np.array([candidates[0].sizes[name] for name in free])
        positive = np.array([PARAMETERS[name].lower >= 0.0 for name in free], bool)
        starts = [np.array([candidate.start[name] for name in free]) for candidate in candidates]
        starts = [
            np.where(positive & ~(values > 0.02 * scales), 0.3 * scales, values)
            for values in starts
        ]
        model = dataclasses.replace(self, names=free, scales=scales)
        return model, model.search(segments, starts, positive)

    def search(
        self, segments: Sequence[Segment], starts: Sequence[np.ndarray], positive: np.ndarray
    ) -> list[np.ndarray]:
        """Return two starts: the best of a random search, and the best of the given ones.

        The regressions are biased by delays and by friction that holds the shaft. A simulation of
        all segments takes a millisecond, so that a few hundred random variations are affordable.

        Args:
            segments: segments of a servo's logs.
            starts: initial guesses, each of shape (p,).
            positive: True for parameters that cannot be negative, shape (p,).
        """
        lower, upper = self.bounds

        def error(values: np.ndarray) -> float:
            simulate = self.simulator(values)
            errors = [
                np.abs(simulate(segment, segment.state) - segment.measured).mean()
                for segment in segments
            ]
            mean = float(np.mean(errors))
            return mean if math.isfinite(mean) else math.inf

        ranked = sorted((error(values), index) for index, values in enumerate(starts))
        best_error, best = ranked[0][0], starts[ranked[0][1]]
        regressed, random = best, np.random.default_rng(0)
        lags = {"command_delay", "damping", "position_gain"} <= {*self.names}
        delay, damping = (
            self.names.index(name) if lags else 0 for name in ("command_delay", "damping")
        )
        for spread in _SPREADS:
            for _ in range(_VARIATIONS):
                # A change of a few parameters improves more often than a change of all of them.
                chosen = random.random(len(best)) < 2.5 / len(best)
                change = spread * random.standard_normal(len(best)) * chosen
                values = np.where(
                    positive, best * np.exp(change), best + 2.0 * change * self.scales
                )
                # A delay and a damping cause the same lag behind a slow command.
                if lags and random.random() < 0.5:
                    lag = spread * 0.02 * random.standard_normal()
                    values[delay] += lag
                    values[damping] -= lag * values[self.names.index("position_gain")]
                values = np.clip(values, lower, upper)
                if (new_error := error(values)) < best_error:
                    best_error, best = new_error, values
        return [best, regressed]

    def _values_of(self, guess: _Guess, segments: Sequence[Segment]) -> _Candidate:
        """Return all parameters of a guess, and the typical size of each."""
        parameters = {**self.defaults, **self.known}
        inertia, damping, coulomb, gravity, constant = map(float, guess.coefficients)
        gain = parameters.get("position_gain", 1.0)
        if "position_gain" not in self.known:
            if parameters.get("mgl", 0.0) > 0.0 and gravity > 0.0:
                gain = parameters["mgl"] / gravity
            elif "inertia" in self.known and inertia > 0.0:
                gain = self.known["inertia"] / inertia
        errors = np.concatenate([angle_errors(segment, guess.delay) for segment in segments])
        largest = float(np.percentile(np.abs(errors), 99.9))
        total = max(inertia * gain, 1e-4 * gain)
        start = parameters | {
            "position_gain": gain,
            "damping": damping * gain,
            "inertia": total,
            "armature": max(total - parameters.get("load_inertia", 0.0), 0.1 * total),
            "coulomb_friction": coulomb * gain,
            "command_delay": guess.delay,
            "mgl": gravity * gain,
            "zero": -constant / gravity if gravity > 0.0 else 0.0,
            "stall_torque": min(guess.limit, largest) * gain,
            "gear_efficiency": 0.9,
            "stribeck_friction": 0.1 * max(coulomb * gain, 1e-3 * gain * largest),
            "stribeck_speed": 0.3,
            "max_velocity": _peak_speed(segments),
        }
        torque = gain * float(np.sqrt(np.mean(errors**2)))
        speed = float(np.sqrt(np.mean(_speeds(segments) ** 2)))
        sizes = {name: max(abs(value), 1e-9) for name, value in start.items()}
        sizes |= {
            "coulomb_friction": 0.1 * torque,
            "damping": 0.1 * torque / max(speed, 1e-9),
            "stribeck_friction": 0.1 * torque,
            "command_delay": 0.01,
            "zero": 0.05,
            "gear_efficiency": 0.1,
        }
        return _Candidate(start, sizes)


def delayed_commands(segment: Segment, times: np.ndarray, delay: float) -> np.ndarray:
    """Return the held command at times, late by a delay."""
    inputs = segment.servo
    assert inputs is not None
    rows = np.searchsorted(inputs.times, times - delay, side="right") - 1
    delayed: np.ndarray = inputs.targets[np.maximum(rows, 0)]
    return delayed


def angle_errors(segment: Segment, delay: float) -> np.ndarray:
    """Return the angle errors [rad] of the control law at the rows of a segment, times its gain."""
    assert segment.servo is not None
    errors: np.ndarray = (
        delayed_commands(segment, segment.times, delay) - segment.measured
    ) * segment.servo.gains
    return errors


def _speeds(segments: Sequence[Segment]) -> np.ndarray:
    """Return the smoothed speeds [rad/s] of all segments."""
    return np.concatenate(
        [
            smoothed_speeds(segment.times, segment.measured, segment.times, _WINDOW)
            for segment in segments
        ]
    )


def _peak_speed(segments: Sequence[Segment]) -> float:
    """Return a speed [rad/s] that hardly any row exceeds."""
    return float(np.percentile(np.abs(_speeds(segments)), 99.0))


class _Regression:
    """Regression of the integral of the angle error on the integrals of the other torques."""

    def __init__(self, segments: Sequence[Segment], has_gravity: bool) -> None:
        """Compute the columns, which do not depend on the delay and on the torque's limit."""
        self.segments, self.free = segments, [0, 1, 2, 3, 4] if has_gravity else [0, 1, 2]
        creeping = _CREEPING * float(np.sqrt(np.mean(_speeds(segments) ** 2)))
        self.edges: list[np.ndarray] = []
        self.moves: list[np.ndarray] = []
        tables = []
        for segment in segments:
            times = segment.times
            window = max(_WINDOW, 5.0 * float(np.median(np.diff(times))))
            speed = smoothed_speeds(times, segment.measured, times, window)
            columns = (speed, np.sign(speed), np.sin(segment.measured), np.ones(len(times)))
            edges = np.searchsorted(times, np.arange(times[0], times[-1] + 1e-9, 2.5 * window))
            edges = np.unique(np.minimum(edges, len(times) - 1))
            # Where friction may hold the shaft, its torque is unknown.
            moves = np.array(
                [
                    np.abs(speed[start : end + 1]).min() > creeping
                    for start, end in itertools.pairwise(edges)
                ],
                bool,
            )
            integrals = [np.diff(_trapezoids(times, column)[edges])[moves] for column in columns]
            tables.append(np.stack([np.diff(speed[edges])[moves], *integrals], axis=1))
            self.edges.append(edges)
            self.moves.append(moves)
        self.table = np.concatenate(tables)[:, self.free]

    def solve(self, delay: float, share: float) -> _Guess:
        """Return the coefficients for a delay [s] and a limit, as a share of the largest error."""
        errors = [angle_errors(segment, delay) for segment in self.segments]
        limit = share * max(float(np.percentile(np.abs(np.concatenate(errors)), 99.9)), 1e-9)
        targets = []
        for segment, error, edges, moves in zip(
            self.segments, errors, self.edges, self.moves, strict=True
        ):
            assert segment.servo is not None
            drive = segment.servo.volts * np.clip(error, -limit, limit)
            targets.append(np.diff(_trapezoids(segment.times, drive)[edges])[moves])
        target, coefficients = np.concatenate(targets), np.zeros(5)
        if len(target) <= len(self.free):
            return _Guess(coefficients, math.inf, delay, limit)
        norms = np.maximum(np.linalg.norm(self.table, axis=0), 1e-30)
        solution = np.linalg.lstsq(self.table / norms, target, rcond=1e-6)[0] / norms
        coefficients[self.free] = solution
        residual = float(np.linalg.norm(target - self.table @ solution))
        ratio = residual / max(float(np.linalg.norm(target)), 1e-30)
        return _Guess(coefficients, ratio, delay, limit)


def _trapezoids(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the integral of values over time by the trapezoidal rule, shape (n,)."""
    return np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times)))


def largest_torque(
    model: ServoModel, values: np.ndarray, segments: Sequence[Segment], share: float
) -> float:
    """Return the torque [N*m] that the law of a servo does not exceed in a share of the rows.

    It is the torque at standstill for the angle error, or after the damping if that is limited.
    """
    servo, damping = model.servo_parameters(values), model.shaft_parameters(values).braking
    torques = []
    for segment in segments:
        torque = servo.position_gain * angle_errors(segment, servo.command_delay)
        if model.limits_torque:
            torque -= damping * smoothed_speeds(
                segment.times, segment.measured, segment.times, _WINDOW
            )
        torques.append(np.abs(torque))
    return float(np.quantile(np.concatenate(torques), share))
