"""Bench logs in SI units: their quality, the requirements of a fit, and the cut into segments."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

SIGNALS = {
    "voltage": "V",  # at the motor's terminals
    "current": "A",
    "position": "rad",
    "velocity": "rad/s",
    "torque": "N*m",
    "bus": "V",  # of the supply
    "duty": "",  # share of the bus voltage
    "temperature": "degC",
    "command": None,  # setpoint of a controller, in any unit
    "gain": "",  # register of a servo's position gain
}
"""Signal of a log -> its SI unit; None: any."""
# Nothing is simulated across a gap.
GAP_STEPS = 5.0
"""Time step, in median steps, above which a step is a gap."""
_ROUND_DIGITS = {*(tenths / 10 for tenths in range(10, 100)), 1.25, 2.25}
"""Mantissas of a quantization step that probably comes from decimal rounding in a file."""
_MAX_LEVELS = 1_000_000  # a signal with more levels of quantization counts as continuous


@dataclasses.dataclass(frozen=True)
class Finding:
    """A fault or a remarkable property of a log."""

    severity: str
    """`error`: fitted values would be wrong; `warning`: they may be wrong; `info`: good to know."""
    check: str
    """Name of the check."""
    row: int | None
    """Number of the row in the file, from 1 and without headers; None: the whole log."""
    message: str
    """Description of the fault, with its size."""
    remedy: str
    """Advice; empty if nothing needs to be done."""


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """A bench log in SI units; times increase strictly, gaps and dropped rows are allowed.

    Position, velocity and torque are those of the motor's output. Positive voltage, current, torque
    and speed have the same direction.

    Raises:
        ValueError: a signal is unknown, has another shape than the times or a value that is not
            finite; fewer than two rows; times that do not increase.
    """

    name: str
    """Stem of the file's name, for messages."""
    time: np.ndarray
    """Times [s], shape (n,)."""
    signals: Mapping[str, np.ndarray]
    """Signals by name, each of shape (n,), in the units of `SIGNALS`."""
    resolution: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Signal -> step of its quantization, detected or declared; 0: none."""
    mean_voltage: bool = False
    """True if voltage[k] is the mean from time[k] to time[k+1]; else it is held from time[k] on."""
    constants: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Numbers that the file states for the whole log, such as `kp` or `mass`."""
    rows: np.ndarray | None = None
    """Row numbers in the file, shape (n,), from 1; None: all rows, in order."""
    findings: tuple[Finding, ...] = ()
    """Findings from reading the file."""

    def __post_init__(self) -> None:
        """Validate all fields."""
        shape = self.time.shape
        if len(shape) != 1 or shape[0] < 2:
            raise ValueError(
                f"log {self.name}: time has shape {shape}, must be (n,) with n >= 2; give a"
                " longer log"
            )
        for name, values in {"time": self.time, **self.signals}.items():
            if name != "time" and name not in SIGNALS:
                raise ValueError(
                    f"log {self.name}: unknown signal {name!r}, must be one of {', '.join(SIGNALS)}"
                )
            if values.shape != shape:
                raise ValueError(
                    f"log {self.name}: {name} has shape {values.shape}, must be that of time,"
                    f" {shape}"
                )
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values))[0])
                raise ValueError(
                    f"log {self.name}: {name}[{row}] = {values[row]}, must be finite; leave the"
                    " row out"
                )
        late = np.flatnonzero(np.diff(self.time) <= 0.0)
        if late.size:
            row = int(late[0]) + 1
            raise ValueError(
                f"log {self.name}: time[{row}] = {self.time[row]!r}, must be above"
                f" {self.time[row - 1]!r} of the row before; leave such rows out"
            )

    def has(self, *names: str) -> bool:
        """Return True if all of these signals were logged."""
        return all(name in self.signals for name in names)

    def slice_rows(self, rows: slice) -> "Log":
        """Return a log of some of the rows."""
        signals = {name: values[rows] for name, values in self.signals.items()}
        return dataclasses.replace(
            self, time=self.time[rows], signals=signals, rows=self.row_numbers[rows]
        )

    @property
    def row_numbers(self) -> np.ndarray:
        """Row numbers in the file, shape (n,), from 1."""
        return np.arange(1, len(self.time) + 1) if self.rows is None else self.rows

    @property
    def step(self) -> float:
        """Median time step [s]."""
        return float(np.median(np.diff(self.time)))


