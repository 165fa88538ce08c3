"""Which excitation, sample rate and amplitude a motor needs: what each would tell, before anything is measured.

The errors expected are those of the best unbiased estimate, by the Fisher information, and of the voltage that is taken
as held from row to row where it changes in between. Winding and shaft stand each for itself: the current under voltage
and measured speed, the position under the measured torque; so nothing depends on how well the other is modelled. A
delay and an offset of the current, and position and speed at the beginning of segments of 0.25 s, are free. Source:
Ljung, *System Identification* (2nd ed. 1999), sec. 7.4 and 13.2.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.fields import check, check_names, real
from codrl_mj.identify import simulation
from codrl_mj.identify.excitations import KINDS, Excitation
from codrl_mj.identify.parameters import ELECTRICAL
from codrl_mj.identify.synthetic import FREE, Course, Load, moved, run, sample_times
from codrl_mj.runs.files import writing

GOALS = {
    "resistance": 0.02,
    "inductance": 0.10,
    "back_emf_constant": 0.02,
    "inertia": 0.05,
    "coulomb_friction": 0.05,
    "viscous_friction": 0.05,
}
"""Relative error of each parameter that a plan is to reach."""
MARGIN = 3.0
"""By which a plan's errors are below the goals, because a bench has more faults than noise."""
RATES = (1e3, 2e3, 5e3, 10e3, 20e3)
"""Rows a second [Hz] that are tried."""
_SEGMENT = 0.25  # [s]
_PHASE = 0.37  # of a row, by which the rows miss the excitation's clock


@dataclasses.dataclass(frozen=True)
class Sensing:
    """What is measured, how well.

    Raises:
        ValueError: a field is out of bounds.
    """

    current_noise: float = real(0.01, above=0.0, unit="")
    """Standard deviation of the current's noise as a share of the largest current, > 0."""
    encoder: float = real(4096.0, above=0.0, unit="")
    """Steps of the position a turn of the output, > 0."""
    voltage: Literal["together", "instantaneous", "mean"] = "together"
    """How the rows have the voltage: `together`, it changes when a row is written and not in between; else it changes
    by a clock of its own, and a row has what it is at the time, or its mean to the next row."""

    def __post_init__(self) -> None:
        """Validate."""
        check(self)
        check_names([self.voltage], ("together", "instantaneous", "mean"), "voltage")


class Option(NamedTuple):
    """An excitation at a sample rate, and what it would tell."""

    excitation: Excitation
    rate: float
    """Rows a second [Hz]."""
    peak_current: float
    """[A]"""
    rms_current: float
    """Root mean square [A]."""
    errors: dict[str, float]
    """Parameter -> relative error expected; what cannot be seen is left out."""

    @property
    def worst(self) -> float:
        """The largest error over its goal; infinite where one of the electrical parameters cannot be seen."""
        if any(name not in self.errors for name in ELECTRICAL):
            return math.inf
        return max(error / GOALS[name] for name, error in self.errors.items())


class Plan(NamedTuple):
    """All options, and the one to play."""

    options: list[Option]
    best: Option
    """That of the lowest rate that is below all goals by `MARGIN`; else that which comes closest."""
    missed: list[str]
    """Parameters that it does not reach the goals of."""
    unknown: list[str]
    """Parameters that the datasheet leaves at 0, of which nothing can be said."""


def plan(
    drive: Drive,
    load: Load = FREE,
    sensing: Sensing | None = None,
    duration: float = 4.0,
    max_current: float = math.inf,
    continuous_current: float = math.inf,
) -> Plan:
    """Compare excitations and sample rates for a motor whose parameters are about known.

    Args:
        drive: the motor, with its supply and its largest current.
        load: what it moves meanwhile.
        sensing: what is measured.
        duration: of a log [s].
        max_current: that the bench allows [A]; the drive's own counts too.
        continuous_current: that the motor bears [A]; its root mean square stays below.

    Raises:
        ValueError: the motor has no inertia to turn; or a value is out of bounds.
    """
    if not duration >= 4.0 * _SEGMENT:
        raise ValueError(f"duration = {duration!r}: must be at least {4.0 * _SEGMENT:g} s; log for longer")
    limit = min(max_current, drive.controller.max_current)
    for name, value in (("max_current", max_current), ("continuous_current", continuous_current)):
        if not value > 0.0:
            raise ValueError(f"{name} = {value!r}: must be above 0 A; leave it out if there is no limit")
    options = []
    for kind in KINDS:
        options += _options(drive, kind, duration, load, sensing or Sensing(), (limit, continuous_current))
    reached = [option for option in options if option.worst <= 1.0 / MARGIN]
    best = min(reached, key=lambda one: (one.rate, one.worst)) if reached else min(options, key=lambda one: one.worst)
    names = {name: GOALS[name] for name in GOALS if _value(drive, load, name) > 0.0}
    missed = [name for name, goal in names.items() if best.errors.get(name, math.inf) > goal]
    return Plan(options, best, missed, [name for name in GOALS if name not in names])


