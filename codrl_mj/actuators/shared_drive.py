"""Drives that share one supply, family `shared_drive`: the currents of all lower its voltage.

The bridge of a drive takes the current duty*i from the supply, because it neither stores nor loses
power: u*i = V*(duty*i). A drive that brakes takes a negative current, which feeds the others. With
the source's voltage E and resistance Rs the voltage V of the supply at a sample is the largest
solution of

    V = E - Rs*sum(u*i)/V,  u = min(max(requested, -V), V).

It follows from the currents at that sample, and is held like the drives' voltages to the next one.
All drives of a supply must therefore advance together, sample by sample: `begin_step`, then
`request_voltage` and `advance_sample` for each sample, then `end_step`. The engine does so for the
drives of a model whose supplies have the same number. `advance` does it for a single drive.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import drive, sampled, shaft
from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.drive import Drive, State
from codrl_mj.actuators.model import (
    ActuatorModel,
    Command,
    FamilyTuple,
    Inputs,
    UnstableError,
)
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.actuators.shaft import Shaft, StepAverages, Winding
from codrl_mj.catalogue import MotorParameters
from codrl_mj.fields import flag, integer, optional_nested


class Signals(NamedTuple):
    """Signals after a step: first those of a drive, then those of the supply."""

    current: float
    reference_current: float
    voltage: float
    temperature: float
    saturated: float
    voltage_saturated: float
    current_saturated: float
    temperature_saturated: float
    electrical_power: float
    copper_loss: float
    supply_voltage: float
    """Mean voltage [V] of the shared supply."""
    supply_current: float
    """Mean current [A] of the shared supply's source; negative while it is charged."""


class StepConstants(NamedTuple):
    """Values of a motor that are constant in a mechanical step."""

    resistance: float
    """Resistance [ohm] of the winding."""
    reference: float
    """Commanded current [A], or voltage [V] without a loop."""
    inertia: float
    """Inertia [kg*m^2] that the rotor moves; `inf` if its speed is held."""
    external_acceleration: float
    """Acceleration [rad/s^2] of the rotor by everything except the motor."""
    initial_speed: float
    """Speed [rad/s] of the rotor at the beginning of the step."""
    kp: float
    """Proportional gain [V/A]."""
    ki: float
    """Integral gain [V/A] per sample."""
    x: float
    """Duration of a sample in electrical time constants, R*T/L."""
    samples: float
    """Number of samples in the step."""


class Piece(NamedTuple):
    """Part of a mechanical step in which a motor's speed is held, as in `shaft.advance_motor`."""

    num_samples: float
    """Number of its samples."""
    speed: float
    """Speed [rad/s] of the rotor."""
    initial_current: float
    """Current [A] at its beginning."""
    pieces_left: float
    """Number of pieces after it."""
    samples_left: float
    """Number of samples after it."""


class Sampled(NamedTuple):
    """State of a motor at a sample."""

    current: float
    """Current [A]."""
    integral: float
    """The controller's integral [V]."""
    pending: float
    """Voltage [V] that a delayed loop applies in the next sample."""
    countdown: float
    """Number of samples to the end of the piece."""
    total: float
    """Sum of the current [A] over the samples' starts in the piece."""
    drawn: float
    """Sum over the piece of the drawn power, divided by the resistance [A^2]."""
    saturated: float
    """Number of saturated samples in the step."""


def supply_voltage(parameters: Parameters, requested: float, current: float) -> float:
    """Return the voltage [V] of a supply with one drive, from the voltage that it requests.

    `engine.supplies` has the solution for several drives.
    """
    source, resistance = parameters.supply_voltage, parameters.supply_resistance
    size, drawn = abs(requested), current if requested > 0.0 else -current
    # The drive is saturated, and passes the whole current on, unless V^2 - E*V + Rs*u*i = 0 has a
    # solution at which it is not.
    voltage = min(max(source - resistance * drawn, 0.0), size)
    square = source * source - 4.0 * resistance * (size * drawn)
    root = 0.5 * (source + math.sqrt(max(square, 0.0)))
    if square >= 0.0 and root >= size:
        voltage = root
    return voltage if parameters.supply_recharges != 0.0 else min(voltage, source)


def source_current(parameters: Parameters, amperes: float) -> float:
    """Return the current [A] of the source, which can be negative only if it recharges."""
    return amperes if parameters.supply_recharges != 0.0 else max(amperes, 0.0)