def gapless_stretches(log: Log) -> list[slice]:
    """Return the stretches of a log without gaps, each of at least two rows.

    Single rows may be missing within a stretch, so that a simulation has to use the time stamps.
    """
    gaps = np.flatnonzero(np.diff(log.time) > GAP_STEPS * log.step) + 1
    edges = [0, *map(int, gaps), len(log.time)]
    return [slice(start, end) for start, end in itertools.pairwise(edges) if end - start >= 2]


def find_resolution(values: np.ndarray) -> float:
    """Return the step of a signal's quantization; 0 if its values do not lie on a grid."""
    levels = np.unique(values)
    spread = float(levels[-1] - levels[0])
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * spread]
    # One or two levels do not show whether they lie on a grid.
    if steps.size < 2:
        return 0.0
    # Rounding in the file makes equal steps slightly different, so that their mean is taken.
    min_step = float(steps.min())
    min_step = float(steps[steps < 1.2 * min_step].mean())
    # Neighboring levels may be missing, so that the smallest step may be two or three grid steps.
    for parts in (1, 2, 3):
        count = round(parts * spread / min_step)
        grid = (levels - levels[0]) * (count / spread)
        if count < _MAX_LEVELS and float(np.abs(grid - np.round(grid)).max()) < 0.1:
            return spread / count
    return 0.0


def find_turn_jumps(values: np.ndarray, period: float) -> np.ndarray:
    """Return the rows after which an angle jumps by a full turn, `period` in the angle's unit.

    The result is empty if over a fifth of the steps exceed a quarter turn, because the shaft then
    turns too fast to tell.
    """
    steps = np.abs(np.diff(values))
    jumps = np.flatnonzero(np.abs(steps - period) < 0.1 * period)
    return jumps if jumps.size and np.mean(steps > 0.25 * period) <= 0.2 else jumps[:0]


def counts_per_turn(step: float, period: float) -> int | None:
    """Return an encoder's counts per turn; None if the step may come from rounding in the file."""
    if step <= 0.0 or round(step / 10.0 ** math.floor(math.log10(step)), 5) in _ROUND_DIGITS:
        return None
    count = round(period / step)
    # Encoders have a multiple of 100 counts, or a power of two.
    is_usual = count >= 100 and (count % 100 == 0 or count & (count - 1) == 0)
    return count if is_usual and abs(period / step - count) < 0.02 else None


def is_supply_voltage(volts: np.ndarray, responses: Sequence[np.ndarray]) -> bool:
    """Return True if a voltage is the supply's: it hardly changes although the motor reverses."""
    reverses = any(
        values.size
        and float(values.min()) < -0.2 * float(np.abs(values).max()) < 0.0 < values.max()
        for values in responses
    )
    return bool(volts.size) and 0.0 < float(volts.max()) <= 1.3 * float(volts.min()) and reverses


# -- requirements of a fit ------------------------------------------------------------------------

INPUTS = ("torque", "current", "voltage")
"""Possible inputs of a shaft, in order of preference."""
OUTPUTS = "position", "velocity"
"""Signals that a simulated shaft is compared with, in order of preference."""
# Rows that are farther apart contain too little information within a segment.
MAX_STEP = 0.05
"""Longest median time step of a log [s]."""
# Fewer rows cannot determine the parameters and the two initial states of a shaft.
MIN_ROWS = 20
"""Minimum number of rows in the longest stretch without a gap."""
# In a prediction, the first 0.03 s determine only the initial state.
MIN_DURATION = 0.04
"""Shortest duration [s] of the longest stretch without a gap, if the shaft moves."""


class LogRoles(NamedTuple):
    """The logs that determine each part of a motor, and the signals of the shaft."""

    electrical: list[Log]  # logs that determine the winding
    moving: list[Log]  # logs that determine the shaft
    # The input of the shaft in the fit; None if the moving logs have no input in common.
    driven_by: str | None
    # The motion that the fit compares; empty if the moving logs have no motion in common.
    output: str


