"""Printed datasheets of motors, and the files that hold them: `assets/motors/` and custom ones."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from codrl_mj.catalogue.derivation import (
    IncompleteError,
    MotorParameters,
    TorqueSpeedLine,
    derive,
    derive_line,
)
from codrl_mj.catalogue.units import ParsedValue, QuantitySpec, parse_value
from codrl_mj.fields import check_names, command
from codrl_mj.user_code import asset_folder, read_text

T = TypeVar("T")
# A file and a user may give values of any type: `parse_value` and `_entry` check each of them.
Unchecked = Any
"""Value of a datasheet that is not checked yet."""


def _printed(
    unit: str, example: str, gear_exponent: int = 0, allow_zero: bool = False, synonyms: str = ""
) -> str | None:
    """Return a field for a printed value; `synonyms` are its other common names."""
    return dataclasses.field(
        default=None,
        metadata={
            "spec": QuantitySpec(unit, example, gear_exponent, allow_zero),
            "synonyms": synonyms,
        },
    )


@dataclasses.dataclass(frozen=True)
class Datasheet:
    """Printed values of a datasheet, each a text with its unit; missing values are omitted.

    Any sufficient combination is accepted: the nominal voltage with stall torque, stall current,
    no-load speed and no-load current; or resistance and torque constant (or back-EMF constant, or
    speed constant); or both, which are then compared. A winding also needs the inductance, or an
    electrical time constant; without a winding, there may be a `torque_speed_line`.

    Electrical values are those at the two terminals. For a three-phase motor these are resistance
    and inductance between two phases (as maxon, T-Motor and most makers print them), with the
    voltage between the phases and the corresponding torque constant. For a star connection with
    printed phase values, write `2 * 0.3 ohm`.

    Torques, speeds, inertias and friction are at `shaft`, unless the value ends in `at motor` or
    `at output`.
    """

    shaft: str | None = None
    """Shaft at which torques, speeds, inertias and friction are stated: `motor`, or `output` behind
    the gear; required with a gear.
    """
    nominal_voltage: str | None = _printed("V", "12 V", synonyms="voltage rated_voltage")
    """Voltage at which the values below are stated."""
    stall_torque: str | None = _printed("N*m", "2.42 N*m", -1, synonyms="starting_torque")
    """Torque of the blocked shaft, net of friction."""
    stall_current: str | None = _printed("A", "133 A", synonyms="starting_current")
    """Current of the blocked motor."""
    no_load_speed: str | None = _printed("rad/s", "5310 rpm", 1)
    """Speed without load."""
    no_load_current: str | None = _printed("A", "2.7 A", allow_zero=True)
    """Current without load, which overcomes the friction."""
    continuous_torque: str | None = _printed(
        "N*m", "91.1 mN*m", -1, synonyms="rated_torque nominal_torque"
    )
    """Torque that the motor can deliver permanently; often called nominal or rated."""
    continuous_current: str | None = _printed(
        "A", "2.52 A", synonyms="rated_current nominal_current"
    )
    """Current that the motor can carry permanently."""
    continuous_speed: str | None = _printed(
        "rad/s", "5170 rpm", 1, synonyms="rated_speed nominal_speed"
    )
    """Speed at the nominal voltage and the continuous current."""
    peak_current: str | None = _printed("A", "24 A", synonyms="max_current")
    """Largest current of the motor or the drive."""
    peak_torque: str | None = _printed("N*m", "17 N*m", -1, synonyms="max_torque")
    """Largest torque of the motor or the drive; it replaces a `peak_current` that is not printed.
    """
    pole_pairs: str | float | None = _printed("", "7")
    """Number of pole pairs; needed only for electrical speeds, such as "60000 eRPM"."""
    resistance: str | None = _printed("ohm", "0.464 ohm")
    """Resistance between the terminals."""
    inductance: str | None = _printed("H", "0.322 mH")
    """Inductance between the terminals."""
    electrical_time_constant: str | None = _printed("s", "0.5 ms")
    """Inductance over resistance."""
    torque_constant: str | None = _printed("N*m/A", "25.1 mN*m/A", -1, synonyms="kt")
    """Torque per current; at the output, for a gear without losses."""
    back_emf_constant: str | None = _printed("V*s/rad", "0.56 mV/rpm", -1, synonyms="ke")
    """Voltage per speed."""
    speed_constant: str | None = _printed("rad/s/V", "380 rpm/V", 1, synonyms="kv")
    """Speed per voltage, Kv."""
    rotor_inertia: str | None = _printed("kg*m^2", "135 g*cm^2", -2)
    """Inertia of the rotor; at the output, the reflected inertia (`armature`). With `shaft =
    "output"` it must end in `at motor` or `at output`.
    """
    mechanical_time_constant: str | None = _printed("s", "9.92 ms")
    """Time constant of the speed after a step of voltage without load: R*J/(kT*kE)."""
    gear_ratio: str | float | None = _printed("", "30", synonyms="gear reduction")
    """Turns of the motor per turn of the output."""
    gear_efficiency: str | float | None = _printed("", "0.74")
    """Share of the torque that the gear transmits."""
    coulomb_friction: str | None = _printed("N*m", "0.12 mN*m", -1, allow_zero=True)
    """Coulomb friction: the torque that opposes motion at any speed."""
    viscous_friction: str | None = _printed("N*m*s/rad", "1.5e-4 N*m*s/rad", -2, allow_zero=True)
    """Viscous friction: the torque that opposes motion, per speed."""
    thermal_resistance: str | None = _printed("K/W", "9.85 K/W")
    """Thermal resistance from winding to ambient, if it is printed as one value."""
    thermal_resistance_winding: str | None = _printed("K/W", "8.28 K/W")
    """Thermal resistance from winding to housing."""
    thermal_resistance_housing: str | None = _printed("K/W", "1.57 K/W")
    """Thermal resistance from housing to ambient."""
    thermal_time_constant_winding: str | None = _printed("s", "28.8 s")
    """Thermal time constant of the winding relative to the housing."""
    thermal_time_constant_housing: str | None = _printed("s", "78.3 s")
    """Thermal time constant of the housing relative to the ambient."""
    max_winding_temperature: str | None = _printed("degC", "125 degC")
    """Largest permissible temperature of the winding."""

    def __post_init__(self) -> None:
        """Parse every value, so that an invalid one raises an error at once."""
        if self.shaft not in (None, "motor", "output"):
            raise ValueError(f"datasheet.shaft = {self.shaft!r}: must be motor or output")
        self.parsed_values()

    def parsed_values(self) -> dict[str, ParsedValue]:
        """Return the printed values, each in SI units at its stated shaft.

        Raises:
            ValueError: a value has no unit or a wrong one, is not positive, or an efficiency
                exceeds 1; or the shaft of a value is not stated although there is a gear.
        """
        printed_values = {name: getattr(self, name) for name in QUANTITY_SPECS}
        pole_pairs = None
        if self.pole_pairs is not None:
            spec = QUANTITY_SPECS["pole_pairs"]
            pole_pairs = parse_value("pole_pairs", self.pole_pairs, spec).value
        parsed_values = {
            name: parse_value(name, printed, QUANTITY_SPECS[name], pole_pairs)
            for name, printed in printed_values.items()
            if printed is not None
        }
        ambiguous = [
            name
            for name, reading in parsed_values.items()
            if QUANTITY_SPECS[name].gear_exponent and reading.shaft is None
        ]
        if (
            self.shaft is None
            and ambiguous
            and "gear_ratio" in parsed_values
            and parsed_values["gear_ratio"].value != 1.0
        ):
            raise ValueError(
                f"datasheet.shaft is missing: {', '.join(ambiguous)} may be before or behind the"
                " gear of "
                f'{self.gear_ratio}; write shaft = "motor" or shaft = "output", or "... at motor"'
                " in a single value"
            )
        inertia, ratio = parsed_values.get("rotor_inertia"), parsed_values.get("gear_ratio")
        if (
            self.shaft == "output"
            and inertia
            and inertia.shaft is None
            and ratio
            and ratio.value != 1.0
        ):
            raise ValueError(
                f'datasheet.rotor_inertia = {self.rotor_inertia!r}: shaft = "output" does not tell'
                " if this is the rotor's own inertia, or the reflected one, gear_ratio^2 times"
                f' that: write "{inertia.printed} at motor" (own inertia, as datasheets of motors'
                f' print it) or "{inertia.printed} at output" (reflected inertia, an armature)'
            )
        default_shaft = self.shaft or "motor"
        parsed_values = {
            name: reading._replace(shaft=reading.shaft or default_shaft)
            for name, reading in parsed_values.items()
        }
        if "gear_efficiency" in parsed_values and parsed_values["gear_efficiency"].value > 1.0:
            raise ValueError(
                f"datasheet.gear_efficiency = {self.gear_efficiency!r}: must be a finite number > 0"
                ' and <= 1; write percent as "74 %"'
            )
        return parsed_values

    def parameters(self, strict: bool = True, tolerance: float = 0.2) -> MotorParameters:
        """Return the motor's parameters in SI units; see `from_datasheet`."""
        return derive(self.parsed_values(), QUANTITY_SPECS, strict, tolerance)

    def torque_speed_line(self, tolerance: float = 0.2) -> TorqueSpeedLine | None:
        """Return the torque-speed line if the values determine no winding; otherwise None.

        Raises:
            ValueError: the values determine neither, or contradict each other.
        """
        try:
            self.parameters(tolerance=tolerance)
        except IncompleteError as error:
            line = derive_line(self.parsed_values(), QUANTITY_SPECS, tolerance, str(error))
            if line is None:
                raise
            return line
        return None