def _next_piece(pieces_left: float, samples_left: float, speed: float, current: float) -> Piece:
    """Return the first of the remaining pieces."""
    count = math.floor(samples_left / pieces_left) if pieces_left > 1.0 else samples_left
    return Piece(count, speed, current, pieces_left - 1.0, samples_left - count)


def begin_step(
    parameters: Parameters,
    timestep: float,
    state: FamilyTuple,
    inputs: Inputs,
    closed: bool,
    sample_rate: float,
) -> tuple[StepConstants, Piece, Sampled]:
    """Return a motor at the beginning of a mechanical step.

    If the loop is `closed`, kT*A of desired torque stand for a current, else kT*V for a voltage.
    """
    command = inputs.desired_torque / parameters.torque_constant
    winding, heat, rotor = drive.begin_step(parameters, timestep, state, inputs)
    resistance = shaft.resistance_at(parameters, shaft.temperature_of(parameters, heat))
    kp, ki, sample_time = 0.0, 0.0, 1.0 / sample_rate
    if closed:
        command = drive.limit_current(parameters, timestep, heat, resistance, command)
        kp, ki = parameters.kp, parameters.ki * sample_time
        if parameters.kp == 0.0 and parameters.ki == 0.0:
            share = DEFAULT_BANDWIDTH
            if parameters.bandwidth > 0.0:
                share = parameters.bandwidth * sample_time
            kp, ki = sampled.designed_gains(
                resistance, parameters.inductance, sample_time, 2.0 * math.pi * share * sample_rate
            )
    samples = max(int(timestep * sample_rate + 0.5), 1)
    pieces = shaft.pieces_of_step(parameters, resistance, timestep, samples, rotor.inertia)
    x = resistance * sample_time / parameters.inductance
    acceleration = rotor.external_acceleration
    step = StepConstants(
        *(resistance, command, rotor.inertia, acceleration, rotor.speed),
        *(kp, ki, x, float(samples)),
    )
    piece = _next_piece(float(pieces), float(samples), rotor.speed, winding.current)
    integral = winding.integral if closed else 0.0
    return (
        step,
        piece,
        Sampled(winding.current, integral, winding.pending, piece.num_samples, 0.0, 0.0, 0.0),
    )


def request_voltage(
    parameters: Parameters, step: StepConstants, piece: Piece, motor: Sampled, closed: bool
) -> tuple[float, float]:
    """Return the voltages [V] that the loop commands and that the bridge would apply now.

    They differ in a loop with a delay.
    """
    command = step.reference
    if closed:
        compensated = 0.0
        if parameters.bemf_compensation != 0.0:
            compensated = parameters.back_emf_constant * piece.speed
        error = step.reference - motor.current
        command = (step.kp + step.ki) * error + motor.integral + compensated
    return command, command if parameters.delayed == 0.0 else motor.pending


def advance_sample(
    parameters: Parameters,
    timestep: float,
    step: StepConstants,
    piece: Piece,
    motor: Sampled,
    averages: StepAverages,
    command: float,
    requested: float,
    limit: float,
    closed: bool,
) -> tuple[Piece, Sampled, StepAverages, float]:
    """Return the motor after a sample in which the supply has the voltage `limit` [V].

    The averages are parts of those of the step, from all finished pieces. The last value is the
    mean current [A] that the bridge took from the supply.
    """
    gain, back_emf = step.kp + step.ki, parameters.back_emf_constant * piece.speed
    drop = -math.expm1(-step.x)
    current, integral, pending, applied, mean, drawn, limited = sampled.advance_sample(
        parameters,
        motor.current,
        motor.integral,
        motor.pending,
        step.reference - motor.current if closed else 0.0,
        command,
        limit,
        back_emf,
        step.resistance,
        1.0 - drop,
        drop / step.x,
        step.ki,
        step.ki / gain if gain > 0.0 else 0.0,
    )
    # At a voltage of 0 the supply is short-circuited by saturated bridges.
    duty = applied / limit if limit > 0.0 else math.copysign(1.0, requested)
    countdown, saturated = motor.countdown - 1.0, motor.saturated + limited
    total, drawn = motor.total + motor.current, motor.drawn + drawn
    if countdown == 0.0:
        averages, speed = _end_piece(
            parameters, timestep, step, piece, averages, current, total, drawn
        )
        if piece.pieces_left > 0.0:
            piece = _next_piece(piece.pieces_left, piece.samples_left, speed, current)
        countdown, total, drawn = piece.num_samples, 0.0, 0.0
    after = Sampled(current, integral, pending, countdown, total, drawn, saturated)
    return piece, after, averages, duty * mean


