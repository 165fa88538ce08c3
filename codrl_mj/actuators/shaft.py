"""A drive's winding, gear and shaft over some time: the mathematics that `drive` and `servo` share.

Within a mechanical step the shaft's speed changes by the motor's own torque, which is known, and by
whatever else acts on the load, which is taken as it was in the step before: `others`. Where nobody
knows the inertia the speed is held.
"""

import math
from typing import Any, NamedTuple

from codrl_mj.actuators import sampled
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH

RATED_TEMPERATURE = 25.0
"""Temperature [degC] at which datasheets give resistances."""


class Winding(NamedTuple):
    """Winding and loop at a moment."""

    current: float
    """[A]"""
    integral: float
    """The controller's integral [V]."""
    pending: float
    """Voltage [V] that a delayed loop applies in the next sample."""


class TemperatureRises(NamedTuple):
    """How warm the motor is."""

    winding: float
    """How much warmer [K] the winding is than the housing."""
    housing: float
    """How much warmer [K] the housing is than the surroundings."""


class Shaft(NamedTuple):
    """The rotor at a moment, and what moves it besides the motor."""

    inertia: float
    """Inertia [kg*m^2] of all that the rotor moves, itself included; `inf` where its speed is held."""
    external_acceleration: float
    """Acceleration [rad/s^2] by all but the motor's torque."""
    speed: float
    """[rad/s]"""


class StepAverages(NamedTuple):
    """What there was of a stretch of time, in the mean of it."""

    current: float
    """[A]"""
    voltage: float
    """At the winding's terminals [V]."""
    torque: float
    """Delivered by the gear, at the rotor's side of it [N*m]."""
    saturated: float
    """How many samples were at the voltage's limit."""
    power: float
    """Into the winding at its terminals [W]."""
    heat: float
    """Lost in the winding [W]: of its resistance and the square of its current, within the samples too."""


def temperature_of(parameters: Any, heat: TemperatureRises) -> float:
    """Of the winding [degC]."""
    return parameters.ambient_temperature + heat.winding + heat.housing


def resistance_at(parameters: Any, temperature: float) -> float:
    """Resistance [ohm] of the winding at a temperature [degC]."""
    return parameters.resistance * (
        1.0 + parameters.resistance_coefficient * (temperature - RATED_TEMPERATURE)
    )


def rise_after(resistance: float, constant: float, duration: float, rise: float, watts: float) -> float:
    """Rise [K] over a thermal resistance [K/W] with a time constant [s] after a duration [s] of a held loss [W]."""
    kept = math.exp(-duration / constant)
    return rise * kept + resistance * watts * (1.0 - kept)


def rises_after(parameters: Any, duration: float, heat: TemperatureRises, watts: float) -> TemperatureRises:
    """The motor's temperatures after some time [s] of a held loss [W] in the winding: two bodies in a row."""
    return TemperatureRises(
        rise_after(
            parameters.thermal_resistance_winding,
            parameters.thermal_time_constant_winding,
            duration,
            heat.winding,
            watts,
        ),
        rise_after(
            parameters.thermal_resistance_housing,
            parameters.thermal_time_constant_housing,
            duration,
            heat.housing,
            watts,
        ),
    )


def thermal_limit(parameters: Any, duration: float, heat: TemperatureRises, resistance: float) -> float:
    """The current [A] that takes the winding to `max_temperature` within some time [s], and no further.

    While the motor is cold that is more than it can bear for long; at the limit it falls to the
    continuous current.
    """
    cooled, by_a_watt = (
        rises_after(parameters, duration, heat, 0.0),
        rises_after(parameters, duration, TemperatureRises(0.0, 0.0), 1.0),
    )
    room = (
        parameters.max_temperature
        - parameters.ambient_temperature
        - cooled.winding
        - cooled.housing
    )
    return math.sqrt(max(room, 0.0) / (resistance * (by_a_watt.winding + by_a_watt.housing)))


