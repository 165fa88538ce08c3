"""A motor that one can buy behind a drive that one can buy, family `drive`: gear, rotor, friction, a sampled PI loop.

Where the paper's `current_loop` takes one or a few Euler steps of a slow winding, a bench motor's winding has a time
constant of 0.1 to 5 ms under a loop that samples at 10 to 40 kHz. The winding is exact here, the loop has a sample rate
of its own, its integrator does not wind up, and what is delivered over a mechanical step is the *mean* torque of it:
the current at the end of a step says little of what moved the load.

The speed, and with it the back-EMF, is held over the mechanical step, as everywhere in the package, unless the drive is
told what it moves (`load_inertia`).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import sampled, stability
from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.model import ActuatorModel, Command, Inputs, JointAdditions, UnstableError, parameters_type
from codrl_mj.fields import check, choice, flag, part, real

DEFAULT_BANDWIDTH = 0.349 / (2 * math.pi)
"""Bandwidth of the loop over its sample rate: 60 degrees of phase margin with one and a half samples of delay."""


@dataclasses.dataclass(frozen=True)
class GearMotor:
    """A DC motor, or a brushless one seen from its drive, with its gear: what a datasheet says.

    Brushless motors: terminal quantities, line to line, of the equivalent DC motor.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    resistance: float = real(8.4, above=0.0, unit="ohm")
    """Terminal resistance R [ohm], > 0. The defaults are the Quanser QUBE-Servo 2's motor."""
    inductance: float = real(1.16e-3, above=0.0, unit="H")
    """Terminal inductance L [H], > 0."""
    torque_constant: float = real(0.042, above=0.0, unit="N*m/A")
    """Torque constant kT [N*m/A] at the rotor, > 0."""
    back_emf_constant: float = real(0.042, least=0.0, unit="V*s/rad")
    """Back-EMF constant kE [V*s/rad] at the rotor, >= 0; equal to kT in SI units but for losses."""
    rotor_inertia: float = real(4.0e-6, least=0.0, unit="kg*m^2")
    """Inertia J [kg*m^2] of the rotor, >= 0: the joint gets J*n^2."""
    gear_ratio: float = real(1.0, above=0.0, unit="")
    """Turns n of the rotor for a turn of the output shaft, > 0."""
    gear_efficiency: float = real(1.0, above=0.0, most=1.0)
    """Share of the torque that the gear passes on when it drives, in (0, 1]; driven, it brakes with 1/efficiency - 1 of
    the torque. Part of what is delivered, by an implicit step: it never turns the rotor back, and so is the smaller the
    closer the rotor is to standstill, where nothing is held by it (holding is `coulomb_friction`'s)."""
    coulomb_friction: float = real(0.0, least=0.0, unit="N*m")
    """Coulomb friction [N*m] at the rotor, >= 0: the joint's `frictionloss`."""
    viscous_friction: float = real(0.0, least=0.0, unit="N*m*s/rad")
    """Viscous friction [N*m*s/rad] at the rotor, >= 0: the joint's `damping`."""
    load_inertia: float = real(0.0, least=0.0, unit="kg*m^2")
    """Inertia [kg*m^2] of what the output shaft moves, >= 0, so that its speed can change within a step; 0: it is held.
    Nothing is added to the model by it."""
    arm_radius: float = real(1.0, above=0.0, unit="m")
    """Radius [m] of the wheel, drum or pinion on the output shaft that moves a slide, > 0; on a hinge 1."""

    def __post_init__(self) -> None:
        """Validate."""
        check(self)

    @classmethod
    def from_datasheet(cls, **printed: Any) -> "GearMotor":
        """A motor from what its datasheet prints, each value as text with its unit.

            >>> GearMotor.from_datasheet(resistance="0.464 ohm", inductance="0.322 mH", torque_constant="25.1 mN*m/A",
            ...                          rotor_inertia="135 g*cm^2").torque_constant
            0.0251

        Args:
            printed: as for `codrl_mj.catalogue.from_datasheet`, which also says how each number came about.

        Raises:
            ValueError: the datasheet does not suffice, or contradicts itself; the message has values and remedy.
        """
        from codrl_mj.catalogue import from_datasheet

        return cls.of(from_datasheet(**printed))

    @classmethod
    def of(cls, numbers: Any) -> "GearMotor":
        """A motor of `codrl_mj.catalogue.MotorNumbers`; what they do not know is left at 0, an efficiency at 1."""
        known = {field.name: getattr(numbers, field.name, None) for field in dataclasses.fields(cls)}
        known |= {name: 0.0 for name in _UNKNOWN if known[name] is None}
        return cls(**{name: value for name, value in known.items() if value is not None})

    @property
    def electrical_time_constant(self) -> float:
        """L/R [s]."""
        return self.inductance / self.resistance

    @property
    def mechanical_time_constant(self) -> float:
        """R*J/(kT*kE) [s] of the motor alone, without its gear and load; infinite without a back-EMF."""
        product = self.torque_constant * self.back_emf_constant
        return self.resistance * self.rotor_inertia / product if product > 0.0 else math.inf


