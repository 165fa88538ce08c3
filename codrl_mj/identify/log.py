"""A bench log in SI units: what the fit reads and the checks look at."""

import dataclasses
import itertools
from collections.abc import Mapping

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
LONGEST_STEP = 5.0  # a longer step, in median steps, is a gap, across which nothing is simulated
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

    Signals are at the motor's output as logged; positive voltage, current, torque and speed point the same way.

    Raises:
        ValueError: a signal is unknown, has another shape than the times or a value that is not finite; fewer than two
            rows; times that do not increase.
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
            raise ValueError(f"log {self.name}: time has shape {shape}, must be (n,) with n >= 2; give a longer log")
        for name, values in {"time": self.time, **self.signals}.items():
            if name != "time" and name not in SIGNALS:
                raise ValueError(f"log {self.name}: unknown signal {name!r}, must be one of {', '.join(SIGNALS)}")
            if values.shape != shape:
                raise ValueError(f"log {self.name}: {name} has shape {values.shape}, must be that of time, {shape}")
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values))[0])
                raise ValueError(f"log {self.name}: {name}[{row}] = {values[row]}, must be finite; leave the row out")
        late = np.flatnonzero(np.diff(self.time) <= 0.0)
        if late.size:
            row = int(late[0]) + 1
            raise ValueError(
                f"log {self.name}: time[{row}] = {self.time[row]!r}, must be above {self.time[row - 1]!r} of the row "
                "before; leave such rows out"
            )

    def has(self, *names: str) -> bool:
        """Whether it holds all of these signals."""
        return all(name in self.signals for name in names)

    def part(self, rows: slice) -> "Log":
        """Some of its rows."""
        signals = {name: values[rows] for name, values in self.signals.items()}
        return dataclasses.replace(self, time=self.time[rows], signals=signals, rows=self.row_numbers[rows])

    @property
    def row_numbers(self) -> np.ndarray:
        """Row of the file that each row was, shape (n,)."""
        return np.arange(1, len(self.time) + 1) if self.rows is None else self.rows

    @property
    def step(self) -> float:
        """Its usual step of time [s], the median."""
        return float(np.median(np.diff(self.time)))


def usable(log: Log) -> list[slice]:
    """The stretches of a log without gaps, through which may be simulated by the time stamps; each of two rows or more.

    What is dropped within one has to be seen by the stamps: its steps differ.
    """
    gaps = np.flatnonzero(np.diff(log.time) > LONGEST_STEP * log.step) + 1
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
