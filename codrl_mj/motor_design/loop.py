"""The current loop of a drive: gains, margins, bandwidth, and its step by the drive's own equations.

As the sampled current sees it: the winding under a zero-order hold is (1 - e)/R/(z - e) with e = exp(-R*T/L), the PI
controller ((kp + ki*T)*z - kp)/(z - 1), the delay of a sample 1/z. Source: Franklin, Powell, Workman, *Digital Control
of Dynamic Systems*, ch. 4; `codrl_mj.actuators.sampled` has the design.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, Inputs, parameters_type
from codrl_mj.actuators.sampled import designed_gains
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH

RATES = (10e3, 20e3, 40e3)
"""Sample rates [Hz] that drives commonly have."""


def gains(drive: Drive) -> tuple[float, float]:
    """Proportional gain [V/A] and integral gain [V/(A*s)] of a drive's loop, designed or given."""
    loop = drive.controller
    if loop.kp != 0.0 or loop.ki != 0.0:
        return loop.kp, loop.ki
    kp, ki = designed_gains(*drive.winding, 1.0 / loop.sample_rate, 2.0 * math.pi * _bandwidth_asked(drive))
    return kp, ki * loop.sample_rate


def _bandwidth_asked(drive: Drive) -> float:
    """What the gains are designed for [Hz]."""
    return drive.controller.bandwidth or DEFAULT_BANDWIDTH * drive.controller.sample_rate


def open_loop(drive: Drive) -> Any:
    """The loop from error to sampled current, a `control.TransferFunction` in z."""
    import control

    time, (kp, ki), (resistance, inductance) = 1.0 / drive.controller.sample_rate, gains(drive), drive.winding
    decay = math.exp(-resistance * time / inductance)
    effect = -math.expm1(-resistance * time / inductance) / resistance  # [A/V], of a sample
    late = [1.0, 0.0] if drive.controller.delayed else [1.0]
    poles = np.polymul(np.polymul([1.0, -decay], [1.0, -1.0]), late)
    return control.TransferFunction([effect * (kp + ki * time), -effect * kp], poles, time)


def closed_loop(drive: Drive) -> Any:
    """The loop from reference to sampled current, a `control.TransferFunction` in z."""
    import control

    return control.feedback(open_loop(drive), 1)


class Response(NamedTuple):
    """A drive's currents over time; entry 0 is the start."""

    time: np.ndarray
    """[s]"""
    reference: np.ndarray
    """Current asked for [A], from each time on."""
    current: np.ndarray
    """Sampled current [A]."""
    voltage: np.ndarray
    """Terminal voltage [V], from each time on."""

    @property
    def overshoot(self) -> float:
        """How far the current goes beyond the last reference, as a share of it."""
        return max(float(self.current.max() / self.reference[-1]) - 1.0, 0.0)

    def settling_time(self, band: float = 0.02) -> float:
        """When the current stays within a share of the last reference [s after that came]; NaN: not within sight."""
        start = int(np.flatnonzero(np.diff(self.reference, prepend=math.nan) != 0.0)[-1])
        wrong = np.flatnonzero(np.abs(self.current[start:] / self.reference[-1] - 1.0) > band)
        settled = start + (int(wrong[-1]) + 1 if len(wrong) else 0)
        return float(self.time[settled] - self.time[start]) if settled < len(self.time) else math.nan


def respond(drive: Drive, references: Any, speed: float = 0.0) -> Response:
    """Step a drive one sample at a time, through `Drive.advance`, from where it has held a current of 0 at its speed.

    Args:
        drive: which.
        references: current asked for in each sample [A], shape (n,).
        speed: of the rotor [rad/s], held.
    """
    parameters, time = parameters_type(Drive)(*drive.numbers), 1.0 / drive.controller.sample_rate
    back_emf = drive.motor.back_emf_constant * speed
    integral = 0.0 if drive.controller.bemf_compensation else back_emf
    kind: Any = drive.State
    state = kind(*[0.0] * len(kind._fields))._replace(integral=integral, pending=back_emf, speed=speed)
    rows = []
    for reference in references:
        before = state.current
        torque = drive.motor.torque_constant * float(reference)
        state, _, signals = drive.advance(parameters, time, state, Inputs(torque, 0.0, speed, 0.0, 0.0))
        rows.append((signals.reference_current, before, signals.voltage))
    return Response(time * np.arange(len(rows)), *np.array(rows).T)