def write_excitation(path: Path, option: Option) -> None:
    """Write what to play as CSV, a row for each change at the option's rate: `time` [s], `voltage` [V]."""
    time = np.arange(round(option.excitation.duration * option.rate) + 1) / option.rate
    table = np.column_stack([time, option.excitation.voltage(time + 1e-9 / option.rate)])
    with writing(path) as temporary:
        np.savetxt(temporary, table, fmt="%.7g", delimiter=",", header="time,voltage", comments="")


def _options(
    drive: Drive, kind: str, duration: float, load: Load, sensing: Sensing, limits: tuple[float, float]
) -> list[Option]:
    """An excitation at every rate, as large as the supply, the largest and the continuous current allow."""
    constant, together = drive.motor.electrical_time_constant, sensing.voltage == "together"
    options = []
    for rate in RATES:
        if rate > drive.controller.sample_rate:
            continue
        excitation = Excitation(
            kind,
            drive.voltage_limit,
            duration,
            frequency=2.0 if kind == "square" else 0.5,
            highest=min(200.0, 0.5 / constant),
            # an even number of rows, so that a fit of every second one still has the voltage
            clock=2 * max(round(2.0 * constant * rate), 1) / rate if together else 4.0 * constant,
        )
        held = dataclasses.replace(load, locked=load.locked or excitation.locked)
        time = sample_times(drive, duration)
        shape = excitation.voltage(np.floor(time * rate + 1e-6) / rate if together else time) / excitation.amplitude
        amplitude = excitation.amplitude
        for _ in range(8):  # the response is nearly in proportion to the voltage
            course = run(drive, amplitude * shape, held)
            peak, rms = float(np.abs(course.current).max()), float(np.sqrt(np.mean(course.current**2)))
            excess = max(peak / limits[0], rms / limits[1])
            if excess <= 1.0:
                break
            amplitude *= 0.98 / excess
        told = _told(drive, amplitude * shape, rate, sensing)
        errors = _electrical(drive, course, told, rate, sensing)
        if not held.locked:
            constant_error = errors.get("back_emf_constant", 0.0)  # which the torque is known by
            by_position = _mechanical(drive, course, held, rate, sensing)
            errors |= {name: math.hypot(error, constant_error) for name, error in by_position.items()}
        options.append(Option(dataclasses.replace(excitation, amplitude=amplitude), rate, peak, rms, errors))
    return options


_MECHANICAL = ("inertia", "coulomb_friction", "viscous_friction")
_STEP = 1e-3  # of a parameter, relative, by which it is changed


def _electrical(drive: Drive, course: Course, told: np.ndarray, rate: float, sensing: Sensing) -> dict[str, float]:
    """Relative errors by the current."""
    from scipy.signal import lfilter

    middle = 0.5 * (course.speed + np.append(course.speed[1:], course.speed[-1])) * drive.motor.gear_ratio

    def current(voltage: np.ndarray, resistance: float, inductance: float, back_emf_constant: float) -> np.ndarray:
        decay = math.exp(-resistance / (inductance * drive.controller.sample_rate))
        gain = (1.0 - decay) / resistance
        found: np.ndarray = lfilter([0.0, gain], [1.0, -decay], voltage - back_emf_constant * middle)
        return found

    given = {name: _value(drive, FREE, name) for name in ELECTRICAL}
    base = current(course.voltage, **given)
    time = _row_times(course, rate, sensing).ravel()
    noise = sensing.current_noise * max(float(np.abs(base).max()), 1e-300)

    def see(values: np.ndarray) -> np.ndarray:
        seen: np.ndarray = np.interp(time, course.time, values) / noise
        return seen

    slopes = [
        _slope(lambda value, name=name: see(current(course.voltage, **{**given, name: value})), given[name])  # type: ignore[misc]
        for name in ELECTRICAL
    ]
    later = see(np.concatenate([base[:1], base[:-1]])) - see(base)
    wrong = see(current(told, **given)) - see(base)
    return _errors(ELECTRICAL, np.column_stack([*slopes, later, np.ones(len(time))]), wrong)