def assign_log_roles(logs: Sequence[Log]) -> LogRoles:
    """Return which logs determine the winding and which the shaft, with the shaft's signals."""
    moving = [log for log in logs if has_motion(log)]
    driven_by, output = (
        next((name for name in names if moving and all(log.has(name) for log in moving)), None)
        for names in (INPUTS, OUTPUTS)
    )
    return LogRoles(
        [log for log in logs if log.has("voltage", "current")], moving, driven_by, output or ""
    )


def find_obstacle(logs: Sequence[Log]) -> Finding | None:
    """Return the reason why logs cannot be fitted together; None if they can.

    `check` reports it as a finding, `identify` as an error.
    """
    electrical, moving, driven_by, _ = assign_log_roles(logs)
    if not electrical and driven_by is None:
        return _no_signals(logs, bool(moving))
    for log in moving:
        if log.step > MAX_STEP:
            text = f"log {log.name}: a row every {log.step:.3g} s, must be at most {MAX_STEP:g} s"
            remedy = "log more often; or correct the unit of time"
            return Finding("error", "rows", None, text, remedy)
    for log in [*electrical, *moving]:
        rows = max(
            gapless_stretches(log),
            key=lambda stretch: stretch.stop - stretch.start,
            default=slice(0, 1),
        )
        count = rows.stop - rows.start
        seconds = float(log.time[rows.stop - 1] - log.time[rows.start])
        is_moving = any(log is moving_log for moving_log in moving)
        if count < MIN_ROWS or (is_moving and seconds < MIN_DURATION):
            text = (
                f"log {log.name}: {count} rows in {seconds:.3g} s without a gap, must be at least"
                f" {MIN_ROWS}"
            )
            text += f" in {MIN_DURATION:g} s" if is_moving else ""
            return Finding("error", "rows", None, text, "log for longer, without gaps")
    return None


def is_servo_log(log: Log) -> bool:
    """Return True if a log has commands and positions, from which a servo can be identified."""
    return log.has("command", "position") and has_motion(log)


def _no_signals(logs: Sequence[Log], is_moving: bool) -> Finding:
    """Return a finding that names the signals that a fit lacks, and how to get them."""
    signals = set().union(*(log.signals for log in logs))
    if not signals & {*INPUTS}:
        # The command of a servo is not an input of the shaft, but its duty gives the voltage.
        lacking, remedy = "no voltage, current or torque", "log one of them"
        if "duty" in signals:
            remedy = (
                "write voltage=duty*bus:V with the columns of both, or voltage=duty*12:V if the"
                " supply has 12 V"
            )
        elif "command" in signals:
            remedy = (
                "identify the servo as a whole: codrl-mj identify servo. It tells more if you also"
                " log the duty (Feetech: Present Load, Dynamixel: Present PWM) and the input"
                " voltage"
            )
    elif is_moving:
        lacking = "no torque, current or voltage that all moving logs have"
        remedy = "fit logs with the same signals together"
    else:
        lacking = "no position or velocity that changes"
        remedy = "log a motion, or both voltage and current"
    subject, pronoun = ("this log has", "it") if len(logs) == 1 else ("these logs have", "them")
    return Finding(
        "error",
        "signals",
        None,
        f"{subject} {lacking}: nothing can be identified from {pronoun}",
        remedy,
    )


# -- segments, each simulated from its own initial state ------------------------------------------

# Over a longer simulation the errors of the friction model accumulate, and the cost has several
# minima.
SEGMENT_DURATION = 0.5
"""Duration [s] of the segments of a shaft."""
# Residuals within a block are correlated: resampling single rows would make intervals too narrow.
BLOCK_DURATION = 1.0
"""Shortest duration [s] of a block, which is a stretch of a log that is resampled as a whole."""
# The shaft is slower than the winding. Combined rows have the mean of their inputs and the position
# of the first row.
SHAFT_STEP = 5e-4
"""Shortest time step [s] of a shaft's segments; rows that are closer are combined."""
SPIKE_FACTOR = 50.0
"""Smallest deviation of a spike, over the 90th percentile of the deviations of all rows."""
# The window is shorter than the motions of a shaft, and longer than the steps of an encoder take.
SMOOTHING_WINDOW = 4e-3
"""Duration [s] that positions are smoothed over."""
MIN_MOTION_STEPS = 10.0
"""Motion in encoder steps below which a shaft counts as locked."""


