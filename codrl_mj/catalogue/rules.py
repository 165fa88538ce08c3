"""Which number of a motor follows from which, and which have to agree.

The motor is V = R*I + kE*w with torque kT*I. The gear passes on `gear_efficiency` of it, and friction takes its part
behind the gear, where the simulation has it: at no load it is gear_efficiency*kT*I0. Source of the relations: maxon's
*Key information on maxon DC and EC motors*; they are those of any text on DC motors.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

NAME = r"[a-z]\w+"
"""A quantity in a formula."""


class Rule(NamedTuple):
    """How one quantity follows from others: the names in the formula, in their order, are the function's arguments."""

    quantity: str
    needs: tuple[str, ...]
    formula: str
    function: Callable[..., float]


def _rule(quantity: str, formula: str) -> Rule:
    needs = tuple(dict.fromkeys(re.findall(NAME, formula)))
    return Rule(quantity, needs, formula, eval(f"lambda {', '.join(needs)}: {formula}"))


# Torques at the output, past a gear's losses, have names of their own. The first rule whose needs are known is taken.
RULES = (
    _rule("resistance", "nominal_voltage / stall_current"),
    _rule("resistance", "mechanical_time_constant * torque_constant * back_emf_constant / rotor_inertia"),
    _rule(
        "resistance",
        "nominal_voltage * (no_load_speed - continuous_speed) "
        "/ (continuous_current * no_load_speed - no_load_current * continuous_speed)",
    ),
    _rule("stall_current", "nominal_voltage / resistance"),
    _rule("back_emf_constant", "1 / speed_constant"),
    _rule("back_emf_constant", "(nominal_voltage - resistance * no_load_current) / no_load_speed"),
    _rule("torque_constant", "stall_torque / (stall_current - no_load_current)"),
    _rule("torque_constant", "continuous_torque / (continuous_current - no_load_current)"),
    _rule(
        "torque_constant", "stall_torque_at_output / (gear_ratio * gear_efficiency * (stall_current - no_load_current))"
    ),
    _rule("torque_constant", "back_emf_constant"),
    _rule("back_emf_constant", "torque_constant"),
    _rule("back_emf_constant", "(nominal_voltage - resistance * continuous_current) / continuous_speed"),
    _rule(
        "gear_efficiency", "stall_torque_at_output / (gear_ratio * torque_constant * (stall_current - no_load_current))"
    ),
    _rule(
        "gear_efficiency",
        "continuous_torque_at_output / (gear_ratio * torque_constant * (continuous_current - no_load_current))",
    ),
    _rule("rotor_inertia", "mechanical_time_constant * torque_constant * back_emf_constant / resistance"),
    _rule("inductance", "electrical_time_constant * resistance"),
    _rule("continuous_current", "continuous_torque / torque_constant + no_load_current"),
    _rule(
        "continuous_current",
        "continuous_torque_at_output / (gear_ratio * gear_efficiency * torque_constant) + no_load_current",
    ),
    _rule("thermal_resistance", "thermal_resistance_winding + thermal_resistance_housing"),
)
_LOAD = "the shaft's torque is kT*(I - I0) here, many makers print kT*I; iron saturates at stall; warm motors give less"
_SPEED = "iron losses and brushes are not in the model; many print a warm motor's speed, or a limit of the drive"
CHECKS = (
    # what a printed quantity should be, by the numbers that were found, and what to make of a difference
    (
        _rule("torque_constant", "back_emf_constant"),
        "equal in SI for an ideal motor. A smaller torque constant is lost in iron, or saturates at stall; a larger "
        "one would make energy: distrust the stall torque, or the conventions of current and voltage",
    ),
    (
        _rule("speed_constant", "1 / back_emf_constant"),
        "two ways to print one number; rounding, or the one includes losses",
    ),
    (
        _rule("stall_current", "nominal_voltage / resistance"),
        "rounding, or the resistance is without brushes and leads, or the stall current was measured on a warm motor",
    ),
    (_rule("stall_torque", "torque_constant * (stall_current - no_load_current)"), _LOAD),
    (
        _rule(
            "stall_torque_at_output",
            "gear_ratio * gear_efficiency * torque_constant * (stall_current - no_load_current)",
        ),
        _LOAD,
    ),
    (_rule("continuous_torque", "torque_constant * (continuous_current - no_load_current)"), _LOAD),
    (
        _rule(
            "continuous_torque_at_output",
            "gear_ratio * gear_efficiency * torque_constant * (continuous_current - no_load_current)",
        ),
        _LOAD,
    ),
    (_rule("no_load_speed", "(nominal_voltage - resistance * no_load_current) / back_emf_constant"), _SPEED),
    (_rule("continuous_speed", "(nominal_voltage - resistance * continuous_current) / back_emf_constant"), _SPEED),
    (
        _rule("mechanical_time_constant", "resistance * rotor_inertia / (torque_constant * back_emf_constant)"),
        "rounding; some print it with a gear's or an encoder's inertia",
    ),
    (
        _rule("electrical_time_constant", "inductance / resistance"),
        "rounding; inductance depends on the frequency it is measured at",
    ),
    (
        _rule(
            "no_load_current",
            "(coulomb_friction + viscous_friction * no_load_speed) / (gear_efficiency * torque_constant)",
        ),
        "friction varies with temperature and from motor to motor",
    ),
    (
        _rule("thermal_resistance", "thermal_resistance_winding + thermal_resistance_housing"),
        "the housing's depends on what it is mounted on",
    ),
)
