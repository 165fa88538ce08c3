"""Current loop of a `Drive` or a `DCMotorActuator`: gains, margins, bandwidth and step responses.

Transfer functions refer to the sampled current. For a `Drive`, the winding with a zero-order hold
is (1 - e)/R/(z - e) with e = exp(-R*T/L), the PI controller is ((kp + ki*T)*z - kp)/(z - 1), and
the delay of a sample is 1/z. Source: Franklin, Powell, Workman, *Digital Control of Dynamic
Systems*, ch. 4; the design is in `codrl_mj.actuators.sampled`. A `DCMotorActuator` integrates its
winding by Euler's rule, T/L/(z - 1 + R*T/L), with the PID controller of
`codrl_mj.actuators.current_loop`. Its sample rate is substeps/timestep, so the functions take the
mechanical timestep [s].
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import DCMotorActuator, Drive, Inputs, parameters_type
from codrl_mj.actuators.parameters import family_of
from codrl_mj.actuators.sampled import designed_gains
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.fields import check_memory

CurrentLoopActuator = Drive | DCMotorActuator
# mypy does not read python-control.
TransferFunction = Any
"""A `control.TransferFunction`."""
# Memory [bytes] of the step responses with all kinds of anti-windup, for each sample.
_SAMPLE_SIZE = 500
RATES = (10e3, 20e3, 40e3)
"""Common sample rates of drives [Hz]."""


def is_closed(actuator: CurrentLoopActuator) -> bool:
    """Return True if the current loop is closed: a gain on the error is not 0."""
    return isinstance(actuator, Drive) or any(
        (actuator.controller.kp, actuator.controller.ki, actuator.controller.kd)
    )


def loop_gains(drive: Drive) -> tuple[float, float]:
    """Return the proportional gain [V/A] and the integral gain [V/(A*s)] of a drive's loop."""
    loop = drive.controller
    if loop.kp != 0.0 or loop.ki != 0.0:
        return loop.kp, loop.ki
    bandwidth = loop.bandwidth or DEFAULT_BANDWIDTH * loop.sample_rate
    kp, ki = designed_gains(*drive.winding, 1.0 / loop.sample_rate, 2.0 * math.pi * bandwidth)
    return kp, ki * loop.sample_rate


def undersampling_warning(drive: Drive) -> str:
    """Return a warning if a sample is longer than three L/R of the winding; otherwise empty."""
    # Within three time constants a current makes 95 % of its change.
    rate, constant = drive.controller.sample_rate, drive.motor.electrical_time_constant
    text = (
        f"sample_rate = {rate:g} Hz: a sample lasts {1.0 / rate / constant:,.1f} times the"
        " winding's L/R = "
    )
    text += f"{1e3 * constant:.3g} ms, so that the current settles before the loop sees it: take "
    return "" if 3.0 * rate * constant >= 1.0 else f"{text}{1.0 / 3.0 / constant:,.0f} Hz or more"


class _Sampled(NamedTuple):
    """Discrete transfer functions of a current loop, with its gains and limits."""

    rate: float  # sample rate [Hz]
    gains: tuple[float, float]  # proportional [V/A], integral [V/(A*s)]
    numerator: np.ndarray  # from error to sampled current
    denominator: np.ndarray
    reference_numerator: np.ndarray  # numerator from reference to sampled current
    initial_gain: float  # voltage per ampere in the first sample of a step [V/A]
    # Time constant [s] of the designed loop; with explicit gains, that of the winding.
    time_constant: float
    max_current: float = math.inf  # largest reference current [A]
    delayed: bool = False  # True if the voltage is applied one sample late


