"""Parameters that can be identified, with units and bounds.

Parameters of a motor have the names of `GearMotor`'s fields, and are values at the rotor.
"""

from collections.abc import Mapping
from typing import NamedTuple


class Parameter(NamedTuple):
    """A parameter that a log may determine."""

    unit: str
    lower: float
    upper: float
    description: str
    default: float | None = None  # value if neither fitted nor known; None: no default


PARAMETERS = {
    "resistance": Parameter("ohm", 1e-4, 1e5, "terminal resistance"),
    "inductance": Parameter("H", 1e-8, 1e2, "terminal inductance"),
    "back_emf_constant": Parameter("V*s/rad", 1e-6, 1e3, "back-EMF constant at the rotor"),
    "torque_constant": Parameter("N*m/A", 1e-6, 1e3, "torque constant at the rotor"),
    "torque_gain": Parameter("", 1e-2, 1e2, "true torque over the logged torque", 1.0),
    "inertia": Parameter("kg*m^2", 1e-9, 1e4, "total moving inertia, at the output"),
    "mgl": Parameter("N*m", 0.0, 1e4, "largest gravity torque, m*g*l, at the output", 0.0),
    "constant_torque": Parameter(
        "N*m", -1e4, 1e4, "constant load torque that opposes positive speeds, at the output", 0.0
    ),
    "coulomb_friction": Parameter("N*m", 0.0, 1e3, "Coulomb friction at the rotor"),
    "viscous_friction": Parameter("N*m*s/rad", 0.0, 1e3, "viscous friction at the rotor"),
    "friction_torque": Parameter(
        "N*m", 0.0, 1e3, "total friction torque at the RMS speed of the logs, at the rotor"
    ),
    "gear_efficiency": Parameter("", 0.3, 1.0, "share of the torque that the gear passes on", 1.0),
    "stribeck_friction": Parameter(
        "N*m", 0.0, 1e3, "additional static friction above Coulomb friction, at the rotor", 0.0
    ),
    "stribeck_speed": Parameter(
        "rad/s", 1e-3, 1e4, "rotor speed at which 1/e of the Stribeck friction is left", 1.0
    ),
    "rotor_inertia": Parameter("kg*m^2", 0.0, 1e3, "inertia of the rotor"),
    "load_inertia": Parameter("kg*m^2", 0.0, 1e4, "inertia at the output without the motor's"),
    "gear_ratio": Parameter("", 1e-3, 1e5, "turns of the rotor per turn of the output", 1.0),
    # Parameters of a position servo, see `codrl_mj.identify.servo`.
    "position_gain": Parameter("N*m/rad", 1e-6, 1e7, "torque per angle error, at the output"),
    "damping": Parameter(
        "N*m*s/rad", 0.0, 1e4, "loss of torque per speed: viscous, by back-EMF and derivative gain"
    ),
    "armature": Parameter("kg*m^2", 0.0, 1e3, "inertia of the servo, at the output"),
    "stall_torque": Parameter("N*m", 1e-6, 1e6, "largest torque at standstill, at the output"),
    "duty_gain": Parameter("1/rad", 1e-6, 1e6, "duty per angle error"),
    # A command that is logged after it was sent has a negative delay.
    "command_delay": Parameter("s", -0.1, 0.5, "time from the logged command to the torque"),
    "zero": Parameter("rad", -3.2, 3.2, "position at which the pendulum hangs", 0.0),
    "max_velocity": Parameter("rad/s", 1e-3, 1e4, "largest speed of the target", 1e4),
    "no_load_speed": Parameter("rad/s", 1e-6, 1e6, "speed of the servo without a load"),
    # Without a known load, only these ratios to the moving inertia can be told.
    "position_gain_per_inertia": Parameter("1/s^2", 1e-6, 1e12, "position gain over inertia"),
    "stall_torque_per_inertia": Parameter("rad/s^2", 1e-6, 1e12, "stall torque over inertia"),
    "damping_per_inertia": Parameter("1/s", 0.0, 1e9, "damping over inertia"),
    "coulomb_friction_per_inertia": Parameter("rad/s^2", 0.0, 1e9, "Coulomb friction over inertia"),
    "stribeck_friction_per_inertia": Parameter(
        "rad/s^2", 0.0, 1e9, "additional static friction over inertia"
    ),
    "friction_torque_per_inertia": Parameter("rad/s^2", 0.0, 1e9, "total friction over inertia"),
    "mgl_per_inertia": Parameter("1/s^2", 0.0, 1e9, "largest gravity torque over inertia"),
}
"""All parameters. Each can be known in advance, except `friction_torque`, which is derived."""
SERVO_PARAMETERS = (
    *("position_gain", "stall_torque", "duty_gain", "command_delay", "max_velocity"),
    *("damping", "armature", "zero", "no_load_speed"),
)
"""Parameters that only a position servo has."""
PER_INERTIA = tuple(name for name in PARAMETERS if name.endswith("_per_inertia"))
"""Parameters of a servo over its moving inertia."""
ELECTRICAL = ("resistance", "inductance", "back_emf_constant")
FRICTION = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "gear_efficiency",
    "friction_torque",
    "damping",
)
"""Friction parameters, whose true value may be 0, or 1 for `gear_efficiency`.

Their intervals are judged relative to the total friction, because a relative error is meaningless
for a value near 0.
"""
MIN_SIZES = {"command_delay": 0.01, "zero": 0.1}
"""Parameter -> smallest size that relative half-widths refer to.

The true value may be 0, and smaller errors hardly change a motion.
"""
MOTOR_PARAMETERS = (
    *(
        "resistance",
        "inductance",
        "torque_constant",
        "back_emf_constant",
        "rotor_inertia",
        "gear_ratio",
    ),
    *(
        "gear_efficiency",
        "coulomb_friction",
        "viscous_friction",
        "stribeck_friction",
        "stribeck_speed",
    ),
)
"""Fields of `GearMotor` that are identified or known."""
LOSS_PARAMETERS = ("gear_efficiency", "stribeck_friction", "stribeck_speed", "stribeck_exponent")
"""Fields of `GearMotor` that the base drive supplies if they are neither fitted nor known."""
WINDING_SOURCES = {
    "current": ("torque_constant", "back_emf_constant"),
    "voltage": ("resistance", "resistance"),
}
"""Input of a shaft -> the shaft's parameter, and the parameter of the winding that it equals."""
FRICTION_PARAMETERS: dict[str, tuple[str, ...]] = {
    "coulomb": ("coulomb_friction", "viscous_friction"),
    "stribeck": ("coulomb_friction", "viscous_friction", "stribeck_friction", "stribeck_speed"),
    "load": ("coulomb_friction", "viscous_friction", "gear_efficiency"),
    "both": (
        "coulomb_friction",
        "viscous_friction",
        "stribeck_friction",
        "stribeck_speed",
        "gear_efficiency",
    ),
}
"""Friction model -> its free parameters."""
RIG_PARAMETERS: dict[str, tuple[str, ...]] = {
    "pendulum": ("inertia", "mgl"),
    "free": ("inertia",),
    "load": ("inertia", "constant_torque"),
}
"""Rig, which is the kind of load at the output -> its free parameters."""
DEFAULTS = {
    name: parameter.default
    for name, parameter in PARAMETERS.items()
    if parameter.default is not None
}
"""Values of parameters that are neither fitted nor known."""
ESTIMABLE = {
    **dict.fromkeys(
        [
            *RIG_PARAMETERS["pendulum"],
            *RIG_PARAMETERS["load"],
            *FRICTION_PARAMETERS["both"],
            "torque_constant",
        ]
    ),
    "torque_gain": "torque",
    "back_emf_constant": "voltage",
    "resistance": "voltage",
}
"""Optional free parameter of a shaft -> the input that it requires; None: any input."""