def small_step(drive: Drive) -> Response:
    """The step from rest to a current that does not saturate.

    It is a tenth of V/R, or what half the voltage makes at once, or `max_current`, whichever is smallest. It lasts 20
    time constants of the designed loop, or of the winding under given gains, and 100 to 20000 samples.
    """
    (kp, ki), loop = gains(drive), drive.controller
    at_once = 0.5 * drive.voltage_limit / (kp + ki / loop.sample_rate)
    amplitude = min(0.1 * drive.voltage_limit / drive.motor.resistance, at_once, loop.max_current)
    designed = loop.kp == 0.0 and loop.ki == 0.0
    constant = 1.0 / (2.0 * math.pi * _bandwidth_asked(drive)) if designed else drive.motor.electrical_time_constant
    samples = min(max(math.ceil(20.0 * constant * loop.sample_rate), 100), 20_000)
    return respond(drive, np.full(samples, amplitude))


@dataclasses.dataclass(frozen=True)
class LoopDesign:
    """A current loop and what follows from it; NaN where there is none below half the sample rate."""

    sample_rate: float
    """[Hz]"""
    delayed: bool
    """Whether the voltage comes a sample late."""
    kp: float
    """[V/A]"""
    ki: float
    """[V/(A*s)]"""
    gain_margin: float
    """Factor on the gain at which the loop oscillates."""
    phase_margin: float
    """Phase [deg] that is left at the crossover."""
    phase_crossover: float
    """Where the open loop's phase is -180 degrees [Hz]: the gain margin is read there."""
    crossover: float
    """Where the open loop's gain is 1 [Hz]: the phase margin is read there."""
    bandwidth: float
    """Where the closed loop's gain falls to 1/sqrt(2) [Hz]."""
    settling_time: float
    """Of a small step, to 2 % [s]."""
    overshoot: float
    """Of a small step, as a share of it."""


def design(drive: Drive) -> LoopDesign:
    """Judge a drive's current loop: margins of its transfer function, a step of the drive itself.

    Raises:
        ValueError: the loop is unstable; the message has the spectral radius and a remedy.
    """
    loop = drive.controller
    drive.check(1.0 / loop.sample_rate)
    step = small_step(drive)
    return LoopDesign(
        loop.sample_rate,
        loop.delayed,
        *gains(drive),
        *_margins(drive),
        step.settling_time(),
        step.overshoot,
    )


def designs(drive: Drive, rates: Any = None) -> dict[tuple[float, bool], LoopDesign | str]:
    """`design` without and with the delay of a sample; a text says why there is none.

    Args:
        drive: whose bandwidth is kept, or gains where they are given.
        rates: sample rates [Hz]; None: `RATES` and the drive's own.
    """
    found: dict[tuple[float, bool], LoopDesign | str] = {}
    for rate in sorted({drive.controller.sample_rate, *RATES}) if rates is None else rates:
        for delayed in (False, True):
            try:
                loop = dataclasses.replace(drive.controller, sample_rate=rate, delayed=delayed)
                found[rate, delayed] = design(dataclasses.replace(drive, controller=loop))
            except ValueError as error:
                found[rate, delayed] = str(error)
    return found


def _margins(drive: Drive) -> tuple[float, float, float, float, float]:
    """Gain margin, phase margin [deg], phase crossover, crossover and bandwidth [Hz].

    They are searched for on the unit circle, which slow loops and the pole at z = 1 leave exact; python-control's
    margins, by the roots of polynomials, are not. At half the sample rate, z = -1, the loop is real: without a
    crossing before, the gain margin is read there.
    """
    rate, opened, closed = drive.controller.sample_rate, open_loop(drive), closed_loop(drive)
    turned = _first_below(lambda z: -opened(z).imag, rate)
    turned = 0.5 * rate if math.isnan(turned) else turned
    crossover = _first_below(lambda z: abs(opened(z)) - 1.0, rate)
    bandwidth = _first_below(lambda z: abs(closed(z)) - math.sqrt(0.5), rate)
    left = 180.0 + math.degrees(np.angle(opened(_point(crossover, rate)))) if crossover > 0.0 else math.nan
    return float(1.0 / abs(opened(_point(turned, rate)))), left, turned, crossover, bandwidth


def _point(frequency: Any, rate: float) -> Any:
    """On the unit circle: the z of a frequency [Hz]."""
    return np.exp(2j * math.pi * frequency / rate)


def _first_below(function: Any, rate: float) -> float:
    """The first frequency [Hz] at which a function of z falls below 0; NaN where it never does, or always is."""
    from scipy.optimize import brentq

    frequencies = np.geomspace(1e-7, 0.49999, 4000) * rate
    below = np.flatnonzero(function(_point(frequencies, rate)) < 0.0)
    if not len(below) or below[0] == 0:
        return math.nan
    around = frequencies[below[0] - 1], frequencies[below[0]]
    return float(brentq(lambda frequency: float(function(_point(frequency, rate))), *around))
