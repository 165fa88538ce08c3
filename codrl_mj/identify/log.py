"""A bench log in SI units, what its sensors and its shaft do, and the segments that it is cut into."""

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
    "command": None,  # in any unit: what a controller was asked for
}
"""What a log may hold -> its SI unit; None: any."""
GAP_STEPS = 5.0  # a longer step, in median steps, is a gap, across which nothing is simulated
_ROUND = {
    *(tenths / 10 for tenths in range(10, 100)),
    1.25,
    2.25,
}  # leading digits of a step that a file rounds to
_MOST_LEVELS = 1_000_000  # of a converter: what has more is as good as continuous


@dataclasses.dataclass(frozen=True)
class Finding:
    """What is noteworthy about a log."""

    severity: str
    """`error`: what is fitted would be wrong; `warning`: it may be; `info`: good to know."""
    check: str
    """Name of the check."""
    row: int | None
    """Row of the file, the first one being 1, headers not counted; None: the whole log."""
    message: str
    """What, with how much."""
    remedy: str
    """What to do about it; empty where nothing is to be done."""


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """A bench log in SI units; times increase strictly, gaps and dropped rows stay as they are.

    Signals are at the motor's output as logged; positive voltage, current, torque and speed point
    the same way.

    Raises:
        ValueError: a signal is unknown, has another shape than the times or a value that is not
            finite; fewer than two rows; times that do not increase.
    """

    name: str
    """The file's stem, for messages."""
    time: np.ndarray
    """[s], shape (n,)."""
    signals: Mapping[str, np.ndarray]
    """Each of shape (n,), in the units of `SIGNALS`."""
    resolution: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Signal -> step of its quantisation, found or declared; 0 where there is none."""
    mean_voltage: bool = False
    """Whether voltage[k] is the mean from time[k] to time[k+1]; else it is what holds from time[k] to the next row."""
    constants: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Numbers that the file states for the whole log, such as `kp` or `mass`."""
    rows: np.ndarray | None = None
    """Row of the file that each row was, shape (n,), the first being 1; None: all of them, in order."""
    findings: tuple[Finding, ...] = ()
    """What reading it found."""

    def __post_init__(self) -> None:
        """Validate."""
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
        """Whether it holds all of these signals."""
        return all(name in self.signals for name in names)

    def slice_rows(self, rows: slice) -> "Log":
        """Some of its rows."""
        signals = {name: values[rows] for name, values in self.signals.items()}
        return dataclasses.replace(
            self, time=self.time[rows], signals=signals, rows=self.row_numbers[rows]
        )

    @property
    def row_numbers(self) -> np.ndarray:
        """Row of the file that each row was, shape (n,)."""
        return np.arange(1, len(self.time) + 1) if self.rows is None else self.rows

    @property
    def step(self) -> float:
        """Its usual step of time [s], the median."""
        return float(np.median(np.diff(self.time)))


def gapless_stretches(log: Log) -> list[slice]:
    """The stretches of a log without gaps, through which may be simulated by the time stamps; each of two rows or more.

    What is dropped within one has to be seen by the stamps: its steps differ.
    """
    gaps = np.flatnonzero(np.diff(log.time) > GAP_STEPS * log.step) + 1
    edges = [0, *map(int, gaps), len(log.time)]
    return [slice(start, end) for start, end in itertools.pairwise(edges) if end - start >= 2]


def find_resolution(values: np.ndarray) -> float:
    """The step of a signal's quantisation; 0 where its values do not lie on a grid."""
    levels = np.unique(values)
    spread = float(levels[-1] - levels[0])
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * spread]
    if steps.size < 2:  # what has one or two values says nothing
        return 0.0
    least = float(steps.min())
    least = float(steps[steps < 1.2 * least].mean())  # rounding of the file itself
    for parts in (1, 2, 3):  # neighbouring levels need not occur
        count = round(parts * spread / least)
        grid = (levels - levels[0]) * (count / spread)
        if count < _MOST_LEVELS and float(np.abs(grid - np.round(grid)).max()) < 0.1:
            return spread / count
    return 0.0


