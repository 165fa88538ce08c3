"""Models of a winding and of a shaft that are fitted, with initial guesses from regressions."""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import numpy as np

from codrl_mj.identify.estimate import Fit, Model, Simulate, best_initial_state
from codrl_mj.identify.log import (
    BLOCK_DURATION,
    SEGMENT_DURATION,
    SHAFT_STEP,
    Log,
    Segment,
    cut_segments,
    gapless_stretches,
    has_motion,
    initial_state,
    remove_spikes,
    sensor_deviation,
    shift_signal,
    smoothed_speeds,
)
from codrl_mj.identify.parameters import (
    ELECTRICAL,
    FRICTION,
    FRICTION_PARAMETERS,
    PARAMETERS,
    RIG_PARAMETERS,
    ShaftParameters,
    shaft_parameters,
)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class WindingModel(Model):
    """Winding, L di/dt = u - R i - kE n w, solved exactly for held voltages and mean speeds."""

    driven_by: str = "voltage"
    output: str = "current"
    shaft: "Fit[ShaftModel] | None" = None
    """Shaft driven by the current, to compute the speed between rows; None: not used."""

    steps: ClassVar = np.array([1e-3])

    def simulator(self, values: np.ndarray) -> Simulate:
        """Return a function that simulates the currents [A] of a segment with parameters (p,)."""
        from codrl_mj.identify.simulation import simulate_winding

        parameters = self.all_values(values)
        resistance, inductance = parameters["resistance"], parameters["inductance"]
        # The speeds of segments are those of the output.
        back_emf_constant = parameters.get("back_emf_constant", 0.0) * parameters["gear_ratio"]
        return lambda segment, state: simulate_winding(
            segment.times,
            segment.inputs,
            segment.speeds,
            state[0],
            resistance,
            inductance,
            back_emf_constant,
        )

    def segments(
        self, logs: Sequence[Log], speeds: Sequence[np.ndarray] | None = None
    ) -> list[Segment]:
        """Cut logs into segments of one block each; `speeds` [rad/s] replace those of the logs."""
        segments: list[Segment] = []
        for index, log in enumerate(logs):
            volts, deviation = log.signals["voltage"], sensor_deviation(log, "current")
            speed = self._mean_speeds(log) if speeds is None else speeds[index]
            for rows in cut_segments(log, BLOCK_DURATION):
                times, current = log.time[rows], log.signals["current"][rows]
                arrays = times, volts[rows], np.zeros(len(times)), speed[rows]
                segments.append(
                    Segment(index, len(segments), rows, *arrays, current, deviation, current[:1])
                )
        return segments

    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """Return the model with its free parameters set, and initial guesses from regressions.

        The integral of the voltage over a window is R times the integral of the current, plus L
        times the change of the current, plus kE times the change of the angle. Each guess uses
        another window length.
        """
        moving = any(np.any(segment.speeds) for segment in segments)
        free = tuple(
            name
            for name in ELECTRICAL
            if name not in self.known and (moving or name != "back_emf_constant")
        )
        fixed = {**self.defaults, "back_emf_constant": 0.0, **self.known}
        starts = []
        # Short windows show the inductance, long ones average the noise.
        for count in (2, 8, 32):
            rows = []
            for segment in segments:
                steps = np.diff(segment.times)
                current = segment.measured
                speeds = segment.speeds[:-1] * fixed["gear_ratio"]
                edges = np.arange(0, len(current), min(count, len(current) - 1))
                rates = 0.5 * (current[1:] + current[:-1]), speeds, segment.inputs[:-1]
                charge, angle, flux = (
                    np.diff(np.append(0.0, np.cumsum(rate * steps))[edges]) for rate in rates
                )
                rows.append(np.stack([charge, np.diff(current[edges]), angle, flux], axis=1))
            table = np.concatenate(rows)
            starts.append(_regress_free(table[:, :3], table[:, 3], ELECTRICAL, free, fixed))
        magnitudes = np.abs(np.median(starts, axis=0))
        volts = np.concatenate([segment.inputs for segment in segments])
        amperes = np.concatenate([segment.measured for segment in segments])
        # Regression results that are near 0 or negative are replaced by rough magnitudes.
        fallback = {
            "resistance": np.std(volts) / max(np.std(amperes), 1e-9) + 1e-6,
            "inductance": 1e-4,
        }
        scales = np.maximum(
            magnitudes, 0.03 * np.array([fallback.get(name, 1e-3) for name in free])
        )
        starts = [np.where(start > 0.02 * scales, start, scales) for start in starts]
        return dataclasses.replace(self, names=free, scales=scales), starts

    def _mean_speeds(self, log: Log) -> np.ndarray:
        """Return the mean speed [rad/s] from each row to the next, shape (n,); 0 if locked.

        The speeds are slopes of smoothed positions. With a fitted shaft, they are the speeds of its
        simulation plus the slopes of the smoothed residuals.
        """
        speeds, shaft = np.zeros(len(log.time)), self.shaft
        for rows in gapless_stretches(log) if has_motion(log) else ():
            times = log.time[rows]
            if log.has("position"):
                middles = times + 0.5 * np.diff(times, append=2.0 * times[-1] - times[-2])
                speeds[rows] = smoothed_speeds(times, log.signals["position"][rows], middles)
            else:
                velocity = log.signals["velocity"][rows]
                speeds[rows] = 0.5 * (velocity + np.append(velocity[1:], velocity[-1]))
        if shaft is None or not has_motion(log) or not log.has("position", shaft.model.driven_by):
            return speeds
        # A smoothed speed lags behind that of a light rotor, and the missing back-EMF would be
        # attributed to the inductance. A simulated speed has no lag.
        model, values = dataclasses.replace(shaft.model, output="position"), shaft.values
        simulate = model.simulator(values)
        for segment in model.segments([shift_signal(log, model.driven_by, shaft.delay)], 0.0):
            positions = simulate(segment, best_initial_state(model, values, segment))
            residuals = log.signals["position"][segment.rows] - positions
            middles = 0.5 * (segment.times[1:] + segment.times[:-1])
            correction = smoothed_speeds(segment.times, residuals, middles)
            speeds[segment.rows][:-1] = np.diff(positions) / np.diff(segment.times) + correction
        return speeds


