"""From what a datasheet prints to the numbers of a motor: which follows from which, and which have to agree.

The motor is V = R*I + kE*w with torque kT*I. The gear passes on `gear_efficiency` of it, and
friction takes its part behind the gear, where the simulation has it: at no load it is
gear_efficiency*kT*I0. Source of the relations: maxon's *Key information on maxon DC and EC motors*;
they are those of any text on DC motors.
"""

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from types import CodeType
from typing import Any, NamedTuple

from codrl_mj.catalogue.units import Kind, Reading

NAME = r"[a-z]\w+"
"""A quantity in a formula."""


@functools.cache
def compile_formula(formula: str) -> CodeType:
    """A formula to be evaluated among known quantities; its `co_names` are those that it needs."""
    return compile(formula, "a rule of the catalogue", "eval")


# A quantity, and how it follows from others. Torques at the output, past a gear's losses, have
# names of their own. The first rule whose needs are known is taken.
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
)
_LOAD = (
    "the shaft's torque is kT*(I - I0) here, many makers print kT*I; iron saturates at stall; warm"
    " motors give less"
)
_SPEED = (
    "iron losses and brushes are not in the model; many print a warm motor's speed, or a limit of"
    " the drive"
)
CHECKS = (
    # a printed quantity, what it should be by the numbers that were found, and what to make of a
    # difference
    (
        "torque_constant",
        "back_emf_constant",
        (
            "equal in SI for an ideal motor. A smaller torque constant is lost in iron, or"
            " saturates at stall; a larger one would make energy: distrust the stall torque, or the"
            " conventions of current and voltage"
        ),
    ),
    (
        "speed_constant",
        "1 / back_emf_constant",
        "two ways to print one number; rounding, or the one includes losses",
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
        "rounding; some print it with a gear's or an encoder's inertia",
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
        "the housing's depends on what it is mounted on",
    ),
)


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
    explanation: str
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
            f"{self.quantity} = {self.printed:.4g} {self.unit}, but {self.formula} ="
            f" {self.computed:.4g} {self.unit}, {by}: {self.explanation}"
        )


@dataclasses.dataclass(frozen=True)
class MotorParameters:
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


AT_OUTPUT = ("stall_torque_at_output", "continuous_torque_at_output", "torque_constant_at_output")
"""Torques, and torque per current, past a gear's losses, which tell the motor's only once its efficiency is known."""
_LEAST_EFFICIENCY = 0.2
"""No off-the-shelf gear for a servo is worse: a derived efficiency below it is a slip of units."""
PRINTED_NAMES = {
    "max_current": "peak_current",
    "voltage": "nominal_voltage",
    "max_temperature": "max_winding_temperature",
}
"""Numbers whose printed field is called otherwise."""
_NEEDED = {
    "resistance": "resistance, or nominal_voltage and stall_current",
    "torque_constant": (
        "torque_constant, or back_emf_constant, or speed_constant, or nominal_voltage and"
        " no_load_speed"
    ),
    "back_emf_constant": (
        "back_emf_constant, or speed_constant, or nominal_voltage and no_load_speed"
    ),
    "inductance": (
        'inductance, such as inductance = "0.3 mH", or electrical_time_constant: it does not follow'
        " from the rest. If the maker does not print it, measure it or take that of a similar"
        " motor, and say so"
    ),
}


