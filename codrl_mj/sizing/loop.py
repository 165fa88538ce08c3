"""The current loop of a drive or an `DCMotorActuator`: gains, margins, bandwidth, and steps by their own equations.

As the sampled current sees it: the winding under a zero-order hold is (1 - e)/R/(z - e) with e =
exp(-R*T/L), the PI controller ((kp + ki*T)*z - kp)/(z - 1), the delay of a sample 1/z. Source:
Franklin, Powell, Workman, *Digital Control of Dynamic Systems*, ch. 4; `codrl_mj.actuators.sampled`
has the design. An `DCMotorActuator`'s winding is stepped by Euler's rule, T/L/(z - 1 + R*T/L), under the
PID controller of `codrl_mj.actuators.current_loop`; its sample rate is that of the mechanical
steps, times its substeps, so that its functions take a mechanical step [s].
"""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import DCMotorActuator, Drive, Inputs, parameters_type
from codrl_mj.actuators.sampled import designed_gains
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.fields import check_memory

CurrentLoopActuator = Drive | DCMotorActuator
_SAMPLE_SIZE = (
    500  # memory [bytes] of a sample in the responses to a step, with each kind of anti-windup
)
RATES = (10e3, 20e3, 40e3)
"""Sample rates [Hz] that drives commonly have."""


def is_closed(one: CurrentLoopActuator) -> bool:
    """Whether there is a loop: a gain on the error."""
    return isinstance(one, Drive) or any((one.controller.kp, one.controller.ki, one.controller.kd))


def gains(drive: Drive) -> tuple[float, float]:
    """Proportional gain [V/A] and integral gain [V/(A*s)] of a drive's loop, designed or given."""
    loop = drive.controller
    if loop.kp != 0.0 or loop.ki != 0.0:
        return loop.kp, loop.ki
    bandwidth = loop.bandwidth or DEFAULT_BANDWIDTH * loop.sample_rate
    kp, ki = designed_gains(*drive.winding, 1.0 / loop.sample_rate, 2.0 * math.pi * bandwidth)
    return kp, ki * loop.sample_rate


def undersampling_warning(drive: Drive) -> str:
    """What to say of less than a sample in three L/R, within which 95 % of a current's change happen; else empty."""
    rate, constant = drive.controller.sample_rate, drive.motor.electrical_time_constant
    text = (
        f"sample_rate = {rate:g} Hz: a sample lasts {1.0 / rate / constant:,.1f} times the"
        " winding's L/R = "
    )
    text += f"{1e3 * constant:.3g} ms, so that the current settles before the loop sees it: take "
    return "" if 3.0 * rate * constant >= 1.0 else f"{text}{1.0 / 3.0 / constant:,.0f} Hz or more"


class _Sampled(NamedTuple):
    """A current loop in z, whosever it is."""

    rate: float  # samples a second [Hz]
    gains: tuple[float, float]  # proportional [V/A], integral [V/(A*s)]
    over: np.ndarray  # numerator from error to sampled current
    under: np.ndarray  # its denominator
    forward: np.ndarray  # numerator from reference to sampled current
    at_once: float  # voltage for one ampere of a step, in its first sample [V/A]
    constant: float  # time constant of the designed loop, or of the winding under given gains [s]
    most: float = math.inf  # largest current that is asked for [A]
    delayed: bool = False  # whether the voltage comes a sample late


def _sampled(one: CurrentLoopActuator, timestep: float | None) -> _Sampled:
    """The loop of a drive, or of an `DCMotorActuator` at a mechanical step [s]."""
    resistance, inductance = one.winding
    constant = inductance / resistance
    if isinstance(one, Drive):
        (kp, ki), rate = gains(one), one.controller.sample_rate
        time = 1.0 / rate
        if one.controller.kp == 0.0 and one.controller.ki == 0.0:
            constant = 1.0 / (
                2.0 * math.pi * (one.controller.bandwidth or DEFAULT_BANDWIDTH * rate)
            )
        decay = math.exp(-resistance * time / inductance)
        effect = -math.expm1(-resistance * time / inductance) / resistance  # [A/V], of a sample
        over = np.array([effect * (kp + ki * time), -effect * kp])
        late = [1.0, 0.0] if one.controller.delayed else [1.0]
        under = np.polymul(np.polymul([1.0, -decay], [1.0, -1.0]), late)
        most, delayed = one.controller.max_current, one.controller.delayed
        return _Sampled(rate, (kp, ki), over, under, over, kp + ki / rate, constant, most, delayed)
    if timestep is None:
        raise ValueError(
            "timestep = None: must be the mechanical step [s] of an Actuator, whose loop is closed"
            " in it"
        )
    rate, loop = one.controller.substeps / timestep, one.controller
    time = 1.0 / rate
    pid, below = np.array([loop.kp]), np.array([1.0])  # from error [A] to voltage [V]
    for gain, up, down in (
        (loop.ki, [time, 0.0], [1.0 + loop.integral_leak * time, -1.0]),
        (
            loop.kd,
            [1.0, -1.0],
            [time + loop.derivative_time_constant, -loop.derivative_time_constant],
        ),
    ):
        if gain:
            pid, below = (
                np.polyadd(np.polymul(pid, down), gain * np.polymul(up, below)),
                np.polymul(below, down),
            )
    over = pid * time / inductance
    under = np.polymul(below, [1.0, resistance * time / inductance - 1.0])
    forward = np.polyadd(
        over, loop.kff * time / inductance * below
    )  # feed-forward goes past the error
    at_once = pid[0] / below[0] + loop.kff
    return _Sampled(rate, (loop.kp, loop.ki), over, under, forward, at_once, constant)


