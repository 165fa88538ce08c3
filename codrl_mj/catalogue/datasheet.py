"""A motor's datasheet as it is printed, and the files that hold one: `assets/motors/`, and anybody's own."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codrl_mj.catalogue.derivation import MotorParameters, derive
from codrl_mj.catalogue.units import Kind, parse_value
from codrl_mj.fields import check_names, command
from codrl_mj.user_code import asset_folder, read_text


def _printed(unit: str, example: str, power: int = 0, zero: bool = False, also: str = "") -> Any:
    """A field that may be printed; `also` is what others call it."""
    return dataclasses.field(
        default=None, metadata={"kind": Kind(unit, example, power, zero), "also": also}
    )


@dataclasses.dataclass(frozen=True)
class Datasheet:
    """What a datasheet prints, each value as text with its unit; what it does not print is left out.

    Any sufficient combination will do: the nominal voltage with stall torque, stall current,
    no-load speed and no-load current; or resistance and torque constant (or back-EMF constant, or
    speed constant); or both, which are then compared. The inductance, or an electrical time
    constant, is needed in any case.

    Electrical values are those at the two terminals. Of a three-phase motor these are resistance
    and inductance between two phases (what maxon, T-Motor and most makers print), with the voltage
    between the phases and the torque constant that goes with it; of a star whose phase is printed,
    write `2 * 0.3 ohm`.

    Torques, speeds, inertias and friction are at `shaft`, unless the value ends in `at motor` or
    `at output`.
    """

    shaft: str | None = None
    """At which shaft mechanical values are printed: `motor`, or `output`, past the gear; needed with a gear."""
    nominal_voltage: str | None = _printed("V", "12 V", also="voltage rated_voltage")
    """Voltage that the values below are at."""
    stall_torque: str | None = _printed("N*m", "2.42 N*m", -1, also="starting_torque")
    """Torque of the blocked shaft, friction already taken off."""
    stall_current: str | None = _printed("A", "133 A", also="starting_current")
    """Current of the blocked motor."""
    no_load_speed: str | None = _printed("rad/s", "5310 rpm", 1)
    """Speed of the free shaft."""
    no_load_current: str | None = _printed("A", "2.7 A", zero=True)
    """Current of the free motor, which overcomes its friction."""
    continuous_torque: str | None = _printed(
        "N*m", "91.1 mN*m", -1, also="rated_torque nominal_torque"
    )
    """Torque that it bears for ever; many call it nominal or rated."""
    continuous_current: str | None = _printed("A", "2.52 A", also="rated_current nominal_current")
    """Current that it bears for ever."""
    continuous_speed: str | None = _printed(
        "rad/s", "5170 rpm", 1, also="rated_speed nominal_speed"
    )
    """Speed at the nominal voltage and the continuous current."""
    peak_current: str | None = _printed("A", "24 A", also="max_current")
    """Largest current of motor or drive."""
    resistance: str | None = _printed("ohm", "0.464 ohm")
    """Resistance between the terminals."""
    inductance: str | None = _printed("H", "0.322 mH")
    """Inductance between the terminals."""
    electrical_time_constant: str | None = _printed("s", "0.5 ms")
    """Inductance over resistance."""
    torque_constant: str | None = _printed("N*m/A", "25.1 mN*m/A", -1, also="kt")
    """Torque per current; at the output, of a gear without losses."""
    back_emf_constant: str | None = _printed("V*s/rad", "0.56 mV/rpm", -1, also="ke")
    """Voltage per speed."""
    speed_constant: str | None = _printed("rad/s/V", "380 rpm/V", 1, also="kv")
    """Speed per voltage, Kv."""
    rotor_inertia: str | None = _printed("kg*m^2", "135 g*cm^2", -2)
    """Inertia of the rotor; at the output, the reflected one (`armature`). With `shaft = "output"`
    it must end in `at motor` or `at output`.
    """
    mechanical_time_constant: str | None = _printed("s", "9.92 ms")
    """How fast the free rotor follows a step of voltage: R*J/(kT*kE)."""
    gear_ratio: str | float | None = _printed("", "30", also="gear reduction")
    """Turns of the motor for a turn of the output."""
    gear_efficiency: str | float | None = _printed("", "0.74")
    """Share of the torque that the gear passes on."""
    coulomb_friction: str | None = _printed("N*m", "0.12 mN*m", -1, zero=True)
    """Friction torque at any speed."""
    viscous_friction: str | None = _printed("N*m*s/rad", "1.5e-4 N*m*s/rad", -2, zero=True)
    """Friction torque per speed."""
    thermal_resistance: str | None = _printed("K/W", "9.85 K/W")
    """From winding to ambient, where it is printed in one."""
    thermal_resistance_winding: str | None = _printed("K/W", "8.28 K/W")
    """From winding to housing."""
    thermal_resistance_housing: str | None = _printed("K/W", "1.57 K/W")
    """From housing to ambient."""
    thermal_time_constant_winding: str | None = _printed("s", "28.8 s")
    """Of the winding against the housing."""
    thermal_time_constant_housing: str | None = _printed("s", "78.3 s")
    """Of the housing against the ambient."""
    max_winding_temperature: str | None = _printed("degC", "125 degC")
    """Largest permissible temperature of the winding."""

    def __post_init__(self) -> None:
        """Read every value once, so that a datasheet that exists can be read."""
        if self.shaft not in (None, "motor", "output"):
            raise ValueError(f"datasheet.shaft = {self.shaft!r}: must be motor or output")
        self.readings()

    def readings(self) -> dict[str, Any]:
        """The values that are printed, each a `Reading` in the SI unit of its field, at the shaft it is printed at.

        Raises:
            ValueError: a value has no unit or a wrong one, is not positive, or an efficiency is
                above 1; or nothing says at which shaft of a gear one is.
        """
        given = {name: getattr(self, name) for name in KINDS}
        found = {
            name: parse_value(name, printed, KINDS[name])
            for name, printed in given.items()
            if printed is not None
        }
        either = [
            name for name, reading in found.items() if KINDS[name].power and reading.shaft is None
        ]
        if (
            self.shaft is None
            and either
            and "gear_ratio" in found
            and found["gear_ratio"].value != 1.0
        ):
            raise ValueError(
                f"datasheet.shaft is missing: {', '.join(either)} may be before or past the"
                " gear of "
                f'{self.gear_ratio}; write shaft = "motor" or shaft = "output", or "... at motor"'
                " in a single value"
            )
        inertia, ratio = found.get("rotor_inertia"), found.get("gear_ratio")
        if (
            self.shaft == "output"
            and inertia
            and inertia.shaft is None
            and ratio
            and ratio.value != 1.0
        ):
            raise ValueError(
                f"datasheet.rotor_inertia = {self.rotor_inertia!r}: the rotor's own, or as it is"
                " seen at the output, "
                'gear_ratio^2 times that? shaft = "output" leaves it open: write'
                f' "{inertia.printed} at motor" (what '
                f'motors\' datasheets print) or "{inertia.printed} at output" (reflected, an'
                " armature)"
            )
        at = self.shaft or "motor"
        found = {
            name: reading._replace(shaft=reading.shaft or at) for name, reading in found.items()
        }
        if "gear_efficiency" in found and found["gear_efficiency"].value > 1.0:
            raise ValueError(
                f"datasheet.gear_efficiency = {self.gear_efficiency!r}: must be a finite number > 0"
                ' and <= 1; write percent as "74 %"'
            )
        return found

    def parameters(self, strict: bool = True, tolerance: float = 0.2) -> MotorParameters:
        """The motor's numbers in SI; see `from_datasheet`."""
        return derive(self.readings(), KINDS, strict, tolerance)