def _end_piece(
    parameters: Parameters,
    timestep: float,
    step: StepConstants,
    piece: Piece,
    averages: StepAverages,
    current: float,
    total: float,
    drawn: float,
) -> tuple[StepAverages, float]:
    """Return the averages with those of a piece that ends, and the rotor's new speed [rad/s]."""
    share = piece.num_samples / step.samples
    mean, voltage, power, heat = shaft.winding_means(
        step.resistance,
        step.x,
        -math.expm1(-step.x),
        parameters.back_emf_constant * piece.speed,
        piece.num_samples,
        piece.initial_current,
        current,
        total,
        drawn,
    )
    delivered, viscous = parameters.torque_constant * mean, parameters.viscous_friction
    rotor = Shaft(step.inertia, step.external_acceleration, piece.speed)
    delivered -= shaft.lost_torque(parameters, share * timestep, delivered, rotor)
    net_torque = delivered - viscous * (piece.speed - step.initial_speed)
    acceleration = net_torque / step.inertia + step.external_acceleration
    return StepAverages(
        averages.current + share * mean,
        averages.voltage + share * voltage,
        averages.torque + share * delivered,
        averages.saturated,
        averages.power + share * power,
        averages.heat + share * heat,
    ), piece.speed + share * timestep * acceleration


def end_step(
    parameters: Parameters,
    timestep: float,
    state: FamilyTuple,
    inputs: Inputs,
    step: StepConstants,
    motor: Sampled,
    averages: StepAverages,
    closed: bool,
    volts: float,
    amperes: float,
) -> tuple[State, float, Signals]:
    """Return the results of `advance`, from the means of the supply's voltage and current."""
    _, heat, rotor = drive.begin_step(parameters, timestep, state, inputs)
    winding = Winding(motor.current, motor.integral, motor.pending)
    after, temperature = drive.end_step(
        parameters, timestep, inputs.time, heat, step.resistance, winding, rotor, averages
    )
    command = inputs.desired_torque / parameters.torque_constant
    signals = drive.step_signals(
        parameters, command, step.reference, closed, temperature, averages, motor.saturated
    )
    # mypy does not know the number of a drive's signals.
    all_signals = Signals(*signals, volts, amperes)  # type: ignore[call-arg]
    return State(*after), averages.torque, all_signals


