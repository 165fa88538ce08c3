"""Synthetic logs: simulation of a drive with a given voltage, and of sensors with faults.

The voltages of excitations are functions of time alone. Slow motion shows resistance, back-EMF and
friction; only changes within the winding's time constant L/R show the inductance. A PRBS is a
pseudo-random binary sequence with a nearly flat spectrum up to its clock rate. Source: Ljung,
*System Identification* (2nd ed. 1999), sec. 13.3.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.actuators.shaft import resistance_at
from codrl_mj.fields import Checked, check_memory, check_names, real
from codrl_mj.identify.columns import COLUMN_UNITS
from codrl_mj.identify.log import Log
from codrl_mj.identify.parameters import WindingParameters, shaft_parameters
from codrl_mj.runs.files import atomic_write


@dataclasses.dataclass(frozen=True)
class Excitation(Checked):
    """A voltage over time."""

    kind: str = "prbs"
    """Waveform of the voltage, a key of `EXCITATIONS`."""
    amplitude: float = real(1.0, above=0.0, unit="V")
    """Amplitude of the voltage [V], > 0."""
    duration: float = real(4.0, above=0.0, unit="s")
    """Duration [s], > 0."""
    frequency: float = real(0.5, above=0.0, unit="Hz")
    """Frequency of the slow sine and of the square wave [Hz], > 0."""
    highest: float = real(200.0, above=0.0, unit="Hz")
    """Final frequency of the chirp [Hz], > 0; the chirp begins at `frequency`."""
    clock: float = real(2.0e-3, above=0.0, unit="s")
    """Shortest time [s] between two changes of a PRBS, > 0; about 4 L/R is a good choice."""

    def __post_init__(self) -> None:
        """Validate all fields."""
        super().__post_init__()
        check_names([self.kind], EXCITATIONS, "excitation")

    @property
    def locked(self) -> bool:
        """True if the shaft has to be held."""
        return self.kind == "locked_prbs"

    def voltage(self, time: np.ndarray) -> np.ndarray:
        """Return the voltages [V] at times [s] of any shape; 0 after the duration."""
        time = np.asarray(time, dtype=float)
        return self.amplitude * np.where(
            time < self.duration, EXCITATIONS[self.kind](self, time), 0.0
        )


def _slow_sine(excitation: Excitation, time: np.ndarray) -> np.ndarray:
    """Return a sine of amplitude 1."""
    sine: np.ndarray = np.sin(2.0 * math.pi * excitation.frequency * time)
    return sine


def _prbs(excitation: Excitation, time: np.ndarray) -> np.ndarray:
    """Return a pseudo-random sequence of -1 and 1, which repeats after 2^13 - 1 values."""
    from scipy.signal import max_len_seq

    bits = 2.0 * max_len_seq(13)[0].astype(float) - 1.0
    values: np.ndarray = bits[np.floor(time / excitation.clock + 1e-9).astype(int) % len(bits)]
    return values


EXCITATIONS: dict[str, Callable[[Excitation, np.ndarray], np.ndarray]] = {
    "slow_sine": _slow_sine,
    "square": lambda excitation, time: np.where(
        (excitation.frequency * time) % 1.0 < 0.5, 1.0, -1.0
    ),
    # The phase is the integral of a frequency that grows linearly, hence the factor 0.5.
    "chirp": lambda excitation, time: np.sin(
        2.0
        * math.pi
        * (
            excitation.frequency
            + 0.5 * (excitation.highest - excitation.frequency) * time / excitation.duration
        )
        * time
    ),
    "prbs": lambda excitation, time: (
        0.5 * _prbs(excitation, time) + 0.5 * _slow_sine(excitation, time)
    ),
    # The shaft is held: see `Excitation.locked`.
    "locked_prbs": _prbs,
}
"""Kind of an excitation -> its voltage with amplitude 1, as a function of time."""


@dataclasses.dataclass(frozen=True)
class Load(Checked):
    """The load at the output shaft."""

    inertia: float = real(0.0, minimum=0.0, unit="kg*m^2")
    """Inertia [kg*m^2] at the output without the rotor's, >= 0."""
    gravity: float = real(0.0, minimum=0.0, unit="N*m")
    """m*g*l [N*m] of a pendulum that hangs at position 0, >= 0."""
    against: float = real(0.0, unit="N*m")
    """Constant load torque [N*m] that opposes positive speeds, such as that of a lifted weight."""
    locked: bool = False
    """True if the shaft is held."""