QUANTITY_SPECS: dict[str, QuantitySpec] = {
    f.name: f.metadata["spec"] for f in dataclasses.fields(Datasheet) if "spec" in f.metadata
}
"""Name -> quantity, for all fields of `Datasheet` with printed values."""
_FIELD_BY_OTHER_NAME = {
    other_name: f.name
    for f in dataclasses.fields(Datasheet)
    for other_name in f.metadata.get("synonyms", "").split()
}
_PHASE = (
    "write the value between two phases: twice that of a phase for a star, two thirds for a delta"
)
_UNSUPPORTED = {
    "flux_linkage": (
        "write the amplitude between two phases: sqrt(3) * pole pairs * flux of a phase of a star,"
        ' back_emf_constant = "1.7321 * 14 * 0.0045 V*s/rad"'
    ),
    "phase_resistance": f'{_PHASE}, resistance = "2 * 0.3 ohm"',
    "phase_inductance": f'{_PHASE}, inductance = "2 * 0.1 mH"',
}


def to_field_names(printed: Mapping[str, T]) -> dict[str, T]:
    """Convert names of printed values (in any case, also common synonyms) to names of fields.

    Raises:
        ValueError: a name is unknown, or a field has two values.
    """
    values: dict[str, T] = {}
    for name, value in printed.items():
        field = _FIELD_BY_OTHER_NAME.get(name.lower(), name.lower())
        if field in _UNSUPPORTED:
            raise ValueError(f"datasheet.{name}: {_UNSUPPORTED[field]}")
        check_names(
            [field if field in ("shaft", *QUANTITY_SPECS) else name],
            ("shaft", *QUANTITY_SPECS),
            "datasheet field",
            list_all=True,
        )
        if field in values:
            raise ValueError(
                f"datasheet.{name} is {field}, which is specified already: omit one of them"
            )
        values[field] = value
    return values


