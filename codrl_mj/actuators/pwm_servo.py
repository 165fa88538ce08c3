"""Servo without a current loop, family `pwm_servo`: hobby servos and bus servos.

The firmware compares the target angle with the measured one. The error, times a gain, is the duty
cycle of a bridge: the share of the supply's voltage that the motor gets. The current follows from
the winding and the back-EMF, and nothing controls it. Feetech's servos and those of Dynamixel in
position mode work like this.
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import drive, shaft, stability
from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.firmware import FIRMWARES, find_firmware
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.geared import Geared, has_single_friction, has_valid_temperatures
from codrl_mj.actuators.model import Command, Inputs, UnstableError
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.pwm_loop import (
    HISTORY,
    SLACK,
    Commands,
    LoopState,
    PwmLoop,
    advance_loop,
    command_in_force,
)
from codrl_mj.actuators.servo_friction import ServoFriction
from codrl_mj.actuators.shaft import Shaft, TemperatureRises
from codrl_mj.fields import optional_nested

MAX_PIECES = 64
"""Largest number of pieces with a constant speed between two samples of the servo."""


class State(NamedTuple):
    """State of the servo."""

    current: float
    """Motor current [A]."""
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
    target: float
    """Target [rad] of the loop at the output shaft, on its way to the command."""
    target_velocity: float
    """Speed [rad/s] of the target."""
    error: float
    """Position error [rad] at the last sample."""
    integral: float
    """Duty cycle of the integral part."""
    duty: float
    """Duty cycle since the last sample."""
    steps_to_sample: float
    """Mechanical steps until the next sample, if samples are rarer than steps."""
    sent: float
    """Number of commands that have been sent."""
    c1: float
    """Last command [rad] at the output shaft; the following entries are the older ones."""
    c2: float
    c3: float
    c4: float
    c5: float
    c6: float
    c7: float
    c8: float


class Signals(NamedTuple):
    """Signals after a step."""

    current: float
    """Mean current [A] over the step; times kT it is the torque of the motor."""
    duty: float
    """Mean duty cycle over the step, from -1 to 1."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    temperature: float
    """Temperature [degC] of the winding at the end of the step."""
    target: float
    """Target [rad] of the loop at the output shaft at the end of the step."""
    error: float
    """Command that is in force minus position [rad] at the beginning of the step."""
    saturated: float
    """1 if any of the following two signals is 1."""
    voltage_saturated: float
    """1 if the duty cycle reached `max_duty` in at least one sample."""
    temperature_saturated: float
    """1 if the servo is switched off because its winding is hotter than `max_temperature`."""
    electrical_power: float
    """Mean of voltage times current at the winding's terminals [W]."""
    copper_loss: float
    """Mean heat [W] in the winding."""


class Driven(NamedTuple):
    """Winding after some time of a constant duty cycle and speed."""

    current: float
    """Current [A] at the end."""
    mean: float
    """Mean current [A]."""
    mean_square: float
    """Mean squared current [A^2]."""


class StepMotion(NamedTuple):
    """Motor and shaft within a step, and sums over the periods between the samples so far."""

    current: float
    """Current [A]."""
    position: float
    """Position [rad] of the output shaft."""
    speed: float
    """Speed [rad/s] of the rotor."""
    mean_current: float
    """Mean current [A], multiplied by the share of the step so far, as all further entries."""
    mean_square: float
    """Mean squared current [A^2]."""
    duty: float
    """Mean duty cycle."""
    voltage: float
    """Mean terminal voltage [V]."""
    power: float
    """Mean of voltage times current [W]."""
    torque: float
    """Mean torque [N*m] that the gear delivers, converted to the rotor's side."""


def sent_commands(state: State, command: float, position: float, is_new: bool) -> Commands:
    """Return the last commands [rad]; before the first step they are the position."""
    if state.expected_time <= 0.0:
        return Commands(
            command, position, position, position, position, position, position, position
        )
    if is_new:
        return Commands(
            command, state.c1, state.c2, state.c3, state.c4, state.c5, state.c6, state.c7
        )
    return Commands(state.c1, state.c2, state.c3, state.c4, state.c5, state.c6, state.c7, state.c8)