def _sampled(actuator: CurrentLoopActuator, timestep: float | None) -> _Sampled:
    """Return the loop of a drive, or of a `DCMotorActuator` with a mechanical step [s]."""
    resistance, inductance = actuator.winding
    time_constant = inductance / resistance
    if isinstance(actuator, Drive):
        (kp, ki), rate = loop_gains(actuator), actuator.controller.sample_rate
        period = 1.0 / rate
        if actuator.controller.kp == 0.0 and actuator.controller.ki == 0.0:
            time_constant = 1.0 / (
                2.0 * math.pi * (actuator.controller.bandwidth or DEFAULT_BANDWIDTH * rate)
            )
        decay = math.exp(-resistance * period / inductance)
        input_gain = (
            -math.expm1(-resistance * period / inductance) / resistance
        )  # [A/V] in a sample
        numerator = np.array([input_gain * (kp + ki * period), -input_gain * kp])
        delay = [1.0, 0.0] if actuator.controller.delayed else [1.0]
        denominator = np.polymul(np.polymul([1.0, -decay], [1.0, -1.0]), delay)
        max_current, delayed = actuator.controller.max_current, actuator.controller.delayed
        return _Sampled(
            rate,
            (kp, ki),
            numerator,
            denominator,
            numerator,
            kp + ki / rate,
            time_constant,
            max_current,
            delayed,
        )
    if timestep is None:
        raise ValueError(
            "timestep = None: must be the mechanical step [s] of a DCMotorActuator, whose loop"
            " is sampled within it"
        )
    rate, loop = actuator.controller.substeps / timestep, actuator.controller
    period = 1.0 / rate
    pid, pid_denominator = np.array([loop.kp]), np.array([1.0])  # from error [A] to voltage [V]
    for gain, term_numerator, term_denominator in (
        (loop.ki, [period, 0.0], [1.0 + loop.integral_leak * period, -1.0]),
        (
            loop.kd,
            [1.0, -1.0],
            [period + loop.derivative_time_constant, -loop.derivative_time_constant],
        ),
    ):
        if gain:
            pid = np.polyadd(
                np.polymul(pid, term_denominator),
                gain * np.polymul(term_numerator, pid_denominator),
            )
            pid_denominator = np.polymul(pid_denominator, term_denominator)
    numerator = pid * period / inductance
    denominator = np.polymul(pid_denominator, [1.0, resistance * period / inductance - 1.0])
    # The feed-forward bypasses the error, so it appears only in the numerator from the reference.
    reference_numerator = np.polyadd(numerator, loop.kff * period / inductance * pid_denominator)
    initial_gain = pid[0] / pid_denominator[0] + loop.kff
    return _Sampled(
        rate,
        (loop.kp, loop.ki),
        numerator,
        denominator,
        reference_numerator,
        initial_gain,
        time_constant,
    )


def open_loop(actuator: CurrentLoopActuator, timestep: float | None = None) -> TransferFunction:
    """Return the transfer function from error to sampled current, in z."""
    import control

    loop = _sampled(actuator, timestep)
    return control.TransferFunction(loop.numerator, loop.denominator, 1.0 / loop.rate)


def closed_loop(actuator: CurrentLoopActuator, timestep: float | None = None) -> TransferFunction:
    """Return the transfer function from reference to sampled current, in z."""
    import control

    loop = _sampled(actuator, timestep)
    return control.TransferFunction(
        loop.reference_numerator, np.polyadd(loop.denominator, loop.numerator), 1.0 / loop.rate
    )


class Response(NamedTuple):
    """Response of a current loop over time; entry 0 is the start."""

    time: np.ndarray
    """Time [s]."""
    reference: np.ndarray
    """Reference current [A], from each time on."""
    current: np.ndarray
    """Sampled current [A]."""
    voltage: np.ndarray
    """Terminal voltage [V], from each time on."""

    @property
    def overshoot(self) -> float:
        """Overshoot of the current over the last reference, as a share of it."""
        return max(float(self.current.max() / self.reference[-1]) - 1.0, 0.0)

    @property
    def _last(self) -> int:
        """Index from which the last reference applies."""
        return int(np.flatnonzero(np.diff(self.reference, prepend=math.nan) != 0.0)[-1])

    @property
    def undershoot(self) -> float:
        """Largest deficit of the current below the last reference, as a share of it."""
        return max(1.0 - float(self.current[self._last :].min()) / float(self.reference[-1]), 0.0)

    def settling_time(self, band: float = 0.02) -> float:
        """Return the time [s] from the last step until the current stays in a band, or NaN."""
        outside = np.flatnonzero(
            np.abs(self.current[self._last :] / self.reference[-1] - 1.0) > band
        )
        settled = self._last + (int(outside[-1]) + 1 if len(outside) else 0)
        return (
            float(self.time[settled] - self.time[self._last])
            if settled < len(self.time)
            else math.nan
        )