def from_datasheet(
    *, strict: bool = True, tolerance: float = 0.2, **printed: Unchecked
) -> MotorParameters:
    """Return a motor's parameters in SI units from its printed datasheet.

        >>> cim = from_datasheet(
        ...     nominal_voltage="12 V", stall_torque="2.42 N*m", stall_current="133 A",
        ...     no_load_speed="5310 rpm", no_load_current="2.7 A", inductance="59 uH",
        ... )
        >>> cim.derived["resistance"]
        'resistance = nominal_voltage / stall_current = 12 V / 133 A = 0.09023 ohm'

    Args:
        strict: raise if the datasheet contradicts itself; False: only list the contradictions in
            `disagreements`.
        tolerance: relative difference above which two values contradict each other. 0.2 accepts
            rounded values, and values of a warm motor or of saturated iron; wrong units differ by
            more.
        **printed: fields of `Datasheet`.

    Raises:
        ValueError: a field is unknown, has no unit or a wrong one, or is out of bounds; the fields
            are not sufficient; or two of them contradict each other. The message names field, value
            and remedy.
    """
    return Datasheet(**to_field_names(printed)).parameters(strict, tolerance)


# -- in a file -------------------------------------------------------------------------------------

_THE_REST = "the rest"


@dataclasses.dataclass(frozen=True)
class MotorEntry:
    """Motor of the catalogue."""

    name: str
    """Name of the motor: the file's name."""
    manufacturer: str
    """Manufacturer or seller."""
    product: str
    """Name of the product."""
    kind: str
    """Kind of motor, such as `brushless`."""
    datasheet: Datasheet
    """Printed and estimated values."""
    sources: Mapping[str, str]
    """Source of each printed value."""
    estimated: Mapping[str, str]
    """Reason for each value that is estimated because it is not printed."""
    notes: str
    """Notes for users, which also explain disagreements."""
    tolerance: float
    """Largest accepted difference between values that contradict each other; see `from_datasheet`.
    """

    @property
    def title(self) -> str:
        """Manufacturer, product and kind, as far as the file states them."""
        return ", ".join(filter(None, (f"{self.manufacturer} {self.product}".strip(), self.kind)))

    @functools.cached_property
    def parameters(self) -> MotorParameters:
        """Parameters from the datasheet, in SI units; an `IncompleteError` without a winding."""
        return self.datasheet.parameters(tolerance=self.tolerance)

    @functools.cached_property
    def line(self) -> TorqueSpeedLine | None:
        """Torque-speed line of a datasheet that determines no winding; None if it does."""
        return self.datasheet.torque_speed_line(self.tolerance)


