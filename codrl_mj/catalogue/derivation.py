"""From what a datasheet prints to the numbers of a motor: applies the rules, and compares what is told twice."""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from codrl_mj.catalogue.rules import CHECKS, NAME, RULES
from codrl_mj.catalogue.units import Kind, Reading


class Disagreement(NamedTuple):
    """A value that is printed, or a torque constant wherever it came from, and what follows for it from others."""

    quantity: str
    """The field."""
    printed: float
    """Its value [unit]."""
    computed: float
    """What follows from the numbers that were derived [unit]."""
    unit: str
    """SI."""
    formula: str
    """How it follows."""
    reading: str
    """What to make of it."""

    @property
    def difference(self) -> float:
        """Relative: computed over printed, less 1."""
        return self.computed / self.printed - 1.0 if self.printed else float("inf")

    def __str__(self) -> str:
        """In a sentence."""
        share = self.difference
        by = f"{100.0 * share:+.3g}%" if abs(share) < 1.0 else f"{share + 1.0:.3g} times that"
        return (
            f"{self.quantity} = {self.printed:.4g} {self.unit}, but {self.formula} = {self.computed:.4g} {self.unit}, "
            f"{by}: {self.reading}"
        )


@dataclasses.dataclass(frozen=True)
class MotorNumbers:
    """A motor's numbers in SI at the motor's shaft; None where they are unknown."""

    resistance: float
    """[ohm]"""
    inductance: float
    """[H]"""
    torque_constant: float
    """[N*m/A]"""
    back_emf_constant: float
    """[V*s/rad]"""
    rotor_inertia: float | None
    """[kg*m^2]"""
    gear_ratio: float
    """Turns of the motor for a turn of the output; 1 without a gear."""
    gear_efficiency: float | None
    """Share of the torque that the gear passes on; 1 without a gear."""
    coulomb_friction: float | None
    """[N*m]"""
    viscous_friction: float | None
    """[N*m*s/rad]"""
    max_current: float | None
    """Of motor or drive [A]."""
    continuous_current: float | None
    """[A]"""
    voltage: float | None
    """Nominal supply [V]."""
    thermal_resistance: float | None
    """From winding to ambient [K/W]."""
    thermal_resistance_winding: float | None
    """From winding to housing [K/W]."""
    thermal_resistance_housing: float | None
    """From housing to ambient [K/W]."""
    thermal_time_constant_winding: float | None
    """Of the winding against the housing [s]."""
    thermal_time_constant_housing: float | None
    """Of the housing against the ambient [s]."""
    max_temperature: float | None
    """Of the winding [degC]."""
    derived: Mapping[str, str]
    """For every number above that is known, how it came about."""
    disagreements: tuple[Disagreement, ...]
    """Values that are printed and also follow from others, the worst first; not those that agree to 1e-9."""


_UNITS = {"stall_torque_at_output": "N*m", "continuous_torque_at_output": "N*m"}
_LEAST_EFFICIENCY = 0.2
"""No gear that one can buy for a servo is worse: a derived efficiency below it is a slip of units."""
OTHER_NAMES = {
    "max_current": "peak_current",
    "voltage": "nominal_voltage",
    "max_temperature": "max_winding_temperature",
}
"""Numbers whose printed field is called otherwise."""
_NEEDED = {
    "resistance": "resistance, or nominal_voltage and stall_current",
    "torque_constant": "torque_constant, or back_emf_constant, or speed_constant, or nominal_voltage and no_load_speed",
    "back_emf_constant": "back_emf_constant, or speed_constant, or nominal_voltage and no_load_speed",
    "inductance": 'inductance, such as inductance = "0.3 mH", or electrical_time_constant: it does not follow from the '
    "rest. If the maker does not print it, measure it or take that of a similar motor, and say so",
}