FREE = Load()
"""No load: only the rotor moves."""
SIMULATED_SIGNALS = ("current", "position", "velocity", "torque", "bus", "voltage", "duty")
"""Signals of a simulated log."""
_SAMPLE_SIZE, _ROW_SIZE = (80, 200)
"""Measured peak memory [bytes] for a sample of the drive, and for a row of the log."""


@dataclasses.dataclass(frozen=True)
class Sensor(Checked):
    """A sensor: value -> gain * value(time - delay) + bias + noise, then rounded."""

    noise: float = real(0.0, minimum=0.0, unit="")
    """Standard deviation of white noise, >= 0, in the signal's unit."""
    resolution: float = real(0.0, minimum=0.0, unit="")
    """Step of the rounding, >= 0, in the signal's unit; 0: none."""
    delay: float = real(0.0, minimum=0.0, unit="s")
    """Delay [s] of the measured values, >= 0."""
    gain: float = real(1.0, unit="")
    """Ratio of the measured to the true value; -1: the sign is wrong."""
    bias: float = real(0.0, unit="")
    """Measured value if the true value is 0, in the signal's unit."""
    outliers: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of outliers, in [0, 1], which are off by 3 to 10 standard deviations of the signal."""

    def measure(self, values: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Return measured values, shape (n,), of true values that already include the delay."""
        measured = self.gain * values + self.bias + self.noise * random.standard_normal(len(values))
        is_outlier = random.random(len(values)) < self.outliers
        errors = random.uniform(3.0, 10.0, len(values)) * random.choice([-1.0, 1.0], len(values))
        measured = measured + np.where(is_outlier, errors * float(np.std(measured)), 0.0)
        return (
            measured
            if self.resolution == 0.0
            else self.resolution * np.round(measured / self.resolution)
        )


@dataclasses.dataclass(frozen=True)
class Sampler(Checked):
    """The times at which rows are written."""

    rate: float = real(5000.0, above=0.0, unit="Hz")
    """Rows per second [Hz], > 0."""
    jitter: float = real(0.0, minimum=0.0, maximum=0.3)
    """Standard deviation of the sampling times, as a share of the period, in [0, 0.3]. Time stamps
    are the actual times.
    """
    dropped: float = real(0.0, minimum=0.0, maximum=0.9)
    """Share of rows that are lost, in [0, 0.9]."""
    mean_voltage: bool = False
    """True if a row has the mean voltage until the next row; False for the voltage at its time."""


def simulate_drive(
    drive: Drive, excitation: Excitation | np.ndarray, load: Load = FREE, position: float = 0.0
) -> Log:
    """Simulate a drive in open loop from standstill, and return its samples.

    The bridge applies a duty d = u/V, where V is the voltage of the supply without load. Under load
    the supply's voltage falls by d*i times the resistance of the supply.

    Args:
        drive: drive to simulate.
        excitation: excitation, or its voltages [V] at each sample.
        load: load at the output.
        position: initial position [rad].

    Returns:
        A log with a row per sample; its `command` is the requested voltage [V].
    """
    from codrl_mj.identify.simulation import simulate_samples

    period, limit, motor = 1.0 / drive.controller.sample_rate, drive.voltage_limit, drive.motor
    locked = load.locked
    if isinstance(excitation, Excitation):
        locked = locked or excitation.locked
        excitation = excitation.voltage(sample_times(drive, excitation.duration))
    commanded = np.clip(excitation, -limit, limit)
    duties = (
        np.sign(commanded) * np.maximum(np.abs(commanded) - drive.controller.deadband, 0.0) / limit
    )
    resistance = resistance_at(motor, motor.ambient_temperature)
    winding = WindingParameters(
        resistance, motor.inductance, motor.back_emf_constant * motor.gear_ratio
    )
    inertia = motor.rotor_inertia * motor.gear_ratio**2 + load.inertia
    if not inertia > 0.0 and not locked:
        raise ValueError(
            f"motor.rotor_inertia = {motor.rotor_inertia:g} and load.inertia = {load.inertia:g}:"
            " one must be > 0; give the load its inertia, or lock the shaft"
        )
    parameters = {
        **vars(motor),
        "inertia": inertia,
        "mgl": load.gravity,
        "constant_torque": load.against,
    }
    parts = winding, shaft_parameters(parameters, motor.torque_constant * motor.gear_ratio)
    states = simulate_samples(
        period, duties, float(limit), float(drive.supply_resistance), parts, locked, float(position)
    )
    names = "voltage", "current", "velocity", "position", "bus"
    signals = dict(zip(names, states.T, strict=True))
    return Log("course", period * np.arange(len(duties)), {**signals, "command": commanded})