def open_loop(one: CurrentLoopActuator, timestep: float | None = None) -> Any:
    """The loop from error to sampled current, a `control.TransferFunction` in z."""
    import control

    loop = _sampled(one, timestep)
    return control.TransferFunction(loop.over, loop.under, 1.0 / loop.rate)


def closed_loop(one: CurrentLoopActuator, timestep: float | None = None) -> Any:
    """The loop from reference to sampled current, a `control.TransferFunction` in z."""
    import control

    loop = _sampled(one, timestep)
    return control.TransferFunction(
        loop.forward, np.polyadd(loop.under, loop.over), 1.0 / loop.rate
    )


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

    @property
    def _last(self) -> int:
        """From where on the last reference is asked for."""
        return int(np.flatnonzero(np.diff(self.reference, prepend=math.nan) != 0.0)[-1])

    @property
    def undershoot(self) -> float:
        """How far the current falls below the last reference once that is asked for, as a share of it."""
        return max(1.0 - float(self.current[self._last :].min()) / float(self.reference[-1]), 0.0)

    def settling_time(self, band: float = 0.02) -> float:
        """When the current stays within a share of the last reference [s after that came]; NaN: not within sight."""
        wrong = np.flatnonzero(np.abs(self.current[self._last :] / self.reference[-1] - 1.0) > band)
        settled = self._last + (int(wrong[-1]) + 1 if len(wrong) else 0)
        return (
            float(self.time[settled] - self.time[self._last])
            if settled < len(self.time)
            else math.nan
        )


def simulate_loop(
    one: CurrentLoopActuator, references: Any, speed: float = 0.0, timestep: float | None = None
) -> Response:
    """Step a loop one sample at a time, through its own `advance`, from where it has held a current of 0 at its speed.

    Args:
        one: a drive; or an `DCMotorActuator`, whose sensor is right here, and whose speed must be 0.
        references: current asked for in each sample [A], shape (n,).
        speed: of the rotor [rad/s], held.
        timestep: of an `DCMotorActuator`: see the module.
    """
    time = 1.0 / _sampled(one, timestep).rate
    kind: Any = one.State
    state = kind(*[0.0] * len(kind._fields))
    if isinstance(one, Drive):
        back_emf = one.motor.back_emf_constant * speed
        integral = 0.0 if one.controller.bemf_compensation else back_emf
        state = state._replace(integral=integral, pending=back_emf, speed=speed)
    else:
        right = {"substeps": 1, "current_bias": 0.0, "current_noise": 0.0}
        one = one.replaced({f"controller.{name}": value for name, value in right.items()})
    family: Any = type(one)
    parameters, rows = parameters_type(family)(*one.numbers), []
    for reference in references:
        before = state.current
        torque = one.motor.torque_constant * float(reference)
        state, _, signals = one.advance(
            parameters, time, state, Inputs(torque, 0.0, speed, 0.0, 0.0)
        )
        rows.append((signals.reference_current, before, signals.voltage))
    return Response(time * np.arange(len(rows)), *np.array(rows).T)


def small_step_response(one: CurrentLoopActuator, timestep: float | None = None) -> Response:
    """The step from rest to a current that does not saturate.

    It is a tenth of V/R, or what half the voltage makes at once, or `max_current`, whichever is
    smallest; 1 A where the voltage has no limit. It lasts 20 time constants of the designed loop,
    or of the winding under given gains, and 100 to 20000 samples.
    """
    loop, limit = _sampled(one, timestep), one.voltage_limit
    amplitude = min(0.1 * limit / one.winding[0], 0.5 * limit / loop.at_once, loop.most)
    samples = min(max(math.ceil(20.0 * loop.constant * loop.rate), 100), 20_000)
    return simulate_loop(
        one, np.full(samples, amplitude if math.isfinite(amplitude) else 1.0), timestep=timestep
    )


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


