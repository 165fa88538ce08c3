"""Derivation of a motor's parameters, or of its torque-speed line, from its datasheet."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from codrl_mj.catalogue.relations import Derivation, Disagreement
from codrl_mj.catalogue.units import ParsedValue, QuantitySpec


@dataclasses.dataclass(frozen=True)
class MotorParameters:
    """Parameters of a motor in SI units at the motor's shaft; None if unknown."""

    resistance: float
    """Terminal resistance [ohm]."""
    inductance: float
    """Terminal inductance [H]."""
    torque_constant: float
    """Torque constant [N*m/A]."""
    back_emf_constant: float
    """Back-EMF constant [V*s/rad]."""
    rotor_inertia: float | None
    """Inertia of the rotor [kg*m^2]."""
    gear_ratio: float
    """Turns of the motor per turn of the output; 1 without a gear."""
    gear_efficiency: float | None
    """Share of the torque that the gear transmits; 1 without a gear."""
    coulomb_friction: float | None
    """Coulomb friction [N*m]."""
    viscous_friction: float | None
    """Viscous friction [N*m*s/rad]."""
    max_current: float | None
    """Largest current of the motor or the drive [A]."""
    continuous_current: float | None
    """Current that the motor can carry permanently [A]."""
    voltage: float | None
    """Nominal supply voltage [V]."""
    thermal_resistance: float | None
    """Thermal resistance from winding to ambient [K/W]."""
    thermal_resistance_winding: float | None
    """Thermal resistance from winding to housing [K/W]."""
    thermal_resistance_housing: float | None
    """Thermal resistance from housing to ambient [K/W]."""
    thermal_time_constant_winding: float | None
    """Thermal time constant of the winding relative to the housing [s]."""
    thermal_time_constant_housing: float | None
    """Thermal time constant of the housing relative to the ambient [s]."""
    max_temperature: float | None
    """Largest permissible temperature of the winding [degC]."""
    derived: Mapping[str, str]
    """Parameter -> sentence on its origin, for every known parameter."""
    disagreements: tuple[Disagreement, ...]
    """Differences above 1e-9 between printed values and values computed from others, the largest
    first.
    """


class IncompleteError(ValueError):
    """A datasheet determines no winding: a quantity is missing."""


class TorqueSpeedLine(NamedTuple):
    """Line from stall torque to no-load speed at the output, for a datasheet without a winding."""

    stall_torque: float
    """Torque [N*m] of the blocked output."""
    no_load_speed: float
    """Speed [rad/s] of the free output."""
    max_torque: float | None
    """Largest torque [N*m] of the motor or its drive; None if unknown."""
    reason: str
    """Sentence that names the quantity without which there is no winding, and a remedy."""


PRINTED_NAMES = {
    "max_current": "peak_current",
    "voltage": "nominal_voltage",
    "max_temperature": "max_winding_temperature",
}
"""Parameter -> field of the datasheet, where their names differ."""
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
    parsed_values: Mapping[str, ParsedValue],
    specs: Mapping[str, QuantitySpec],
    strict: bool,
    tolerance: float,
) -> MotorParameters:
    """Return the parameters that follow from printed values; see `from_datasheet`."""
    if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not tolerance > 0.0:
        raise ValueError(f"tolerance = {tolerance!r}: must be a number > 0, such as 0.2")
    lossy_quantities = (
        ("torque_constant",)
        if strict and _includes_gear_loss(parsed_values, specs, tolerance)
        else ()
    )
    derivation = Derivation(parsed_values, specs, lossy_quantities)
    values = derivation.values
    origins = derivation.origins
    printed = {*derivation.values, "torque_constant"}
    values.setdefault("no_load_current", 0.0)
    derivation.apply_rules()
    for name, remedy in _NEEDED.items():
        if name not in values:
            raise IncompleteError(
                f"datasheet.{name} is not printed and does not follow from the printed values:"
                f" add {remedy}"
            )
        if not values[name] > 0.0:
            raise ValueError(
                f"datasheet.{name} = {values[name]:.4g}: must be > 0, but {origins[name]}; check"
                " these values"
            )
    derivation.complete_gear(strict, tolerance)
    if "no_load_current" in printed:
        derivation.derive_friction()
    disagreements = derivation.disagreements(printed)
    if strict:
        _check_agreement(derivation, disagreements, tolerance)
    for name, field in PRINTED_NAMES.items():
        if field in values:
            values[name] = values[field]
            origins[name] = origins[field].replace(field, name, 1)
            origins[name] += f" as {field}" if field in printed else ""
    names = [
        f.name
        for f in dataclasses.fields(MotorParameters)
        if f.name not in ("derived", "disagreements")
    ]
    return MotorParameters(
        **{name: values.get(name) for name in names},  # type: ignore[arg-type]
        derived={name: origins[name] for name in names if name in values},
        disagreements=disagreements,
    )