def _regress_free(
    columns: np.ndarray,
    target: np.ndarray,
    names: Sequence[str],
    free: Sequence[str],
    fixed: Mapping[str, float],
) -> np.ndarray:
    """Return the least-squares coefficients of the free columns, with the others fixed."""
    remainder = target - sum(
        columns[:, index] * fixed[name] for index, name in enumerate(names) if name not in free
    )
    # Columns of equal norm make the cutoff of small singular values independent of units.
    matrix = columns[:, [names.index(name) for name in free]]
    norms = np.maximum(np.linalg.norm(matrix, axis=0), 1e-30)
    solution = np.linalg.lstsq(matrix / norms, remainder, rcond=1e-6)[0]
    return np.asarray(solution / norms)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ShaftModel(Model):
    """Shaft with inertia, gravity, load and friction, driven by a torque, a current or a voltage.

    With a voltage as input, the current is quasi-static, and kE equals kT unless kE is known.
    """

    rig: str  # load at the output, a key of `RIG_PARAMETERS`
    friction: str  # friction model, a key of `FRICTION_PARAMETERS`
    estimated: tuple[str, ...] = ()  # additional free parameters
    segment: float = SEGMENT_DURATION  # duration [s] of a segment

    steps: ClassVar = np.array([1e-4, 1e-3])

    def shaft_parameters(self, values: np.ndarray) -> ShaftParameters:
        """Return the parameters for a simulation, from free parameters of shape (p,)."""
        parameters = self.all_values(values)
        ratio = parameters["gear_ratio"]
        gain, braking = parameters["torque_gain"], 0.0
        if self.driven_by != "torque":
            gain = parameters["torque_constant"] * ratio
        if self.driven_by == "voltage":
            gain /= parameters["resistance"]
            braking = (
                gain * ratio * parameters.get("back_emf_constant", parameters["torque_constant"])
            )
        return shaft_parameters(parameters, gain, braking)

    def input_quotients(self, values: np.ndarray) -> list[float]:
        """Return the numbers that tell how the input moves the shaft, from parameters (p,).

        Two sets of parameters move the shaft alike if these numbers and the shaft's torques over
        its inertia are equal.
        """
        shaft = self.shaft_parameters(values)
        return [shaft.gain / shaft.inertia]

    def simulator(self, values: np.ndarray) -> Simulate:
        """Return a function that simulates the positions [rad] or speeds [rad/s] of a segment."""
        from codrl_mj.identify.simulation import simulate_shaft

        shaft, output_index = self.shaft_parameters(values), int(self.output == "velocity")
        return lambda segment, state: simulate_shaft(
            segment.times, segment.inputs, segment.slopes, state[0], state[1], shaft
        )[output_index]

    def driving_torque(self, values: np.ndarray, segments: Sequence[Segment]) -> float:
        """Return the RMS of the driving torque [N*m] at the output."""
        inputs = np.concatenate([segment.inputs for segment in segments])
        return float(np.sqrt(np.mean(inputs**2))) * self.shaft_parameters(values).gain

    def segments(self, logs: Sequence[Log], min_step: float = SHAFT_STEP) -> list[Segment]:
        """Cut logs into segments; rows that are closer than `min_step` [s] are combined."""
        from scipy.integrate import cumulative_trapezoid

        segments: list[Segment] = []
        driven_by, output, block = self.driven_by, self.output, -1
        for index, log in enumerate(logs):
            inputs = log.signals[driven_by]
            # A peak of a single row may be real in a voltage, for example in a PRBS with a fast
            # clock, but is an outlier in a measured signal.
            if driven_by != "voltage":
                inputs = remove_spikes(inputs)
            measured, deviation = log.signals[output], sensor_deviation(log, output)
            # Without a position the angle at the first row counts as 0, and later segments continue
            # from there.
            angle = cumulative_trapezoid(measured, log.time, initial=0.0)
            rows_per_step = max(int(min_step / log.step * (1.0 + 1e-6)), 1)
            block_start = -math.inf
            for rows in cut_segments(log, self.segment):
                times, drive = log.time[rows], inputs[rows]
                if times[0] - block_start >= BLOCK_DURATION - 1e-3:
                    block, block_start = block + 1, times[0]
                # A voltage is held until the next row; a measured effort is interpolated.
                slopes = np.zeros(len(times))
                if driven_by != "voltage":
                    slopes[:-1] = np.diff(drive) / np.diff(times)
                if rows_per_step > 1:
                    means = drive[:-1] + 0.5 * slopes[:-1] * np.diff(times)
                    edges = np.arange(0, len(times), rows_per_step)
                    totals = np.diff(np.append(0.0, np.cumsum(means * np.diff(times)))[edges])
                    drive = np.append(totals / np.diff(times[edges]), drive[-1])
                    rows = slice(rows.start, rows.start + int(edges[-1]) + 1, rows_per_step)
                    times, slopes = times[edges], np.zeros(len(edges))
                state = np.array([angle[rows.start], measured[rows.start]])
                state = initial_state(log, rows) if output == "position" else state
                segments.append(
                    Segment(
                        index,
                        block,
                        rows,
                        times,
                        drive,
                        slopes,
                        slopes,
                        measured[rows],
                        deviation,
                        state,
                    )
                )
        return segments

    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """Return the model with its free parameters set, and initial guesses from regressions.

        Two random variations of the first guess are added.
        """
        driven_by, known = self.driven_by, self.known
        names = [*RIG_PARAMETERS[self.rig], *FRICTION_PARAMETERS[self.friction], *self.estimated]
        if driven_by != "torque":
            names.insert(0, "torque_constant")
        if driven_by == "voltage":
            names.insert(0, "resistance")
        free = tuple(name for name in dict.fromkeys(names) if name not in known)
        guesses = []
        for window in (0.02, 0.004):
            coefficients, drive, speed = _shaft_regression(segments, self.rig, self.output, window)
            guesses.append(
                _guess_shaft(
                    coefficients, drive, speed, driven_by, {**self.defaults, **known}, known
                )
            )
        start, floors = guesses[0]
        scales = np.array(
            [
                floors[name] if name in FRICTION else max(abs(start[name]), floors.get(name, 1e-9))
                for name in free
            ]
        )
        positive = np.array([PARAMETERS[name].lower >= 0.0 for name in free], bool)
        starts = [np.array([guess[name] for name in free]) for guess, _ in guesses]
        starts = [
            np.where(positive & ~(values > 0.02 * scales), 0.3 * scales, values)
            for values in starts
        ]
        # Dry friction gives the cost several minima: random factors of 0.5 to 2 reach others.
        changes = np.random.default_rng(0).uniform(-0.7, 0.7, (2, len(free)))
        starts += [starts[0] * np.exp(change) for change in changes]
        return dataclasses.replace(self, names=free, scales=scales), starts