def inertia_of(parameters: Any, inertia: float) -> float:
    """Inertia [kg*m^2] that the rotor moves, by `load_inertia` or the model's; `inf` where the speed is held."""
    if parameters.load_inertia > 0.0:
        inertia = parameters.rotor_inertia + parameters.load_inertia / (
            parameters.gear_ratio * parameters.gear_ratio
        )
    return inertia if inertia > 0.0 else math.inf


def estimate_external_acceleration(timestep: float, change: float, own: float, external_acceleration: float) -> float:
    """Acceleration [rad/s^2] of the rotor by all but its motor, from what the last step showed.

    Half of it is what was taken then: two joints that move each other, each with a stiff motor,
    would answer to what the other did a step ago, back and forth. From the rotor's change of speed
    in the step [rad/s] and, [rad/s^2], its acceleration by the motor's torque and what was taken
    for that by all else.
    """
    return 0.5 * (change / timestep - own) + 0.5 * external_acceleration


def friction(parameters: Any, duration: float, torque: float, shaft: Shaft) -> float:
    """Torque [N*m] that Stribeck friction and the gear take from the motor's, by an implicit step.

    It is against the speed that the shaft would have without it, and at most what stops the shaft:
    so it never turns the rotor back, and where the inertia is known it holds what pushes less than
    it: the rotor sticks. Where the speed is held it stops no more than the rotor alone, and nothing
    sticks. Source: the friction of Duclusaud, Passault, Padois, Ly, *Extended Friction Models for
    the Physics Simulation of Servo Actuators* (2024), sec. III.
    """
    if shaft.inertia < math.inf:
        free = shaft.speed + duration * (torque / shaft.inertia + shaft.external_acceleration)
        most = shaft.inertia * abs(free) / duration
    else:
        free, rotor = shaft.speed, parameters.rotor_inertia
        most = rotor * abs(free) / duration if rotor > 0.0 else math.inf
    efficiency = parameters.gear_efficiency
    level = abs(torque) * (1.0 - efficiency if torque * free > 0.0 else 1.0 / efficiency - 1.0)
    if parameters.stribeck_friction > 0.0:
        ratio = abs(shaft.speed) / parameters.stribeck_speed
        level += parameters.stribeck_friction * math.exp(-(ratio**parameters.stribeck_exponent))
    return math.copysign(min(level, most), free) if free != 0.0 else 0.0


def has_thermal_model(parameters: Any) -> bool:
    """Whether the motor's temperature changes at all."""
    return parameters.thermal_resistance_winding + parameters.thermal_resistance_housing > 0.0