class ServoInputs(NamedTuple):
    """Commands of a servo until the end of a segment, and what scales its torque."""

    times: np.ndarray  # times of the log's rows until the end of the segment [s], shape (n,)
    targets: np.ndarray  # commanded positions at these rows [rad], shape (n,)
    volts: np.ndarray  # supply voltage over its reference at the segment's rows, shape (m,)
    gains: np.ndarray  # position gain over its reference at the segment's rows, shape (m,)


class Segment(NamedTuple):
    """Rows of a log that are simulated from one initial state."""

    log: int  # index of the log among the fitted logs
    block: int  # number of its block, unique over all logs; blocks are resampled as a whole
    rows: slice  # rows of the log
    times: np.ndarray  # [s], shape (m,)
    inputs: np.ndarray  # input at the times, shape (m,)
    slopes: np.ndarray  # rate of change of the input until the next row [1/s], shape (m,)
    speeds: np.ndarray  # mean speed [rad/s] until the next row, shape (m,); used by a winding
    measured: np.ndarray  # output that a simulation is compared with, shape (m,)
    deviation: float  # standard deviation of the sensor, in the unit of `measured`
    state: np.ndarray  # initial guess of the state at the first row
    servo: ServoInputs | None = None  # inputs of a servo; None: the segment is not of a servo

    def first(self, count: int) -> "Segment":
        """Return a segment of the first `count` rows."""
        arrays = ("times", "inputs", "slopes", "speeds", "measured")
        return self._replace(**{name: getattr(self, name)[:count] for name in arrays})


def shift_signal(log: Log, name: str, rows: float) -> Log:
    """Return a log with a signal delayed by a number of rows, which may be negative or fractional.

    Fractions are interpolated linearly; the value at an end of the log is repeated.
    """
    indices, values = np.arange(len(log.time)), log.signals[name]
    return (
        log if rows == 0 else replace_signal(log, name, np.interp(indices - rows, indices, values))
    )


def replace_signal(log: Log, name: str, values: np.ndarray) -> Log:
    """Return a log with other values of a signal, shape (n,)."""
    return dataclasses.replace(log, signals={**log.signals, name: values})


def remove_spikes(values: np.ndarray) -> np.ndarray:
    """Return a signal in which each spike of a single row is replaced by its nearer neighbor.

    The robust loss tolerates outliers of an output, but the input of a simulation must not have
    any.
    """
    # The median of three rows is the row itself, unless it is above or below both neighbors.
    median = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
    deviations = np.abs(values[1:-1] - median)
    usual = max(float(np.percentile(deviations, 90.0)), 1e-3 * float(np.std(values)))
    cleaned = values.copy()
    cleaned[1:-1][deviations > SPIKE_FACTOR * usual] = median[deviations > SPIKE_FACTOR * usual]
    return cleaned


def sensor_deviation(log: Log, name: str) -> float:
    """Return the standard deviation of a signal's sensor, from its noise or its quantization.

    Third differences over four rows, which a smooth motion hardly affects, estimate the noise. If
    it is less than a step of the quantization, only the quantization counts.
    """
    values = log.signals[name]
    step = log.resolution.get(name, 0.0)
    # A uniform error within one step has the standard deviation step/sqrt(12).
    if len(values) < 8:
        return max(step / math.sqrt(12.0), 1e-9)
    # Third differences have the coefficients 1, -3, 3, -1, whose squares add up to 20.
    noise_samples = np.diff(values, n=3) / math.sqrt(20.0)
    noise = 1.4826 * float(np.median(np.abs(noise_samples)))
    return max(
        noise if noise > step else step / math.sqrt(12.0), 1e-6 * float(np.ptp(values)), 1e-12
    )


