"""Equations of a drive's winding, gear and shaft, shared by the families `drive` and `servo`.

Within a mechanical step the shaft's speed changes by the motor's torque, which is known, and by
everything else that acts on the load. That part, `external_acceleration`, is taken from the
previous step. If the inertia is unknown the speed is held.
"""

import math
from typing import NamedTuple

from codrl_mj.actuators import sampled
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.actuators.servo_friction import friction_torque, has_servo_friction

RATED_TEMPERATURE = 25.0
"""Temperature [degC] at which datasheets state resistances."""


class Winding(NamedTuple):
    """State of winding and loop."""

    current: float
    """Current [A]."""
    integral: float
    """The controller's integral [V]."""
    pending: float
    """Voltage [V] that a delayed loop applies in the next sample."""


class TemperatureRises(NamedTuple):
    """Temperature differences in the motor."""

    winding: float
    """Difference [K] between winding and housing."""
    housing: float
    """Difference [K] between housing and surroundings."""


class Shaft(NamedTuple):
    """State of the rotor, and its acceleration by everything except the motor."""

    inertia: float
    """Total inertia [kg*m^2] that the rotor moves, including its own; `inf` if its speed is held.
    """
    external_acceleration: float
    """Acceleration [rad/s^2] by everything except the motor's torque."""
    speed: float
    """Speed [rad/s]."""


class StepAverages(NamedTuple):
    """Averages over a period of time."""

    current: float
    """Current [A]."""
    voltage: float
    """Voltage [V] at the winding's terminals."""
    torque: float
    """Torque [N*m] that the gear delivers, converted to the rotor's side."""
    saturated: float
    """Number of samples at the voltage limit."""
    power: float
    """Electrical power [W] into the winding at its terminals."""
    heat: float
    """Heat [W] in the winding, from its resistance and the squared current within the samples."""


def temperature_of(parameters: Parameters, heat: TemperatureRises) -> float:
    """Return the temperature [degC] of the winding."""
    return parameters.ambient_temperature + heat.winding + heat.housing


def resistance_at(parameters: Parameters | GearMotor, temperature: float) -> float:
    """Return the resistance [ohm] of the winding at a temperature [degC]."""
    return parameters.resistance * (
        1.0 + parameters.resistance_coefficient * (temperature - RATED_TEMPERATURE)
    )


def approach_shares(parameters: Parameters, duration: float) -> tuple[float, float]:
    """Return the shares in (0, 1) of the way to their final values that temperatures cover.

    A share is 1 - exp(-duration/constant), of the winding and of the housing, for a duration [s].
    """
    # A step is so short beside the constants that 1 - exp(...) would be off by 0.1 % in float32.
    return (
        -math.expm1(-duration / parameters.thermal_time_constant_winding),
        -math.expm1(-duration / parameters.thermal_time_constant_housing),
    )


def rises_after(
    parameters: Parameters, duration: float, heat: TemperatureRises, watts: float
) -> TemperatureRises:
    """Return the temperature differences after some time [s] of a constant loss [W] in the winding.

    Winding and housing are two thermal bodies in series. Each difference approaches the product of
    thermal resistance [K/W] and loss.
    """
    winding_share, housing_share = approach_shares(parameters, duration)
    winding_per_watt = parameters.thermal_resistance_winding * winding_share
    housing_per_watt = parameters.thermal_resistance_housing * housing_share
    # The small terms are added first, because in float32 a sum with a temperature loses digits of
    # them: over 1,000 s, this order keeps 0.01 % of the rise, and the other one 0.6 %.
    return TemperatureRises(
        heat.winding + (winding_per_watt * watts - heat.winding * winding_share),
        heat.housing + (housing_per_watt * watts - heat.housing * housing_share),
    )


def thermal_limit(
    parameters: Parameters, duration: float, heat: TemperatureRises, resistance: float
) -> float:
    """Return the current [A] that heats the winding just to `max_temperature` in some time [s].

    While the motor is cold this exceeds the continuous current; at the limit it falls to that.
    """
    winding_share, housing_share = approach_shares(parameters, duration)
    margin = (
        parameters.max_temperature
        - parameters.ambient_temperature
        - (heat.winding - heat.winding * winding_share)
        - (heat.housing - heat.housing * housing_share)
    )
    per_watt = (
        parameters.thermal_resistance_winding * winding_share
        + parameters.thermal_resistance_housing * housing_share
    )
    return math.sqrt(max(margin, 0.0) / (resistance * per_watt))


def inertia_of(parameters: Parameters, inertia: float) -> float:
    """Return the inertia [kg*m^2] that the rotor moves; `inf` if the speed is held.

    It follows from `load_inertia` if that is not 0, and otherwise from the model.
    """
    if parameters.load_inertia > 0.0:
        inertia = parameters.rotor_inertia + parameters.load_inertia / (
            parameters.gear_ratio * parameters.gear_ratio
        )
    return inertia if inertia > 0.0 else math.inf


