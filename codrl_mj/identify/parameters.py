"""What can be identified: names, units, bounds. Those of a motor are called as `GearMotor`'s fields, at its rotor."""

from typing import NamedTuple


class Parameter(NamedTuple):
    """A number that a log may tell."""

    unit: str
    lower: float
    upper: float
    description: str
    default: float | None = None  # where it is neither fitted nor known; None: it has to be either


PARAMETERS = {
    "resistance": Parameter("ohm", 1e-4, 1e5, "terminal resistance"),
    "inductance": Parameter("H", 1e-8, 1e2, "terminal inductance"),
    "back_emf_constant": Parameter("V*s/rad", 1e-6, 1e3, "back-EMF constant at the rotor"),
    "torque_constant": Parameter("N*m/A", 1e-6, 1e3, "torque constant at the rotor"),
    "torque_gain": Parameter(
        "", 1e-2, 1e2, "true torque for one of the torque that was logged", 1.0
    ),
    "inertia": Parameter("kg*m^2", 1e-9, 1e4, "inertia of all that moves, at the output"),
    "mgl": Parameter("N*m", 0.0, 1e4, "largest torque of gravity, at the output", 0.0),
    "constant_torque": Parameter(
        "N*m", -1e4, 1e4, "held load against positive speeds, at the output", 0.0
    ),
    "coulomb_friction": Parameter("N*m", 0.0, 1e3, "Coulomb friction at the rotor"),
    "viscous_friction": Parameter("N*m*s/rad", 0.0, 1e3, "viscous friction at the rotor"),
    "friction_torque": Parameter(
        "N*m", 0.0, 1e3, "what all friction takes at the speed of the logs, at the rotor"
    ),
    "gear_efficiency": Parameter("", 0.3, 1.0, "share of the torque that the gear passes on", 1.0),
    "stribeck_friction": Parameter(
        "N*m", 0.0, 1e3, "what standstill adds to Coulomb friction, at the rotor", 0.0
    ),
    "stribeck_speed": Parameter(
        "rad/s", 1e-3, 1e4, "rotor speed at which 1/e of that is left", 1.0
    ),
    "rotor_inertia": Parameter("kg*m^2", 0.0, 1e3, "inertia of the rotor"),
    "load_inertia": Parameter(
        "kg*m^2", 0.0, 1e4, "inertia of what the output moves besides the motor"
    ),
    "gear_ratio": Parameter("", 1e-3, 1e5, "turns of the rotor for one of the output", 1.0),
}
"""Everything that can be identified; all but `friction_torque`, which is a sum, can be given as known."""
ELECTRICAL = ("resistance", "inductance", "back_emf_constant")
FRICTION = (
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "gear_efficiency",
    "friction_torque",
)
"""What may well be nothing at all (an efficiency: 1): judged by how much of the torque it takes."""
OF_MOTOR = (
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
OF_LOSS = ("gear_efficiency", "stribeck_friction", "stribeck_speed", "stribeck_exponent")
"""Fields of `GearMotor` that the simulation of a shaft has from a base where they are neither fitted nor known."""
OF_WINDING = {
    "current": ("torque_constant", "back_emf_constant"),
    "voltage": ("resistance", "resistance"),
}
"""Signal that drives a shaft -> parameter taken from the winding, and its name there."""
OF_FRICTION: dict[str, tuple[str, ...]] = {
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
OF_RIG: dict[str, tuple[str, ...]] = {
    "pendulum": ("inertia", "mgl"),
    "free": ("inertia",),
    "load": ("inertia", "constant_torque"),
}
DEFAULTS = {name: one.default for name, one in PARAMETERS.items() if one.default is not None}
"""What is taken for parameters that are neither fitted nor known."""
ESTIMABLE = {
    **dict.fromkeys(
        [*OF_RIG["pendulum"], *OF_RIG["load"], *OF_FRICTION["both"], "torque_constant"]
    ),
    "torque_gain": "torque",
    "back_emf_constant": "voltage",
    "resistance": "voltage",
}
"""What a shaft can tell -> the only input under which it does; None: any."""