def advance_winding(
    parameters: Parameters,
    resistance: float,
    duration: float,
    current: float,
    duty: float,
    speed: float,
) -> Driven:
    """Advance the winding exactly for some time [s] at a constant duty cycle d and speed [rad/s].

    The bridge draws the current d*i from the supply, whose resistance r takes r*d*i of its voltage
    V. The motor gets d*(V - r*d*i), as if the winding had d^2*r more resistance.
    """
    total = resistance + duty * duty * parameters.supply_resistance
    x = total * duration / parameters.inductance
    drop = -math.expm1(-x)
    final = (duty * parameters.supply_voltage - parameters.back_emf_constant * speed) / total
    change = current - final
    mean = final + change * drop / x
    mean_square = final * (final + 2.0 * change * drop / x)
    mean_square += change * change * drop * (2.0 - drop) / (2.0 * x)
    return Driven(current - change * drop, mean, mean_square)


def advance_motor(
    parameters: Parameters,
    resistance: float,
    duration: float,
    share: float,
    duty: float,
    motion: StepMotion,
    rotor: Shaft,
) -> StepMotion:
    """Advance winding and rotor for some time [s], a share of the step, at a constant duty cycle.

    The rotor is that at the beginning of the step. The time is divided into pieces with a constant
    speed, as in `shaft.advance_motor`.
    """
    viscous = parameters.viscous_friction
    pieces = shaft.pieces_of_step(parameters, resistance, duration, MAX_PIECES, rotor.inertia)
    current, speed = motion.current, motion.speed
    mean, mean_square, torque = 0.0, 0.0, 0.0
    piece = duration / pieces
    for _ in range(pieces):
        driven = advance_winding(parameters, resistance, piece, current, duty, speed)
        current, delivered = driven.current, parameters.torque_constant * driven.mean
        now = Shaft(rotor.inertia, rotor.external_acceleration, speed)
        delivered -= shaft.lost_torque(parameters, piece, delivered, now)
        mean += driven.mean / pieces
        mean_square += driven.mean_square / pieces
        torque += delivered / pieces
        # The external acceleration includes the viscous friction at the step's initial speed.
        net_torque = delivered - viscous * (speed - rotor.speed)
        speed += piece * (net_torque / rotor.inertia + rotor.external_acceleration)
    way = 0.5 * duration * (motion.speed + speed) / parameters.gear_ratio
    driving, lost = duty * parameters.supply_voltage, duty * duty * parameters.supply_resistance
    return StepMotion(
        current,
        motion.position + way,
        speed,
        motion.mean_current + share * mean,
        motion.mean_square + share * mean_square,
        motion.duty + share * duty,
        motion.voltage + share * (driving - lost * mean),
        motion.power + share * (driving * mean - lost * mean_square),
        motion.torque + share * torque,
    )


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance bus, target, loop, winding and shaft by one mechanical step.

    `inputs.desired_torque` is a commanded position [rad] of the rotor.
    """
    ratio, is_first = parameters.gear_ratio, state.expected_time <= 0.0
    rotor = drive.begin_shaft(parameters, timestep, state, inputs)
    heat = TemperatureRises(state.winding_rise, state.housing_rise)
    temperature = shaft.temperature_of(parameters, heat)
    resistance = shaft.resistance_at(parameters, temperature)
    is_hot = 1.0 if temperature > parameters.max_temperature else 0.0
    newest = int(inputs.time / max(1.0 / parameters.command_rate, timestep) + SLACK)
    # The number is smaller if the simulation's time was set back.
    is_new = is_first or newest + 1.0 != state.sent
    start = inputs.position / ratio
    commands = sent_commands(state, inputs.desired_torque / ratio, start, is_new)
    count = max(int(timestep * parameters.servo_rate + 0.5), 1)
    steps_per_sample = max(int(1.0 / (timestep * parameters.servo_rate) + 0.5), 1)
    period, steps_to_sample, in_force = timestep / count, state.steps_to_sample, start
    target = start if is_first else state.target
    loop = LoopState(target, state.target_velocity, state.error, state.integral, state.duty, 0.0)
    motion = StepMotion(state.current, start, inputs.speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for index in range(count):
        # If the loop is faster than the mechanical step, all `count` passes are samples.
        if steps_to_sample <= 0.0 or count > 1:
            time = inputs.time + index * period
            command = command_in_force(
                parameters, timestep, commands, newest, time, inputs.noise_key
            )
            in_force = command if index == 0 else in_force
            loop = advance_loop(
                parameters,
                period * steps_per_sample,
                loop,
                command,
                motion.position,
                is_first and index == 0,
            )
            steps_to_sample = float(steps_per_sample)
        duty = 0.0 if is_hot > 0.0 else loop.duty
        motion = advance_motor(parameters, resistance, period, 1.0 / count, duty, motion, rotor)
    loss = resistance * motion.mean_square
    if shaft.has_thermal_model(parameters):
        heat = shaft.rises_after(parameters, timestep, heat, loss)
    return (
        State(
            motion.current,
            heat.winding,
            heat.housing,
            motion.torque / rotor.inertia,
            inputs.speed,
            rotor.external_acceleration,
            inputs.time + timestep,
            loop.target,
            loop.target_velocity,
            loop.error,
            loop.integral,
            loop.duty,
            steps_to_sample - 1.0,
            newest + 1.0 if is_new else state.sent,
            commands.c1,
            commands.c2,
            commands.c3,
            commands.c4,
            commands.c5,
            commands.c6,
            commands.c7,
            commands.c8,
        ),
        motion.torque,
        Signals(
            motion.mean_current,
            motion.duty,
            motion.voltage,
            shaft.temperature_of(parameters, heat),
            loop.target,
            in_force - start,
            max(loop.saturated, is_hot),
            loop.saturated,
            is_hot,
            motion.power,
            loss,
        ),
    )


def observe(
    parameters: Parameters,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    signals: Signals,
    inputs: Inputs,  # noqa: ARG001
) -> tuple[float, float]:
    """Return current [A] and duty cycle of the last step, as servos report them."""
    return signals.current, signals.duty


@dataclasses.dataclass(frozen=True)
class PwmServo(Geared):
    """Motor with gear, position loop without a current loop, and supply: commands are positions.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "pwm_servo"
    State: ClassVar[type[NamedTuple]] = State
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {
        "current": "A",
        "duty": "1",
        "voltage": "V",
        "temperature": "degC",
        "target": "rad",
        "error": "rad",
        **dict.fromkeys(("voltage_saturated", "temperature_saturated"), "1"),
        **dict.fromkeys(("electrical_power", "copper_loss"), "W"),
    }
    OBSERVED: ClassVar[tuple[str, ...]] = ("current", "duty")
    RANDOM: ClassVar[tuple[str, ...]] = ("loop.command_jitter",)
    INERTIA: ClassVar[bool] = True
    MOTION: ClassVar[bool] = True
    is_torque_controlled: ClassVar[bool] = False
    advance: ClassVar = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    motor: GearMotor = GearMotor()
    """The motor and its gear."""
    loop: PwmLoop = PwmLoop()
    """The position loop and the bus."""
    supply: Supply | None = optional_nested(Supply(voltage=24.0))
    """Supply of the servo; None: 24 V without a resistance."""
    friction: ServoFriction | None = dataclasses.field(
        default=None, kw_only=True, metadata={"absent": ServoFriction()}
    )
    """Friction that depends on speed and load; None: only that of the motor's fields."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if math.isinf(self.voltage_limit):
            raise ValueError(
                "PwmServo.supply.voltage = inf: must be finite, because the duty cycle is a share"
                " of it"
            )
        loop, gain = self.loop, 0.0
        if loop.position_p:
            gain = loop.position_p * FIRMWARES[loop.firmware].gain_per_p
        elif loop.stiffness:
            gain = loop.stiffness / self.stall_torque
        if gain:
            # The dataclass is frozen. A single gain remains, so that a later change of another
            # field, such as a drawn voltage, does not change the servo's law.
            converted = dataclasses.replace(loop, position_gain=gain, position_p=0.0, stiffness=0.0)
            vars(self)["loop"] = converted

    @property
    def stall_torque(self) -> float:
        """Torque [N*m] of the motor at the output at standstill and a duty cycle of 1.

        It leaves out the gear's losses and the supply's resistance.
        """
        motor = self.motor
        return motor.torque_constant * self.voltage_limit * motor.gear_ratio / motor.resistance

    @property
    def stiffness(self) -> float:
        """Torque [N*m] of the motor at the output for a position error of 1 rad at standstill."""
        return self.loop.position_gain * self.stall_torque

    @classmethod
    def factory_settings(
        cls, motor: str, loop_fields: Mapping[str, object]
    ) -> dict[str, float | str]:
        """Return the settings of the loop that a motor's name implies; empty if it implies none.

        Args:
            motor: name of a motor of the catalogue, or of a file.
            loop_fields: settings of the loop that the user has specified.
        """
        factory = find_firmware(motor)
        name = str(loop_fields.get("firmware", factory[0] if factory else "unknown"))
        if name not in FIRMWARES:
            return {}
        law = FIRMWARES[name]
        settings: dict[str, float | str] = {
            "firmware": name,
            "max_duty": law.max_duty,
            "encoder_counts": law.encoder_counts,
        }
        is_set = {"position_gain", "position_p", "stiffness"} & loop_fields.keys()
        if factory is not None and factory[0] == name and not is_set:
            settings["position_p"] = factory[1]
        return settings

    @property
    def assumed(self) -> str:
        """Unspecified inertia and gain; see `ActuatorModel.assumed`."""
        missing = {
            f"supply.voltage = {self.voltage_limit:g} V": self.supply is None,
            f"loop.position_gain = {self.loop.position_gain:g}, a default": (
                self.loop.position_gain == PwmLoop.position_gain
            ),
            "motor.rotor_inertia = 0": self.motor.rotor_inertia == 0.0,
        }
        assumptions = [text for text, is_missing in missing.items() if is_missing]
        text = ", ".join(assumptions)
        return f"assumed, because not specified: {text}" if text else ""

    def commands(self) -> Mapping[str, Command]:
        """Return the command `position` [rad] or [m]."""
        reason = "it would change what an action means"
        fixed = dict.fromkeys(drive.ARM_FIELDS, reason) | dict.fromkeys(
            ("loop.position_p", "loop.stiffness", "loop.firmware"),
            "it was converted to loop.position_gain, which can be drawn",
        )
        limit = self.loop.max_position * self.motor.arm_radius
        return {"position": Command("rad", self, 1.0 / self.arm_radius, limit, fixed)}

    def check(self, timestep: float) -> None:
        """Raise if rates do not match the step, or if too many commands are on their way.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        loop = self.loop
        if not bool(_rates_match(np.array(loop.servo_rate), timestep)):
            in_step = timestep * loop.servo_rate
            steps = max(round(in_step), 1) if in_step > 1.0 else 1.0 / round(1.0 / in_step)
            raise ValueError(
                f"PwmLoop.servo_rate = {loop.servo_rate:g}: must be a multiple or a divisor of the"
                f" mechanical step's rate, {1.0 / timestep:g} Hz; the nearest valid rate is"
                f" {steps / timestep:.8g} Hz"
            )
        interval = max(1.0 / loop.command_rate, timestep)
        latest = loop.command_delay + 4.0 * loop.command_jitter
        if latest > (HISTORY - 1) * interval * (1.0 + 1e-9):
            raise ValueError(
                f"PwmLoop.command_delay = {loop.command_delay:g}: with four times command_jitter ="
                f" {loop.command_jitter:g} it must be <= {(HISTORY - 1) * interval:g} s, seven"
                " periods of the commands. Lower command_rate (now"
                f" {min(loop.command_rate, 1.0 / timestep):g} Hz), or delay the commands before the"
                " servo: disturbances={'command_delay': ...}"
            )

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return infinity where `check` raises, else 0: the load is not known here."""
        columns = stability.parameter_columns(cls, parameter_values)
        latest = columns.command_delay + 4.0 * columns.command_jitter
        interval = np.maximum(1.0 / columns.command_rate, timestep)
        valid = latest <= (HISTORY - 1) * interval * (1.0 + 1e-9)
        valid &= _rates_match(columns.servo_rate, timestep)
        valid &= columns.start_duty <= columns.max_duty
        valid &= np.isfinite(columns.supply_voltage)
        valid &= has_valid_temperatures(columns) & has_single_friction(columns)
        return np.where(valid, 0.0, np.inf)

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Raise if the back-EMF makes the speed unstable; warn if it is inaccurate.

        Raises:
            UnstableError: with the number and a remedy.
        """
        motor, loop = self.motor, self.loop
        held = held or math.isinf(motor.load_inertia)
        if 0.0 < motor.load_inertia < math.inf:
            inertia = motor.rotor_inertia + motor.load_inertia / motor.gear_ratio**2
        # As in `Drive.check_shaft`: the share of its speed that the back-EMF takes from the rotor
        # while the speed is held.
        braking = motor.torque_constant * motor.back_emf_constant / motor.resistance
        period = timestep if held else min(timestep, 1.0 / loop.servo_rate)
        pieces = 1 if held else min(max(math.ceil(2.0 * period * braking / inertia), 1), MAX_PIECES)
        share = period / pieces * braking / inertia
        if share <= 0.5:
            return
        text = (
            f"motor.rotor_inertia = {motor.rotor_inertia:g}: the speed is held for"
            f" {period / pieces:g} s, in which the back-EMF changes it by {share:.3g} times its"
            f" value. The inertia at the rotor is {inertia:.3g} kg*m^2: set motor.rotor_inertia"
            f" from the motor's datasheet, or shorten the step to {0.5 * period / share:.2g} s"
        )
        if share >= 2.0:
            raise UnstableError(
                f"{text}; must be < 2, or pass allow_unstable=True to study it as it is"
            )
        warnings.warn(
            f"{text}: above 0.5 the speed is inaccurate, above 1 it oscillates", stacklevel=2
        )

    def steps_per_sample(self, timestep: float) -> int:
        """Return the number of mechanical steps per sample of the loop, at least 1."""
        return max(int(1.0 / (timestep * self.loop.servo_rate) + 0.5), 1)

    def loop_remedy(self, inertia: float) -> str:
        """Return a remedy for the loop's gains; see `ActuatorModel.loop_remedy`."""
        loop, at_joint = self.loop, inertia * self.motor.gear_ratio**2
        return (
            f"The inertia at the joint is {at_joint:.3g} kg*m^2, and the servo pulls it with"
            f" {self.stiffness:.3g} N*m/rad. Lower loop.position_gain (now {loop.position_gain:g})"
            f" or loop.derivative_gain (now {loop.derivative_gain:g}), or set motor.rotor_inertia"
            f" (now {self.motor.rotor_inertia:g}) from the motor's datasheet."
        )


def _rates_match(servo_rate: np.ndarray, timestep: float) -> np.ndarray:
    """Return True where a sample rate [Hz] is a multiple or a divisor of the step's rate."""
    in_step = timestep * servo_rate
    multiple = np.maximum(in_step, 1.0 / in_step)
    matches: np.ndarray = np.abs(multiple - np.round(multiple)) <= 1e-6 * multiple
    return matches
