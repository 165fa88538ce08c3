"""Relations between the quantities of a datasheet: rules to derive them, checks of consistency.

The motor is V = R*I + kE*w with torque kT*I. The gear transmits the share `gear_efficiency` of this
torque. Friction is subtracted behind the gear, as in the simulation, so without load it equals
gear_efficiency*kT*I0. Source: maxon's *Key information on maxon DC and EC motors*; textbooks on DC
motors have the same relations.
"""

import functools
import re
from collections.abc import Mapping, Sequence
from types import CodeType
from typing import NamedTuple

from codrl_mj.catalogue.units import ParsedValue, QuantitySpec

NAME = r"[a-z]\w+"
"""Pattern of a quantity in a formula."""


@functools.cache
def compile_formula(formula: str) -> CodeType:
    """Return a compiled formula; its `co_names` are the names of the quantities in it."""
    return compile(formula, "a rule of the catalogue", "eval")


# Each rule is a quantity and a formula for it. `apply_rules` applies the first rule for a missing
# quantity whose formula can be evaluated, so the order of the rules is their priority. Torques at
# the output include the losses of the gear, and therefore have names of their own.
RULES = (
    ("resistance", "nominal_voltage / stall_current"),
    (
        "resistance",
        "mechanical_time_constant * torque_constant * back_emf_constant / rotor_inertia",
    ),
    (
        "resistance",
        (
            "nominal_voltage * (no_load_speed - continuous_speed) "
            "/ (continuous_current * no_load_speed - no_load_current * continuous_speed)"
        ),
    ),
    ("stall_current", "nominal_voltage / resistance"),
    ("back_emf_constant", "1 / speed_constant"),
    ("back_emf_constant", "(nominal_voltage - resistance * no_load_current) / no_load_speed"),
    ("torque_constant", "stall_torque / (stall_current - no_load_current)"),
    ("torque_constant", "continuous_torque / (continuous_current - no_load_current)"),
    (
        "torque_constant",
        (
            "stall_torque_at_output / (gear_ratio * gear_efficiency * (stall_current -"
            " no_load_current))"
        ),
    ),
    ("torque_constant", "back_emf_constant"),
    ("back_emf_constant", "torque_constant"),
    ("back_emf_constant", "(nominal_voltage - resistance * continuous_current) / continuous_speed"),
    (
        "gear_efficiency",
        (
            "stall_torque_at_output / (gear_ratio * torque_constant * (stall_current -"
            " no_load_current))"
        ),
    ),
    ("gear_efficiency", "torque_constant_at_output / (gear_ratio * torque_constant)"),
    (
        "gear_efficiency",
        (
            "continuous_torque_at_output / (gear_ratio * torque_constant * (continuous_current -"
            " no_load_current))"
        ),
    ),
    (
        "rotor_inertia",
        "mechanical_time_constant * torque_constant * back_emf_constant / resistance",
    ),
    ("inductance", "electrical_time_constant * resistance"),
    ("continuous_current", "continuous_torque / torque_constant + no_load_current"),
    (
        "continuous_current",
        (
            "continuous_torque_at_output / (gear_ratio * gear_efficiency * torque_constant) +"
            " no_load_current"
        ),
    ),
    ("thermal_resistance", "thermal_resistance_winding + thermal_resistance_housing"),
    ("peak_current", "peak_torque / torque_constant + no_load_current"),
    (
        "peak_current",
        (
            "peak_torque_at_output / (gear_ratio * gear_efficiency * torque_constant) +"
            " no_load_current"
        ),
    ),
)
_LOAD = (
    "the shaft's torque is kT*(I - I0) here, many makers print kT*I; iron saturates at stall; warm"
    " motors give less"
)
_SPEED = (
    "iron losses and brushes are not in the model; many makers print a warm motor's speed, or a"
    " limit of the drive"
)
CHECKS = (
    # A printed quantity, its value according to the derived numbers, and an explanation of a
    # difference.
    (
        "torque_constant",
        "back_emf_constant",
        (
            "equal in SI for an ideal motor. Iron losses, or saturation at stall, make the torque"
            " constant smaller; a larger one would create energy: distrust the stall torque, or the"
            " conventions of current and voltage"
        ),
    ),
    (
        "speed_constant",
        "1 / back_emf_constant",
        "two ways to print one number; rounding, or one of them includes losses",
    ),
    (
        "stall_current",
        "nominal_voltage / resistance",
        (
            "rounding, or the resistance is without brushes and leads, or the stall current was"
            " measured on a warm motor"
        ),
    ),
    ("stall_torque", "torque_constant * (stall_current - no_load_current)", _LOAD),
    (
        "stall_torque_at_output",
        "gear_ratio * gear_efficiency * torque_constant * (stall_current - no_load_current)",
        _LOAD,
    ),
    ("torque_constant_at_output", "gear_ratio * gear_efficiency * torque_constant", _LOAD),
    ("continuous_torque", "torque_constant * (continuous_current - no_load_current)", _LOAD),
    (
        "continuous_torque_at_output",
        "gear_ratio * gear_efficiency * torque_constant * (continuous_current - no_load_current)",
        _LOAD,
    ),
    (
        "no_load_speed",
        "(nominal_voltage - resistance * no_load_current) / back_emf_constant",
        _SPEED,
    ),
    (
        "continuous_speed",
        "(nominal_voltage - resistance * continuous_current) / back_emf_constant",
        _SPEED,
    ),
    (
        "mechanical_time_constant",
        "resistance * rotor_inertia / (torque_constant * back_emf_constant)",
        "rounding; some makers include the inertia of a gear or an encoder",
    ),
    (
        "electrical_time_constant",
        "inductance / resistance",
        "rounding; inductance depends on the frequency it is measured at",
    ),
    (
        "no_load_current",
        (
            "(coulomb_friction + viscous_friction * no_load_speed) / (gear_efficiency *"
            " torque_constant)"
        ),
        "friction varies with temperature and from motor to motor",
    ),
    (
        "thermal_resistance",
        "thermal_resistance_winding + thermal_resistance_housing",
        "that of the housing depends on its mounting",
    ),
)