def estimate_external_acceleration(
    timestep: float, change: float, motor_acceleration: float, external_acceleration: float
) -> float:
    """Estimate the acceleration [rad/s^2] of the rotor by everything except its motor.

    The estimate is the average of the value observed in the last step and the previous estimate.
    Without the average, two joints that move each other, each with a stiff motor, would react to
    each other with a delay of one step and oscillate.

    Args:
        timestep: duration of the last step [s].
        change: change of the rotor's speed in that step [rad/s].
        motor_acceleration: acceleration by the motor's torque in that step [rad/s^2].
        external_acceleration: previous estimate [rad/s^2].
    """
    return 0.5 * (change / timestep - motor_acceleration) + 0.5 * external_acceleration


def friction(parameters: Parameters, duration: float, torque: float, shaft: Shaft) -> float:
    """Return the torque [N*m] of Stribeck friction and gear losses by an implicit step.

    Friction opposes the speed that the shaft would have without it. It is at most the torque that
    stops the shaft, so it never reverses the rotor; a smaller driving torque is balanced, and the
    rotor sticks. If the inertia is unknown, so that the speed is held, friction is at most the
    torque that stops the rotor alone, and nothing sticks. Source: the friction of Duclusaud,
    Passault, Padois, Ly, *Extended Friction Models for the Physics Simulation of Servo Actuators*
    (2024), sec. III.
    """
    if shaft.inertia < math.inf:
        free_speed = shaft.speed + duration * (torque / shaft.inertia + shaft.external_acceleration)
        stopping_torque = shaft.inertia * abs(free_speed) / duration
    else:
        free_speed, rotor = shaft.speed, parameters.rotor_inertia
        stopping_torque = rotor * abs(free_speed) / duration if rotor > 0.0 else math.inf
    efficiency = parameters.gear_efficiency
    level = abs(torque) * (
        1.0 - efficiency if torque * free_speed > 0.0 else 1.0 / efficiency - 1.0
    )
    if parameters.stribeck_friction > 0.0:
        ratio = abs(shaft.speed) / parameters.stribeck_speed
        level += parameters.stribeck_friction * math.exp(-(ratio**parameters.stribeck_exponent))
    return math.copysign(min(level, stopping_torque), free_speed) if free_speed != 0.0 else 0.0


def servo_friction(parameters: Parameters, duration: float, torque: float, shaft: Shaft) -> float:
    """Return the torque [N*m] of the part `friction` at the rotor, for the rotor's quantities."""
    ratio = parameters.gear_ratio
    square = ratio * ratio
    load_torque = 0.0
    if shaft.inertia < math.inf:
        load_torque = ratio * shaft.inertia * shaft.external_acceleration
    at_output = friction_torque(
        parameters,
        duration,
        shaft.inertia * square,
        parameters.rotor_inertia * square,
        shaft.speed / ratio,
        torque * ratio,
        load_torque,
    )
    return at_output / ratio


def lost_torque(parameters: Parameters, duration: float, torque: float, shaft: Shaft) -> float:
    """Return what gear and friction take of the motor's torque [N*m]; friction of the joint not."""
    if parameters.gear_efficiency < 1.0 or parameters.stribeck_friction > 0.0:
        return friction(parameters, duration, torque, shaft)
    if has_servo_friction(parameters):
        return servo_friction(parameters, duration, torque, shaft)
    return 0.0


def has_thermal_model(parameters: Parameters) -> bool:
    """Return True if the motor's temperature can change."""
    return parameters.thermal_resistance_winding + parameters.thermal_resistance_housing > 0.0