def find_turn_jumps(values: np.ndarray, period: float) -> np.ndarray:
    """Return the rows after which an angle jumps by a turn, `period` in its unit; none if it mostly moves that fast."""
    steps = np.abs(np.diff(values))
    jumps = np.flatnonzero(np.abs(steps - period) < 0.1 * period)
    return jumps if jumps.size and np.mean(steps > 0.25 * period) <= 0.2 else jumps[:0]


def counts_per_turn(step: float, period: float) -> int | None:
    """Return the counts of an encoder whose step is a part of a turn; None if it is as likely a file's rounding."""
    if step <= 0.0 or round(step / 10.0 ** math.floor(math.log10(step)), 5) in _ROUND:
        return None
    count = round(period / step)
    is_usual = count >= 100 and (count % 100 == 0 or count & (count - 1) == 0)
    return count if is_usual and abs(period / step - count) < 0.02 else None


def is_supply_voltage(volts: np.ndarray, others: Sequence[np.ndarray]) -> bool:
    """Return True if a voltage hardly changes although the motor is driven or turns both ways, as only a supply's."""
    reverses = any(
        one.size and float(one.min()) < -0.2 * float(np.abs(one).max()) < 0.0 < one.max()
        for one in others
    )
    return bool(volts.size) and 0.0 < float(volts.max()) <= 1.3 * float(volts.min()) and reverses


# -- whether a fit can use it ---------------------------------------------------------------------------------------

INPUTS = (
    "torque",
    "current",
    "voltage",
)  # what drives the shaft: the nearest to it that all logs that move have
OUTPUTS = "position", "velocity"  # what a simulation is compared with
MAX_STEP = 0.05  # rows that are farther apart [s] say too little within the time that is predicted
MIN_ROWS = (
    20  # of the longest stretch without a gap: a shaft has up to five parameters and two states
)
# of that stretch [s], if the shaft moves: the first 0.03 s only tell the state it begins from
MIN_DURATION = 0.04


class LogRoles(NamedTuple):
    """The part of a fit that each of some logs is for."""

    electrical: list[Log]  # tell the winding
    moving: list[Log]  # tell the shaft
    driven_by: (
        str | None
    )  # the shaft's input in the fit; None if the moving logs have none in common
    output: str  # the motion that the fit compares; empty if the moving logs have none in common


def assign_logs(logs: Sequence[Log]) -> LogRoles:
    """Return which logs tell the winding and which the shaft, by which input and output."""
    moving = [log for log in logs if has_motion(log)]
    driven_by, output = (
        next((name for name in names if moving and all(log.has(name) for log in moving)), None)
        for names in (INPUTS, OUTPUTS)
    )
    return LogRoles(
        [log for log in logs if log.has("voltage", "current")], moving, driven_by, output or ""
    )


def find_obstacle(logs: Sequence[Log]) -> Finding | None:
    """Return the reason why logs cannot be fitted together, as `check` and `identify` report it; None if they can."""
    electrical, moving, driven_by, _ = assign_logs(logs)
    if not electrical and driven_by is None:
        return _no_signals(logs, bool(moving))
    for log in moving:
        if log.step > MAX_STEP:
            text = f"log {log.name}: a row every {log.step:.3g} s, must be at most {MAX_STEP:g} s"
            remedy = "log more often; or correct the unit of time"
            return Finding("error", "rows", None, text, remedy)
    for log in [*electrical, *moving]:
        rows = max(
            gapless_stretches(log), key=lambda stretch: stretch.stop - stretch.start, default=slice(0, 1)
        )
        count, seconds = (
            rows.stop - rows.start,
            float(log.time[rows.stop - 1] - log.time[rows.start]),
        )
        is_moving = any(log is one for one in moving)
        if count < MIN_ROWS or (is_moving and seconds < MIN_DURATION):
            text = (
                f"log {log.name}: {count} rows in {seconds:.3g} s without a gap, must be at least"
                f" {MIN_ROWS}"
            )
            text += f" in {MIN_DURATION:g} s" if is_moving else ""
            return Finding("error", "rows", None, text, "log for longer, without gaps")
    return None


