"""Logs that are computed: a drive of ours under a voltage, through sensors and a sampler, with faults to order.

Voltages are pure functions of time. Slow turning shows resistance, back-EMF and friction; only what
changes within the winding's time constant L/R shows the inductance. PRBS: a pseudo-random binary
sequence, white up to its clock. Source: Ljung, *System Identification* (2nd ed. 1999), sec. 13.3.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.actuators.shaft import resistance_at
from codrl_mj.fields import Checked, check_memory, check_names, real
from codrl_mj.identify.columns import KINDS
from codrl_mj.identify.log import Log
from codrl_mj.runs.files import atomic_write


@dataclasses.dataclass(frozen=True)
class Excitation(Checked):
    """A voltage over time."""

    kind: str = "prbs"
    """One of `EXCITATIONS`."""
    amplitude: float = real(1.0, above=0.0, unit="V")
    """The largest voltage [V], > 0."""
    duration: float = real(4.0, above=0.0, unit="s")
    """[s], > 0."""
    frequency: float = real(0.5, above=0.0, unit="Hz")
    """Of the slow sine, and of the square [Hz], > 0."""
    highest: float = real(200.0, above=0.0, unit="Hz")
    """Where the chirp ends [Hz], > 0; it begins at `frequency`."""
    clock: float = real(2.0e-3, above=0.0, unit="s")
    """Least time [s] between the changes of a PRBS, > 0; about 4 L/R."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check_names([self.kind], EXCITATIONS, "excitation")

    @property
    def locked(self) -> bool:
        """Whether the shaft is to be held."""
        return self.kind == "locked_prbs"

    def voltage(self, time: np.ndarray) -> np.ndarray:
        """[V], of the shape of time [s]; 0 after the duration."""
        time = np.asarray(time, dtype=float)
        return self.amplitude * np.where(
            time < self.duration, EXCITATIONS[self.kind](self, time), 0.0
        )


def _slow_sine(excitation: Excitation, time: np.ndarray) -> np.ndarray:
    return np.sin(2.0 * math.pi * excitation.frequency * time)


def _bits(excitation: Excitation, time: np.ndarray) -> np.ndarray:
    """-1 and 1 in a sequence of 2^13 - 1 by a shift register."""
    from scipy.signal import max_len_seq

    bits = 2.0 * max_len_seq(13)[0].astype(float) - 1.0
    return bits[np.floor(time / excitation.clock + 1e-9).astype(int) % len(bits)]


EXCITATIONS: dict[str, Callable[[Excitation, np.ndarray], np.ndarray]] = {
    "slow_sine": _slow_sine,
    # reverses at once
    "square": lambda one, time: np.where((one.frequency * time) % 1.0 < 0.5, 1.0, -1.0),
    # its frequency grows in proportion to time
    "chirp": lambda one, time: np.sin(
        2.0
        * math.pi
        * (one.frequency + 0.5 * (one.highest - one.frequency) * time / one.duration)
        * time
    ),
    "prbs": lambda one, time: 0.5 * _bits(one, time) + 0.5 * _slow_sine(one, time),
    "locked_prbs": _bits,  # with the shaft held
}
"""Kind -> function of amplitude 1."""


@dataclasses.dataclass(frozen=True)
class Load(Checked):
    """What the output shaft moves."""

    inertia: float = real(0.0, least=0.0, unit="kg*m^2")
    """Inertia [kg*m^2] at the output, >= 0, besides the rotor's."""
    gravity: float = real(0.0, least=0.0, unit="N*m")
    """m*g*l [N*m] of a pendulum, >= 0, that hangs at position 0."""
    against: float = real(0.0, unit="N*m")
    """Constant torque [N*m] against the motor, as of a lifted weight."""
    locked: bool = False
    """Whether the shaft is held."""


FREE = Load()  # nothing but the rotor
SEEN = (
    "current",
    "position",
    "velocity",
    "torque",
    "bus",
    "voltage",
    "duty",
)  # what a simulated log has
_SAMPLE_SIZE, _ROW_SIZE = (
    80,
    200,
)  # memory [bytes] of a drive's sample, and of a row until it is written, as measured


