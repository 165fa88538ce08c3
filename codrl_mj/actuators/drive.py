"""Geared motor with a digital current loop, family `drive`: gear, rotor, friction, sampled PI loop.

The paper's `current_loop` takes one or a few Euler steps of a slow winding. The winding of a real
motor has a time constant of 0.1 to 5 ms under a loop that samples at 10 to 40 kHz. This family
solves the winding exactly and samples the loop at its own rate, with anti-windup. It delivers the
*mean* torque over a mechanical step, because the current at the end of a step tells little about
the torque that moved the load.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import sampled, shaft, stability
from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.geared import Geared, has_single_friction, has_valid_temperatures
from codrl_mj.actuators.model import Command, FamilyTuple, Inputs, UnstableError
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH, SampledLoop
from codrl_mj.actuators.servo_friction import ServoFriction
from codrl_mj.actuators.shaft import Shaft, StepAverages, TemperatureRises, Winding
from codrl_mj.catalogue import MotorParameters
from codrl_mj.fields import optional_nested


class State(NamedTuple):
    """State of the drive."""

    current: float
    """Motor current [A]."""
    integral: float
    """The controller's integral [V]."""
    pending: float
    """Voltage [V] that a delayed loop applies in the next sample."""
    winding_rise: float
    """Temperature difference [K] between winding and housing."""
    housing_rise: float
    """Temperature difference [K] between housing and surroundings."""
    acceleration: float
    """Acceleration [rad/s^2] that the motor's torque gave the rotor in the last step."""
    speed: float
    """Speed [rad/s] of the rotor at the beginning of the last step."""
    external_acceleration: float
    """Estimated acceleration [rad/s^2] of the rotor by everything but the motor in the last step.
    """
    expected_time: float
    """Time [s] at which the next step should begin; 0 before the first step."""


class Signals(NamedTuple):
    """Signals after a step."""

    current: float
    """Mean current [A] over the step; times kT it is the torque of the motor."""
    reference_current: float
    """Reference current [A] of the loop, within its limits."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    temperature: float
    """Temperature [degC] of the winding at the end of the step."""
    saturated: float
    """1 if any of the following three signals is 1."""
    voltage_saturated: float
    """1 if the voltage reached the supply's limit in at least one sample."""
    current_saturated: float
    """1 if the command exceeded `max_current`."""
    temperature_saturated: float
    """1 if `max_temperature` limited the current to less than `max_current`."""
    electrical_power: float
    """Mean of voltage times current at the winding's terminals [W]."""
    copper_loss: float
    """Mean heat [W] in the winding, from the squared current within the samples."""


def limit_current(
    parameters: Parameters,
    timestep: float,
    heat: TemperatureRises,
    resistance: float,
    current: float,
) -> float:
    """Return the commanded current [A] within `max_current` and the thermal limit."""
    limit = parameters.max_current
    if parameters.max_temperature < math.inf and shaft.has_thermal_model(parameters):
        limit = min(limit, shaft.thermal_limit(parameters, timestep, heat, resistance))
    return min(max(current, -limit), limit)


def begin_shaft(
    parameters: Parameters, timestep: float, state: FamilyTuple, inputs: Inputs
) -> Shaft:
    """Return the shaft at the beginning of a step, from the state of a drive or a servo."""
    inertia, external_acceleration = shaft.inertia_of(parameters, inputs.inertia), 0.0
    # The estimate needs the previous step. A step that begins at another time than expected follows
    # a reset or a stage of Runge-Kutta.
    if (
        state.expected_time > 0.0
        and abs(inputs.time - state.expected_time) < 0.5 * timestep
        and inertia < math.inf
    ):
        external_acceleration = shaft.estimate_external_acceleration(
            timestep, inputs.speed - state.speed, state.acceleration, state.external_acceleration
        )
    return Shaft(inertia, external_acceleration, inputs.speed)


def begin_step(
    parameters: Parameters, timestep: float, state: FamilyTuple, inputs: Inputs
) -> tuple[Winding, TemperatureRises, Shaft]:
    """Return winding, temperatures and shaft at the beginning of a step, from a drive's state."""
    rotor = begin_shaft(parameters, timestep, state, inputs)
    winding = Winding(state.current, state.integral, state.pending)
    return winding, TemperatureRises(state.winding_rise, state.housing_rise), rotor


