"""Which excitation, sample rate and amplitude a motor needs: what each would tell, before anything is measured.

The errors expected are those of a fit to a log without noise, at the truth: by the noise that will
be and by the fit's own Jacobian (Fisher information), and those of a winding by a voltage that is
taken as held where it changes. Winding and shaft stand each for itself: the current under voltage
and speed, the position under the measured current. Source: Ljung, *System Identification* (2nd ed.
1999), sec. 7.4 and 13.2.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.fields import Checked, choice, real
from codrl_mj.identify.estimate import Model, refit
from codrl_mj.identify.log import Log, Segment
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import DEFAULTS, ELECTRICAL, OF_LOSS, PARAMETERS
from codrl_mj.identify.synthetic import (
    EXCITATIONS,
    FREE,
    Excitation,
    Load,
    Sampler,
    check_size,
    run,
    sample_times,
    simulate,
)
from codrl_mj.runs.files import atomic_write

GOALS = {
    "resistance": 0.02,
    "inductance": 0.10,
    "back_emf_constant": 0.02,
    "inertia": 0.05,
    "coulomb_friction": 0.05,
    "viscous_friction": 0.05,
}
"""Relative error of each parameter that a plan is to reach."""
MARGIN = (
    3.0  # by which a plan's errors are below the goals, because a bench has more faults than noise
)
RATES = (1e3, 2e3, 5e3, 10e3, 20e3)  # rows a second [Hz] that are tried
_SEGMENT = 0.25  # [s]
_PHASE = 0.37  # of a row, by which the rows miss the excitation's clock


@dataclasses.dataclass(frozen=True)
class Sensing(Checked):
    """What is measured, how well."""

    current_noise: float = real(0.01, above=0.0, unit="")
    """Standard deviation of the current's noise as a share of the largest current, > 0."""
    encoder: float = real(4096.0, above=0.0, unit="")
    """Steps of the position a turn of the output, > 0."""
    voltage: Literal["together", "instantaneous", "mean"] = choice(
        "together", "together", "instantaneous", "mean"
    )
    """How the rows have the voltage: `together`, it changes when a row is written and not in
    between; else it changes by a clock of its own, and a row has what it is at the time, or its
    mean to the next row.
    """


class Option(NamedTuple):
    """An excitation at a sample rate, and what it would tell."""

    excitation: Excitation
    rate: float  # rows a second [Hz]
    peak_current: float  # [A]
    rms_current: float  # root mean square [A]
    errors: dict[
        str, float
    ]  # parameter -> relative error expected; what cannot be seen is left out

    @property
    def worst(self) -> float:
        """The largest error over its goal; infinite where one of the electrical parameters cannot be seen."""
        if any(name not in self.errors for name in ELECTRICAL):
            return math.inf
        return max(error / GOALS[name] for name, error in self.errors.items())


class Plan(NamedTuple):
    """All options, and the one to play."""

    options: list[Option]
    # that of the lowest rate that is below all goals by `MARGIN`; else that which comes closest
    best: Option
    missed: list[str]  # parameters that it does not reach the goals of
    unknown: list[str]  # parameters that the datasheet leaves at 0, of which nothing can be said


def plan(
    drive: Drive,
    load: Load = FREE,
    sensing: Sensing | None = None,
    duration: float = 4.0,
    max_current: float = math.inf,
    continuous_current: float = math.inf,
) -> Plan:
    """Compare excitations and sample rates for a motor whose parameters are about known.

    A log lasts `duration` [s]; the current stays below `max_current` [A] of the bench and below the
    drive's own, its root mean square below `continuous_current` [A] of the motor.
    """
    if not duration >= 4.0 * _SEGMENT:
        raise ValueError(
            f"duration = {duration!r}: must be at least {4.0 * _SEGMENT:g} s; log for longer"
        )
    limit = min(max_current, drive.controller.max_current)
    for name, value in (("max_current", max_current), ("continuous_current", continuous_current)):
        if not value > 0.0:
            raise ValueError(
                f"{name} = {value!r}: must be above 0 A; leave it out if there is no limit"
            )
    motor, fastest = drive.motor, drive.controller.sample_rate
    rates = [rate for rate in RATES if rate <= fastest] or [fastest]
    truth = {**vars(motor), "inertia": motor.rotor_inertia * motor.gear_ratio**2 + load.inertia}
    check_size(drive, duration, rates[-1])
    options = [
        _option(
            drive,
            kind,
            rate,
            duration,
            load,
            sensing or Sensing(),
            (limit, continuous_current),
            truth,
        )
        for kind in EXCITATIONS
        for rate in rates
    ]
    reached = [option for option in options if option.worst <= 1.0 / MARGIN]
    best = (
        min(reached, key=lambda one: (one.rate, one.worst))
        if reached
        else min(options, key=lambda one: one.worst)
    )
    names = [name for name in GOALS if truth[name] > 0.0]
    missed = [name for name in names if best.errors.get(name, math.inf) > GOALS[name]]
    return Plan(options, best, missed, [name for name in GOALS if name not in names])