def _advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs, closed: bool
) -> tuple[State, float, Signals]:
    """Advance a drive that is the only one of its supply."""
    step, piece, motor = begin_step(
        parameters, timestep, state, inputs, closed, parameters.sample_rate
    )
    averages = StepAverages(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    volts, amperes = 0.0, 0.0
    samples = max(int(timestep * parameters.sample_rate + 0.5), 1)
    for _ in range(samples):
        command, requested = request_voltage(parameters, step, piece, motor, closed)
        limit = supply_voltage(parameters, requested, motor.current)
        piece, motor, averages, supplied = advance_sample(
            parameters, timestep, step, piece, motor, averages, command, requested, limit, closed
        )
        volts, amperes = volts + limit, amperes + source_current(parameters, supplied)
    return end_step(
        *(parameters, timestep, state, inputs, step, motor, averages, closed),
        *(volts / samples, amperes / samples),
    )


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance a drive alone by one mechanical step [s]; inputs are those of the rotor."""
    return _advance(parameters, timestep, state, inputs, True)


def _advance_driven(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance a drive alone under a commanded voltage."""
    return _advance(parameters, timestep, state, inputs, False)


@dataclasses.dataclass(frozen=True)
class SharedSupply(Supply):
    """Power supply of several drives: a voltage source with an internal resistance.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    number: int = integer(1, minimum=1)
    """Number of the supply. The motors of a model with the same number share it."""
    recharges: bool = flag(True)
    """True if the source takes current, as a battery does. Otherwise a brake resistor takes what
    braking motors return and the others do not use, and the voltage does not rise above `voltage`.
    """

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if math.isinf(self.voltage):
            raise ValueError("SharedSupply.voltage = inf: must be finite")


@dataclasses.dataclass(frozen=True)
class SharedDrive(Drive):
    """Motor with its gear and the drive's current loop, on a supply that other motors share.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "shared_drive"
    State: ClassVar[type[NamedTuple]] = State
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {
        **Drive.SIGNAL_UNITS,
        "supply_voltage": "V",
        "supply_current": "A",
    }
    SHARES_SUPPLY: ClassVar[bool] = True
    advance: ClassVar[Callable[..., tuple[FamilyTuple, float, FamilyTuple]]] = staticmethod(advance)

    supply: SharedSupply | None = optional_nested(SharedSupply(voltage=24.0))
    """The shared supply; None: number 1, with 24 V and no resistance."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.controller.deadband > 0.0:
            raise ValueError(
                f"controller.deadband = {self.controller.deadband:g}: must be 0 on a shared supply,"
                " because a bridge with a deadband takes another current; use the family drive"
            )

    @property
    def shared_supply(self) -> SharedSupply:
        """The supply, or its default."""
        return SharedSupply(voltage=24.0) if self.supply is None else self.supply

    @classmethod
    def from_motor_parameters(cls, parameters: MotorParameters) -> "SharedDrive":
        """Return a drive for a motor, with its nominal voltage (or 24 V) and its peak current."""
        drive_alone = Drive.from_motor_parameters(parameters)
        supply = None if drive_alone.supply is None else SharedSupply(drive_alone.supply.voltage)
        return cls(drive_alone.motor, drive_alone.controller, supply)

    def commands(self) -> Mapping[str, Command]:
        """Return the commands of a drive."""
        commands = dict(super().commands())
        voltage_drive = SharedVoltageDrive(
            self.motor, self.controller, self.supply, friction=self.friction
        )
        commands["voltage"] = commands["voltage"]._replace(actuator=voltage_drive)
        return commands


@dataclasses.dataclass(frozen=True)
class SharedVoltageDrive(SharedDrive):
    """Shared drive with a commanded terminal voltage; a desired torque of kT stands for 1 V."""

    family: ClassVar[str] = ""
    is_torque_controlled: ClassVar[bool] = False
    CLOSED: ClassVar[bool] = False
    advance: ClassVar = staticmethod(_advance_driven)


def check_supplies(actuators: Mapping[str, ActuatorModel], allow_unstable: bool = False) -> None:
    """Raise if motors with the same supply number contradict each other, or oscillate together.

    Args:
        actuators: name -> actuator of a model; those without a shared supply are left out.
        allow_unstable: accept motors that oscillate.

    Raises:
        ValueError: motors of a supply differ in the supply's fields or in their sample rates.
        UnstableError: the saturated motors of a supply oscillate through its resistance.
    """
    drives = {
        name: actuator for name, actuator in actuators.items() if isinstance(actuator, SharedDrive)
    }
    for number in sorted({motor.shared_supply.number for motor in drives.values()}):
        members = {
            name: motor for name, motor in drives.items() if motor.shared_supply.number == number
        }
        first_name, first = next(iter(members.items()))
        for name, motor in members.items():
            for field, value, expected in (
                *_differences(motor.shared_supply, first.shared_supply),
                (
                    "controller.sample_rate",
                    motor.controller.sample_rate,
                    first.controller.sample_rate,
                ),
            ):
                if value != expected:
                    raise ValueError(
                        f"{name}: {field} = {value}: must be {expected} as for {first_name}: both"
                        f" are on supply {number}; or give it another supply.number"
                    )
        smallest = _smallest_eigenvalue(list(members.values()))
        if smallest <= -1.0 and not allow_unstable:
            raise UnstableError(
                f"{', '.join(members)}: saturated together, they oscillate through"
                f" supply.resistance = {first.shared_supply.resistance:g}: eigenvalue"
                f" {smallest:.4g} over a sample, must be > -1. Raise controller.sample_rate, lower"
                " supply.resistance, or pass allow_unstable=True to study it as it is"
            )


def _differences(
    supply: SharedSupply, first: SharedSupply
) -> list[tuple[str, float | bool, float | bool]]:
    """Return name, value and the first supply's value of all fields of a supply."""
    return [
        (f"supply.{field.name}", getattr(supply, field.name), getattr(first, field.name))
        for field in dataclasses.fields(supply)
    ]


def _smallest_eigenvalue(motors: Sequence[SharedDrive]) -> float:
    """Return the smallest eigenvalue over a sample of saturated motors that share a supply.

    A current decays by exp(-R*T/L), and the sum of all currents lowers the voltage. Fewer saturated
    motors have larger eigenvalues.
    """
    resistances = np.array([motor.motor.resistance for motor in motors])
    inductances = np.array([motor.motor.inductance for motor in motors])
    decay = np.exp(-resistances / (inductances * motors[0].controller.sample_rate))
    # Scaled by these roots, the matrix diag(decay) - Rs*gain*ones is symmetric.
    roots = np.sqrt((1.0 - decay) / resistances)
    coupling = motors[0].shared_supply.resistance * np.outer(roots, roots)
    return float(np.linalg.eigvalsh(np.diag(decay) - coupling)[0])