def motor_names() -> list[str]:
    """Return the names of the motors in the catalogue whose datasheets determine a winding."""
    return sorted(path.stem for path in (asset_folder() / "motors").glob("*.toml"))


def joint_names() -> list[str]:
    """Return the names in the catalogue that are known only by their torque-speed line."""
    return sorted(path.stem for path in (asset_folder() / "joints").glob("*.toml"))


def new_motor(path: Path) -> None:
    """Write a template file for a motor, to be completed with the values of its datasheet.

    Raises:
        ValueError: its name does not end in .toml, or the file exists.
    """
    if path.suffix != ".toml" or path.exists():
        raise ValueError(
            f"{path}: {'already exists' if path.exists() else 'must end in .toml'}: give another"
            " name"
        )
    path.write_bytes((asset_folder() / "motor_template.toml").read_bytes())


def motor_entry(name: str) -> MotorEntry:
    """Return a motor of the catalogue, or of a file.

    Args:
        name: one of `motor_names()` or `joint_names()`, or the path of a custom TOML file, which
            needs only the table [datasheet].

    Raises:
        ValueError: there is no such motor (the message suggests the nearest); the file lacks an
            entry or has an unknown one; or its datasheet is invalid, see `from_datasheet`.
    """
    path = Path(name)
    if path.suffix != ".toml":
        check_names([name], motor_names() + joint_names(), "motor", listed_by="codrl-mj motor list")
        folder = "joints" if name in joint_names() else "motors"
        path = asset_folder() / folder / f"{name}.toml"
    try:
        return _entry(path.stem, tomllib.loads(read_text(path)), name.endswith(".toml"))
    except FileNotFoundError as error:
        raise ValueError(
            f"motor {name!r}: there is no such file; {command('motor', 'new', name)} writes one"
        ) from error
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"motor {name!r}: {path} is not a readable TOML file: {error}") from error
    except ValueError as error:
        raise ValueError(f"motor {name!r} ({path}): {error}") from error


def _entry(name: str, content: dict[str, Unchecked], is_custom: bool) -> MotorEntry:
    """Return the motor described by a file; a custom file may omit manufacturer and sources."""
    optional: dict[str, Unchecked] = {"estimated": {}, "notes": "", "tolerance": 0.2}
    if is_custom:
        optional |= {"manufacturer": "", "product": name, "kind": "", "sources": {}}
    names = [f.name for f in dataclasses.fields(MotorEntry) if f.name != "name"]
    check_names(content, names, "entry")
    # Empty entries count as missing: the template consists of them.
    content = optional | {key: value for key, value in content.items() if value != ""}
    if missing := [key for key in names if key not in content]:
        raise ValueError(f"{', '.join(missing)} missing; write [datasheet] with the printed values")
    for key, value in content.items():
        table = key in ("datasheet", "sources", "estimated")
        if key != "tolerance" and not isinstance(value, Mapping if table else str):
            raise ValueError(
                f"{key} = {value!r}: must be {f'a table, [{key}]' if table else 'text'}"
            )
    printed = {
        key: value for key, value in to_field_names(content["datasheet"]).items() if value != ""
    }
    content |= {
        "name": name,
        "datasheet": Datasheet(**printed),
        "estimated": to_field_names(content["estimated"]),
    }
    # Winding or line is derived now, so that an invalid file is rejected when it is read.
    _ = MotorEntry(**content).line
    check_names(content["estimated"], printed, "entry", "estimated.")
    printed_names = [
        key for key in printed if key in QUANTITY_SPECS and key not in content["estimated"]
    ]
    if content["sources"] or not is_custom:
        content["sources"] = _sources(content["sources"], printed_names)
    return MotorEntry(**content)


def _sources(sources: Mapping[str, Unchecked], printed: list[str]) -> dict[str, str]:
    """Return the source of each printed value, from the lists of values of each source."""
    source_by_value: dict[str, str] = {}
    for source, values in sources.items():
        if values != _THE_REST and not (
            isinstance(values, list) and all(isinstance(value, str) for value in values)
        ):
            raise ValueError(
                f'sources.{source!r} = {values!r}: must be a list of entries, or "{_THE_REST}"'
            )
        if values != _THE_REST:
            values = to_field_names(dict.fromkeys(values, source))
            check_names(values, printed, "entry", f"sources.{source!r}: ")
            source_by_value |= values
    unsourced = [name for name in printed if name not in source_by_value]
    default_sources = [source for source, values in sources.items() if values == _THE_REST]
    if unsourced and len(default_sources) != 1:
        raise ValueError(
            f'sources: none for {", ".join(unsourced)}; list these, or write "one source" ='
            f' "{_THE_REST}"'
        )
    return source_by_value | dict.fromkeys(unsourced, "".join(default_sources))