@dataclasses.dataclass(frozen=True)
class Sensor(Checked):
    """How a signal is read: value -> gain * value(time - delay) + bias + noise, then rounded."""

    noise: float = real(0.0, least=0.0, unit="")
    """Standard deviation of white noise, >= 0, in the signal's unit."""
    resolution: float = real(0.0, least=0.0, unit="")
    """Step of the rounding, >= 0, in the signal's unit; 0: none."""
    delay: float = real(0.0, least=0.0, unit="s")
    """How old [s] the values are, >= 0."""
    gain: float = real(1.0, unit="")
    """What the sensor shows of one; -1 is a wrong sign."""
    bias: float = real(0.0, unit="")
    """What it shows of nothing, in the signal's unit."""
    outliers: float = real(0.0, least=0.0, most=1.0)
    """Share of values, in [0, 1], that are off by 3 to 10 of the signal's standard deviations."""

    def seen(self, values: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """What is read of values, shape (n,), that are as old as they are."""
        seen = self.gain * values + self.bias + self.noise * random.standard_normal(len(values))
        wrong = random.random(len(values)) < self.outliers
        off = random.uniform(3.0, 10.0, len(values)) * random.choice([-1.0, 1.0], len(values))
        seen = seen + np.where(wrong, off * float(np.std(seen)), 0.0)
        return (
            seen if self.resolution == 0.0 else self.resolution * np.round(seen / self.resolution)
        )


@dataclasses.dataclass(frozen=True)
class Sampler(Checked):
    """When rows are written."""

    rate: float = real(5000.0, above=0.0, unit="Hz")
    """Rows a second [Hz], > 0."""
    jitter: float = real(0.0, least=0.0, most=0.3)
    """Standard deviation of the times as a share of the period, in [0, 0.3]; the stamps are right."""
    dropped: float = real(0.0, least=0.0, most=0.9)
    """Share of rows that are lost, in [0, 0.9]."""
    mean_voltage: bool = False
    """Whether the voltage is the mean from a row to the next, and not what it is at the row."""


def run(
    drive: Drive, excitation: Excitation | np.ndarray, load: Load = FREE, position: float = 0.0
) -> Log:
    """What a drive does, without its loop, under a voltage, or its values [V] in each sample, from standstill.

    A row is a sample of the drive, its `command` the voltage [V] asked for. A bridge makes the
    voltage u of a share d = u/V of the supply, which sags by its resistance times d*i.
    """
    from codrl_mj.identify.simulation import driven, moved

    period, limit, motor = 1.0 / drive.controller.sample_rate, drive.voltage_limit, drive.motor
    locked = load.locked
    if isinstance(excitation, Excitation):
        locked = locked or excitation.locked
        excitation = excitation.voltage(sample_times(drive, excitation.duration))
    commanded = np.clip(excitation, -limit, limit)
    shares = (
        np.sign(commanded) * np.maximum(np.abs(commanded) - drive.controller.deadband, 0.0) / limit
    )
    resistance = resistance_at(motor, motor.ambient_temperature)
    winding = resistance, motor.inductance, motor.back_emf_constant * motor.gear_ratio
    inertia = motor.rotor_inertia * motor.gear_ratio**2 + load.inertia
    if not inertia > 0.0 and not locked:
        raise ValueError(
            f"motor.rotor_inertia = {motor.rotor_inertia:g} and load.inertia = {load.inertia:g}:"
            " one must be > 0; give the load its inertia, or lock the shaft"
        )
    numbers = {
        **vars(motor),
        "inertia": inertia,
        "mgl": load.gravity,
        "constant_torque": load.against,
    }
    parts = winding, moved(numbers, motor.torque_constant * motor.gear_ratio)
    states = driven(period, shares, float(limit), float(drive.sag), parts, locked, float(position))
    names = "voltage", "current", "velocity", "position", "bus"
    signals = dict(zip(names, states.T, strict=True))
    return Log("course", period * np.arange(len(shares)), {**signals, "command": commanded})


def sample_times(drive: Drive, duration: float) -> np.ndarray:
    """The times [s] of the drive's samples from 0 to a duration, shape (n + 1,)."""
    check_size(drive, duration, 0.0)
    period = 1.0 / drive.controller.sample_rate
    return period * np.arange(math.ceil(duration / period - 1e-9) + 1)


def check_size(drive: Drive, duration: float, rate: float) -> None:
    """Refuse a simulation of a duration [s], with rows at a rate [Hz], that memory does not hold."""
    samples, rows = duration * drive.controller.sample_rate, duration * rate
    what = f"{duration:,g} s are {samples:,.0f} samples of the drive and {rows:,.0f} rows"
    remedy = "shorten the duration (--duration), or lower the rate of the rows"
    check_memory(_SAMPLE_SIZE * samples + _ROW_SIZE * rows, what, remedy)


def simulate(
    drive: Drive,
    excitation: Excitation | np.ndarray,
    load: Load = FREE,
    sensors: Mapping[str, Sensor] | None = None,
    sampler: Sampler = Sampler(),
    seed: int = 0,
    position: float = 0.0,
    name: str = "synthetic",
) -> Log:
    """A log of a drive with all that can be logged, from a `position` [rad] on, under a voltage as `run` takes it.

    Signals without a sensor show what is. The voltage is the one asked for, without sag; the torque
    n*kT*i.
    """
    if isinstance(excitation, Excitation):
        check_size(drive, excitation.duration, sampler.rate)
    course = run(drive, excitation, load, position)
    check_names(sensors or {}, SEEN, "signal")
    random = np.random.default_rng(seed)
    period = 1.0 / sampler.rate
    time = period * np.arange(math.floor(course.time[-1] / period + 1e-9) + 1)
    time[1:-1] += (
        period * sampler.jitter * np.clip(random.standard_normal(max(len(time) - 2, 0)), -3.0, 3.0)
    )
    time = np.maximum.accumulate(time + 1e-9 * period * np.arange(len(time)))  # rows never swap
    torque = drive.motor.gear_ratio * drive.motor.torque_constant * course.signals["current"]
    commanded, known = course.signals["command"], {**course.signals, "torque": torque}
    flux = np.concatenate([[0.0], np.cumsum(np.diff(course.time) * commanded[:-1])])
    found = {}
    for signal in SEEN:
        sensor = (sensors or {}).get(signal, Sensor())
        past = time - sensor.delay
        if signal in ("voltage", "duty"):  # what was asked for holds for a sample of the drive
            places = np.clip(
                np.floor(past / course.time[1] + 1e-6).astype(int), 0, len(commanded) - 1
            )
            values = commanded[places]
            if sampler.mean_voltage:
                values[:-1] = np.diff(np.interp(past, course.time, flux)) / np.diff(past)
            values = values if signal == "voltage" else 1.0 / drive.voltage_limit * values
        else:
            values = np.interp(past, course.time, known[signal])
        found[signal] = sensor.seen(values, random) if signal in (sensors or {}) else values
    kept = random.random(len(time)) >= sampler.dropped
    kept[[0, -1]] = True
    found = {signal: values[kept] for signal, values in found.items()}
    resolution = {signal: (sensors or {}).get(signal, Sensor()).resolution for signal in found}
    return Log(
        name, time[kept], found, resolution, sampler.mean_voltage, rows=np.flatnonzero(kept) + 1
    )


def write_log(path: Path, log: Log) -> str:
    """Write a log as CSV (.csv or .csv.gz), whole or not at all; returns the columns that `read_log` reads it by."""
    names = ["time", *log.signals]
    table = np.column_stack([log.time, *log.signals.values()])
    with atomic_write(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="")
    texts = {
        name: f"mean({name})" if log.mean_voltage and name == "voltage" else name for name in names
    }
    return ",".join(f"{name}={text}:{KINDS[name] or '1'}" for name, text in texts.items())