def sample_times(drive: Drive, duration: float) -> np.ndarray:
    """Return the times [s] of the drive's samples from 0 to a duration, shape (n + 1,)."""
    check_size(drive, duration, 0.0)
    period = 1.0 / drive.controller.sample_rate
    return period * np.arange(math.ceil(duration / period - 1e-9) + 1)


def check_size(drive: Drive, duration: float, rate: float) -> None:
    """Raise an error if a duration [s] with rows at a rate [Hz] needs too much memory."""
    samples, rows = duration * drive.controller.sample_rate, duration * rate
    size = f"{duration:,g} s are {samples:,.0f} samples of the drive and {rows:,.0f} rows"
    remedy = "shorten the duration (--duration), or lower the rate of the rows"
    check_memory(_SAMPLE_SIZE * samples + _ROW_SIZE * rows, size, remedy)


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
    """Simulate a drive, and return a log of all signals.

    The logged voltage is the requested one, without the sag of the supply. The logged torque is
    n*kT*i, with the gear ratio n.

    Args:
        drive: drive to simulate.
        excitation: excitation, or its voltages [V] at each sample of the drive.
        load: load at the output.
        sensors: sensors by signal; signals without a sensor are exact.
        sampler: times of the rows.
        seed: seed of noise, outliers, jitter and dropped rows.
        position: initial position [rad].
        name: name of the log.
    """
    if isinstance(excitation, Excitation):
        check_size(drive, excitation.duration, sampler.rate)
    samples = simulate_drive(drive, excitation, load, position)
    check_names(sensors or {}, SIMULATED_SIGNALS, "signal")
    random = np.random.default_rng(seed)
    period = 1.0 / sampler.rate
    time = period * np.arange(math.floor(samples.time[-1] / period + 1e-9) + 1)
    # Jitter does not move the first and the last row, so that the log has the full duration.
    time[1:-1] += (
        period * sampler.jitter * np.clip(random.standard_normal(max(len(time) - 2, 0)), -3.0, 3.0)
    )
    # Large jitter may swap neighboring times, but the times of a log have to increase strictly.
    time = np.maximum.accumulate(time + 1e-9 * period * np.arange(len(time)))
    torque = drive.motor.gear_ratio * drive.motor.torque_constant * samples.signals["current"]
    commanded, true_signals = samples.signals["command"], {**samples.signals, "torque": torque}
    integral = np.concatenate([[0.0], np.cumsum(np.diff(samples.time) * commanded[:-1])])
    signals = {}
    for signal in SIMULATED_SIGNALS:
        sensor = (sensors or {}).get(signal, Sensor())
        delayed_time = time - sensor.delay
        # The requested voltage is held for a sample of the drive; other signals are continuous.
        if signal in ("voltage", "duty"):
            indices = np.clip(
                np.floor(delayed_time / samples.time[1] + 1e-6).astype(int), 0, len(commanded) - 1
            )
            values = commanded[indices]
            if sampler.mean_voltage:
                values[:-1] = np.diff(np.interp(delayed_time, samples.time, integral)) / np.diff(
                    delayed_time
                )
            values = values if signal == "voltage" else 1.0 / drive.voltage_limit * values
        else:
            values = np.interp(delayed_time, samples.time, true_signals[signal])
        signals[signal] = sensor.measure(values, random) if signal in (sensors or {}) else values
    is_written = random.random(len(time)) >= sampler.dropped
    is_written[[0, -1]] = True
    signals = {signal: values[is_written] for signal, values in signals.items()}
    resolution = {signal: (sensors or {}).get(signal, Sensor()).resolution for signal in signals}
    return Log(
        name,
        time[is_written],
        signals,
        resolution,
        sampler.mean_voltage,
        rows=np.flatnonzero(is_written) + 1,
    )


def write_log(path: Path, log: Log) -> str:
    """Write a log as CSV (.csv or .csv.gz) atomically, and return its columns for `read_log`."""
    names = ["time", *log.signals]
    table = np.column_stack([log.time, *log.signals.values()])
    with atomic_write(path) as temporary:
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="")
    texts = {
        name: f"mean({name})" if log.mean_voltage and name == "voltage" else name for name in names
    }
    return ",".join(f"{name}={text}:{COLUMN_UNITS[name] or '1'}" for name, text in texts.items())
