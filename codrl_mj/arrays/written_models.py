"""Models of motors that other simulators know, with the numbers of our motors.

A torque-speed line has the joint's torques and speeds. A winding has those of the motor's shaft,
no inductance and one motor constant, which replaces torque constant and back-EMF constant.
"""

import math
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from codrl_mj.actuators import (
    ActuatorModel,
    Drive,
    GearMotor,
    JointAdditions,
    ServoFriction,
    TorqueSpeed,
)
from codrl_mj.actuators.bam import bam_friction
from codrl_mj.actuators.shaft import RATED_TEMPERATURE, resistance_at


class WrittenWinding(NamedTuple):
    """Winding and gear of a motor whose command is a voltage."""

    gear: float
    """Turns of the shaft per turn of the joint, or per meter of a slide."""
    constant: float
    """Torque constant [N*m/A], and back-EMF constant [V*s/rad]."""
    resistance: float
    """Resistance [ohm] with which a voltage gives the torque of our motor."""
    time_constant: float
    """Ratio [s] of inductance and resistance."""
    voltage: float
    """Largest voltage [V]."""
    max_torque: float
    """Largest torque [N*m] of the shaft, from the drive's current limit."""

    @property
    def max_force(self) -> float:
        """Largest torque [N*m], or force [N], of the joint from the drive's current limit."""
        return self.max_torque * self.gear

    @property
    def max_current(self) -> float:
        """Largest current [A] of this winding, which has the torque of the drive's limit."""
        return self.max_torque / self.constant

    @property
    def volts_per_force(self) -> float:
        """Voltage [V] for a torque of 1 N*m, or a force of 1 N, at the standing joint."""
        return self.resistance / (self.constant * self.gear)

    @property
    def volts_per_speed(self) -> float:
        """Voltage [V] that balances the back-EMF at a joint's speed of 1 rad/s, or 1 m/s."""
        return self.constant * self.gear


def torque_speed_line(actuator: ActuatorModel) -> TorqueSpeed:
    """Return the torque-speed line of a motor at its joint, without the friction of the joint.

    Raises:
        ValueError: a number that the line needs is missing.
    """
    if isinstance(actuator, TorqueSpeed):
        return actuator
    drive = _complete(actuator, "a torque-speed line")
    motor, voltage = drive.motor, full_voltage(drive)
    stall_current = voltage / total_resistance(drive)
    force_per_current = motor.torque_constant * motor.gear_efficiency / drive.arm_radius
    return TorqueSpeed(
        stall_torque=force_per_current * stall_current,
        no_load_speed=voltage / motor.back_emf_constant * drive.arm_radius,
        max_torque=force_per_current * min(stall_current, drive.controller.max_current),
    )


def winding_of(actuator: ActuatorModel, target: str) -> WrittenWinding:
    """Return the winding of a motor for a simulator that has one motor constant.

    With the back-EMF constant kE as this constant and the resistance R*kE/kT, a voltage gives the
    torque of the motor at every speed. The current is then kT/kE of the motor's.

    Raises:
        ValueError: a number that the winding needs is missing.
    """
    if isinstance(actuator, TorqueSpeed):
        if target == "bam":
            raise ValueError(
                "TorqueSpeed has no torque_constant and no resistance, which bam needs; pass a"
                " Drive, or write mjlab, isaaclab, newton or dcmotor"
            )
        # A supply of 1 V makes the control the share of the full voltage.
        constant = 1.0 / actuator.no_load_speed
        resistance = constant / actuator.stall_torque
        return WrittenWinding(1.0, constant, resistance, 0.0, 1.0, actuator.max_torque)
    drive = _complete(actuator, target)
    motor, resistance = drive.motor, total_resistance(drive)
    constants = motor.back_emf_constant / motor.torque_constant
    return WrittenWinding(
        1.0 / drive.arm_radius,
        motor.back_emf_constant,
        resistance * constants,
        motor.inductance / resistance,
        full_voltage(drive),
        motor.torque_constant * drive.controller.max_current,
    )


