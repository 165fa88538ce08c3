"""A winding and a shaft: segments of their logs, models that the estimator fits, starts that regression gives."""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np

from codrl_mj.identify.estimate import Model, Simulate, best_initial_state
from codrl_mj.identify.log import (
    BLOCK_DURATION,
    SEGMENT_DURATION,
    SHAFT_STEP,
    Log,
    Segment,
    cut_segments,
    initial_state,
    has_motion,
    sensor_deviation,
    shift_signal,
    smoothed_speeds,
    gapless_stretches,
    remove_spikes,
)
from codrl_mj.identify.parameters import ELECTRICAL, FRICTION, OF_FRICTION, OF_RIG, PARAMETERS


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class WindingModel(Model):
    """L di/dt = u - R i - kE n w, exactly over each interval of a held voltage; the speed is its mean there."""

    driven_by: str = "voltage"
    output: str = "current"
    shaft: Any = None
    """The `Fit` of a shaft under the current, where it is known: what an encoder does not see between its rows."""

    steps: ClassVar = np.array([1e-3])

    def simulator(self, values: np.ndarray) -> Simulate:
        """Of currents [A]."""
        from codrl_mj.identify.simulation import simulate_winding

        number = self.all_values(values)
        resistance, inductance = number["resistance"], number["inductance"]
        constant = number.get("back_emf_constant", 0.0) * number["gear_ratio"]
        return lambda one, state: simulate_winding(
            one.times, one.inputs, one.speeds, state[0], resistance, inductance, constant
        )

    def segments(
        self, logs: Sequence[Log], turned: Sequence[np.ndarray] | None = None
    ) -> list[Segment]:
        """The logs, cut into a block each, in which voltage and speed drive the current; speeds may be given."""
        made: list[Segment] = []
        for place, log in enumerate(logs):
            volts, deviation = log.signals["voltage"], sensor_deviation(log, "current")
            speed = self._turning(log) if turned is None else turned[place]
            for rows in cut_segments(log, BLOCK_DURATION):
                times, current = log.time[rows], log.signals["current"][rows]
                drive = times, volts[rows], np.zeros(len(times)), speed[rows]
                made.append(
                    Segment(place, len(made), rows, *drive, current, deviation, current[:1])
                )
        return made

    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """With starts by regressions of the voltage's integral over windows of several lengths.

        The integral over a window is R times that of the current, L times its change and kE times
        the turn.
        """
        moving = any(np.any(segment.speeds) for segment in segments)
        free = tuple(
            name
            for name in ELECTRICAL
            if name not in self.known and (moving or name != "back_emf_constant")
        )
        given = {**self.defaults, "back_emf_constant": 0.0, **self.known}
        starts = []
        for count in (2, 8, 32):  # rows of a window
            rows = []
            for one in segments:
                steps, current, turns = (
                    np.diff(one.times),
                    one.measured,
                    one.speeds[:-1] * given["gear_ratio"],
                )
                edges = np.arange(0, len(current), min(count, len(current) - 1))
                rates = 0.5 * (current[1:] + current[:-1]), turns, one.inputs[:-1]
                charge, turn, flux = (
                    np.diff(np.append(0.0, np.cumsum(rate * steps))[edges]) for rate in rates
                )
                rows.append(np.stack([charge, np.diff(current[edges]), turn, flux], axis=1))
            table = np.concatenate(rows)
            starts.append(_regressed(table[:, :3], table[:, 3], ELECTRICAL, free, given))
        magnitudes = np.abs(np.median(starts, axis=0))
        volts = np.concatenate([one.inputs for one in segments])
        amperes = np.concatenate([one.measured for one in segments])
        fallback = {
            "resistance": np.std(volts) / max(np.std(amperes), 1e-9) + 1e-6,
            "inductance": 1e-4,
        }
        scales = np.maximum(
            magnitudes, 0.03 * np.array([fallback.get(name, 1e-3) for name in free])
        )
        starts = [np.where(one > 0.02 * scales, one, scales) for one in starts]
        return dataclasses.replace(self, names=free, scales=scales), starts

    def _turning(self, log: Log) -> np.ndarray:
        """Mean speeds till the next row, (n,), 0 if locked: of smoothed positions, or what the shaft does and leaves.

        A smoothed speed lags behind a light rotor, and the back-EMF that it misses would be taken
        for inductance.
        """
        found, part = np.zeros(len(log.time)), self.shaft
        for rows in gapless_stretches(log) if has_motion(log) else ():
            times = log.time[rows]
            if log.has("position"):
                middles = times + 0.5 * np.diff(times, append=2.0 * times[-1] - times[-2])
                found[rows] = smoothed_speeds(times, log.signals["position"][rows], middles)
            else:
                velocity = log.signals["velocity"][rows]
                found[rows] = 0.5 * (velocity + np.append(velocity[1:], velocity[-1]))
        if part is None or not has_motion(log) or not log.has("position", part.model.driven_by):
            return found
        model, values = dataclasses.replace(part.model, output="position"), part.values
        simulate = model.simulator(values)
        for segment in model.segments([shift_signal(log, model.driven_by, part.delay)], 0.0):
            positions = simulate(segment, best_initial_state(model, values, segment))
            left = log.signals["position"][segment.rows] - positions
            middles = 0.5 * (segment.times[1:] + segment.times[:-1])
            rest = smoothed_speeds(segment.times, left, middles)
            found[segment.rows][:-1] = np.diff(positions) / np.diff(segment.times) + rest
        return found