_UNKNOWN = ("rotor_inertia", "coulomb_friction", "viscous_friction")
"""What a datasheet may leave open, and is 0 then."""


@dataclasses.dataclass(frozen=True)
class SampledLoop:
    """The PI current loop of a drive, at a sample rate of its own.

    Raises:
        ValueError: a field is out of bounds, or the bandwidth is beyond what the sample rate allows.
    """

    sample_rate: float = real(20e3, above=0.0, unit="Hz")
    """Samples a second [Hz], > 0; a mechanical step must hold a whole number of them."""
    bandwidth: float = real(0.0, least=0.0, unit="Hz")
    """Bandwidth [Hz] that the gains are designed for by pole-zero cancellation, >= 0. 0: 0.0555 of the sample rate,
    60 degrees of phase margin with `delayed`."""
    kp: float = real(0.0, least=0.0, unit="V/A")
    """Proportional gain [V/A], >= 0. It and `ki` replace the designed gains where one of them is not 0."""
    ki: float = real(0.0, least=0.0, unit="V/(A*s)")
    """Integral gain [V/(A*s)], >= 0."""
    anti_windup: str = choice("back_calculation", "back_calculation", "clamping", "none")
    """What the integrator does while the voltage saturates: it follows what was possible (`back_calculation`, with the
    tracking time kp/ki), it stands still (`clamping`), or it goes on (`none`)."""
    delayed: bool = flag(False)
    """Whether the voltage that a sample computes is applied in the next one, as most digital drives do."""
    bemf_compensation: bool = flag(True)
    """Add the back-EMF kE*omega to the voltage."""
    max_current: float = real(math.inf, above=0.0, unit="A", infinite=True)
    """Largest current [A] that the drive asks for, > 0; `inf` for none."""

    def __post_init__(self) -> None:
        """Validate."""
        check(self)
        most = self.sample_rate / (2 * math.pi)
        if self.bandwidth > most:
            raise ValueError(
                f"SampledLoop.bandwidth = {self.bandwidth:g}: must be <= {most:g} Hz at sample_rate = "
                f"{self.sample_rate:g} Hz, where a delay of one sample leaves 4 degrees of phase margin; lower it, or "
                "raise the sample rate"
            )


class State(NamedTuple):
    """What the drive remembers."""

    current: float
    """Motor current [A]."""
    integral: float
    """The controller's integral [V]."""
    pending: float
    """Voltage [V] that a delayed loop applies in the next sample."""
    torque: float
    """Torque [N*m] delivered in the last step."""
    speed: float
    """Speed [rad/s] of the rotor at its beginning."""
    started: float
    """1 once there was a step."""