def end_step(
    parameters: Parameters,
    timestep: float,
    time: float,
    heat: TemperatureRises,
    resistance: float,
    winding: Winding,
    rotor: Shaft,
    averages: StepAverages,
) -> tuple[tuple[float, float, float, float, float, float, float, float, float], float]:
    """Return the entries of `State` after a step, and the temperature [degC] of the winding.

    Temperatures and shaft are those at the beginning of the step. The mean current of the step
    heats the winding.
    """
    if shaft.has_thermal_model(parameters):
        heat = shaft.rises_after(
            parameters, timestep, heat, resistance * averages.current * averages.current
        )
    acceleration = averages.torque / rotor.inertia
    remaining = winding.current, winding.integral, winding.pending, heat.winding, heat.housing
    return (
        *remaining,
        acceleration,
        rotor.speed,
        rotor.external_acceleration,
        time + timestep,
    ), shaft.temperature_of(parameters, heat)


def step_signals(
    parameters: Parameters,
    command: float,
    reference: float,
    closed: bool,
    temperature: float,
    averages: StepAverages,
    saturated: float,
) -> tuple[float, ...]:
    """Return the entries of `Signals` for a step in which a number of samples was saturated.

    `command` and `reference` are the current [A] before and after its limits, or without a loop
    both the same value. The averages are over the step, and the temperature [degC] is at its end.
    """
    is_limited, is_thermal = reference != command, abs(reference) < parameters.max_current
    # A plain tuple, because numba does not add entries to a named one.
    return (
        averages.current,
        reference if closed else averages.current,
        averages.voltage,
        temperature,
        1.0 if saturated > 0.0 or is_limited else 0.0,
        1.0 if saturated > 0.0 else 0.0,
        1.0 if is_limited and not is_thermal else 0.0,
        1.0 if is_limited and is_thermal else 0.0,
        averages.power,
        averages.heat,
    )