def _no_signals(logs: Sequence[Log], is_moving: bool) -> Finding:
    """Return which signals are missing for a fit, and how to get them."""
    signals = set().union(*(log.signals for log in logs))
    if not signals & {*INPUTS}:
        lacking, remedy = "no voltage, current or torque", "log one of them"
        if "duty" in signals:
            remedy = (
                "write voltage=duty*bus:V with the columns of both, or voltage=duty*12:V if the"
                " supply has 12 V"
            )
        elif "command" in signals:
            remedy += (
                "; of a servo also the duty (Feetech: Present Load, Dynamixel: Present PWM) and the"
                " input voltage"
            )
    elif is_moving:
        lacking, remedy = (
            "no torque, current or voltage in all logs that move",
            "fit alike logs together",
        )
    else:
        lacking, remedy = (
            "no position or velocity that moves",
            "log the motion, or both voltage and current",
        )
    who, them = ("this log has", "it") if len(logs) == 1 else ("these logs have", "them")
    return Finding(
        "error", "signals", None, f"{who} {lacking}: nothing can be identified from {them}", remedy
    )


# -- cut into segments, each simulated from an initial state of its own ----------------------------------------------

SEGMENT_DURATION = 0.5
"""Time [s] that a shaft is simulated for at once: longer ones meet friction that no model has, and several minima."""
# shortest stretch [s] of a log that is resampled as a whole: residuals within it belong together
BLOCK_DURATION = 1.0
SHAFT_STEP = 5e-4
"""Rows that are nearer [s] are taken together for a shaft, which is slower: their mean input, their first position."""
# a row is a spike where it sticks out by more than so many times what nine of ten rows do at most
SPIKE_FACTOR = 50.0
SMOOTHING_WINDOW = 4e-3
"""Time [s] that positions are smoothed over: short beside what a shaft does, long beside an encoder's steps."""
MIN_MOTION_STEPS = 10.0  # a shaft that moves by no more than so many steps of its encoder is locked


class Segment(NamedTuple):
    """Rows that are simulated at once."""

    log: int  # place of its log among those fitted
    block: int  # number of the stretch that it is resampled with, unique over all logs
    rows: slice  # of its log
    times: np.ndarray  # [s], shape (m,)
    inputs: np.ndarray  # what drives it, at the times, shape (m,)
    slopes: np.ndarray  # how that changes till the next row [1/s], shape (m,)
    speeds: np.ndarray  # mean speed [rad/s] till the next row, shape (m,): of a winding
    measured: np.ndarray  # what a simulation is compared with, shape (m,)
    deviation: float  # standard deviation of the sensor, in the unit of `measured`
    state: np.ndarray  # a guess of the state at the first row

    def first(self, count: int) -> "Segment":
        """Its first rows."""
        several = ("times", "inputs", "slopes", "speeds", "measured")
        return self._replace(**{name: getattr(self, name)[:count] for name in several})


def shift_signal(log: Log, name: str, rows: float) -> Log:
    """A log whose signal is as it was some rows before (or, negative, after), the ends repeated; halves lie between."""
    places, values = np.arange(len(log.time)), log.signals[name]
    return log if rows == 0 else replace_signal(log, name, np.interp(places - rows, places, values))


def replace_signal(log: Log, name: str, values: np.ndarray) -> Log:
    """A log with another signal, shape (n,)."""
    return dataclasses.replace(log, signals={**log.signals, name: values})


def remove_spikes(values: np.ndarray) -> np.ndarray:
    """A sampled signal, rows that stick out of both their neighbours by far more than is usual in place of the nearer.

    Residuals of an output bear outliers, by the robust loss; what drives a simulation has to be
    free of them.
    """
    middle = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
    off = np.abs(values[1:-1] - middle)
    usual = max(float(np.percentile(off, 90.0)), 1e-3 * float(np.std(values)))
    found = values.copy()
    found[1:-1][off > SPIKE_FACTOR * usual] = middle[off > SPIKE_FACTOR * usual]
    return found


def sensor_deviation(log: Log, name: str) -> float:
    """Standard deviation of a signal's sensor: of its quantisation, or of what no smooth motion does within 4 rows.

    Where the latter is within a step of the quantisation it is that of the quantisation.
    """
    values = log.signals[name]
    step = log.resolution.get(name, 0.0)
    if len(values) < 8:
        return max(step / math.sqrt(12.0), 1e-9)
    ripple = np.diff(values, n=3) / math.sqrt(20.0)  # 1, 3, 3, 1
    noise = 1.4826 * float(np.median(np.abs(ripple)))
    return max(
        noise if noise > step else step / math.sqrt(12.0), 1e-6 * float(np.ptp(values)), 1e-12
    )


