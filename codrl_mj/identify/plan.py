"""Choice of the excitation, sample rate and amplitude for a motor, before a measurement.

A log is simulated without noise. The expected errors follow from the noise of the sensors and the
Jacobian of the fit at the true parameters (Fisher information). For a winding they include the bias
from a voltage that changes between rows, but is modeled as held. Winding and shaft
are fitted separately: the winding to the current, driven by voltage and speed, and the shaft to the
position, driven by the measured current. Source: Ljung, *System Identification* (2nd ed. 1999),
sec. 7.4 and 13.2.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.fields import Checked, choice, real
from codrl_mj.identify.estimate import Model, optimize
from codrl_mj.identify.log import Log, Segment
from codrl_mj.identify.models import ShaftModel, WindingModel
from codrl_mj.identify.parameters import DEFAULTS, ELECTRICAL, LOSS_PARAMETERS, PARAMETERS
from codrl_mj.identify.synthetic import (
    EXCITATIONS,
    FREE,
    Excitation,
    Load,
    Sampler,
    check_size,
    sample_times,
    simulate,
    simulate_drive,
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
"""Parameter -> relative error that a plan aims at."""
# A real bench has other errors than noise, so that real errors are larger than expected ones.
MARGIN = 3.0
"""Factor by which the expected errors of a good plan are below the goals."""
RATES = (1e3, 2e3, 5e3, 10e3, 20e3)
"""Sample rates [Hz] that are compared."""
_SEGMENT = 0.25  # duration of a segment [s]
_PHASE = 0.37  # offset between the clocks of the voltage and of the rows, in row periods


@dataclasses.dataclass(frozen=True)
class Sensing(Checked):
    """Accuracy of the sensors and timing of the voltage."""

    current_noise: float = real(0.01, above=0.0, unit="")
    """Standard deviation of the current's noise as a share of the largest current, > 0."""
    encoder: float = real(4096.0, above=0.0, unit="")
    """Encoder steps per turn of the output, > 0."""
    voltage: Literal["together", "instantaneous", "mean"] = choice(
        "together", "together", "instantaneous", "mean"
    )
    """Timing of the logged voltage. With `together` the voltage changes only when a row is written.
    Otherwise it changes at other times, and a row contains its `instantaneous` value, or its `mean`
    until the next row.
    """


class Option(NamedTuple):
    """An excitation at a sample rate, with the expected errors."""

    excitation: Excitation
    rate: float  # rate of the rows [Hz]
    peak_current: float  # [A]
    rms_current: float  # [A]
    # Parameter -> expected relative error; parameters that cannot be identified are left out.
    errors: dict[str, float]

    @property
    def worst(self) -> float:
        """Largest ratio of an error to its goal; infinite if an electrical parameter is missing."""
        if any(name not in self.errors for name in ELECTRICAL):
            return math.inf
        return max(error / GOALS[name] for name, error in self.errors.items())


class Plan(NamedTuple):
    """All options, and the best one."""

    options: list[Option]
    # Among the options whose errors are below all goals by the factor `MARGIN`, the option with the
    # lowest rate. If there is none, the option with the smallest `worst`.
    best: Option
    missed_goals: list[str]  # parameters whose goals the best option misses
    unknown: list[str]  # parameters that are 0 on the datasheet, so that no error can be expected