def _advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs, closed: bool
) -> tuple[State, float, Signals]:
    """Advance a drive by one step, under a desired torque or, if not `closed`, a voltage.

    A voltage is passed as a desired torque: kT stands for 1 V.
    """
    command = inputs.desired_torque / parameters.torque_constant
    winding, heat, rotor = begin_step(parameters, timestep, state, inputs)
    resistance = shaft.resistance_at(parameters, shaft.temperature_of(parameters, heat))
    reference = (
        limit_current(parameters, timestep, heat, resistance, command) if closed else command
    )
    samples = max(int(timestep * parameters.sample_rate + 0.5), 1)
    winding, _, averages = shaft.advance_motor(
        parameters, resistance, timestep, samples, winding, rotor, closed, reference
    )
    after, temperature = end_step(
        parameters, timestep, inputs.time, heat, resistance, winding, rotor, averages
    )
    signals = step_signals(
        parameters, command, reference, closed, temperature, averages, averages.saturated
    )
    return State(*after), averages.torque, Signals(*signals)


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance winding, loop and shaft by one mechanical step [s]; inputs are those of the rotor."""
    return _advance(parameters, timestep, state, inputs, True)


def observe(
    parameters: Parameters,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    signals: Signals,
    inputs: Inputs,  # noqa: ARG001
) -> tuple[float, float]:
    """Return the mean current [A] of the last step, as drives report it, and the reference."""
    return signals.current, signals.reference_current


@dataclasses.dataclass(frozen=True)
class Drive(Geared):
    """Motor with its gear, the drive's current loop and the supply.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "drive"
    State: ClassVar[type[NamedTuple]] = State
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {
        "current": "A",
        "reference_current": "A",
        "voltage": "V",
        "temperature": "degC",
        **dict.fromkeys(("voltage_saturated", "current_saturated", "temperature_saturated"), "1"),
        **dict.fromkeys(("electrical_power", "copper_loss"), "W"),
    }
    OBSERVED: ClassVar[tuple[str, ...]] = ("current", "reference_current")
    INERTIA: ClassVar[bool] = True
    CLOSED: ClassVar[bool] = True
    """True if a current loop is closed around the winding."""
    advance: ClassVar[Callable[..., tuple[FamilyTuple, float, FamilyTuple]]] = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    motor: GearMotor = GearMotor()
    """The motor and its gear."""
    controller: SampledLoop = SampledLoop()
    """The current loop."""
    supply: Supply | None = optional_nested(Supply(voltage=24.0))
    """Supply of the drive; None: 24 V without a resistance."""
    # As `fields.optional_nested`, but taken by its name only, so that the positions of others stay.
    friction: ServoFriction | None = dataclasses.field(
        default=None, kw_only=True, metadata={"absent": ServoFriction()}
    )
    """Friction that depends on speed and load; None: only that of the motor's fields."""

    @classmethod
    def from_motor_parameters(cls, parameters: MotorParameters) -> "Drive":
        """Return a drive for a motor, with its nominal voltage (or 24 V) and its peak current."""
        max_current, voltage = parameters.max_current, parameters.voltage
        loop = SampledLoop() if max_current is None else SampledLoop(max_current=max_current)
        return cls(
            GearMotor.from_motor_parameters(parameters),
            loop,
            None if voltage is None else Supply(voltage),
        )

    @property
    def assumed(self) -> str:
        """Unspecified supply, current limit, inertia and constants; see `ActuatorModel.assumed`."""
        motor = self.motor
        is_consistent = 0.5 <= motor.back_emf_constant / motor.torque_constant <= 2.0
        missing = {
            f"supply.voltage = {self.voltage_limit:g} V": (
                self.supply is None or math.isinf(self.supply.voltage)
            ),
            "controller.max_current = inf": math.isinf(self.controller.max_current),
            "motor.rotor_inertia = 0": motor.rotor_inertia == 0.0,
        }
        # In SI units the two constants are equal except for losses. If they differ a lot, one was
        # probably left at the default of another motor.
        for name in (
            "torque_constant",
            "back_emf_constant",
        ):
            value = getattr(motor, name)
            missing[f"motor.{name} = {value:g}, a default"] = (
                not is_consistent and value == getattr(GearMotor, name)
            )
        assumptions = ", ".join(
            assumption for assumption, is_missing in missing.items() if is_missing
        )
        return f"assumed, because not specified: {assumptions}" if assumptions else ""

    def commands(self) -> Mapping[str, Command]:
        """Return the commands `current` [A], within `max_current`, and terminal `voltage` [V]."""
        limit, torque = self.controller.max_current, self.motor.torque_constant
        fixed = dict.fromkeys(
            ("motor.torque_constant", *ARM_FIELDS), "it would change what an action means"
        )
        voltage_drive = VoltageDrive(
            self.motor, self.controller, self.supply, friction=self.friction
        )
        bypassed = [
            "motor.max_temperature",
            *(f"controller.{name}" for name in _BYPASSED_BY_VOLTAGE),
        ]
        return {
            "current": Command("A", self, torque, limit if math.isfinite(limit) else None, fixed),
            "voltage": Command(
                "V",
                voltage_drive,
                torque,
                self.voltage_limit,
                fixed | dict.fromkeys(bypassed, "the command bypasses the loop"),
            ),
        }

    def check(self, timestep: float) -> None:
        """Raise if a step is not a whole number of samples, or if the loop is unstable.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        controller, samples = self.controller, timestep * self.controller.sample_rate
        if abs(samples - round(samples)) > 1e-6 * samples or samples < 0.5:
            nearest = max(round(samples), 1) / timestep
            raise ValueError(
                f"SampledLoop.sample_rate = {controller.sample_rate:g}: a mechanical step of"
                f" {timestep:g} s has {samples:g} samples, must be a whole number; the nearest"
                f" valid rate is {nearest:.8g} Hz"
            )
        radius = float(_radii(type(self), np.array([self.parameter_values]))[0])
        if not radius < 1.0:
            raise UnstableError(
                f"actuator: the current loop is unstable: spectral radius {radius:.4g} over a"
                f" sample, must be < 1. Lower controller.kp = {controller.kp:g} and controller.ki ="
                f" {controller.ki:g}, or leave both 0 to have them designed; lower"
                " supply.resistance; or pass allow_unstable=True to study it as it is"
            )

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Raise if the back-EMF of a saturated motor makes the speed unstable; warn if inaccurate.

        Raises:
            UnstableError: with the number and a remedy.
        """
        rotor, load_inertia = self.motor.rotor_inertia, self.motor.load_inertia
        held = held or math.isinf(load_inertia)
        if 0.0 < load_inertia < math.inf:
            inertia = rotor + load_inertia / self.motor.gear_ratio**2
        # A speed that is held for a time h changes by the share h*kT*kE/(R*J) through the back-EMF:
        # above 1 it oscillates, above 2 it grows.
        braking = self.motor.torque_constant * self.motor.back_emf_constant / self.motor.resistance
        samples = 1.0 if held else max(round(timestep * self.controller.sample_rate), 1)
        share = timestep / samples * braking / inertia
        remedy = "raise controller.sample_rate"
        if held:
            remedy = (
                "shorten the step"
                if load_inertia == 0.0
                else "leave motor.load_inertia 0, so that the speed within a step is predicted"
            )
        text = (
            f"motor.rotor_inertia = {rotor:g}: the speed is held for {timestep / samples:g} s, in"
            f" which the back-EMF of a saturated motor changes it by {share:.3g} times its value"
        )
        if share >= 2.0:
            remedies = [remedy, f"set motor.rotor_inertia (total now {inertia:.3g} kg*m^2)"]
            if rotor == 0.0:
                remedies = [
                    f"the motor moves only the load, {inertia:.3g} kg*m^2 at its shaft: set"
                    " motor.rotor_inertia > 0, from the motor's datasheet",
                    remedy,
                ]
            if remedy != "shorten the step":
                remedies.append("shorten the step")
            raise UnstableError(
                f"{text}, must be < 2; {', '.join(remedies)}, or pass allow_unstable=True to study"
                " it as it is"
            )
        if share > 0.5:
            warnings.warn(
                f"{text}: above 0.5 the speed is inaccurate, above 1 it oscillates; {remedy}",
                stacklevel=2,
            )
        elif share * samples > 3.0:
            warnings.warn(
                f"motor.rotor_inertia = {rotor:g}: a step of {timestep:g} s is"
                f" {share * samples:.3g} times the time in which the back-EMF of a saturated motor"
                " brakes its rotor. A free shaft is simulated well; at a stop, under friction or"
                " with other joints the torque is delayed by about as many steps: "
                + (
                    "set rotor_inertia, or shorten the step" if rotor == 0.0 else "shorten the step"
                ),
                stacklevel=2,
            )

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return the spectral radius of the loop over a sample; infinity for invalid combinations.

        A step that is not a whole number of samples is invalid, and so are combinations of fields
        that `GearMotor` or `SampledLoop` reject.
        """
        columns = stability.parameter_columns(cls, parameter_values)
        samples = timestep * columns.sample_rate
        valid = (abs(samples - np.round(samples)) <= 1e-6 * samples) & (samples >= 0.5)
        valid &= columns.bandwidth <= columns.sample_rate / (2.0 * math.pi)
        valid &= has_valid_temperatures(columns) & has_single_friction(columns)
        return np.where(valid, _radii(cls, parameter_values), np.inf)


ARM_FIELDS = ("motor.gear_ratio", "motor.arm_radius")
"""Fields that determine how a torque at the rotor acts on the joint."""
_BYPASSED_BY_VOLTAGE = ("bandwidth", "kp", "ki", "anti_windup", "bemf_compensation", "max_current")
"""Fields of the loop that have no effect if the agent commands the voltage."""


def _advance_driven(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Run `advance` without the loop, and report the current as its own reference.

    An agent that commands the voltage desires no particular current.
    """
    return _advance(parameters, timestep, state, inputs, False)