def write_excitation(path: Path, option: Option) -> None:
    """Write what to play as CSV, a row for each change at the option's rate: `time` [s], `voltage` [V]."""
    time = np.arange(round(option.excitation.duration * option.rate) + 1) / option.rate
    table = np.column_stack([time, option.excitation.voltage(time + 1e-9 / option.rate)])
    with atomic_write(path) as temporary:
        np.savetxt(temporary, table, fmt="%.10g", delimiter=",", header="time,voltage", comments="")


def _option(
    drive: Drive,
    kind: str,
    rate: float,
    duration: float,
    load: Load,
    sensing: Sensing,
    limits: tuple[float, float],
    truth: Mapping[str, float],
) -> Option:
    """An excitation at a rate, as large as the supply, the largest and the continuous current allow."""
    constant, together = drive.motor.electrical_time_constant, sensing.voltage == "together"
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
    time, amplitude = sample_times(drive, duration), excitation.amplitude
    shape = (
        excitation.voltage(
            np.floor(time * rate + 1e-6) / rate if together else time + _PHASE / rate
        )
        / amplitude
    )
    for _ in range(8):  # the response is nearly in proportion to the voltage
        current = run(drive, amplitude * shape, held).signals["current"]
        peak, rms = float(np.abs(current).max()), float(np.sqrt(np.mean(current**2)))
        excess = max(peak / limits[0], rms / limits[1])
        if excess <= 1.0:
            break
        amplitude *= 0.98 / excess
    log = simulate(
        drive,
        amplitude * shape,
        held,
        sampler=Sampler(rate, mean_voltage=sensing.voltage == "mean"),
    )
    excitation = dataclasses.replace(excitation, amplitude=amplitude)
    return Option(excitation, rate, peak, rms, _expected(truth, held, sensing, log))


def _expected(
    truth: Mapping[str, float], load: Load, sensing: Sensing, log: Log
) -> dict[str, float]:
    """Relative errors of a winding by the current, at the speed that is, and of a shaft by the position.

    The torque is known by the back-EMF constant; what the datasheet leaves at 0 is left out.
    """
    deviation = sensing.current_noise * float(np.abs(log.signals["current"]).max())
    turned = np.append(np.diff(log.signals["position"]) / np.diff(log.time), 0.0)
    winding = WindingModel(known={"gear_ratio": truth["gear_ratio"]})
    errors = _errors(truth, winding, winding.segments([log], [turned]), deviation)
    if load.locked:
        return errors
    known = {
        name: truth[name]
        for name in PARAMETERS
        if name in truth and name not in ("inertia", "rotor_inertia")
    }
    known |= {"mgl": load.gravity, "constant_torque": load.against}
    known = {name: value for name, value in known.items() if name not in GOALS or value == 0.0}
    losses = {name: truth[name] for name in OF_LOSS}
    shaft = ShaftModel(rig="free", friction="coulomb", driven_by="current", output="position", known=known,
                       defaults=DEFAULTS | losses, segment=_SEGMENT)  # fmt: skip
    by_position = _errors(
        truth, shaft, shaft.segments([log]), 2.0 * math.pi / sensing.encoder / math.sqrt(12.0)
    )
    constant = errors.get("back_emf_constant", 0.0)
    return errors | {name: math.hypot(error, constant) for name, error in by_position.items()}


def _errors(
    truth: Mapping[str, float], model: Model, segments: Sequence[Segment], deviation: float
) -> dict[str, float]:
    """Relative errors of a fit by noise, and of a winding by what it cannot explain; those above 1 are left out."""
    model, _ = model.begun(segments)
    values = np.array([truth[name] for name in model.names])
    fit = refit(model, [one._replace(deviation=deviation) for one in segments], values, 0)
    inverse = np.linalg.pinv(np.concatenate(fit.jacobians) * values)
    found = np.linalg.norm(inverse, axis=1)
    if isinstance(model, WindingModel):
        found = np.hypot(found, inverse @ np.concatenate(fit.residuals))
    return {
        name: float(error)
        for name, error in zip(model.names, found, strict=True)
        if 0.0 < error < 1.0
    }