KINDS: dict[str, Kind] = {
    f.name: f.metadata["kind"] for f in dataclasses.fields(Datasheet) if "kind" in f.metadata
}
"""The printed fields and what each may hold."""
_OTHERWISE = {
    other: f.name
    for f in dataclasses.fields(Datasheet)
    for other in f.metadata.get("also", "").split()
}
_PHASE = "write what is between two phases: of a star twice the phase's, of a delta two thirds"
_LEFT_OUT = {
    "pole_pairs": (
        "leave it out: turns are the rotor's here; where a maker prints electrical rpm, divide"
        " these by it"
    ),
    "phase_resistance": f'{_PHASE}, resistance = "2 * 0.3 ohm"',
    "phase_inductance": f'{_PHASE}, inductance = "2 * 0.1 mH"',
}


def to_field_names(printed: Mapping[str, Any]) -> dict[str, Any]:
    """Printed values by the names of `Datasheet`'s fields, in whatever case, or by what others call them, such as kv.

    Raises:
        ValueError: a name is unknown, or one field has two.
    """
    found: dict[str, Any] = {}
    for name, value in printed.items():
        field = _OTHERWISE.get(name.lower(), name.lower())
        if field in _LEFT_OUT:
            raise ValueError(f"datasheet.{name}: {_LEFT_OUT[field]}")
        check_names(
            [field if field in ("shaft", *KINDS) else name],
            ("shaft", *KINDS),
            "datasheet field",
            list_all=True,
        )
        if field in found:
            raise ValueError(
                f"datasheet.{name} is {field}, which is given already: leave one of them out"
            )
        found[field] = value
    return found