def derive(readings: Mapping[str, Reading], kinds: Mapping[str, Kind], strict: bool, tolerance: float) -> MotorNumbers:
    """The numbers that follow from what is printed; the arguments and errors of `from_datasheet`."""
    if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not tolerance > 0.0:
        raise ValueError(f"tolerance = {tolerance!r}: must be a number > 0, such as 0.2")
    known, how = _at_motor(readings, kinds)
    printed = {*known, "torque_constant"}
    text = _Text(known, {name: kind.unit for name, kind in kinds.items()} | _UNITS)
    known.setdefault("no_load_current", 0.0)
    _apply(known, how, text)
    for name, remedy in _NEEDED.items():
        if name not in known:
            raise ValueError(f"datasheet.{name} is not printed and does not follow from what is: give {remedy}")
        if not known[name] > 0.0:
            raise ValueError(f"datasheet.{name} = {known[name]:.4g}: must be > 0, but {how[name]}; check these values")
    _settle_gear(known, how, strict, tolerance)
    _settle_friction(known, how, text, "no_load_current" in printed)
    disagreements = _disagreements(known, printed, text)
    if strict and disagreements and not abs(disagreements[0].difference) <= tolerance:
        worst = disagreements[0]
        behind = ", ".join(text.behind([worst.quantity, *text.named(worst.formula)], how))
        behind += ", and at which shaft they are (shaft, gear_ratio)" if known["gear_ratio"] != 1.0 else ""
        raise ValueError(
            f"datasheet.{worst.quantity} contradicts the rest by more than {tolerance:.0%}: {worst}. Check the values "
            f"and units of {behind}; raise tolerance, or pass strict=False, if the maker does print them so"
        )
    for name, field in OTHER_NAMES.items():
        if field in printed:
            known[name], how[name] = known[field], how[field].replace(field, name, 1) + f" as {field}"
    fields = [f.name for f in dataclasses.fields(MotorNumbers) if f.name not in ("derived", "disagreements")]
    return MotorNumbers(
        **{name: known.get(name) for name in fields},  # type: ignore[arg-type]
        derived={name: how[name] for name in fields if name in known},
        disagreements=disagreements,
    )


def _at_motor(readings: Mapping[str, Reading], kinds: Mapping[str, Kind]) -> tuple[dict[str, Any], dict[str, str]]:
    """Printed values as seen at the motor's shaft, and sentences; torques at the output keep their place."""
    known: dict[str, Any] = {}
    how: dict[str, str] = {}
    for name, reading in readings.items():
        power = kinds[name].power
        if reading.shaft == "motor" or power == 0:
            known[name], how[name] = reading.value, f"{name} = {reading.printed}, printed"
            continue
        if "gear_ratio" not in readings:
            raise ValueError(
                f"datasheet.{name} = {reading.printed!r} at the output: needs the gear; write gear_ratio = 30, or "
                "gear_ratio = 1 to describe the motor as it is seen at the output"
            )
        if name.endswith("torque"):
            known[f"{name}_at_output"] = reading.value
            how[f"{name}_at_output"] = f"{name} = {reading.printed} at the output, printed"
            continue
        ratio = readings["gear_ratio"].value
        known[name] = reading.value * ratio**power
        how[name] = f"{name} = {reading.printed} at the output * {ratio:g}^{power}, printed"
    return known, how


class _Text:
    """Writes formulas with numbers."""

    def __init__(self, known: Mapping[str, Any], units: Mapping[str, str]) -> None:
        self._known, self._units = known, units

    def number(self, name: str) -> str:
        """A known quantity with its unit."""
        return f"{self._known[name]:.4g} {self._units[name]}".strip()

    def named(self, formula: str) -> list[str]:
        """The quantities in a formula."""
        return [name for name in dict.fromkeys(re.findall(NAME, formula)) if name in self._units]

    def behind(self, names: list[str], how: Mapping[str, str]) -> list[str]:
        """The printed quantities that some followed from."""
        found: list[str] = []
        while names:
            name = names.pop(0)
            if "printed" in how.get(name, "") or name not in how:
                found.append(name)
            else:
                names += [one for one in self.named(how[name]) if one not in (name, *found)]
        return list(dict.fromkeys(found))

    def filled(self, formula: str) -> str:
        """A formula with numbers for names."""
        return re.sub(NAME, lambda match: self.number(match[0]), formula)

    def sentence(self, name: str, formula: str) -> str:
        """How a quantity followed."""
        return f"{name} = {formula} = {self.filled(formula)} = {self.number(name)}"