def advance_winding(
    parameters: Parameters,
    resistance: float,
    samples: int,
    winding: Winding,
    closed: bool,
    command: float,
    speed: float,
) -> tuple[Winding, float, float, int, float, float]:
    """Advance winding and loop by some samples at a held speed, in closed form if possible.

    The sums telescope: with S the sum of the current over the samples' starts, the mean of (u -
    b)/R is (S + (i_n - i_0)/(1 - e))/n, and the mean of the current, averaged within every sample,
    is (S + (1 - m)/(1 - e)*(i_n - i_0))/n with m = (1 - e)/x and x = R*T/L. The energy that is
    drawn and neither moves the rotor nor remains in the winding's field, L*i^2/2, is heat. If the
    loop is `closed`, the command is a current [A], else a voltage [V].

    Returns:
        The winding afterwards, the mean current [A], the mean voltage [V], the number of saturated
            samples, and the means of the power [W] at the terminals and of the heat [W].
    """
    sample_time, voltage = 1.0 / parameters.sample_rate, parameters.supply_voltage
    is_stiff_and_undelayed = parameters.delayed == 0.0 and parameters.supply_resistance == 0.0
    # A held voltage on a stiff supply makes all samples equal, so they are one long sample.
    if not closed and is_stiff_and_undelayed:
        sample_time, samples = sample_time * samples, 1
    x = resistance * sample_time / parameters.inductance
    drop = -math.expm1(-x)
    back_emf = parameters.back_emf_constant * speed
    compensated = back_emf if parameters.bemf_compensation != 0.0 else 0.0
    has_designed_gains = parameters.kp == 0.0 and parameters.ki == 0.0
    y = (
        2.0
        * math.pi
        * (parameters.bandwidth * sample_time if parameters.bandwidth > 0.0 else DEFAULT_BANDWIDTH)
    )
    has_closed_form = (
        closed
        and has_designed_gains
        and parameters.anti_windup == 0.0
        and parameters.deadband == 0.0
    )
    if has_closed_form and is_stiff_and_undelayed:
        offset = back_emf - compensated
        current, integral, total, drawn, saturated = sampled.solve_designed_loop(
            winding.current,
            (winding.integral - offset) / resistance,
            command,
            (-voltage - back_emf) / resistance,
            (voltage - back_emf) / resistance,
            samples,
            x,
            y,
            drop,
        )
        after = Winding(current, integral * resistance + offset, winding.pending)
    else:
        kp, ki = parameters.kp, parameters.ki * sample_time
        if not closed:
            kp, ki, compensated, command = 0.0, 0.0, command, 0.0
        elif has_designed_gains:
            kp, ki = sampled.designed_gains(
                resistance, parameters.inductance, sample_time, y * parameters.sample_rate
            )
        current, integral, pending, total, drawn, saturated = sampled.run_samples(
            parameters,
            winding.current,
            winding.integral if closed else 0.0,
            winding.pending,
            command,
            back_emf,
            compensated,
            samples,
            resistance,
            1.0 - drop,
            drop / x,
            kp,
            ki,
        )
        after = Winding(current, integral, pending)
    mean, volts, power, heat = winding_means(
        *(resistance, x, drop, back_emf, samples, winding.current, after.current, total, drawn)
    )
    return after, mean, volts, saturated, power, heat


def winding_means(
    resistance: float,
    x: float,
    drop: float,
    back_emf: float,
    samples: float,
    initial_current: float,
    current: float,
    total: float,
    drawn: float,
) -> tuple[float, float, float, float]:
    """Return means over some samples: current [A], voltage [V], power [W] and heat [W].

    The formulas are those of `advance_winding`; `total` and `drawn` are the sums that
    `sampled.run_samples` returns.
    """
    change = (current - initial_current) / drop
    mean = (total + (1.0 - drop / x) * change) / samples
    stored = (current - initial_current) * (current + initial_current) / (2.0 * x)
    scale = resistance / samples
    power, heat = back_emf * mean + scale * drawn, scale * (drawn - stored)
    return mean, back_emf + resistance * (total + change) / samples, power, heat


def pieces_of_step(
    parameters: Parameters, resistance: float, duration: float, samples: int, inertia: float
) -> int:
    """Return the number of pieces, with a speed each, into which `advance_motor` divides time."""
    braking = parameters.torque_constant * parameters.back_emf_constant / resistance
    braking += parameters.viscous_friction
    braking += parameters.friction_viscous / (parameters.gear_ratio * parameters.gear_ratio)
    return min(max(math.ceil(2.0 * duration * braking / inertia), 1), samples)


def advance_motor(
    parameters: Parameters,
    resistance: float,
    duration: float,
    samples: int,
    winding: Winding,
    shaft: Shaft,
    closed: bool,
    command: float,
) -> tuple[Winding, float, StepAverages]:
    """Advance winding, loop and shaft over some time with a held command.

    A saturated motor with a light load changes its speed too fast for a speed that is held. The
    back-EMF removes a share c = h*kT*kE/(R*J) of the speed in a time h: above 1 the speed
    oscillates, above 2 it grows. So the time is divided into 2*c pieces, each with a new speed.

    The result is the winding and the speed [rad/s] afterwards, and the averages.
    """
    # Viscous friction belongs to the joint, and `external_acceleration` includes it at the initial
    # speed. So only the change since then is added.
    viscous = parameters.viscous_friction
    pieces = pieces_of_step(parameters, resistance, duration, samples, shaft.inertia)
    amperes, volts, torque, power, heat = 0.0, 0.0, 0.0, 0.0, 0.0
    saturated, samples_left, speed = 0, samples, shaft.speed
    for piece in range(pieces):
        count = samples_left // (pieces - piece) if piece < pieces - 1 else samples_left
        winding, mean, voltage, limited, power_now, heat_now = advance_winding(
            parameters, resistance, count, winding, closed, command, speed
        )
        samples_left, saturated = samples_left - count, saturated + limited
        share, delivered = count / samples, parameters.torque_constant * mean
        shaft_now = Shaft(shaft.inertia, shaft.external_acceleration, speed)
        delivered -= lost_torque(parameters, share * duration, delivered, shaft_now)
        amperes = amperes + share * mean
        volts = volts + share * voltage
        torque = torque + share * delivered
        power, heat = power + share * power_now, heat + share * heat_now
        net_torque = delivered - viscous * (speed - shaft.speed)
        speed += share * duration * (net_torque / shaft.inertia + shaft.external_acceleration)
    return winding, speed, StepAverages(amperes, volts, torque, float(saturated), power, heat)