def from_datasheet(*, strict: bool = True, tolerance: float = 0.2, **printed: Any) -> MotorParameters:
    """A motor's numbers in SI, from what its datasheet prints.

        >>> cim = from_datasheet(
        ...     nominal_voltage="12 V", stall_torque="2.42 N*m", stall_current="133 A", no_load_speed="5310 rpm",
        ...     no_load_current="2.7 A", inductance="59 uH",
        ... )
        >>> cim.derived["resistance"]
        'resistance = nominal_voltage / stall_current = 12 V / 133 A = 0.09023 ohm'

    Args:
        strict: refuse a datasheet that contradicts itself; False: only list it in `disagreements`.
        tolerance: relative difference above which two values contradict each other. 0.2 lets pass
            what makers round, print of a warm motor or of one with saturated iron, and catches
            slips of units.
        printed: the fields of `Datasheet`.

    Raises:
        ValueError: a field is unknown, is without its unit, has a wrong one or is out of bounds;
            the fields do not suffice; or two of them contradict each other. The message names
            field, value and remedy.
    """
    return Datasheet(**to_field_names(printed)).parameters(strict, tolerance)


# -- in a file --------------------------------------------------------------------------------------------------------

_THE_REST = "the rest"


@dataclasses.dataclass(frozen=True)
class MotorEntry:
    """A motor of the catalogue."""

    name: str
    """What it is asked for by: the file's name."""
    manufacturer: str
    """Who sells it."""
    product: str
    """The manufacturer's name of it."""
    kind: str
    """Such as `brushless`."""
    datasheet: Datasheet
    """What is printed, and what is estimated."""
    sources: Mapping[str, str]
    """Where each printed value was found."""
    estimated: Mapping[str, str]
    """Values that nobody prints, and the reasoning behind each."""
    notes: str
    """What to know before using it; explains disagreements."""
    tolerance: float
    """Up to where its values may contradict each other; see `from_datasheet`."""

    @property
    def title(self) -> str:
        """Maker, product and kind, as far as the file says."""
        return ", ".join(filter(None, (f"{self.manufacturer} {self.product}".strip(), self.kind)))

    @functools.cached_property
    def parameters(self) -> MotorParameters:
        """What follows from the datasheet, in SI."""
        return self.datasheet.parameters(tolerance=self.tolerance)


def motor_names() -> list[str]:
    """The motors of the catalogue."""
    return sorted(path.stem for path in (asset_folder() / "motors").glob("*.toml"))