def _guess_shaft(
    coefficients: Mapping[str, float],
    drive: float,
    speed: float,
    driven_by: str,
    fixed: Mapping[str, float],
    known: Mapping[str, float],
) -> tuple[dict[str, float], dict[str, float]]:
    """Return guesses of all parameters of a shaft, and lower limits for the scales of some.

    Args:
        coefficients: result of `_shaft_regression`.
        drive: RMS of the input.
        speed: RMS of the speed [rad/s].
        driven_by: `torque`, `current` or `voltage`.
        fixed: known parameters and defaults.
        known: known parameters.
    """
    ratio = fixed["gear_ratio"]
    # The gain is the ratio of the output torque to the input.
    gain, braking, resistance = fixed["torque_gain"], 0.0, fixed.get("resistance", 1.0)
    if driven_by != "torque":
        gain = fixed.get("torque_constant", _torque_per_input(coefficients, known) / ratio) * ratio
    start = dict(fixed)
    if driven_by == "voltage":
        scale_names = ("mgl", "constant_torque", "inertia")
        if "resistance" in known and not {"torque_constant", *scale_names} & known.keys():
            # Without a known torque, the viscous term, which is (kT*kE/R + viscous friction) over
            # kT/R at the output, is attributed to back-EMF alone. A guess that is far too large
            # would make the friction so large that the simulated shaft never moves.
            torque_per_volt = (max(coefficients["viscous"], 0.0) + 1e-6) / resistance
        elif "torque_constant" in known or "resistance" in known:
            torque_per_volt = _torque_per_input(
                coefficients, known, gain / resistance if "torque_constant" in known else gain
            )
            resistance = resistance if "resistance" in known else gain / max(torque_per_volt, 1e-9)
        # Without a known constant or resistance, the viscous term is attributed to back-EMF alone.
        else:
            torque_per_volt = gain
            resistance = (max(coefficients["viscous"], 0.0) + 1e-6) / max(torque_per_volt, 1e-9)
        start["torque_constant"] = fixed.get(
            "torque_constant", torque_per_volt * resistance / ratio
        )
        start["resistance"] = resistance
        start["back_emf_constant"] = fixed.get("back_emf_constant", start["torque_constant"])
        braking = torque_per_volt * ratio * start["back_emf_constant"]
        gain = torque_per_volt
    else:
        start["torque_constant"] = gain / ratio
    # If the input is nearly 0, as in a free swing, a known gravity or load gives the scale of the
    # torques.
    load = max(known.get("mgl", 0.0), abs(known.get("constant_torque", 0.0)))
    torque = max(drive * gain if drive * gain > 1e-3 * load else load, 1e-9)
    start |= {
        "inertia": coefficients["inertia"] * gain,
        "mgl": coefficients["mgl"] * gain,
        "constant_torque": coefficients["constant_torque"] * gain,
        "coulomb_friction": coefficients["coulomb"] * gain / ratio,
        "viscous_friction": (coefficients["viscous"] * gain - braking) / ratio**2,
        "gear_efficiency": 0.9,
        "stribeck_friction": 0.05 * torque / ratio,
        "stribeck_speed": 0.1 * speed * ratio,
    }
    floors = {
        "inertia": 0.003 * torque / max(speed, 1e-9),
        "mgl": 0.1 * torque,
        "constant_torque": 0.1 * torque,
        "coulomb_friction": 0.1 * torque / ratio,
        "viscous_friction": 0.1 * torque / max(speed, 1e-9) / ratio**2,
        "stribeck_friction": 0.1 * torque / ratio,
        "gear_efficiency": 0.1,
    }
    return start, floors