def design(one: CurrentLoopActuator, timestep: float | None = None) -> LoopDesign:
    """Judge a current loop: margins of its transfer function, a step of its own.

    Raises:
        ValueError: the loop is unstable; the message has the spectral radius and a remedy.
    """
    loop = _sampled(one, timestep)
    one.check(1.0 / loop.rate if timestep is None else timestep)
    opened, closed, step = (
        open_loop(one, timestep),
        closed_loop(one, timestep),
        small_step_response(one, timestep),
    )
    # margins are searched for on the unit circle, which slow loops and the pole at z = 1 leave
    # exact; python-control's, by the roots of polynomials, are not. At half the sample rate, z =
    # -1, the loop is real: without a crossing before it the gain margin is read there
    turned = _first_below(lambda z: -opened(z).imag, loop.rate)
    turned = 0.5 * loop.rate if math.isnan(turned) else turned
    crossover = _first_below(lambda z: abs(opened(z)) - 1.0, loop.rate)
    at_crossover = opened(_point(crossover, loop.rate)) if crossover > 0.0 else math.nan
    return LoopDesign(
        loop.rate,
        loop.delayed,
        *loop.gains,
        gain_margin=float(1.0 / abs(opened(_point(turned, loop.rate)))),
        phase_margin=180.0 + math.degrees(np.angle(at_crossover)),
        phase_crossover=turned,
        crossover=crossover,
        bandwidth=_first_below(lambda z: abs(closed(z)) - math.sqrt(0.5), loop.rate),
        settling_time=step.settling_time(),
        overshoot=step.overshoot,
    )


def designs(drive: Drive) -> dict[tuple[float, bool], LoopDesign | str]:
    """`design` at its own rate and at `RATES`, without and with the delay of a sample; a text says why there is none.

    Its bandwidth is kept, or its gains where they are given.
    """
    found: dict[tuple[float, bool], LoopDesign | str] = {}
    for rate in sorted({drive.controller.sample_rate, *RATES}):
        for delayed in (False, True):
            try:
                found[rate, delayed] = design(
                    drive.replaced({"controller.sample_rate": rate, "controller.delayed": delayed})
                )
            except ValueError as error:
                found[rate, delayed] = str(error)
    return found


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


# -- out of saturation ---------------------------------------------------------------------------------------------

ANTI_WINDUPS = ("back_calculation", "clamping", "none")
"""The kinds, as `SampledLoop.anti_windup` names them."""
_UNREACHABLE = 0.02
"""For how long more is asked for than can be made [s]."""
_AFTER = 0.1
"""How long the recovery is looked at [s]."""


class StepResponses(NamedTuple):
    """Step responses of a drive."""

    small: Response
    """To a current that does not saturate, at standstill."""
    speed: float
    """Of the rotor in the saturated step [rad/s]: half V/kE, or what makes an unreachable current of `max_current`."""
    unreachable: float
    """Current asked for in vain, for 20 ms [A]."""
    reachable: float
    """Current asked for then [A]."""
    recoveries: dict[str, Response]
    """By kind of anti-windup: what it makes of a current that cannot be reached, and of one that can."""


def step_responses(drive: Drive) -> StepResponses:
    """Step a drive's current: small, and out of saturation with each kind of anti-windup.

    In saturation 1.8 times of what the voltage can make at `StepResponses.speed` is asked for, then 0.4
    times of it.

    Raises:
        ValueError: the loop is unstable, the message has the spectral radius and a remedy; or its
            samples are too few.
    """
    loop = drive.controller
    if loop.sample_rate < 1e3:
        raise ValueError(
            f"SampledLoop.sample_rate = {loop.sample_rate:g}: must be >= 1000 Hz, to see a step;"
            " raise it"
        )
    samples = (_UNREACHABLE + _AFTER) * loop.sample_rate
    what = f"SampledLoop.sample_rate = {loop.sample_rate:g}: {samples:,.0f} samples of a step"
    check_memory(_SAMPLE_SIZE * samples, what, "lower it")
    drive.check(1.0 / loop.sample_rate)
    motor, voltage = drive.motor, drive.voltage_limit
    speed, unreachable = 0.0, min(1.8 * voltage / motor.resistance, loop.max_current)
    if motor.back_emf_constant:
        unreachable = min(0.9 * voltage / motor.resistance, loop.max_current)
        speed = (voltage - motor.resistance * unreachable / 1.8) / motor.back_emf_constant
    reachable = 0.4 / 1.8 * unreachable
    spans = (_UNREACHABLE, unreachable), (_AFTER, reachable)
    references = np.concatenate(
        [np.full(round(time * loop.sample_rate), current) for time, current in spans]
    )
    recoveries = {
        kind: simulate_loop(drive.replaced({"controller.anti_windup": kind}), references, speed)
        for kind in ANTI_WINDUPS
    }
    return StepResponses(small_step_response(drive), speed, unreachable, reachable, recoveries)
