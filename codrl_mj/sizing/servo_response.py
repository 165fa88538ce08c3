"""Responses of a position servo: a step, the error under a load, and the bandwidth.

The servo moves a load of known inertia, without gravity. Friction is that of the motor and its
gear. The family's own `advance` is simulated, so the results include its limits.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import (
    ActuatorSetting,
    Drive,
    Inputs,
    PwmServo,
    Servo,
    parameters_type,
    resolve,
)
from codrl_mj.actuators.model import FamilyTuple

PositionServo = Servo | PwmServo
"""An actuator that takes positions."""
STEP = 0.5
"""Size of the step [rad]."""
AMPLITUDE = 0.1
"""Amplitude of the sines [rad]."""
FREQUENCIES = np.geomspace(1.0, 32.0, 11)
"""Frequencies of the sines [Hz]."""
_CYCLES = 2
"""Fewest cycles of a sine before the measurement, and during it."""
_SETTLING, _MEASURED = 0.6, 0.25
"""Shortest times [s] before the measurement, and of it."""


class ServoTrace(NamedTuple):
    """Motion of a servo over time, each of shape (n,)."""

    time: np.ndarray
    """Time [s]."""
    position: np.ndarray
    """Position [rad] at the output."""
    current: np.ndarray
    """Mean current [A] over a step of the simulation."""
    voltage: np.ndarray
    """Mean voltage [V] at the motor over a step of the simulation."""


class ServoResponse(NamedTuple):
    """Responses of a servo with a load."""

    inertia: float
    """Inertia [kg*m^2] of the load at the output, without the rotor's."""
    step: ServoTrace
    """Response to a step of `STEP`."""
    rise_time: float
    """Time [s] from 10 % to 90 % of the step; NaN if it is not reached."""
    settling_time: float
    """Time [s] after which the position stays within 2 % of its final value."""
    overshoot: float
    """Overshoot over the final value, as a share of the step."""
    final_error: float
    """Error [rad] that remains after the step."""
    stiffness: float
    """Torque [N*m] for a steady error of 1 rad, without friction; infinite with an integral."""
    max_torque: float
    """Torque [N*m] of the motor at standstill at its limit, without friction."""
    gains: np.ndarray
    """Amplitude of the position over that of the command at `FREQUENCIES`."""
    phases: np.ndarray
    """Phase [rad] of the position at `FREQUENCIES`."""
    bandwidth: float
    """Frequency [Hz] at which the amplitude falls below 1/sqrt(2); NaN if above the last one."""


def find_servo(name: ActuatorSetting, drive: Drive) -> PositionServo | None:
    """Return the servo with a name of `find_drive`, with a drive's motor and supply.

    None if the name is that of another actuator.
    """
    base = resolve(name, None, "a motor on its own")
    if isinstance(base, Servo):
        return dataclasses.replace(
            base, motor=drive.motor, controller=drive.controller, supply=drive.supply
        )
    if isinstance(base, PwmServo):
        return dataclasses.replace(base, motor=drive.motor, supply=drive.supply)
    return None


def default_inertia(servo: PositionServo) -> float:
    """Return the inertia [kg*m^2] of no load.

    It is 0, unless the rotor's is unknown: then it is the inertia that the stall torque brings near
    the no-load speed in 50 ms.
    """
    return 0.0 if servo.additions.armature > 0.0 else 0.05 * servo.back_emf_damping


def analyze_servo(servo: PositionServo, inertia: float | None = None) -> ServoResponse:
    """Return the responses of a position servo.

    Args:
        servo: the servo; a `Servo` must control positions.
        inertia: inertia of the load [kg*m^2] at the output; None: `default_inertia`.

    Raises:
        ValueError: the servo controls a speed, or nothing has an inertia.
    """
    if isinstance(servo, Servo) and servo.loop.controls != "position":
        raise ValueError("loop.controls = 'velocity': must be 'position', to follow a position")
    load = default_inertia(servo) if inertia is None else inertia
    if not load + servo.additions.armature > 0.0:
        raise ValueError(f"inertia = {load:g}: must be > 0 if the rotor's is unknown")
    bench = _Bench(servo, load)
    step = bench.run(np.full(round(1.5 / bench.timestep), STEP))
    final = float(step.position[-1])
    outside = np.flatnonzero(np.abs(step.position - final) > 0.02 * STEP)
    rise = [np.flatnonzero(step.position >= share * final) for share in (0.1, 0.9)]
    answers = [bench.sine(float(frequency)) for frequency in FREQUENCIES]
    gains = np.abs(answers)
    below = np.flatnonzero(gains < math.sqrt(0.5))
    return ServoResponse(
        load,
        step,
        float(step.time[rise[1][0]] - step.time[rise[0][0]]) if final > 0.0 else math.nan,
        float(step.time[outside[-1] + 1]) if len(outside) and final > 0.0 else math.nan,
        max(float(step.position.max()) - final, 0.0) / STEP,
        STEP - final,
        _stiffness(servo),
        _max_torque(servo),
        gains,
        np.unwrap(np.angle(answers)),
        _crossing(gains, int(below[0])) if len(below) else math.nan,
    )