class Disagreement(NamedTuple):
    """Difference between a printed value (or any torque constant) and its value from others."""

    quantity: str
    """Name of the field."""
    printed: float
    """Printed value [unit]."""
    computed: float
    """Value computed from the other numbers [unit]."""
    unit: str
    """SI unit of both values."""
    formula: str
    """Formula of the computed value."""
    explanation: str
    """Common reasons for such a difference."""

    @property
    def difference(self) -> float:
        """Relative difference: computed over printed, minus 1."""
        return self.computed / self.printed - 1.0 if self.printed else float("inf")

    def __str__(self) -> str:
        """Return the disagreement as a sentence."""
        share = self.difference
        difference_text = (
            f"{100.0 * share:+.3g}%" if abs(share) < 1.0 else f"{share + 1.0:.3g} times that"
        )
        return (
            f"{self.quantity} = {self.printed:.4g} {self.unit}, but {self.formula} ="
            f" {self.computed:.4g} {self.unit}, {difference_text}: {self.explanation}"
        )


AT_OUTPUT = (
    "stall_torque_at_output",
    "continuous_torque_at_output",
    "peak_torque_at_output",
    "torque_constant_at_output",
)
"""Torques and torque constant that include a gear's losses. The motor's own values follow from them
only if the efficiency of the gear is known.
"""
_MIN_EFFICIENCY = 0.2
"""Lower limit of a derived efficiency. No off-the-shelf servo gear is worse, so a lower value
indicates wrong units.
"""