def derive(
    readings: Mapping[str, Reading], kinds: Mapping[str, Kind], strict: bool, tolerance: float
) -> MotorParameters:
    """The numbers that follow from what is printed; the arguments and errors of `from_datasheet`."""
    if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not tolerance > 0.0:
        raise ValueError(f"tolerance = {tolerance!r}: must be a number > 0, such as 0.2")
    lossy = ("torque_constant",) if strict and _has_loss(readings, kinds, tolerance) else ()
    found = _Derivation(readings, kinds, lossy)
    known, how, printed = found.known, found.how, {*found.known, "torque_constant"}
    known.setdefault("no_load_current", 0.0)
    found.apply_rules()
    for name, remedy in _NEEDED.items():
        if name not in known:
            raise ValueError(
                f"datasheet.{name} is not printed and does not follow from what is: give {remedy}"
            )
        if not known[name] > 0.0:
            raise ValueError(
                f"datasheet.{name} = {known[name]:.4g}: must be > 0, but {how[name]}; check these"
                " values"
            )
    found.settle_gear(strict, tolerance)
    if "no_load_current" in printed:
        found.settle_friction()
    disagreements = found.disagreements(printed)
    if strict and disagreements and not abs(disagreements[0].difference) <= tolerance:
        worst = disagreements[0]
        behind = ", ".join(found.behind([worst.quantity, *found.named(worst.formula)]))
        behind += (
            ", and at which shaft they are (shaft, gear_ratio)"
            if known["gear_ratio"] != 1.0
            else ""
        )
        raise ValueError(
            f"datasheet.{worst.quantity} contradicts the rest by more than {tolerance:.0%}:"
            f" {worst}. Check the values and units of {behind}; raise tolerance, or pass"
            " strict=False, if the maker does print them so"
        )
    for name, field in PRINTED_NAMES.items():
        if field in printed:
            known[name], how[name] = (
                known[field],
                how[field].replace(field, name, 1) + f" as {field}",
            )
    fields = [
        f.name
        for f in dataclasses.fields(MotorParameters)
        if f.name not in ("derived", "disagreements")
    ]
    return MotorParameters(
        **{name: known.get(name) for name in fields},  # type: ignore[arg-type]
        derived={name: how[name] for name in fields if name in known},
        disagreements=disagreements,
    )


def _has_loss(readings: Mapping[str, Reading], kinds: Mapping[str, Kind], tolerance: float) -> bool:
    """Return True if a torque constant printed at the output can only be past the gear's losses, as servos print it.

    That is, no efficiency is printed, and a gear without losses makes it smaller than the back-EMF
    constant, which follows from the rest, by more than the tolerance.
    """
    reading, ratio = readings.get("torque_constant"), readings.get("gear_ratio")
    if (
        reading is None
        or ratio is None
        or reading.shaft != "output"
        or "gear_efficiency" in readings
    ):
        return False
    others = _Derivation(
        {name: one for name, one in readings.items() if name != "torque_constant"}, kinds
    )
    others.known.setdefault("no_load_current", 0.0)
    others.apply_rules()
    constant = others.known.get("back_emf_constant", 0.0)
    return bool(reading.value / ratio.value < constant / (1.0 + tolerance))


