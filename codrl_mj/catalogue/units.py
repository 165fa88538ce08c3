"""Parser of printed values: a number, its unit, and the shaft to which it refers."""

import functools
import math
import re
from typing import Any, NamedTuple, Protocol, Self, TypeVar


class Scalable(Protocol):
    """A number, or an array of numbers."""

    def __mul__(self, factor: float, /) -> Self:
        """Multiply by a factor."""


T = TypeVar("T", bound=Scalable)
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_PRINTED = re.compile(
    rf"\s*({_NUMBER}(?:\s*\*\s*{_NUMBER})*)\s*(.*?)\s*(?:\bat\s+(?:the\s+)?(motor|output))?\s*",
    re.S,
)
_TIME, _ANGLE = rf"({_NUMBER})\s*(m?)s(?:ec|econds?)?\.?", rf"({_NUMBER})\s*(?:°|º|deg(?:rees?)?)"
_TRANSIT = re.compile(
    rf"\s*(?:{_TIME}\s*(?:/|per)\s*{_ANGLE}|{_ANGLE}\s*(?:/|per)\s*{_TIME})\s*(?:\bat\s+(?:the\s+)?(motor|output))?\s*",
    re.I,
)
"""Pattern of the speed of servos: the time for an angle, such as 0.16 s/60deg."""
_OPTIONAL_ANGLE = {"N*m/A", "N*m*s/rad", "V*s/rad", "kg*m^2"}
"""SI units of quantities that may be stated with or without a division by an angle.

A torque constant in N*m/A has the same value in V*s/rad, and an inertia in kg*m^2 the same in
N*m*s^2/rad.
"""
# Regular expressions for spellings that pint does not know, with their replacements. They are
# applied one after another, so those of whole units precede the general one for hyphens.
_SPELLINGS = (
    (r"([mkµμ]?N)([cm]?)m\b", r"\1*\2m"),  # mNm, Nm, Ncm
    (r"(k?g)[-.*· ]?([cm]?)m(?:\^2|\*\*2|²|2)", r"\1*\2m**2"),  # gcm2, kg.m²
    (r"\bmin(?:\^-1|⁻¹|-¹|-1)|(?:\b(?:rev|r|U|tr|1)|^)/min\b", "rpm"),
    (r"(?i)rpm", "rpm"),  # RPM, kRPM
    (r"(?i)ohms?\b", "ohm"),
    (r"(?i)\bvolts?\b", "V"),
    (r"(?i)\bamp(?:ere)?s?\b", "A"),
    (r"(?i)\bkg(f?)[-.*· ]?([cm]?m)\b", r"kg\1*\2"),  # kgcm, Kg-cm
    (r"(?i)\boz(f?)[-.*· ]?in\b", r"oz\1*in"),
    (r"(?<=[A-Za-z])-(?=[A-Za-z])", "*"),  # lb-ft, N-m
)

_COMMON_UNITS = {
    "": {"": 1.0},
    "A": {"A": 1.0, "mA": 1e-3},
    "H": {"H": 1.0, "mH": 1e-3, "uH": 1e-6},
    "K/W": {"K/W": 1.0},
    "N*m": {
        "N*m": 1.0,
        "Nm": 1.0,
        "N*cm": 0.01,
        "mN*m": 1e-3,
        "mNm": 1e-3,
        "kgf*cm": 0.0980665,
        "kgf*mm": 0.00980665,
    },
    "N*m*s/rad": {"N*m*s/rad": 1.0, "N*m/(rad/s)": 1.0},
    "N*m/A": {"N*m/A": 1.0, "Nm/A": 1.0, "mN*m/A": 1e-3, "mNm/A": 1e-3, "Wb": 1.0},
    "V": {"V": 1.0},
    "V*s/rad": {
        "V*s/rad": 1.0,
        "V/(rad/s)": 1.0,
        "V/rpm": 9.549296585513721,
        "mV/rpm": 9.54929658551372e-3,
        "Wb": 1.0,
    },
    "degC": {"degC": 1.0},
    "kg*m^2": {
        "kg*m^2": 1.0,
        **dict.fromkeys(("gcm2", "gcm²", "g*cm^2"), 1.0000000000000001e-07),
    },
    "ohm": {"ohm": 1.0, "mohm": 1e-3},
    "rad/s": {"rad/s": 1.0, "rpm": 0.10471975511965977},
    "rad/s/V": {"rpm/V": 0.10471975511965977},
    "s": {"s": 1.0, "ms": 1e-3},
}
"""SI unit -> common units with their sizes in it, as pint defines them. With this table most
datasheets are read without importing pint, which takes half a second.
"""