class Signals(NamedTuple):
    """What can be seen of a step."""

    current: float
    """Mean current [A] over the step: times kT, the torque of the motor."""
    reference_current: float
    """Current asked of the loop [A], within `max_current`."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    saturated: float
    """1 where the voltage, or the current asked for, was at its limit in some sample."""


def run(
    parameters: Any, samples: int, current: float, integral: float, pending: float, reference: float, speed: float
) -> tuple[float, float, float, float, float, int]:
    """Winding and loop over some samples at a held speed: at once where that has a closed form.

    The sums that it needs telescope: with S the sum of the current over the samples' starts, the mean of (u - b)/R is
    (S + (i_n - i_0)/(1 - e))/n, and that of the current, the mean of every sample included,
    (S + (1 - m)/(1 - e)*(i_n - i_0))/n with m = (1 - e)/x and x = R*T/L.

    Args:
        parameters: as for `advance`.
        samples: n.
        current: i_0 [A].
        integral: the controller's [V].
        pending: voltage [V] of the sample before, for a delayed loop.
        reference: current asked for [A].
        speed: of the rotor [rad/s].

    Returns:
        The three afterwards, the mean current [A], the mean voltage [V], and how many samples were saturated.
    """
    sample_time, first = 1.0 / parameters.sample_rate, current
    resistance, voltage = parameters.resistance, parameters.supply_voltage
    x = resistance * sample_time / parameters.inductance
    lost = -math.expm1(-x)
    back_emf = parameters.back_emf_constant * speed
    compensated = back_emf if parameters.bemf_compensation != 0.0 else 0.0
    designed = parameters.kp == 0.0 and parameters.ki == 0.0
    y = 2.0 * math.pi * (parameters.bandwidth * sample_time if parameters.bandwidth > 0.0 else DEFAULT_BANDWIDTH)
    if designed and parameters.anti_windup == 0.0 and parameters.delayed == 0.0 and parameters.supply_resistance == 0.0:
        offset = back_emf - compensated
        current, integral, total, saturated = sampled.jump(
            current,
            (integral - offset) / resistance,
            reference,
            (-voltage - back_emf) / resistance,
            (voltage - back_emf) / resistance,
            samples,
            x,
            y,
            lost,
        )
        integral = integral * resistance + offset
    else:
        kp, ki = parameters.kp, parameters.ki * sample_time
        if designed:
            kp, ki = sampled.designed_gains(resistance, parameters.inductance, sample_time, y * parameters.sample_rate)
        current, integral, pending, total, saturated = sampled.run_samples(
            current,
            integral,
            pending,
            reference,
            back_emf,
            compensated,
            voltage,
            parameters.supply_resistance,
            samples,
            resistance,
            1.0 - lost,
            kp,
            ki,
            parameters.anti_windup,
            parameters.delayed,
        )
    change = (current - first) / lost
    mean = (total + (1.0 - lost / x) * change) / samples
    return current, integral, pending, mean, back_emf + resistance * (total + change) / samples, saturated


def gear_loss(parameters: Any, timestep: float, torque: float, speed: float) -> float:
    """Torque [N*m] that a gear takes from the motor's torque [N*m] at a speed [rad/s]: against the motion."""
    driving = torque * speed > 0.0
    share = 1.0 - parameters.gear_efficiency if driving else 1.0 / parameters.gear_efficiency - 1.0
    loss = share * abs(torque)
    if parameters.rotor_inertia > 0.0:  # no more than stops the rotor alone, and so never more than stops all
        loss = min(loss, parameters.rotor_inertia * abs(speed) / timestep)
    return math.copysign(loss, speed) if speed != 0.0 else 0.0  # zeros have signs