class _Derivation:
    """What is known of a motor, seen at its shaft, and a sentence on how each number came about."""

    def __init__(
        self, readings: Mapping[str, Reading], kinds: Mapping[str, Kind], lossy: Sequence[str] = ()
    ) -> None:
        """Begin with what is printed; torques at the output, and what is `lossy`, keep their place, by other names."""
        self.known: dict[str, Any] = {}
        self.how: dict[str, str] = {}
        self._units = {name: kind.unit for name, kind in kinds.items()}
        self._units |= {name: self._units[name.removesuffix("_at_output")] for name in AT_OUTPUT}
        for name, (value, printed, shaft) in readings.items():
            power, at, place = kinds[name].power, name, ""
            if shaft != "motor" and power != 0:
                if "gear_ratio" not in readings:
                    raise ValueError(
                        f"datasheet.{name} = {printed!r} at the output: needs the gear; write"
                        " gear_ratio = 30, or gear_ratio = 1 to describe the motor as it is seen"
                        " at the output"
                    )
                place = " at the output"
                if name.endswith("torque") or name in lossy:
                    at = f"{name}_at_output"
                else:
                    ratio = readings["gear_ratio"].value
                    value, place = value * ratio**power, f"{place} * {ratio:g}^{power}"
            self.known[at], self.how[at] = value, f"{name} = {printed}{place}, printed"

    def _tells(self, formula: str) -> bool:
        """Whether all is known that a formula needs."""
        return self.known.keys() >= {*compile_formula(formula).co_names}

    def _filled(self, formula: str) -> str:
        """A formula with numbers and their units for names."""
        return re.sub(
            NAME,
            lambda match: f"{self.known[match[0]]:.4g} {self._units[match[0]]}".strip(),
            formula,
        )

    def _follow(self, name: str, formula: str, value: Any, more: str = "") -> None:
        """What a quantity is by a formula, and in a sentence."""
        self.known[name] = value
        self.how[name] = (
            f"{name} = {formula} = {self._filled(formula)} = {self._filled(name)}{more}"
        )

    def named(self, formula: str) -> list[str]:
        """The quantities in a formula."""
        return [name for name in dict.fromkeys(re.findall(NAME, formula)) if name in self._units]

    def behind(self, names: list[str]) -> list[str]:
        """The printed quantities that some followed from."""
        found: list[str] = []
        while names:
            name = names.pop(0)
            if "printed" in self.how.get(name, "") or name not in self.how:
                found.append(name)
            else:
                names += [one for one in self.named(self.how[name]) if one not in (name, *found)]
        return list(dict.fromkeys(found))

    def apply_rules(self) -> None:
        """Apply the first rule that tells something new, until none does."""
        known = self.known
        while new := next(
            (rule for rule in RULES if rule[0] not in known and self._tells(rule[1])), None
        ):
            quantity, formula = new
            try:
                self._follow(quantity, formula, eval(compile_formula(formula), {}, known))
            except ZeroDivisionError as error:
                raise ValueError(
                    f"datasheet.{quantity}: {formula} = {self._filled(formula)} divides by 0; check"
                    " these values"
                ) from error

    def settle_gear(self, strict: bool, tolerance: float) -> None:
        """Without a gear its ratio and efficiency are 1; a derived efficiency must be one."""
        known, how = self.known, self.how
        for name in ("gear_ratio", "gear_efficiency"):
            if name not in known and known.get("gear_ratio", 1.0) == 1.0:
                known[name], how[name] = 1.0, f"{name} = 1: no gear is printed"
        efficiency = known.get("gear_efficiency")
        if efficiency is None:
            return
        if strict and not _LEAST_EFFICIENCY <= efficiency <= 1.0 + tolerance:
            raise ValueError(
                f"datasheet.gear_efficiency = {efficiency:.4g}: must be in [{_LEAST_EFFICIENCY:g},"
                f" 1], but {how['gear_efficiency']}; check the units of these values, the"
                " gear_ratio, and at which shaft they are"
            )
        if efficiency > 1.0:
            known["gear_efficiency"] = 1.0
            how["gear_efficiency"] += ", taken as 1"

    def settle_friction(self) -> None:
        """Friction from the no-load current: all of it Coulomb's, unless one of the two kinds is printed."""
        known = self.known
        coulomb, viscous = "coulomb_friction" in known, "viscous_friction" in known
        total, free = (
            known["torque_constant"] * known["no_load_current"],
            "torque_constant * no_load_current",
        )
        if known.get("gear_efficiency", 1.0) != 1.0:  # friction is behind the gear
            total, free = known["gear_efficiency"] * total, f"gear_efficiency * {free}"
        if not coulomb and not viscous:
            self._follow("coulomb_friction", free, total)
            known["viscous_friction"] = 0.0
            self.how["viscous_friction"] = (
                "viscous_friction = 0: the no-load current is taken as Coulomb friction alone"
            )
        elif coulomb != viscous and "no_load_speed" in known:
            speed, more = known["no_load_speed"], ", not below 0"
            if coulomb:
                value = max(0.0, (total - known["coulomb_friction"]) / speed)
                self._follow(
                    "viscous_friction", f"({free} - coulomb_friction) / no_load_speed", value, more
                )
            else:
                value = max(0.0, total - known["viscous_friction"] * speed)
                self._follow(
                    "coulomb_friction", f"{free} - viscous_friction * no_load_speed", value, more
                )

    def disagreements(self, printed: set[str]) -> tuple[Disagreement, ...]:
        """What is printed and also follows, otherwise; the worst first."""
        found = []
        for quantity, formula, explanation in CHECKS:
            if quantity in printed and self._tells(formula):
                value, computed = self.known[quantity], eval(compile_formula(formula), {}, self.known)
                if abs(computed - value) > 1e-9 * abs(value):
                    text = f"{formula} = {self._filled(formula)}"
                    found.append(
                        Disagreement(
                            quantity, value, computed, self._units[quantity], text, explanation
                        )
                    )
        return tuple(sorted(found, key=lambda one: -abs(one.difference)))