def has_motion(log: Log) -> bool:
    """Whether the shaft moves, by more than an encoder flickers or a velocity is noisy; no where neither is logged."""
    if log.has("position"):
        return float(np.ptp(log.signals["position"])) > max(
            MIN_MOTION_STEPS * log.resolution.get("position", 0.0), 1e-4
        )
    if not log.has("velocity"):
        return False
    velocity, rows = (
        log.signals["velocity"],
        max(min(round(0.05 / log.step), len(log.time) // 4), 1),
    )
    return float(np.std(np.convolve(velocity, np.full(rows, 1.0 / rows), "valid"))) > 0.3 * float(
        np.std(velocity)
    )


def smoothed_speeds(
    times: np.ndarray, positions: np.ndarray, at: np.ndarray, window: float = SMOOTHING_WINDOW
) -> np.ndarray:
    """Slopes [rad/s] of straight lines through the positions within half a window of a time, at least three of them.

    In the middle of a window that is also the slope of the parabola. Near the ends the window is
    what there is.
    """
    count = len(times)
    first = np.searchsorted(times, at - 0.5 * window - 1e-9)
    last = np.searchsorted(times, at + 0.5 * window + 1e-9)
    near = np.clip(np.searchsorted(times, at), 1, count - 1)
    first = np.clip(np.minimum(first, near - 1), 0, max(count - 2, 0))
    last = np.clip(np.maximum(last, near + 1), first + 2, count)
    shifted, moved = times - times[0], positions - positions[0]
    sums = [
        np.concatenate([[0.0], np.cumsum(one)])
        for one in (shifted, moved, shifted * moved, shifted**2)
    ]
    t, q, tq, tt = (one[last] - one[first] for one in sums)
    number = last - first
    return (number * tq - t * q) / (number * tt - t * t)


def cut_segments(log: Log, longest: float) -> list[slice]:
    """Rows of segments of a length [s], where there are no gaps; the last of a stretch is up to half longer."""
    found = []
    for stretch in gapless_stretches(log):
        begin, end = log.time[stretch.start], log.time[stretch.stop - 1]
        count = max(round((end - begin) / longest), 1)
        edges = (
            np.searchsorted(log.time[stretch], np.linspace(begin, end, count + 1)[:-1])
            + stretch.start
        )
        edges = [*map(int, np.unique(edges)), stretch.stop]
        found += [slice(a, b) for a, b in itertools.pairwise(edges) if b - a >= 4]
    return found


def initial_state(log: Log, rows: slice) -> np.ndarray:
    """Position and speed at the first row, from the rows around it: a parabola within 15 ms, or five rows."""
    time = log.time[rows.start]
    stretch = next(one for one in gapless_stretches(log) if one.start <= rows.start < one.stop)
    first = max(min(int(np.searchsorted(log.time, time - 0.015)), rows.start - 2), stretch.start)
    last = min(max(int(np.searchsorted(log.time, time + 0.015)), rows.start + 3), stretch.stop)
    near = slice(first, last)
    degree = min(2, last - first - 1)
    fitted = np.polynomial.polynomial.polyfit(
        log.time[near] - time, log.signals["position"][near], degree
    )
    return np.array([fitted[0], fitted[1]])


def halve_rate(log: Log) -> Log:
    """Every second row of a log; a mean voltage becomes that of both."""
    count = len(log.time) - (len(log.time) + 1) % 2  # to begin and end with a row that is kept
    kept = log.slice_rows(slice(0, count, 2))
    if not (log.mean_voltage and log.has("voltage")):
        return kept
    steps, volts = np.diff(log.time[:count]), log.signals["voltage"][:count]
    energy = volts[:-1] * steps
    mean = (energy[::2] + energy[1::2]) / (steps[::2] + steps[1::2])
    return replace_signal(kept, "voltage", np.append(mean, volts[-1]))