def _mechanical(drive: Drive, course: Course, load: Load, rate: float, sensing: Sensing) -> dict[str, float]:
    """Relative errors by the position; those that the datasheet leaves at 0 are left out."""
    ratio, shaft = drive.motor.gear_ratio, moved(drive, load)
    # by the names of a motor, at the rotor
    fields = {"inertia": ratio**2, "coulomb_friction": ratio, "viscous_friction": ratio**2}
    time = _row_times(course, rate, sensing)
    free = np.linalg.qr(np.column_stack([np.ones(time.shape[1]), np.arange(time.shape[1])]))[0]
    noise = 2.0 * math.pi / sensing.encoder / math.sqrt(12.0)
    names = [name for name in _MECHANICAL if _value(drive, load, name) > 0.0]
    still = np.zeros(len(course.time))

    def see(name: str, value: float) -> np.ndarray:
        changed = shaft._replace(**{name.removesuffix("_friction"): value * fields[name]})
        angle = simulation.moving()(course.time, course.current, still, 0.0, 0.0, changed)[0]
        seen = np.interp(time, course.time, angle) / noise
        return (seen - seen @ free @ free.T).ravel()

    slopes = [_slope(lambda value, name=name: see(name, value), _value(drive, load, name)) for name in names]  # type: ignore[misc]
    return _errors(names, np.column_stack(slopes), np.zeros(time.size))


def _row_times(course: Course, rate: float, sensing: Sensing) -> np.ndarray:
    """Times of the rows [s], shape (segments, rows)."""
    count = max(round(_SEGMENT * rate), 8)
    total = int((course.time[-1] - 1.0 / rate) * rate) // count * count
    phase = 0.0 if sensing.voltage == "together" else _PHASE
    return ((np.arange(total) + phase) / rate).reshape(-1, count)


def _slope(seen: Callable[[float], np.ndarray], value: float) -> np.ndarray:
    """How the rows change with a parameter, for a relative change of 1."""
    return (seen(value * (1.0 + _STEP)) - seen(value * (1.0 - _STEP))) / (2.0 * _STEP)


def _errors(names: Sequence[str], slopes: np.ndarray, wrong: np.ndarray) -> dict[str, float]:
    """Relative errors by variance and bias; those that the data do not determine are left out."""
    scales = np.linalg.norm(slopes, axis=0)
    used = scales > 0.0
    unit = slopes[:, used] / scales[used]
    values, vectors = np.linalg.eigh(unit.T @ unit)
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    spread = np.sqrt(np.diag(inverse)) / scales[used]
    shift = inverse @ (unit.T @ wrong) / scales[used]
    seen = [name for name, one in zip(names, used, strict=False) if one]
    found = dict(zip(seen, map(float, np.hypot(spread, shift)), strict=False))
    return {name: error for name, error in found.items() if error < 1.0}


def _told(drive: Drive, voltage: np.ndarray, rate: float, sensing: Sensing) -> np.ndarray:
    """The voltage in each of the drive's samples that the rows tell."""
    if sensing.voltage == "together":
        return voltage
    time, period = np.arange(len(voltage)) / drive.controller.sample_rate, 1.0 / drive.controller.sample_rate
    begin = (np.maximum(np.floor(time * rate - _PHASE + 1e-9), 0.0) + _PHASE) / rate
    if sensing.voltage == "instantaneous":
        return voltage[np.clip(np.floor(begin / period + 1e-9).astype(int), 0, len(voltage) - 1)]
    flux = np.concatenate([[0.0], np.cumsum(period * voltage[:-1])])
    return (np.interp(begin + 1.0 / rate, time, flux) - np.interp(begin, time, flux)) * rate


def _value(drive: Drive, load: Load, name: str) -> float:
    motor = drive.motor
    if name == "inertia":
        return motor.rotor_inertia + load.inertia / motor.gear_ratio**2
    return float(getattr(motor, name))