def _regressed(
    columns: np.ndarray,
    target: np.ndarray,
    names: Sequence[str],
    free: Sequence[str],
    given: Mapping[str, float],
) -> np.ndarray:
    """Least squares for the free ones of the columns' factors, the others being given."""
    rest = target - sum(
        columns[:, place] * given[name] for place, name in enumerate(names) if name not in free
    )
    matrix = columns[:, [names.index(name) for name in free]]
    norms = np.maximum(np.linalg.norm(matrix, axis=0), 1e-30)
    found = np.linalg.lstsq(matrix / norms, rest, rcond=1e-6)[0]
    return np.asarray(found / norms)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class ShaftModel(Model):
    """Inertia, gravity, load and friction under a torque, a current or a voltage.

    Under a voltage the winding is taken to be settled, and kE to be kT unless known.
    """

    rig: str
    friction: str
    estimated: tuple[str, ...] = ()  # what is fitted besides
    segment: float = SEGMENT_DURATION  # time [s] that is simulated at once

    steps: ClassVar = np.array([1e-4, 1e-3])

    def shaft_parameters(self, values: np.ndarray) -> Any:
        """What a simulation takes, a `Moved`."""
        from codrl_mj.identify.simulation import shaft_parameters

        number = self.all_values(values)
        ratio = number["gear_ratio"]
        gain, braking = number["torque_gain"], 0.0
        if self.driven_by != "torque":
            gain = number["torque_constant"] * ratio
        if self.driven_by == "voltage":
            gain /= number["resistance"]
            braking = gain * ratio * number.get("back_emf_constant", number["torque_constant"])
        return shaft_parameters(number, gain, braking)

    def simulator(self, values: np.ndarray) -> Simulate:
        """Of positions [rad] or speeds [rad/s]."""
        from codrl_mj.identify.simulation import simulate_shaft

        moved, output = self.shaft_parameters(values), int(self.output == "velocity")
        return lambda one, state: simulate_shaft(
            one.times, one.inputs, one.slopes, state[0], state[1], moved
        )[output]

    def segments(self, logs: Sequence[Log], shortest: float = SHAFT_STEP) -> list[Segment]:
        """The logs, cut; rows that are nearer than `shortest` [s] are taken together."""
        from scipy.integrate import cumulative_trapezoid

        made: list[Segment] = []
        driven_by, output, block = self.driven_by, self.output, -1
        for place, log in enumerate(logs):
            given = log.signals[driven_by]
            if driven_by != "voltage":
                given = remove_spikes(given)
            measured, deviation = log.signals[output], sensor_deviation(log, output)
            # without a position a log begins at 0: it turns on from there
            angle = cumulative_trapezoid(measured, log.time, initial=0.0)
            together = max(int(shortest / log.step * (1.0 + 1e-6)), 1)
            began = -math.inf
            for rows in cut_segments(log, self.segment):
                times, drive = log.time[rows], given[rows]
                if times[0] - began >= BLOCK_DURATION - 1e-3:
                    block, began = block + 1, times[0]
                slopes = np.zeros(len(times))
                if driven_by != "voltage":
                    slopes[:-1] = np.diff(drive) / np.diff(times)
                if together > 1:
                    means = drive[:-1] + 0.5 * slopes[:-1] * np.diff(times)
                    edges = np.arange(0, len(times), together)
                    totals = np.diff(np.append(0.0, np.cumsum(means * np.diff(times)))[edges])
                    drive = np.append(totals / np.diff(times[edges]), drive[-1])
                    rows = slice(rows.start, rows.start + int(edges[-1]) + 1, together)
                    times, slopes = times[edges], np.zeros(len(edges))
                state = np.array([angle[rows.start], measured[rows.start]])
                state = initial_state(log, rows) if output == "position" else state
                made.append(
                    Segment(
                        place,
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
        return made

    def initial_guess(self, segments: Sequence[Segment]) -> tuple[Self, list[np.ndarray]]:
        """With starts by a regression of the input's integral, and changes of it."""
        driven_by, known = self.driven_by, self.known
        wanted = [*OF_RIG[self.rig], *OF_FRICTION[self.friction], *self.estimated]
        if driven_by != "torque":
            wanted.insert(0, "torque_constant")
        if driven_by == "voltage":
            wanted.insert(0, "resistance")
        free = tuple(name for name in dict.fromkeys(wanted) if name not in known)
        firsts = []
        for window in (0.02, 0.004):
            factors, drive, speed = _shaft_regression(segments, self.rig, self.output, window)
            firsts.append(
                _shaft_start(factors, drive, speed, driven_by, {**self.defaults, **known}, known)
            )
        start, floors = firsts[0]
        scales = np.array(
            [
                floors[name] if name in FRICTION else max(abs(start[name]), floors.get(name, 1e-9))
                for name in free
            ]
        )
        positive = np.array([PARAMETERS[name].lower >= 0.0 for name in free], bool)
        starts = [np.array([one[name] for name in free]) for one, _ in firsts]
        starts = [np.where(positive & ~(one > 0.02 * scales), 0.3 * scales, one) for one in starts]
        changes = np.random.default_rng(0).uniform(-0.7, 0.7, (2, len(free)))
        starts += [starts[0] * np.exp(change) for change in changes]
        return dataclasses.replace(self, names=free, scales=scales), starts


def _shaft_start(
    factors: Mapping[str, float],
    drive: float,
    speed: float,
    driven_by: str,
    given: Mapping[str, float],
    known: Mapping[str, float],
) -> tuple[dict[str, float], dict[str, float]]:
    """Every parameter of a shaft by the factors that its input was regressed by, and sizes that matter of some."""
    ratio = given["gear_ratio"]
    # torque at the output for one of the input, where that is not known
    gain, braking, resistance = given["torque_gain"], 0.0, given.get("resistance", 1.0)
    if driven_by != "torque":
        gain = given.get("torque_constant", _gain_of(factors, known) / ratio) * ratio
    start = dict(given)
    if driven_by == "voltage":
        if "torque_constant" in known or "resistance" in known:
            per_volt = _gain_of(
                factors, known, gain / resistance if "torque_constant" in known else gain
            )
            resistance = resistance if "resistance" in known else gain / max(per_volt, 1e-9)
        else:  # as if all of what brakes were the back-EMF
            per_volt = gain
            resistance = (max(factors["viscous"], 0.0) + 1e-6) / max(per_volt, 1e-9)
        start["torque_constant"] = given.get("torque_constant", per_volt * resistance / ratio)
        start["resistance"] = resistance
        start["back_emf_constant"] = given.get("back_emf_constant", start["torque_constant"])
        braking = per_volt * ratio * start["back_emf_constant"]
        gain = per_volt
    else:
        start["torque_constant"] = gain / ratio
    # Without an input, as in a free swing, what is known to pull says how large torques are.
    held = max(known.get("mgl", 0.0), abs(known.get("constant_torque", 0.0)))
    torque = max(drive * gain if drive * gain > 1e-3 * held else held, 1e-9)
    start |= {
        "inertia": factors["inertia"] * gain,
        "mgl": factors["mgl"] * gain,
        "constant_torque": factors["constant_torque"] * gain,
        "coulomb_friction": factors["coulomb"] * gain / ratio,
        "viscous_friction": (factors["viscous"] * gain - braking) / ratio**2,
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


def _gain_of(
    factors: Mapping[str, float], known: Mapping[str, float], otherwise: float = 1.0
) -> float:
    """Torque at the output for one of the input, by whatever torque or inertia is known."""
    for name in ("mgl", "constant_torque", "inertia"):
        if known.get(name, 0.0) != 0.0 and factors[name] > 0.0:
            return known[name] / factors[name]
    return otherwise


def _shaft_regression(
    segments: Sequence[Segment], rig: str, output: str, window: float
) -> tuple[dict[str, float], float, float]:
    """Factors of the input's integral in those of what it works against, its size, and that of the speed.

    Speeds are positions smoothed over `window` [s].
    """
    from scipy.integrate import cumulative_trapezoid

    turned = functools.partial(cumulative_trapezoid, initial=0.0)
    rows, inputs, turning = [], [], []
    for segment in segments:
        times, step = segment.times, float(np.median(np.diff(segment.times)))
        if output == "position":
            position, speed = (
                segment.measured,
                smoothed_speeds(times, segment.measured, times, max(window, 5.0 * step)),
            )
        else:
            position, speed = segment.state[0] + turned(segment.measured, times), segment.measured
        columns = (
            np.sin(position),
            np.ones(len(times)),
            np.sign(speed) * (np.abs(speed) > 0.0),
            speed,
            segment.inputs,
        )
        sums = [turned(one, times) for one in columns]
        edges = np.searchsorted(times, np.arange(times[0], times[-1] + 1e-9, 2.5 * window))
        edges = np.unique(np.minimum(edges, len(times) - 1))
        rows.append(
            np.stack([np.diff(speed[edges]), *(np.diff(one[edges]) for one in sums)], axis=1)
        )
        inputs.append(segment.inputs)
        turning.append(speed)
    table = np.concatenate(rows)
    names = ["inertia", "mgl", "constant_torque", "coulomb", "viscous"]
    free = [name for name in names if name not in ("mgl", "constant_torque") or name in OF_RIG[rig]]
    found = _regressed(table[:, :5], table[:, 5], names, free, dict.fromkeys(names, 0.0))
    factors = dict.fromkeys(names, 0.0) | dict(zip(free, map(float, found), strict=True))
    size = float(np.sqrt(np.mean(np.concatenate(inputs) ** 2)))
    return factors, size, float(np.sqrt(np.mean(np.concatenate(turning) ** 2)))