def derive_line(
    parsed_values: Mapping[str, ParsedValue],
    specs: Mapping[str, QuantitySpec],
    tolerance: float,
    reason: str,
) -> TorqueSpeedLine | None:
    """Return the line from stall torque to no-load speed; None if it does not follow.

    A gear without a known efficiency has no losses here.

    Raises:
        ValueError: printed values contradict each other.
    """
    derivation = Derivation(parsed_values, specs)
    values, printed = derivation.values, {*derivation.values, "torque_constant"}
    values.setdefault("no_load_current", 0.0)
    derivation.apply_rules()
    derivation.complete_gear(strict=True, tolerance=tolerance)
    _check_agreement(derivation, derivation.disagreements(printed), tolerance)
    ratio = values["gear_ratio"]
    for torque in ("stall_torque", "peak_torque"):
        current = values.get(torque.replace("torque", "current"))
        if torque not in values and "torque_constant" in values and current is not None:
            values[torque] = values["torque_constant"] * (current - values["no_load_current"])
        if torque in values:
            loss = values.get("gear_efficiency", 1.0)
            values.setdefault(f"{torque}_at_output", ratio * loss * values[torque])
    if "no_load_speed" not in values and values.keys() >= {"back_emf_constant", "stall_current"}:
        voltage = values["nominal_voltage"]
        drop = voltage * values["no_load_current"] / values["stall_current"]
        values["no_load_speed"] = (voltage - drop) / values["back_emf_constant"]
    if not values.keys() >= {"stall_torque_at_output", "no_load_speed"}:
        return None
    stall, peak = values["stall_torque_at_output"], values.get("peak_torque_at_output")
    return TorqueSpeedLine(stall, values["no_load_speed"] / ratio, peak, reason)


def _check_agreement(
    derivation: Derivation, disagreements: Sequence[Disagreement], tolerance: float
) -> None:
    """Raise if the largest disagreement exceeds the tolerance."""
    values = derivation.values
    if disagreements and not abs(disagreements[0].difference) <= tolerance:
        worst = disagreements[0]
        sources = ", ".join(
            derivation.printed_sources([worst.quantity, *derivation.quantities_in(worst.formula)])
        )
        sources += (
            ", and at which shaft they are (shaft, gear_ratio)"
            if values["gear_ratio"] != 1.0
            else ""
        )
        raise ValueError(
            f"datasheet.{worst.quantity} contradicts the rest by more than {tolerance:.0%}:"
            f" {worst}. Check the values and units of {sources}; raise tolerance, or pass"
            " strict=False, if the manufacturer does print these values"
        )


def _includes_gear_loss(
    parsed_values: Mapping[str, ParsedValue], specs: Mapping[str, QuantitySpec], tolerance: float
) -> bool:
    """Return True if a torque constant printed at the output must include the gear's losses.

    This is the case if no efficiency is printed, and the constant, divided by the gear ratio alone,
    is smaller by more than the tolerance than the back-EMF constant from the other values.
    """
    reading, ratio = parsed_values.get("torque_constant"), parsed_values.get("gear_ratio")
    if (
        reading is None
        or ratio is None
        or reading.shaft != "output"
        or "gear_efficiency" in parsed_values
    ):
        return False
    other_values = Derivation(
        {name: value for name, value in parsed_values.items() if name != "torque_constant"}, specs
    )
    other_values.values.setdefault("no_load_current", 0.0)
    other_values.apply_rules()
    constant = other_values.values.get("back_emf_constant", 0.0)
    return bool(reading.value / ratio.value < constant / (1.0 + tolerance))