def has_motion(log: Log) -> bool:
    """Return True if the shaft moves by more than the noise of its position or velocity.

    Without a logged position or velocity the shaft counts as locked.
    """
    if log.has("position"):
        return float(np.ptp(log.signals["position"])) > max(
            MIN_MOTION_STEPS * log.resolution.get("position", 0.0), 1e-4
        )
    if not log.has("velocity"):
        return False
    # The mean over 50 ms removes noise, but not the velocity of a moving shaft.
    velocity = log.signals["velocity"]
    rows = max(min(round(0.05 / log.step), len(log.time) // 4), 1)
    return float(np.std(np.convolve(velocity, np.full(rows, 1.0 / rows), "valid"))) > 0.3 * float(
        np.std(velocity)
    )


def smoothed_speeds(
    times: np.ndarray, positions: np.ndarray, centers: np.ndarray, window: float = SMOOTHING_WINDOW
) -> np.ndarray:
    """Return the slopes [rad/s] of lines fitted to the positions in a window around each center.

    A window has at least three positions, and is cut off at the ends of the log. At the middle of a
    window, the slope of the line equals that of a fitted parabola.
    """
    count = len(times)
    first = np.searchsorted(times, centers - 0.5 * window - 1e-9)
    last = np.searchsorted(times, centers + 0.5 * window + 1e-9)
    nearest = np.clip(np.searchsorted(times, centers), 1, count - 1)
    first = np.clip(np.minimum(first, nearest - 1), 0, max(count - 2, 0))
    last = np.clip(np.maximum(last, nearest + 1), first + 2, count)
    # Differences of cumulative sums give the sums of all windows at once. Offsets from the first
    # row keep the sums small, and their differences accurate.
    elapsed, angles = times - times[0], positions - positions[0]
    cumulative = [
        np.concatenate([[0.0], np.cumsum(values)])
        for values in (elapsed, angles, elapsed * angles, elapsed**2)
    ]
    t, q, tq, tt = (values[last] - values[first] for values in cumulative)
    num_rows = last - first
    slopes: np.ndarray = (num_rows * tq - t * q) / (num_rows * tt - t * t)
    return slopes


def cut_segments(log: Log, duration: float) -> list[slice]:
    """Cut a log into segments without gaps, each of about a duration [s]; return their rows.

    Each stretch is divided evenly, so that a segment may be up to 1.5 times as long.
    """
    segments = []
    for stretch in gapless_stretches(log):
        begin, end = log.time[stretch.start], log.time[stretch.stop - 1]
        count = max(round((end - begin) / duration), 1)
        edges = (
            np.searchsorted(log.time[stretch], np.linspace(begin, end, count + 1)[:-1])
            + stretch.start
        )
        edges = [*map(int, np.unique(edges)), stretch.stop]
        segments += [slice(a, b) for a, b in itertools.pairwise(edges) if b - a >= 4]
    return segments


def initial_state(log: Log, rows: slice) -> np.ndarray:
    """Return the position and the speed at the first row, from a parabola around it.

    The parabola is fitted to the rows within 15 ms, or to five rows.
    """
    time = log.time[rows.start]
    stretch = next(part for part in gapless_stretches(log) if part.start <= rows.start < part.stop)
    first = max(min(int(np.searchsorted(log.time, time - 0.015)), rows.start - 2), stretch.start)
    last = min(max(int(np.searchsorted(log.time, time + 0.015)), rows.start + 3), stretch.stop)
    nearby = slice(first, last)
    degree = min(2, last - first - 1)
    coefficients = np.polynomial.polynomial.polyfit(
        log.time[nearby] - time, log.signals["position"][nearby], degree
    )
    return np.array([coefficients[0], coefficients[1]])


def halve_rate(log: Log) -> Log:
    """Return every second row of a log; a mean voltage becomes the mean over both rows."""
    # With an odd number of rows, both the first and the last row remain.
    count = len(log.time) - (len(log.time) + 1) % 2
    half = log.slice_rows(slice(0, count, 2))
    if not (log.mean_voltage and log.has("voltage")):
        return half
    steps, volts = np.diff(log.time[:count]), log.signals["voltage"][:count]
    integrals = volts[:-1] * steps
    mean = (integrals[::2] + integrals[1::2]) / (steps[::2] + steps[1::2])
    return replace_signal(half, "voltage", np.append(mean, volts[-1]))