def _stiffness(servo: PositionServo) -> float:
    if isinstance(servo, PwmServo):
        return math.inf if servo.loop.integral_gain else servo.stiffness
    gain = servo.loop.position_gain * servo.loop.velocity_gain
    return math.inf if servo.loop.velocity_integral_gain else gain


def _max_torque(servo: PositionServo) -> float:
    """Return the torque [N*m] at standstill at the limit of voltage and current."""
    motor, resistance = servo.motor, servo.supply_resistance
    duty = servo.loop.max_duty if isinstance(servo, PwmServo) else 1.0
    current = duty * servo.voltage_limit / (motor.resistance + duty * duty * resistance)
    if isinstance(servo, Servo):
        current = min(current, servo.controller.max_current)
    torque = current * motor.torque_constant / servo.arm_radius
    return min(torque, servo.loop.max_torque) if isinstance(servo, Servo) else torque


def max_lifted_load(servo: PositionServo, response: ServoResponse) -> float:
    """Return the largest load [N*m] that a servo lifts at standstill, against friction and gear.

    It is NaN if the servo has the part `friction`, which depends on the load.
    """
    if servo.friction is not None:
        return math.nan
    moved = response.max_torque * servo.motor.gear_efficiency - servo.additions.friction
    return max(moved, 0.0)


def _crossing(gains: np.ndarray, index: int) -> float:
    """Return the frequency [Hz] before an index at which a gain falls below 1/sqrt(2)."""
    if index == 0:
        return float(FREQUENCIES[0])
    logs = np.log([gains[index - 1], gains[index]])
    share = (logs[0] - math.log(math.sqrt(0.5))) / (logs[0] - logs[1])
    low, high = np.log(FREQUENCIES[index - 1 : index + 1])
    return float(math.exp(low + share * (high - low)))


class _Bench:
    """A servo that moves an inertia."""

    def __init__(self, servo: PositionServo, inertia: float) -> None:
        rate = servo.loop.servo_rate
        self.servo, self.additions = servo, servo.additions
        self.timestep = 1.0 / (rate * max(math.ceil(1000.0 / rate), 1))
        self.inertia = inertia + self.additions.armature

    def run(self, commands: np.ndarray) -> ServoTrace:
        """Return the motion from rest under a command [rad] for each step."""
        servo, h, arm = self.servo, self.timestep, self.servo.arm_radius
        parameters = parameters_type(type(servo))(*servo.parameter_values)
        # The states of the two families have different fields.
        state: FamilyTuple = type(servo).State._make([0.0] * len(type(servo).State._fields))
        position = speed = 0.0
        rows = np.empty((len(commands), 3))
        for index, command in enumerate(commands.tolist()):
            inputs = Inputs(
                command / arm,
                position / arm,
                speed / arm,
                index * h,
                0.0,
                self.inertia * arm * arm,
            )
            state, torque, signals = type(servo).advance(parameters, h, state, inputs)
            rows[index] = position, signals.current, signals.voltage
            push = torque / arm - self.additions.damping * speed
            speed += h * push / self.inertia
            # Coulomb friction takes at most what stops the shaft.
            stopping = min(h * self.additions.friction / self.inertia, abs(speed))
            speed -= math.copysign(stopping, speed)
            position += h * speed
        return ServoTrace(h * np.arange(len(commands)), *rows.T)

    def sine(self, frequency: float) -> complex:
        """Return amplitude and phase of the position over those of a sine of `AMPLITUDE`."""
        before, during = (
            max(_CYCLES, math.ceil(frequency * duration)) for duration in (_SETTLING, _MEASURED)
        )
        steps = round((before + during) / frequency / self.timestep)
        turn = 2.0 * math.pi * frequency * self.timestep * np.arange(steps)
        position = self.run(AMPLITUDE * np.sin(turn)).position
        measured = slice(steps - round(during / frequency / self.timestep), None)
        waves = np.stack(
            [np.sin(turn[measured]), np.cos(turn[measured]), np.ones(len(turn[measured]))], 1
        )
        real, imaginary, _ = np.linalg.lstsq(waves, position[measured], rcond=None)[0]
        return complex(real, imaginary) / AMPLITUDE