class QuantitySpec(NamedTuple):
    """Unit and bounds of the quantity that a datasheet field holds."""

    unit: str
    """SI unit."""
    example: str
    """Example of a printed value, for messages."""
    gear_exponent: int = 0
    """Exponent: a value v at the output of a gear N is v*N**power at the motor's shaft."""
    allow_zero: bool = False
    """True if zero is allowed."""


class ParsedValue(NamedTuple):
    """Parsed value of a datasheet."""

    value: float
    """Value in the SI unit of its quantity."""
    printed: str
    """Printed text without the shaft."""
    shaft: str | None
    """`motor`, `output`, or None if not stated."""


def parse_value(
    name: str, printed: object, spec: QuantitySpec, pole_pairs: float | None = None
) -> ParsedValue:
    """Parse a printed value, such as `25.1 mN*m/A`, `2 * 0.3 ohm` or `2.42 N*m at output`.

    The value of a quantity without a unit, such as a gear ratio, may also be a number. With
    `pole_pairs` a speed may be electrical (eRPM), and a constant per electrical speed.

    Raises:
        ValueError: the value has no unit, a wrong or unknown one, more than one number, or is not
            positive.
    """
    if not spec.unit and isinstance(printed, int | float) and not isinstance(printed, bool):
        printed = str(printed)
    # A gear ratio may be printed as 30:1.
    if not spec.unit and isinstance(printed, str):
        printed = re.sub(r"\s*:\s*1\s*$", "", printed)
    if (
        spec.unit == "rad/s"
        and isinstance(printed, str)
        # The speed of a servo is printed as the time for an angle.
        and (transit := _TRANSIT.fullmatch(printed))
    ):
        time, milli, angle = (
            transit.groups()[:3] if transit[1] else (transit[5], transit[6], transit[4])
        )
        time, angle = float(time) * (1e-3 if milli else 1.0), math.radians(float(angle))
        if time > 0.0 and angle > 0.0:
            return ParsedValue(angle / time, printed.strip(), transit[7])
    match = _PRINTED.fullmatch(printed) if isinstance(printed, str) else None
    remedy = f'write a number and its unit, such as {name} = "{spec.example}"'
    if match is None:
        raise ValueError(
            f"datasheet.{name} = {printed!r}: must be a number with its unit, as text; {remedy}"
        )
    factors, unit, shaft = match.groups()
    if re.match(r"[,:\d](?!/min)", unit):
        raise ValueError(
            f"datasheet.{name} = {printed!r}: must be one number, without a space or a comma in it;"
            f" {remedy}"
        )
    # Electrical turns are pole pairs times as many as those of the rotor.
    mechanical_unit = re.sub(r"(?i)\be-?rpm", "rpm", unit)
    if mechanical_unit != unit and pole_pairs is None:
        raise ValueError(
            f"datasheet.{name} = {printed!r}: is an electrical speed; write pole_pairs = 7, or"
            " divide it by the number of pole pairs and write rpm"
        )
    turns = 1.0 if mechanical_unit == unit else float(pole_pairs or 1.0)
    turns = turns if "/" in mechanical_unit.partition("rpm")[0] else 1.0 / turns
    if not unit and spec.unit:
        raise ValueError(f"datasheet.{name} = {printed!r}: has no unit; {remedy}")
    try:
        number = float(math.prod(map(float, factors.split("*"))))
        value = float(turns * to_si(number, mechanical_unit, spec.unit, mass_as_weight=True))
    except ValueError as error:
        raise ValueError(f"datasheet.{name} = {printed!r}: {error}; {remedy}") from error
    bound = "a finite number >= 0" if spec.allow_zero else "a finite number > 0"
    if not (math.isfinite(value) and (value > 0.0 or (value == 0.0 and spec.allow_zero))):
        raise ValueError(
            f"datasheet.{name} = {printed!r}: must be {bound}; give its magnitude, or leave the"
            " field out"
        )
    return ParsedValue(value, f"{factors} {unit}".strip(), shaft)