def winding_torque(winding: WrittenWinding, desired: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the steady torque [N*m] at the joint for a desired torque and a speed of the joint."""
    back_emf = winding.volts_per_speed * speed
    volts = np.clip(winding.volts_per_force * desired + back_emf, -winding.voltage, winding.voltage)
    torque = winding.constant * (volts - back_emf) / winding.resistance
    limited: np.ndarray = np.clip(torque, -winding.max_torque, winding.max_torque)
    return winding.gear * limited


def written_additions(actuator: ActuatorModel) -> JointAdditions:
    """Return what a joint gets in another simulator, with the constant friction in the torque."""
    additions, delivered = actuator.additions, actuator.delivered_friction
    return JointAdditions(
        additions.armature,
        additions.damping + delivered.damping,
        additions.friction + delivered.friction,
    )


def bam_parameters(drive: ActuatorModel) -> dict[str, str | float]:
    """Return BAM's parameters of a drive, at the joint.

    A model of BAM takes defaults for what the file omits, so every parameter is written. The
    models differ in their friction: `m1` is Coulomb's, `m2` adds Stribeck's, and `m5` losses that
    grow with the load. The part `friction` is written as the first of the six that has its numbers.
    """
    winding = winding_of(drive, "bam")
    motor, additions, gear = _motor_of(drive), drive.additions, winding.gear
    values: dict[str, str | float] = {
        "model": "m1",
        "actuator": "mx106",
        "kt": winding.constant * gear,
        "R": winding.resistance,
        "armature": additions.armature,
        "q_offset": 0.0,
        "friction_base": additions.friction,
        "friction_viscous": additions.damping,
    }
    friction = friction_of(drive)
    if friction is not None:
        return values | bam_friction(friction)
    if motor.stribeck_friction > 0.0 or motor.gear_efficiency < 1.0:
        values |= {
            "model": "m2",
            "friction_stribeck": motor.stribeck_friction * gear,
            "dtheta_stribeck": motor.stribeck_speed / gear,
            "alpha": motor.stribeck_exponent,
        }
    if motor.gear_efficiency < 1.0:
        values |= {
            "model": "m5",
            "load_friction_motor": 1.0 - motor.gear_efficiency,
            "load_friction_external": 0.0,
            "load_friction_motor_stribeck": 0.0,
            "load_friction_external_stribeck": 0.0,
        }
    return values


def bam_torque(drive: ActuatorModel, desired: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return BAM's steady torque at a moving joint, without the friction of the joint.

    If the motor has the part `friction`, the torque is that which drives a load at a held speed.
    """
    winding, motor = winding_of(drive, "bam"), _motor_of(drive)
    torque, servo_friction = bam_motor_torque(winding, desired, speed), friction_of(drive)
    if servo_friction is not None:
        return servo_friction.net_torque(torque, speed)
    friction = (1.0 - motor.gear_efficiency) * np.abs(torque) + winding.gear * motor.stribeck(
        winding.gear * speed
    )
    net: np.ndarray = torque - friction * np.sign(speed)
    return net


def bam_motor_torque(winding: WrittenWinding, desired: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return BAM's steady torque at the joint before friction."""
    back_emf, limit = winding.volts_per_speed * speed, winding.volts_per_force * winding.max_force
    # BAM limits the current before the voltage. As with our drives, a joint that turns fast enough
    # drives more than the largest current through the winding.
    volts = np.clip(winding.volts_per_force * desired, -limit, limit) + back_emf
    volts = np.clip(volts, -winding.voltage, winding.voltage)
    torque: np.ndarray = (volts - back_emf) / winding.volts_per_force
    return torque


def format_number(value: float) -> str:
    """Return a number with nine digits, as Python, XML and JSON read it."""
    return repr(float(f"{value:.9g}"))


def dcmotor_element(actuator: ActuatorModel, joint: str) -> str:
    """Return MuJoCo's `<dcmotor>` for a motor; its numbers are those of the motor's shaft."""
    winding = winding_of(actuator, "dcmotor")
    values: dict[str, list[float]] = {
        "gear": [winding.gear],
        "motorconst": [winding.constant],
        "resistance": [winding.resistance],
        "ctrlrange": [-winding.voltage, winding.voltage],
    }
    if winding.max_torque < math.inf:
        values["saturation"] = [winding.max_torque, 0.0, 0.0]
    if isinstance(actuator, Drive):
        # The time constant is given, because the resistance is not that of the winding.
        values["inductance"] = [0.0, winding.time_constant]
        values |= _thermal_values(actuator)
    attributes = " ".join(
        f'{name}="{" ".join(map(format_number, numbers))}"' for name, numbers in values.items()
    )
    return f"<dcmotor joint={quoteattr(joint)} {attributes}/>"


def _thermal_values(drive: Drive) -> dict[str, list[float]]:
    """Return the attribute `thermal` of a `<dcmotor>`; empty if the motor does not warm.

    MuJoCo has one thermal body. It gets the sum of the resistances [K/W], and the mean of the time
    constants [s] weighted by them, so that the final temperature and the area above the step
    response are those of winding and housing.
    """
    motor = drive.motor
    total = motor.thermal_resistance_winding + motor.thermal_resistance_housing
    if total == 0.0:
        return {}
    constant = (
        motor.thermal_resistance_winding * motor.thermal_time_constant_winding
        + motor.thermal_resistance_housing * motor.thermal_time_constant_housing
    ) / total
    ambient, coefficient = motor.ambient_temperature, motor.resistance_coefficient
    # MuJoCo's resistance refers to the temperature of our written one, which is the ambient.
    at_ambient = coefficient / (1.0 + coefficient * (ambient - RATED_TEMPERATURE))
    return {"thermal": [total, 0.0, constant, at_ambient, ambient, ambient]}


def total_resistance(drive: Drive) -> float:
    """Return the resistance [ohm] of the winding at ambient temperature, and of the supply."""
    return resistance_at(drive.motor, drive.motor.ambient_temperature) + drive.supply_resistance


def full_voltage(drive: Drive) -> float:
    """Return the largest voltage [V] at the winding's terminals, without a current."""
    return max(drive.voltage_limit - drive.controller.deadband, 0.0)


def friction_of(actuator: ActuatorModel) -> ServoFriction | None:
    """Return the part `friction` of a drive at its joint; None if it has none."""
    if not isinstance(actuator, Drive) or actuator.friction is None:
        return None
    # A pinion, drum or wheel turns torques of the output shaft into forces of a slide.
    return actuator.friction.at_arm(actuator.motor.arm_radius)


def _motor_of(actuator: ActuatorModel) -> GearMotor:
    assert isinstance(actuator, Drive)  # winding_of has refused the others
    return actuator.motor


def _complete(actuator: ActuatorModel, target: str) -> Drive:
    """Return the actuator as a drive.

    Raises:
        ValueError: it is no drive, or a number is missing.
    """
    if not isinstance(actuator, Drive):
        raise ValueError(f"actuator = {type(actuator).__name__}: {target} needs a Drive")
    if actuator.SHARES_SUPPLY:
        raise ValueError(
            f"actuator = {type(actuator).__name__}: {target} has no supply that motors share; use"
            " the family drive"
        )
    missing = {
        "motor.back_emf_constant = 0: the motor has no no-load speed": (
            actuator.motor.back_emf_constant == 0.0
        ),
        "supply.voltage = inf: the motor has no stall torque": math.isinf(actuator.voltage_limit),
        f"controller.deadband = {actuator.controller.deadband:g}: no voltage remains": (
            full_voltage(actuator) == 0.0
        ),
    }
    for text, is_missing in missing.items():
        if is_missing:
            raise ValueError(f"{text}, which {target} needs; set it, or write the motor as c")
    return actuator