def _torque_per_input(
    coefficients: Mapping[str, float], known: Mapping[str, float], default: float = 1.0
) -> float:
    """Return the ratio of the output torque to the input, from a known torque or inertia."""
    for name in ("mgl", "constant_torque", "inertia"):
        if known.get(name, 0.0) != 0.0 and coefficients[name] > 0.0:
            return known[name] / coefficients[name]
    return default


def _shaft_regression(
    segments: Sequence[Segment], rig: str, output: str, window: float
) -> tuple[dict[str, float], float, float]:
    """Regress the integral of the input on the integrals of the shaft's torques.

    The coefficients are divided by the unknown torque per input.

    Args:
        segments: segments of the shaft's logs.
        rig: `pendulum`, `free` or `load`.
        output: `position` or `velocity`.
        window: duration [s] that positions are smoothed over.

    Returns:
        The coefficients by name, and the RMS of the input and of the speed [rad/s].
    """
    from scipy.integrate import cumulative_trapezoid

    integrate = functools.partial(cumulative_trapezoid, initial=0.0)
    rows, inputs, all_speeds = [], [], []
    for segment in segments:
        times, step = segment.times, float(np.median(np.diff(segment.times)))
        if output == "position":
            position = segment.measured
            speed = smoothed_speeds(times, segment.measured, times, max(window, 5.0 * step))
        else:
            position = segment.state[0] + integrate(segment.measured, times)
            speed = segment.measured
        # The columns are gravity, a constant load, Coulomb friction, viscous friction and the
        # input.
        columns = (
            np.sin(position),
            np.ones(len(times)),
            np.sign(speed) * (np.abs(speed) > 0.0),
            speed,
            segment.inputs,
        )
        integrals = [integrate(column, times) for column in columns]
        # Over 2.5 smoothing windows, the speed changes by much more than its error.
        edges = np.searchsorted(times, np.arange(times[0], times[-1] + 1e-9, 2.5 * window))
        edges = np.unique(np.minimum(edges, len(times) - 1))
        rows.append(
            np.stack(
                [np.diff(speed[edges]), *(np.diff(integral[edges]) for integral in integrals)],
                axis=1,
            )
        )
        inputs.append(segment.inputs)
        all_speeds.append(speed)
    table = np.concatenate(rows)
    names = ["inertia", "mgl", "constant_torque", "coulomb", "viscous"]
    free = [
        name
        for name in names
        if name not in ("mgl", "constant_torque") or name in RIG_PARAMETERS[rig]
    ]
    solution = _regress_free(table[:, :5], table[:, 5], names, free, dict.fromkeys(names, 0.0))
    coefficients = dict.fromkeys(names, 0.0) | dict(zip(free, map(float, solution), strict=True))
    input_rms = float(np.sqrt(np.mean(np.concatenate(inputs) ** 2)))
    return coefficients, input_rms, float(np.sqrt(np.mean(np.concatenate(all_speeds) ** 2)))