def advance(parameters: Any, timestep: float, state: State, inputs: Inputs) -> tuple[State, float, Signals]:
    """Advance winding and loop by the samples of one mechanical step.

    Where a saturated voltage meets a light load, the speed cannot be held over the step: c = h*kT*kE/(R*J), J the
    inertia of rotor and load, is the share of the speed that the back-EMF takes off in a step h; above 1 it rings,
    above 2 it grows. With a `load_inertia` the step is cut into 2*c pieces, and the rotor's speed goes on from piece to
    piece by the motor's torque and by what else moved the load in the step before.

    Args:
        parameters: named as the fields of `Drive` and its parts.
        timestep: mechanical step [s].
        state: as the step before left it.
        inputs: desired torque [N*m] and speed [rad/s] at the rotor.
    """
    samples = max(int(timestep * parameters.sample_rate + 0.5), 1)
    asked = inputs.desired_torque / parameters.torque_constant
    reference = min(max(asked, -parameters.max_current), parameters.max_current)
    inertia, pieces, others = 0.0, 1, 0.0
    if parameters.load_inertia > 0.0:
        inertia = parameters.rotor_inertia + parameters.load_inertia / (parameters.gear_ratio * parameters.gear_ratio)
        braking = parameters.torque_constant * parameters.back_emf_constant / parameters.resistance
        pieces = min(max(math.ceil(2.0 * timestep * braking / inertia), 1), samples)
        if state.started > 0.0:
            others = (inputs.speed - state.speed) / timestep - state.torque / inertia
    current, integral, pending, speed = state.current, state.integral, state.pending, inputs.speed
    amperes, volts, torque, saturated, left = 0.0, 0.0, 0.0, 0, samples
    for piece in range(pieces):
        count = left // (pieces - piece)
        current, integral, pending, mean, voltage, limited = run(
            parameters, count, current, integral, pending, reference, speed
        )
        left, saturated = left - count, saturated + limited
        share, delivered = count / samples, parameters.torque_constant * mean
        if parameters.gear_efficiency < 1.0:
            delivered -= gear_loss(parameters, timestep, delivered, speed)
        amperes, volts, torque = amperes + share * mean, volts + share * voltage, torque + share * delivered
        if pieces > 1:
            speed += share * timestep * (delivered / inertia + others)
    at_limit = 1.0 if saturated > 0 or reference != asked else 0.0
    after = State(current, integral, pending, torque, inputs.speed, 1.0)
    return after, torque, Signals(amperes, reference, volts, at_limit)


def observe(parameters: Any, timestep: float, signals: Signals, inputs: Inputs) -> tuple[float, float]:  # noqa: ARG001
    """The mean current [A] of the last step, which is what a drive reports, and its reference."""
    return signals.current, signals.reference_current