def advance_winding(
    parameters: Any,
    resistance: float,
    samples: int,
    winding: Winding,
    closed: bool,
    asked: float,
    speed: float,
) -> tuple[Winding, float, float, int, float, float]:
    """Winding and loop over some samples at a held speed: at once where that has a closed form.

    The sums that it needs telescope: with S the sum of the current over the samples' starts, the
    mean of (u - b)/R is (S + (i_n - i_0)/(1 - e))/n, and that of the current, the mean of every
    sample included, (S + (1 - m)/(1 - e)*(i_n - i_0))/n with m = (1 - e)/x and x = R*T/L. What is
    drawn and neither moves the rotor nor is left in the winding's field, L*i^2/2, is heat. Where
    the loop is `closed` a current [A] is asked for, else a voltage [V].

    Returns:
        The winding afterwards, the mean current [A], the mean voltage [V], how many samples were
        saturated, and the mean of the power [W] at the terminals and of the heat [W].
    """
    sample_time, voltage = 1.0 / parameters.sample_rate, parameters.supply_voltage
    stiff = parameters.delayed == 0.0 and parameters.supply_resistance == 0.0
    if not closed and stiff:  # nothing changes from sample to sample
        sample_time, samples = sample_time * samples, 1
    x = resistance * sample_time / parameters.inductance
    lost = -math.expm1(-x)
    back_emf = parameters.back_emf_constant * speed
    compensated = back_emf if parameters.bemf_compensation != 0.0 else 0.0
    designed = parameters.kp == 0.0 and parameters.ki == 0.0
    y = (
        2.0
        * math.pi
        * (parameters.bandwidth * sample_time if parameters.bandwidth > 0.0 else DEFAULT_BANDWIDTH)
    )
    as_designed = (
        closed and designed and parameters.anti_windup == 0.0 and parameters.deadband == 0.0
    )
    if as_designed and stiff:
        offset = back_emf - compensated
        current, integral, total, drawn, saturated = sampled.solve_designed_loop(
            winding.current,
            (winding.integral - offset) / resistance,
            asked,
            (-voltage - back_emf) / resistance,
            (voltage - back_emf) / resistance,
            samples,
            x,
            y,
            lost,
        )
        after = Winding(current, integral * resistance + offset, winding.pending)
    else:
        kp, ki = parameters.kp, parameters.ki * sample_time
        if not closed:
            kp, ki, compensated, asked = 0.0, 0.0, asked, 0.0
        elif designed:
            kp, ki = sampled.designed_gains(
                resistance, parameters.inductance, sample_time, y * parameters.sample_rate
            )
        current, integral, pending, total, drawn, saturated = sampled.run_samples(
            parameters,
            winding.current,
            winding.integral if closed else 0.0,
            winding.pending,
            asked,
            back_emf,
            compensated,
            samples,
            resistance,
            1.0 - lost,
            lost / x,
            kp,
            ki,
        )
        after = Winding(current, integral, pending)
    change = (after.current - winding.current) / lost
    mean = (total + (1.0 - lost / x) * change) / samples
    stored = (after.current - winding.current) * (after.current + winding.current) / (2.0 * x)
    scale = resistance / samples
    power, heat = back_emf * mean + scale * drawn, scale * (drawn - stored)
    return after, mean, back_emf + resistance * (total + change) / samples, saturated, power, heat


def advance_motor(
    parameters: Any,
    resistance: float,
    duration: float,
    samples: int,
    winding: Winding,
    shaft: Shaft,
    closed: bool,
    asked: float,
) -> tuple[Winding, float, StepAverages]:
    """Winding, loop and shaft over some time under a held command.

    Where a saturated voltage meets a light load, the speed cannot be held: c = h*kT*kE/(R*J) is the
    share of it that the back-EMF takes off in a time h; above 1 it rings, above 2 it grows. So the
    time is cut into 2*c pieces, and the speed goes on from piece to piece. Found are winding and
    speed [rad/s] afterwards, and what there was in between.
    """
    viscous = (
        parameters.viscous_friction
    )  # of the joint, which `others` has at the speed of the beginning
    braking = parameters.torque_constant * parameters.back_emf_constant / resistance + viscous
    pieces = min(max(math.ceil(2.0 * duration * braking / shaft.inertia), 1), samples)
    lossy = parameters.gear_efficiency < 1.0 or parameters.stribeck_friction > 0.0
    amperes, volts, torque, power, heat = 0.0, 0.0, 0.0, 0.0, 0.0
    saturated, left, speed = 0, samples, shaft.speed
    for piece in range(pieces):
        count = left // (pieces - piece) if piece < pieces - 1 else left
        winding, mean, voltage, limited, drawn, lost = advance_winding(
            parameters, resistance, count, winding, closed, asked, speed
        )
        left, saturated = left - count, saturated + limited
        share, delivered = count / samples, parameters.torque_constant * mean
        if lossy:
            now = Shaft(shaft.inertia, shaft.external_acceleration, speed)
            delivered -= friction(parameters, share * duration, delivered, now)
        amperes, volts, torque = (
            amperes + share * mean,
            volts + share * voltage,
            torque + share * delivered,
        )
        power, heat = power + share * drawn, heat + share * lost
        changed = delivered - viscous * (speed - shaft.speed)
        speed += share * duration * (changed / shaft.inertia + shaft.external_acceleration)
    return winding, speed, StepAverages(amperes, volts, torque, float(saturated), power, heat)