def plan(
    drive: Drive,
    load: Load = FREE,
    sensing: Sensing | None = None,
    duration: float = 4.0,
    max_current: float = math.inf,
    continuous_current: float = math.inf,
) -> Plan:
    """Compare excitations and sample rates for a motor whose parameters are roughly known.

    Args:
        drive: drive with the motor, the supply and the current limit.
        load: load at the output.
        sensing: accuracy of the sensors; None takes the defaults.
        duration: duration of a log [s].
        max_current: largest current of the bench [A]; the drive's limit applies, too.
        continuous_current: largest RMS current of the motor [A].
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
    good = [option for option in options if option.worst <= 1.0 / MARGIN]
    best = (
        min(good, key=lambda choice: (choice.rate, choice.worst))
        if good
        else min(options, key=lambda choice: choice.worst)
    )
    names = [name for name in GOALS if truth[name] > 0.0]
    missed_goals = [name for name in names if best.errors.get(name, math.inf) > GOALS[name]]
    return Plan(options, best, missed_goals, [name for name in GOALS if name not in names])


def write_excitation(path: Path, option: Option) -> None:
    """Write an option's voltage as CSV at its rate, with columns `time` [s] and `voltage` [V]."""
    # With the small offset, a sample at the instant of a voltage change has the new voltage.
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
    """Assess an excitation at a rate, with the largest amplitude that the limits allow.

    The limits are the supply and `limits`, the largest peak and RMS current [A].
    """
    time_constant, together = drive.motor.electrical_time_constant, sensing.voltage == "together"
    excitation = Excitation(
        kind,
        drive.voltage_limit,
        duration,
        frequency=2.0 if kind == "square" else 0.5,
        highest=min(200.0, 0.5 / time_constant),
        # The number of rows between changes is even, so that a log of every second row still
        # contains all changes.
        clock=(
            2 * max(round(2.0 * time_constant * rate), 1) / rate
            if together
            else 4.0 * time_constant
        ),
    )
    locked_load = dataclasses.replace(load, locked=load.locked or excitation.locked)
    time, amplitude = sample_times(drive, duration), excitation.amplitude
    unit_voltage = (
        excitation.voltage(
            np.floor(time * rate + 1e-6) / rate if together else time + _PHASE / rate
        )
        / amplitude
    )
    # The response is nearly proportional to the voltage, so that few iterations suffice.
    for _ in range(8):
        current = simulate_drive(drive, amplitude * unit_voltage, locked_load).signals["current"]
        peak, rms = float(np.abs(current).max()), float(np.sqrt(np.mean(current**2)))
        excess = max(peak / limits[0], rms / limits[1])
        if excess <= 1.0:
            break
        amplitude *= 0.98 / excess
    log = simulate(
        drive,
        amplitude * unit_voltage,
        locked_load,
        sampler=Sampler(rate, mean_voltage=sensing.voltage == "mean"),
    )
    excitation = dataclasses.replace(excitation, amplitude=amplitude)
    return Option(excitation, rate, peak, rms, _expected_errors(truth, locked_load, sensing, log))


def _expected_errors(
    truth: Mapping[str, float], load: Load, sensing: Sensing, log: Log
) -> dict[str, float]:
    """Return the expected relative errors of the parameters of a winding and a shaft.

    The winding is fitted to the current with the true speed, the shaft to the position. The torque
    constant is assumed to have the same relative error as the back-EMF constant. Parameters that
    are 0 on the datasheet are left out.
    """
    deviation = sensing.current_noise * float(np.abs(log.signals["current"]).max())
    speed = np.append(np.diff(log.signals["position"]) / np.diff(log.time), 0.0)
    winding = WindingModel(known={"gear_ratio": truth["gear_ratio"]})
    errors = _fit_errors(truth, winding, winding.segments([log], [speed]), deviation)
    if load.locked:
        return errors
    known = {
        name: truth[name]
        for name in PARAMETERS
        if name in truth and name not in ("inertia", "rotor_inertia")
    }
    known |= {"mgl": load.gravity, "constant_torque": load.against}
    known = {name: value for name, value in known.items() if name not in GOALS or value == 0.0}
    losses = {name: truth[name] for name in LOSS_PARAMETERS}
    shaft = ShaftModel(
        rig="free",
        friction="coulomb",
        driven_by="current",
        output="position",
        known=known,
        defaults=DEFAULTS | losses,
        segment=_SEGMENT,
    )
    shaft_errors = _fit_errors(
        truth, shaft, shaft.segments([log]), 2.0 * math.pi / sensing.encoder / math.sqrt(12.0)
    )
    constant_error = errors.get("back_emf_constant", 0.0)
    return errors | {
        name: math.hypot(error, constant_error) for name, error in shaft_errors.items()
    }


def _fit_errors(
    truth: Mapping[str, float], model: Model, segments: Sequence[Segment], deviation: float
) -> dict[str, float]:
    """Return the relative errors of a fit from noise and, for a winding, from its residuals.

    Errors above 1 are left out.
    """
    model, _ = model.initial_guess(segments)
    values = np.array([truth[name] for name in model.names])
    # With 0 evaluations `optimize` computes only the residuals and the Jacobian at the true values.
    fit = optimize(
        model, [segment._replace(deviation=deviation) for segment in segments], values, 0
    )
    inverse = np.linalg.pinv(np.concatenate(fit.jacobians) * values)
    errors = np.linalg.norm(inverse, axis=1)
    if isinstance(model, WindingModel):
        errors = np.hypot(errors, inverse @ np.concatenate(fit.residuals))
    return {
        name: float(error)
        for name, error in zip(model.names, errors, strict=True)
        if 0.0 < error < 1.0
    }