def simulate_loop(
    actuator: CurrentLoopActuator,
    references: Sequence[float] | np.ndarray,
    speed: float = 0.0,
    timestep: float | None = None,
) -> Response:
    """Simulate a loop sample by sample with the actuator's `advance`, from a settled current of 0.

    Args:
        actuator: drive, or `DCMotorActuator` at a speed of 0, whose sensor is made exact.
        references: reference current of each sample [A], shape (n,).
        speed: constant speed of the rotor [rad/s].
        timestep: mechanical timestep of a `DCMotorActuator` [s]; not used for a drive.
    """
    period = 1.0 / _sampled(actuator, timestep).rate
    # The states of the two classes have different fields.
    state_type: Any = actuator.State
    state = state_type(*[0.0] * len(state_type._fields))
    if isinstance(actuator, Drive):
        back_emf = actuator.motor.back_emf_constant * speed
        # At constant speed and zero current the integrator holds the back-EMF, unless it is
        # compensated.
        integral = 0.0 if actuator.controller.bemf_compensation else back_emf
        state = state._replace(integral=integral, pending=back_emf, speed=speed)
    else:
        exact_sensor = {"substeps": 1, "current_bias": 0.0, "current_noise": 0.0}
        actuator = actuator.replaced(
            {f"controller.{name}": value for name, value in exact_sensor.items()}
        )
    parameters, rows = parameters_type(family_of(actuator))(*actuator.parameter_values), []
    for reference in references:
        sampled_current = state.current
        torque = actuator.motor.torque_constant * float(reference)
        state, _, signals = actuator.advance(
            parameters, period, state, Inputs(torque, 0.0, speed, 0.0, 0.0)
        )
        rows.append((signals.reference_current, sampled_current, signals.voltage))
    return Response(period * np.arange(len(rows)), *np.array(rows).T)


def small_step_response(actuator: CurrentLoopActuator, timestep: float | None = None) -> Response:
    """Return the response from rest to a current step that does not saturate.

    The step is the smallest of V/R/10, the current whose first sample needs half the voltage, and
    `max_current`; it is 1 A if all of these are infinite. It lasts 20 time constants (of the
    designed loop, or of the winding with explicit gains), but at least 100 and at most 20000
    samples.
    """
    loop, limit = _sampled(actuator, timestep), actuator.voltage_limit
    amplitude = min(
        0.1 * limit / actuator.winding[0], 0.5 * limit / loop.initial_gain, loop.max_current
    )
    samples = min(max(math.ceil(20.0 * loop.time_constant * loop.rate), 100), 20_000)
    return simulate_loop(
        actuator,
        np.full(samples, amplitude if math.isfinite(amplitude) else 1.0),
        timestep=timestep,
    )


@dataclasses.dataclass(frozen=True)
class LoopAnalysis:
    """Margins, bandwidth and step response of a current loop.

    Frequencies at which a response crosses a level are NaN if there is none below half the sample
    rate.
    """

    sample_rate: float
    """Sample rate [Hz]."""
    delayed: bool
    """True if the voltage is applied one sample late."""
    kp: float
    """Proportional gain [V/A]."""
    ki: float
    """Integral gain [V/(A*s)]."""
    gain_margin: float
    """Factor on the gain at which the loop oscillates."""
    phase_margin: float
    """Phase margin [deg], at the crossover."""
    phase_crossover: float
    """Frequency at which the open loop's phase is -180 degrees [Hz]; defines the gain margin."""
    crossover: float
    """Frequency at which the open loop's gain is 1 [Hz]; defines the phase margin."""
    bandwidth: float
    """Frequency at which the closed loop's gain falls to 1/sqrt(2) [Hz]."""
    settling_time: float
    """Settling time of a small step, to 2 % [s]."""
    overshoot: float
    """Overshoot of a small step, as a share of it."""


def analyze_loop(actuator: CurrentLoopActuator, timestep: float | None = None) -> LoopAnalysis:
    """Analyze a current loop: margins of its transfer function and a simulated step.

    Raises:
        ValueError: the loop is unstable; the message has the spectral radius and a remedy.
    """
    loop = _sampled(actuator, timestep)
    actuator.check(1.0 / loop.rate if timestep is None else timestep)
    open_transfer = open_loop(actuator, timestep)
    closed_transfer = closed_loop(actuator, timestep)
    response = small_step_response(actuator, timestep)
    # A search on the unit circle is accurate even for slow loops and the pole at z = 1, unlike the
    # polynomial roots that python-control uses. At half the sample rate (z = -1) the loop is real:
    # without an earlier crossing, the gain margin is defined there.
    phase_crossover = _first_below(lambda z: -open_transfer(z).imag, loop.rate)
    phase_crossover = 0.5 * loop.rate if math.isnan(phase_crossover) else phase_crossover
    crossover = _first_below(lambda z: abs(open_transfer(z)) - 1.0, loop.rate)
    at_crossover = open_transfer(_point(crossover, loop.rate)) if crossover > 0.0 else math.nan
    return LoopAnalysis(
        loop.rate,
        loop.delayed,
        *loop.gains,
        gain_margin=float(1.0 / abs(open_transfer(_point(phase_crossover, loop.rate)))),
        phase_margin=180.0 + math.degrees(np.angle(at_crossover)),
        phase_crossover=phase_crossover,
        crossover=crossover,
        bandwidth=_first_below(lambda z: abs(closed_transfer(z)) - math.sqrt(0.5), loop.rate),
        settling_time=response.settling_time(),
        overshoot=response.overshoot,
    )


