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


def _rule(quantity: str, formula: str, function: Callable[..., float]) -> Rule:
    needs = tuple(dict.fromkeys(re.findall(NAME, formula)))
    return Rule(quantity, needs, formula, function)


# Torques at the output, past a gear's losses, have names of their own. The first rule whose needs are known is taken.
RULES = (
    _rule("resistance", "nominal_voltage / stall_current", lambda v, i: v / i),
    _rule(
        "resistance",
        "mechanical_time_constant * torque_constant * back_emf_constant / rotor_inertia",
        lambda tau, kt, ke, j: tau * kt * ke / j,
    ),
    _rule(
        "resistance",
        "nominal_voltage * (no_load_speed - continuous_speed) "
        "/ (continuous_current * no_load_speed - no_load_current * continuous_speed)",
        lambda v, w0, w, i, i0: v * (w0 - w) / (i * w0 - i0 * w),
    ),
    _rule("stall_current", "nominal_voltage / resistance", lambda v, r: v / r),
    _rule("back_emf_constant", "1 / speed_constant", lambda kv: 1.0 / kv),
    _rule(
        "back_emf_constant",
        "(nominal_voltage - resistance * no_load_current) / no_load_speed",
        lambda v, r, i0, w0: (v - r * i0) / w0,
    ),
    _rule("torque_constant", "stall_torque / (stall_current - no_load_current)", lambda t, i, i0: t / (i - i0)),
    _rule(
        "torque_constant", "continuous_torque / (continuous_current - no_load_current)", lambda t, i, i0: t / (i - i0)
    ),
    _rule(
        "torque_constant",
        "stall_torque_at_output / (gear_ratio * gear_efficiency * (stall_current - no_load_current))",
        lambda t, n, eta, i, i0: t / (n * eta * (i - i0)),
    ),
    _rule("torque_constant", "back_emf_constant", lambda ke: ke),
    _rule("back_emf_constant", "torque_constant", lambda kt: kt),
    _rule(
        "back_emf_constant",
        "(nominal_voltage - resistance * continuous_current) / continuous_speed",
        lambda v, r, i, w: (v - r * i) / w,
    ),
    _rule(
        "gear_efficiency",
        "stall_torque_at_output / (gear_ratio * torque_constant * (stall_current - no_load_current))",
        lambda t, n, kt, i, i0: t / (n * kt * (i - i0)),
    ),
    _rule(
        "gear_efficiency",
        "continuous_torque_at_output / (gear_ratio * torque_constant * (continuous_current - no_load_current))",
        lambda t, n, kt, i, i0: t / (n * kt * (i - i0)),
    ),
    _rule(
        "rotor_inertia",
        "mechanical_time_constant * torque_constant * back_emf_constant / resistance",
        lambda tau, kt, ke, r: tau * kt * ke / r,
    ),
    _rule("inductance", "electrical_time_constant * resistance", lambda tau, r: tau * r),
    _rule("continuous_current", "continuous_torque / torque_constant + no_load_current", lambda t, kt, i0: t / kt + i0),
    _rule(
        "continuous_current",
        "continuous_torque_at_output / (gear_ratio * gear_efficiency * torque_constant) + no_load_current",
        lambda t, n, eta, kt, i0: t / (n * eta * kt) + i0,
    ),
    _rule("thermal_resistance", "thermal_resistance_winding + thermal_resistance_housing", lambda w, h: w + h),
)
_LOAD = "the shaft's torque is kT*(I - I0) here, many makers print kT*I; iron saturates at stall; warm motors give less"
_SPEED = "iron losses and brushes are not in the model; many print a warm motor's speed, or a limit of the drive"
CHECKS = (
    # what a printed quantity should be, by the numbers that were found, and what to make of a difference
    (
        _rule("torque_constant", "back_emf_constant", lambda ke: ke),
        "equal in SI for an ideal motor. A smaller torque constant is lost in iron, or saturates at stall; a larger "
        "one would make energy: distrust the stall torque, or the conventions of current and voltage",
    ),
    (
        _rule("speed_constant", "1 / back_emf_constant", lambda ke: 1.0 / ke),
        "two ways to print one number; rounding, or the one includes losses",
    ),
    (
        _rule("stall_current", "nominal_voltage / resistance", lambda v, r: v / r),
        "rounding, or the resistance is without brushes and leads, or the stall current was measured on a warm motor",
    ),
    (
        _rule("stall_torque", "torque_constant * (stall_current - no_load_current)", lambda kt, i, i0: kt * (i - i0)),
        _LOAD,
    ),
    (
        _rule(
            "stall_torque_at_output",
            "gear_ratio * gear_efficiency * torque_constant * (stall_current - no_load_current)",
            lambda n, eta, kt, i, i0: n * eta * kt * (i - i0),
        ),
        _LOAD,
    ),
    (
        _rule(
            "continuous_torque",
            "torque_constant * (continuous_current - no_load_current)",
            lambda kt, i, i0: kt * (i - i0),
        ),
        _LOAD,
    ),
    (
        _rule(
            "continuous_torque_at_output",
            "gear_ratio * gear_efficiency * torque_constant * (continuous_current - no_load_current)",
            lambda n, eta, kt, i, i0: n * eta * kt * (i - i0),
        ),
        _LOAD,
    ),
    (
        _rule(
            "no_load_speed",
            "(nominal_voltage - resistance * no_load_current) / back_emf_constant",
            lambda v, r, i0, ke: (v - r * i0) / ke,
        ),
        _SPEED,
    ),
    (
        _rule(
            "continuous_speed",
            "(nominal_voltage - resistance * continuous_current) / back_emf_constant",
            lambda v, r, i, ke: (v - r * i) / ke,
        ),
        _SPEED,
    ),
    (
        _rule(
            "mechanical_time_constant",
            "resistance * rotor_inertia / (torque_constant * back_emf_constant)",
            lambda r, j, kt, ke: r * j / (kt * ke),
        ),
        "rounding; some print it with a gear's or an encoder's inertia",
    ),
    (
        _rule("electrical_time_constant", "inductance / resistance", lambda inductance, r: inductance / r),
        "rounding; inductance depends on the frequency it is measured at",
    ),
    (
        _rule(
            "no_load_current",
            "(coulomb_friction + viscous_friction * no_load_speed) / (gear_efficiency * torque_constant)",
            lambda c, b, w0, eta, kt: (c + b * w0) / (eta * kt),
        ),
        "friction varies with temperature and from motor to motor",
    ),
    (
        _rule("thermal_resistance", "thermal_resistance_winding + thermal_resistance_housing", lambda w, h: w + h),
        "the housing's depends on what it is mounted on",
    ),
)