@dataclasses.dataclass(frozen=True)
class VoltageDrive(Drive):
    """Drive with a commanded terminal voltage; a desired torque of kT stands for 1 V."""

    family: ClassVar[str] = ""
    is_torque_controlled: ClassVar[bool] = False
    CLOSED: ClassVar[bool] = False
    advance: ClassVar = staticmethod(_advance_driven)


def _radii(cls: type[Drive], parameter_values: np.ndarray) -> np.ndarray:
    """Return the spectral radii over one sample, unsaturated and saturated, shape (m,)."""
    columns = stability.parameter_columns(cls, parameter_values)
    sample_time, resistance = 1.0 / columns.sample_rate, columns.resistance
    x = resistance * sample_time / columns.inductance
    decay = np.exp(-x)
    share = np.where(columns.bandwidth > 0.0, columns.bandwidth * sample_time, DEFAULT_BANDWIDTH)
    design = np.vectorize(sampled.designed_gains, otypes=[float, float])
    gains = design(
        resistance, columns.inductance, sample_time, 2.0 * math.pi * share * columns.sample_rate
    )
    designed = (columns.kp == 0.0) & (columns.ki == 0.0)
    kp = np.where(designed, gains[0], columns.kp)
    ki = np.where(designed, gains[1], columns.ki * sample_time)
    if not cls.CLOSED:
        kp, ki = 0.0 * kp, 0.0 * ki
    # Current [A] that 1 V adds within a sample.
    current_per_volt = (1.0 - decay) / resistance
    zero = np.zeros(len(parameter_values))
    ones = np.ones(len(parameter_values))
    is_delayed = columns.delayed != 0.0
    # Without an integral gain, the integral would only add an eigenvalue of 1.
    has_integral = ki > 0.0
    # Gains of the voltage for (current, integral, pending voltage).
    voltage = -(kp + ki), np.where(has_integral, ones, 0.0), zero
    rows = [
        [
            decay + np.where(is_delayed, 0.0, current_per_volt * voltage[0]),
            np.where(is_delayed, 0.0, current_per_volt * voltage[1]),
            is_delayed * current_per_volt,
        ],
        [-ki, np.where(has_integral, ones, 0.0), zero],
        [is_delayed * voltage[0], is_delayed * voltage[1], zero],
    ]
    matrices = np.array(rows).transpose(2, 0, 1)
    radii = np.abs(np.linalg.eigvals(matrices).astype(np.complex128)).max(axis=1)
    # At its limit the voltage depends on the current through the supply's resistance.
    limited = np.abs(decay - current_per_volt * columns.supply_resistance)
    larger: np.ndarray = np.maximum(radii, limited)
    return larger