def new_motor(path: Path) -> None:
    """Write a file for a motor, to be filled in with what its datasheet prints.

    Raises:
        ValueError: its name does not end in .toml, or it is there already.
    """
    if path.suffix != ".toml" or path.exists():
        raise ValueError(
            f"{path}: {'is there already' if path.exists() else 'must end in .toml'}: give another"
            " name"
        )
    path.write_bytes((asset_folder() / "motor_template.toml").read_bytes())


def motor_entry(name: str) -> MotorEntry:
    """A motor of the catalogue.

    Args:
        name: one of `motor_names()`, or the path of a TOML file of your own, of which [datasheet]
            is enough.

    Raises:
        ValueError: there is no such motor (the nearest is suggested); the file lacks something or
            has something unknown; or its datasheet is refused, see `from_datasheet`.
    """
    path = Path(name)
    if path.suffix != ".toml":
        check_names([name], motor_names(), "motor", listed_by="codrl-mj motor list")
        path = asset_folder() / "motors" / f"{name}.toml"
    try:
        return _entry(path.stem, tomllib.loads(read_text(path)), name.endswith(".toml"))
    except FileNotFoundError as error:
        raise ValueError(
            f"motor {name!r}: there is no such file; {command('motor', 'new', name)} writes one"
        ) from error
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise ValueError(
            f"motor {name!r}: {path} is no TOML file that can be read: {error}"
        ) from error
    except ValueError as error:
        raise ValueError(f"motor {name!r} ({path}): {error}") from error


def _entry(name: str, content: dict[str, Any], own: bool) -> MotorEntry:
    """What a file says, its numbers first; one's `own` need not say who makes it and who says so."""
    optional: dict[str, Any] = {"estimated": {}, "notes": "", "tolerance": 0.2}
    if own:
        optional |= {"manufacturer": "", "product": name, "kind": "", "sources": {}}
    known = [f.name for f in dataclasses.fields(MotorEntry) if f.name != "name"]
    check_names(content, known, "entry")
    content = optional | {key: value for key, value in content.items() if value != ""}
    if missing := [key for key in known if key not in content]:
        raise ValueError(f"{', '.join(missing)} missing; write [datasheet] with what is printed")
    for key, value in content.items():
        table = key in ("datasheet", "sources", "estimated")
        if key != "tolerance" and not isinstance(value, Mapping if table else str):
            raise ValueError(
                f"{key} = {value!r}: must be {f'a table, [{key}]' if table else 'text'}"
            )
    printed = {key: value for key, value in to_field_names(content["datasheet"]).items() if value != ""}
    content |= {
        "name": name,
        "datasheet": Datasheet(**printed),
        "estimated": to_field_names(content["estimated"]),
    }
    _ = MotorEntry(**content).parameters  # refused here, not at first use
    check_names(content["estimated"], printed, "entry", "estimated.")
    sourced = [key for key in printed if key in KINDS and key not in content["estimated"]]
    if content["sources"] or not own:
        content["sources"] = _sources(content["sources"], sourced)
    return MotorEntry(**content)


def _sources(sources: Mapping[str, Any], printed: list[str]) -> dict[str, str]:
    """The source of each printed value, from the values of each source."""
    found: dict[str, str] = {}
    for source, values in sources.items():
        if values != _THE_REST and not (
            isinstance(values, list) and all(isinstance(one, str) for one in values)
        ):
            raise ValueError(
                f'sources.{source!r} = {values!r}: must be a list of entries, or "{_THE_REST}"'
            )
        if values != _THE_REST:
            values = to_field_names(dict.fromkeys(values, source))
            check_names(values, printed, "entry", f"sources.{source!r}: ")
            found |= values
    rest = [name for name in printed if name not in found]
    for_the_rest = [source for source, values in sources.items() if values == _THE_REST]
    if rest and len(for_the_rest) != 1:
        raise ValueError(
            f'sources: not one for {", ".join(rest)}; list these, or write "one source" ='
            f' "{_THE_REST}"'
        )
    return found | dict.fromkeys(rest, "".join(for_the_rest))