class WindingParameters(NamedTuple):
    """Resistance, inductance and back-EMF constant of a winding."""

    resistance: float  # [ohm]
    inductance: float  # [H]
    back_emf_constant: float  # [V*s/rad], at the motor's output


class ShaftParameters(NamedTuple):
    """Inertia, load and friction of a shaft, at the motor's output."""

    inertia: float  # [kg*m^2], > 0
    gravity: float  # m*g*l [N*m]; the torque of gravity is -m*g*l*sin(position)
    constant_torque: float  # constant load torque [N*m], positive if it opposes positive speeds
    coulomb: float  # [N*m]
    viscous: float  # [N*m*s/rad]
    gear_efficiency: float  # in (0, 1]
    stribeck_friction: float  # [N*m]
    stribeck_speed: float  # [rad/s]
    stribeck_exponent: float  # `GearMotor.stribeck_exponent`
    # `shaft.friction` reads this field, but ignores it when it is called with an inertia.
    rotor_inertia: float
    gain: float  # torque over the input [N*m per unit]
    # Loss of torque per speed [N*m*s/rad]: kT*kE/R if the input is a voltage, else 0.
    braking: float


def shaft_parameters(
    parameters: Mapping[str, float], gain: float, braking: float = 0.0
) -> ShaftParameters:
    """Convert parameters, named as in `PARAMETERS`, from values at the rotor to the output."""
    ratio = parameters["gear_ratio"]
    return ShaftParameters(
        parameters["inertia"],
        parameters["mgl"],
        parameters["constant_torque"],
        parameters["coulomb_friction"] * ratio,
        parameters["viscous_friction"] * ratio**2,
        parameters["gear_efficiency"],
        parameters["stribeck_friction"] * ratio,
        parameters["stribeck_speed"] / ratio,
        parameters.get("stribeck_exponent", 2.0),
        0.0,
        gain,
        braking,
    )