def analyze_sample_rates(drive: Drive) -> dict[tuple[float, bool], LoopAnalysis | str]:
    """Return (rate, delayed) -> `analyze_loop` at the drive's rate and `RATES`, or an error text.

    All loops are designed for the drive's bandwidth, or have its gains if these are explicit.
    """
    analyses: dict[tuple[float, bool], LoopAnalysis | str] = {}
    for rate in sorted({drive.controller.sample_rate, *RATES}):
        for delayed in (False, True):
            try:
                analyses[rate, delayed] = analyze_loop(
                    drive.replaced({"controller.sample_rate": rate, "controller.delayed": delayed})
                )
            except ValueError as error:
                analyses[rate, delayed] = str(error)
    return analyses


def _point(frequency: float | np.ndarray, rate: float) -> np.ndarray:
    """Return the point z on the unit circle for a frequency [Hz], in its shape."""
    point: np.ndarray = np.exp(2j * math.pi * frequency / rate)
    return point


def _first_below(function: Callable[[np.ndarray], np.ndarray], rate: float) -> float:
    """Return the first frequency [Hz] at which a function of z becomes negative, or NaN."""
    from scipy.optimize import brentq

    frequencies = np.geomspace(1e-7, 0.49999, 4000) * rate
    negative = np.flatnonzero(function(_point(frequencies, rate)) < 0.0)
    if not len(negative) or negative[0] == 0:
        return math.nan
    bracket = frequencies[negative[0] - 1], frequencies[negative[0]]
    return float(brentq(lambda frequency: float(function(_point(frequency, rate))), *bracket))


# -- recovery from saturation ----------------------------------------------------------------------

ANTI_WINDUPS = ("back_calculation", "clamping", "none")
"""Kinds of anti-windup, by their names in `SampledLoop.anti_windup`."""
_SATURATED_DURATION = 0.02
"""Duration of the unreachable reference [s]."""
_RECOVERY_DURATION = 0.1
"""Duration of the recovery [s]."""


class StepResponses(NamedTuple):
    """Small step response of a drive, and its recovery from saturation."""

    small: Response
    """Response to a current that does not saturate, at standstill."""
    speed: float
    """Rotor speed in the saturated step [rad/s]: V/(2 kE), or the speed that makes `max_current`
    unreachable.
    """
    unreachable: float
    """Reference current that the drive cannot reach [A]; it lasts 20 ms."""
    reachable: float
    """Reference current after the unreachable one [A], which the drive can reach."""
    recoveries: dict[str, Response]
    """Kind of anti-windup -> response to the unreachable and then the reachable current."""


def step_responses(drive: Drive) -> StepResponses:
    """Return a drive's small step response, and its recovery from saturation with each anti-windup.

    The unreachable reference is 1.8 times the largest current that the voltage allows at
    `StepResponses.speed`, the reachable one 0.4 times.

    Raises:
        ValueError: the loop is unstable (the message has the spectral radius and a remedy), or
            the sample rate is below 1 kHz.
    """
    loop = drive.controller
    if loop.sample_rate < 1e3:
        raise ValueError(
            f"SampledLoop.sample_rate = {loop.sample_rate:g}: must be >= 1000 Hz to resolve a"
            " step; raise it"
        )
    samples = (_SATURATED_DURATION + _RECOVERY_DURATION) * loop.sample_rate
    label = f"SampledLoop.sample_rate = {loop.sample_rate:g}: {samples:,.0f} samples of a step"
    check_memory(_SAMPLE_SIZE * samples, label, "lower it")
    drive.check(1.0 / loop.sample_rate)
    motor, voltage = drive.motor, drive.voltage_limit
    speed, unreachable = 0.0, min(1.8 * voltage / motor.resistance, loop.max_current)
    if motor.back_emf_constant:
        unreachable = min(0.9 * voltage / motor.resistance, loop.max_current)
        speed = (voltage - motor.resistance * unreachable / 1.8) / motor.back_emf_constant
    reachable = 0.4 / 1.8 * unreachable
    spans = (_SATURATED_DURATION, unreachable), (_RECOVERY_DURATION, reachable)
    references = np.concatenate(
        [np.full(round(time * loop.sample_rate), current) for time, current in spans]
    )
    recoveries = {
        kind: simulate_loop(drive.replaced({"controller.anti_windup": kind}), references, speed)
        for kind in ANTI_WINDUPS
    }
    return StepResponses(small_step_response(drive), speed, unreachable, reachable, recoveries)