def _apply(known: dict[str, Any], how: dict[str, str], text: _Text) -> None:
    """Apply the first rule that tells something new, until none does."""
    while True:
        for rule in RULES:
            if rule.quantity not in known and all(name in known for name in rule.needs):
                try:
                    known[rule.quantity] = rule.function(*(known[name] for name in rule.needs))
                except ZeroDivisionError as error:
                    raise ValueError(
                        f"datasheet.{rule.quantity}: {rule.formula} = {text.filled(rule.formula)} divides by 0; "
                        "check these values"
                    ) from error
                how[rule.quantity] = text.sentence(rule.quantity, rule.formula)
                break
        else:
            return


def _settle_gear(known: dict[str, Any], how: dict[str, str], strict: bool, tolerance: float) -> None:
    """Without a gear its ratio and efficiency are 1; a derived efficiency must be one."""
    if "gear_ratio" not in known:
        known["gear_ratio"], how["gear_ratio"] = 1.0, "gear_ratio = 1: no gear is printed"
    if "gear_efficiency" not in known and known["gear_ratio"] == 1.0:
        known["gear_efficiency"], how["gear_efficiency"] = 1.0, "gear_efficiency = 1: no gear is printed"
    efficiency = known.get("gear_efficiency")
    if efficiency is None:
        return
    if strict and not _LEAST_EFFICIENCY <= efficiency <= 1.0 + tolerance:
        raise ValueError(
            f"datasheet.gear_efficiency = {efficiency:.4g}: must be in [{_LEAST_EFFICIENCY:g}, 1], but "
            f"{how['gear_efficiency']}; check the units of these values, the gear_ratio, and at which shaft they are"
        )
    if efficiency > 1.0:
        known["gear_efficiency"] = 1.0
        how["gear_efficiency"] += ", taken as 1"


def _settle_friction(known: dict[str, Any], how: dict[str, str], text: _Text, has_no_load: bool) -> None:
    """Friction from the no-load current: all of it Coulomb's, unless one of the two kinds is printed."""
    if not has_no_load:
        return
    coulomb, viscous = "coulomb_friction" in known, "viscous_friction" in known
    total, free = known["torque_constant"] * known["no_load_current"], "torque_constant * no_load_current"
    if known.get("gear_efficiency", 1.0) != 1.0:  # friction is behind the gear
        total, free = known["gear_efficiency"] * total, f"gear_efficiency * {free}"
    if not coulomb and not viscous:
        known["coulomb_friction"], known["viscous_friction"] = total, 0.0
        how["coulomb_friction"] = text.sentence("coulomb_friction", free)
        how["viscous_friction"] = "viscous_friction = 0: the no-load current is taken as Coulomb friction alone"
    elif coulomb != viscous and "no_load_speed" in known:
        speed = known["no_load_speed"]
        if coulomb:
            name, formula = "viscous_friction", f"({free} - coulomb_friction) / no_load_speed"
            known[name] = max(0.0, (total - known["coulomb_friction"]) / speed)
        else:
            name, formula = "coulomb_friction", f"{free} - viscous_friction * no_load_speed"
            known[name] = max(0.0, total - known["viscous_friction"] * speed)
        how[name] = text.sentence(name, formula) + ", not below 0"


def _disagreements(known: dict[str, Any], printed: set[str], text: _Text) -> tuple[Disagreement, ...]:
    found = []
    for (quantity, needs, formula, function), reading in CHECKS:
        if quantity in printed and all(name in known for name in needs):
            value, computed = known[quantity], function(*(known[name] for name in needs))
            if abs(computed - value) > 1e-9 * abs(value):
                unit = text.number(quantity).partition(" ")[2]
                found.append(
                    Disagreement(quantity, value, computed, unit, f"{formula} = {text.filled(formula)}", reading)
                )
    return tuple(sorted(found, key=lambda one: -abs(one.difference)))