@dataclasses.dataclass(frozen=True)
class Drive(ActuatorModel):
    """A motor with its gear, the drive's current loop and the supply: a bench motor.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "drive"
    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {"current": "A", "reference_current": "A", "voltage": "V"}
    OBSERVED: ClassVar[tuple[str, ...]] = ("current", "reference_current")
    helpers: ClassVar[tuple[Any, ...]] = (
        sampled.until,
        sampled.jump,
        sampled.run_samples,
        sampled.designed_gains,
        run,
        gear_loss,
    )
    advance: ClassVar = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    motor: GearMotor = GearMotor()
    """The motor and its gear."""
    controller: SampledLoop = SampledLoop()
    """The current loop."""
    supply: Supply | None = part(Supply(voltage=24.0))
    """What feeds the drive; None: 24 V without a resistance."""

    def __post_init__(self) -> None:
        """Validate."""
        for name, kind in (("motor", GearMotor), ("controller", SampledLoop), ("supply", Supply)):
            if not isinstance(getattr(self, name), kind) and not (name == "supply" and self.supply is None):
                raise ValueError(
                    f"Drive.{name} = {getattr(self, name)!r}: must be a {kind.__name__}; to build a drive from nested "
                    "mappings use Drive.from_mapping"
                )

    @classmethod
    def of(cls, numbers: Any) -> "Drive":
        """A drive for a motor of `codrl_mj.catalogue.MotorNumbers`: its voltage (or 24 V), its peak current."""
        most, voltage = numbers.max_current, numbers.voltage
        loop = SampledLoop() if most is None else SampledLoop(max_current=most)
        return cls(GearMotor.of(numbers), loop, None if voltage is None else Supply(voltage))

    @property
    def arm_radius(self) -> float:
        """Arm [m] between the rotor and the load: the gear is part of it."""
        return self.motor.arm_radius / self.motor.gear_ratio

    @property
    def additions(self) -> JointAdditions:
        """Rotor inertia and friction, seen from the load."""
        arm, motor = self.arm_radius, self.motor
        return JointAdditions(
            motor.rotor_inertia / (arm * arm), motor.viscous_friction / (arm * arm), motor.coulomb_friction / arm
        )

    @property
    def winding(self) -> tuple[float, float]:
        """Resistance [ohm] and inductance [H]."""
        return self.motor.resistance, self.motor.inductance

    @property
    def voltage_limit(self) -> float:
        """The supply's voltage [V]."""
        return 24.0 if self.supply is None else self.supply.voltage

    @classmethod
    def from_numbers(cls, numbers: Any, arm_radius: float = 1.0) -> Any:
        """As `ActuatorModel.from_numbers`: the arm is that between rotor and load, the gear's ratio among the numbers.

        Args:
            numbers: shape (p,).
            arm_radius: [m].

        Raises:
            ValueError: a number is out of its field's bounds.
        """
        family: Any = cls
        return super().from_numbers(numbers, arm_radius * parameters_type(family)(*numbers).gear_ratio)

    def commands(self) -> Mapping[str, Command]:
        """A reference `current` [A] within `max_current`."""
        limit, torque = self.controller.max_current, self.motor.torque_constant
        why = "it would change what an action means"
        fixed = dict.fromkeys(("motor.torque_constant", "motor.gear_ratio", "motor.arm_radius"), why)
        return {"current": Command("A", self, torque, limit if math.isfinite(limit) else None, fixed)}

    def check(self, timestep: float) -> None:
        """Refuse a step without a whole number of samples, and a loop that is unstable.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        controller, samples = self.controller, timestep * self.controller.sample_rate
        if abs(samples - round(samples)) > 1e-6 * samples or samples < 0.5:
            nearest = max(round(samples), 1) / timestep
            raise ValueError(
                f"SampledLoop.sample_rate = {controller.sample_rate:g}: a mechanical step of {timestep:g} s holds "
                f"{samples:g} samples, must be a whole number of them; the nearest rate is {nearest:.8g} Hz"
            )
        radius = float(_radii(type(self), np.array([self.numbers]))[0])
        if not radius < 1.0:
            raise UnstableError(
                f"actuator: the current loop is unstable: spectral radius {radius:.4g} over a sample, must be < 1. "
                f"Lower controller.kp = {controller.kp:g} and controller.ki = {controller.ki:g}, or leave both 0 to "
                "have them designed; lower supply.resistance; or pass allow_unstable=True to study it as it is"
            )

    @classmethod
    def instability(cls, numbers: np.ndarray, timestep: float) -> np.ndarray:
        """The spectral radius of the loop over a sample; infinite where a step holds no whole number of samples.

        Args:
            numbers: shape (m, p), rows as `numbers` returns them.
            timestep: mechanical step [s].
        """
        samples = timestep * stability.columns(cls, numbers).sample_rate
        whole = (abs(samples - np.round(samples)) <= 1e-6 * samples) & (samples >= 0.5)
        return np.where(whole, _radii(cls, numbers), np.inf)


def _radii(cls: Any, numbers: np.ndarray) -> np.ndarray:
    """Spectral radii over one sample, unsaturated and saturated, shape (m,)."""
    columns = stability.columns(cls, numbers)
    sample_time, resistance = 1.0 / columns.sample_rate, columns.resistance
    x = resistance * sample_time / columns.inductance
    decay = np.exp(-x)
    share = np.where(columns.bandwidth > 0.0, columns.bandwidth * sample_time, DEFAULT_BANDWIDTH)
    design = np.vectorize(sampled.designed_gains, otypes=[float, float])
    gains = design(resistance, columns.inductance, sample_time, 2.0 * math.pi * share * columns.sample_rate)
    designed = (columns.kp == 0.0) & (columns.ki == 0.0)
    kp = np.where(designed, gains[0], columns.kp)
    ki = np.where(designed, gains[1], columns.ki * sample_time)
    effect = (1.0 - decay) / resistance  # of a volt, in a sample
    nothing, one, late = np.zeros(len(numbers)), np.ones(len(numbers)), columns.delayed != 0.0
    integrates = ki > 0.0  # else the integral is no part of the loop
    voltage = -(kp + ki), np.where(integrates, one, 0.0), nothing  # of (current, integral, pending)
    rows = [
        [decay + np.where(late, 0.0, effect * voltage[0]), np.where(late, 0.0, effect * voltage[1]), late * effect],
        [-ki, np.where(integrates, one, 0.0), nothing],
        [late * voltage[0], late * voltage[1], nothing],
    ]
    matrices = np.array(rows).transpose(2, 0, 1)
    radii = np.abs(np.linalg.eigvals(matrices).astype(np.complex128)).max(axis=1)
    # at its limit the voltage follows the current through the supply's resistance
    return np.maximum(radii, np.abs(decay - effect * columns.supply_resistance))