def to_si(
    number: T,
    unit: str,
    si_unit: str | None,
    quantity_name: str = "this quantity",
    mass_as_weight: bool = False,
) -> T:
    """Convert a number to the SI unit of its quantity, or to SI base units for `si_unit` None.

    Args:
        number: the number, or an array.
        unit: unit of the number, spelled as in datasheets and logs.
        si_unit: SI unit of the quantity; None for any quantity.
        quantity_name: name of the quantity, for messages.
        mass_as_weight: True to read a mass as a weight where a force is required, as in kg*cm.

    Raises:
        ValueError: the unit is unknown or does not fit; the caller adds the remedy.
    """
    if si_unit is not None and unit in (sizes := _COMMON_UNITS.get(si_unit, {})):
        return number * sizes[unit]
    registry = unit_registry()
    spelling = unit
    for pattern, plain in _SPELLINGS:
        spelling = re.sub(pattern, plain, spelling)
    # Pint's parser and its conversions raise errors of many kinds.
    try:
        quantity = registry.Quantity(number, spelling)
        if si_unit is None:
            in_base_units: T = quantity.to_base_units().magnitude
            return in_base_units
        unit_size = registry.Quantity(1.0, spelling)
        zero = registry.Quantity(0.0, spelling).to_root_units().magnitude
    except Exception as error:
        raise ValueError(f"the unit {unit!r} is not known") from error
    si_size = registry.Quantity(1.0, si_unit)
    # A torque in kg*cm lacks one standard gravity to be a force times a length.
    if (
        mass_as_weight
        and unit_size.dimensionality
        == si_size.dimensionality / registry.standard_gravity.dimensionality
    ):
        quantity, unit_size = (
            factor * registry.standard_gravity for factor in (quantity, unit_size)
        )
    names = {name for name, _ in unit_size.unit_items()}
    powers, si_powers = (dict(size.to_root_units().unit_items()) for size in (unit_size, si_size))
    has_same_dimension = unit_size.dimensionality == si_size.dimensionality
    if has_same_dimension and (
        any(name.endswith("hertz") for name in names)
        or (si_unit.startswith("rad/s") and "radian" not in powers and "second" in powers)
    ):
        raise ValueError("Hz and 1/s are ambiguous: turns or radians?")
    # Pint treats angles, counts and bits as plain numbers, so that 1/deg has the dimension of rad.
    # Their exponents are therefore compared too.
    if si_unit in _OPTIONAL_ANGLE and powers.get("radian", 0) in (-1, 0):
        powers["radian"] = si_powers.get("radian", 0)
    if not has_same_dimension or any(
        powers.get(name, 0) != si_powers.get(name, 0) for name in powers.keys() | si_powers
    ):
        raise ValueError(
            f"{unit!r} is not a unit of {quantity_name}, which is in {si_unit or 'no unit'}"
        )
    if si_unit == "degC":
        # Pint cannot convert a difference of temperatures to a temperature.
        if any(name.startswith("delta_") for name in names):
            raise ValueError(f"{unit!r} is a difference of temperatures, must be a temperature")
    elif zero != 0.0:
        raise ValueError(f"{unit!r} is logarithmic, must be proportional to the quantity")
    converted: T = quantity.to(si_unit or "dimensionless").magnitude
    return converted


# mypy does not read pint.
UnitRegistry = Any
"""A `pint.UnitRegistry`."""


@functools.cache
def unit_registry() -> UnitRegistry:
    """Return pint's registry of units; importing it takes half a second, so this is lazy."""
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