class Derivation:
    """Known quantities of a motor, each with a sentence on its origin."""

    def __init__(
        self,
        parsed_values: Mapping[str, ParsedValue],
        specs: Mapping[str, QuantitySpec],
        lossy_quantities: Sequence[str] = (),
    ) -> None:
        """Start with the printed values, referred to the motor's shaft.

        Torques at the output, and `lossy_quantities`, depend on the efficiency of the gear: they
        are stored as they are, under names that end in `_at_output`.
        """
        self.values: dict[str, float] = {}
        self.origins: dict[str, str] = {}
        self._units = {name: spec.unit for name, spec in specs.items()}
        self._units |= {name: self._units[name.removesuffix("_at_output")] for name in AT_OUTPUT}
        for name, (value, printed, shaft) in parsed_values.items():
            gear_exponent, quantity, shaft_text = specs[name].gear_exponent, name, ""
            if shaft != "motor" and gear_exponent != 0:
                if "gear_ratio" not in parsed_values:
                    raise ValueError(
                        f"datasheet.{name} = {printed!r} at the output: needs the gear ratio; write"
                        " gear_ratio = 30, or gear_ratio = 1 to describe the motor as it is seen"
                        " at the output"
                    )
                shaft_text = " at the output"
                if name.endswith("torque") or name in lossy_quantities:
                    quantity = f"{name}_at_output"
                else:
                    ratio = parsed_values["gear_ratio"].value
                    value = value * ratio**gear_exponent
                    shaft_text = f"{shaft_text} * {ratio:g}^{gear_exponent}"
            self.values[quantity], self.origins[quantity] = (
                value,
                f"{name} = {printed}{shaft_text}, printed",
            )

    def _can_evaluate(self, formula: str) -> bool:
        """Return True if all quantities in a formula are known."""
        return self.values.keys() >= {*compile_formula(formula).co_names}

    def _substituted(self, formula: str) -> str:
        """Return a formula with values and units in place of the names."""
        return re.sub(
            NAME,
            lambda match: f"{self.values[match[0]]:.4g} {self._units[match[0]]}".strip(),
            formula,
        )

    def _add(self, name: str, formula: str, value: float, remark: str = "") -> None:
        """Add a quantity, with its formula and a remark as its origin."""
        self.values[name] = value
        self.origins[name] = (
            f"{name} = {formula} = {self._substituted(formula)} = {self._substituted(name)}{remark}"
        )

    def quantities_in(self, formula: str) -> list[str]:
        """Return the quantities in a formula."""
        return [name for name in dict.fromkeys(re.findall(NAME, formula)) if name in self._units]

    def printed_sources(self, names: list[str]) -> list[str]:
        """Return the printed quantities from which the named ones were derived."""
        sources: list[str] = []
        while names:
            name = names.pop(0)
            if "printed" in self.origins.get(name, "") or name not in self.origins:
                sources.append(name)
            else:
                names += [
                    quantity
                    for quantity in self.quantities_in(self.origins[name])
                    if quantity not in (name, *sources)
                ]
        return list(dict.fromkeys(sources))

    def apply_rules(self) -> None:
        """Apply rules until none adds a quantity; the first applicable one is always next."""
        # The rules are text, so that messages can quote them; they are constants of this module.
        values = self.values
        while new := next(
            (rule for rule in RULES if rule[0] not in values and self._can_evaluate(rule[1])), None
        ):
            quantity, formula = new
            try:
                self._add(quantity, formula, eval(compile_formula(formula), {}, values))
            except ZeroDivisionError as error:
                raise ValueError(
                    f"datasheet.{quantity}: {formula} = {self._substituted(formula)}"
                    " divides by 0; check these values"
                ) from error

    def complete_gear(self, strict: bool, tolerance: float) -> None:
        """Set ratio and efficiency of a missing gear to 1; check a derived efficiency."""
        values, origins = self.values, self.origins
        for name in ("gear_ratio", "gear_efficiency"):
            if name not in values and values.get("gear_ratio", 1.0) == 1.0:
                values[name], origins[name] = 1.0, f"{name} = 1: no gear is printed"
        efficiency = values.get("gear_efficiency")
        if efficiency is None:
            return
        if strict and not _MIN_EFFICIENCY <= efficiency <= 1.0 + tolerance:
            raise ValueError(
                f"datasheet.gear_efficiency = {efficiency:.4g}: must be in [{_MIN_EFFICIENCY:g},"
                f" 1], but {origins['gear_efficiency']}; check the units of these values, the"
                " gear_ratio, and at which shaft they are"
            )
        if efficiency > 1.0:
            values["gear_efficiency"] = 1.0
            origins["gear_efficiency"] += ", taken as 1"

    def derive_friction(self) -> None:
        """Derive friction from the no-load current; by default it is Coulomb friction."""
        values = self.values
        coulomb, viscous = "coulomb_friction" in values, "viscous_friction" in values
        total = values["torque_constant"] * values["no_load_current"]
        formula = "torque_constant * no_load_current"
        # The simulation subtracts friction behind the gear.
        if values.get("gear_efficiency", 1.0) != 1.0:
            total, formula = values["gear_efficiency"] * total, f"gear_efficiency * {formula}"
        if not coulomb and not viscous:
            self._add("coulomb_friction", formula, total)
            values["viscous_friction"] = 0.0
            self.origins["viscous_friction"] = (
                "viscous_friction = 0: the no-load current is taken as Coulomb friction alone"
            )
        elif coulomb != viscous and "no_load_speed" in values:
            speed, remark = values["no_load_speed"], ", not below 0"
            if coulomb:
                value = max(0.0, (total - values["coulomb_friction"]) / speed)
                self._add(
                    "viscous_friction",
                    f"({formula} - coulomb_friction) / no_load_speed",
                    value,
                    remark,
                )
            else:
                value = max(0.0, total - values["viscous_friction"] * speed)
                self._add(
                    "coulomb_friction",
                    f"{formula} - viscous_friction * no_load_speed",
                    value,
                    remark,
                )

    def disagreements(self, printed: set[str]) -> tuple[Disagreement, ...]:
        """Return the differences between printed and computed values, the largest first."""
        disagreements = []
        for quantity, formula, explanation in CHECKS:
            if quantity in printed and self._can_evaluate(formula):
                value = self.values[quantity]
                computed = eval(compile_formula(formula), {}, self.values)
                # Values that agree so closely were derived from each other.
                if abs(computed - value) > 1e-9 * abs(value):
                    text = f"{formula} = {self._substituted(formula)}"
                    disagreements.append(
                        Disagreement(
                            quantity, value, computed, self._units[quantity], text, explanation
                        )
                    )
        return tuple(sorted(disagreements, key=lambda disagreement: -abs(disagreement.difference)))
