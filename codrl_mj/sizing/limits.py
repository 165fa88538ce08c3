"""Drives by name, their datasheets, and their steady-state limits from V = R*I + kE*omega.

Source: maxon, *Key information on maxon DC and EC motors*; `codrl_mj.catalogue` derives its numbers
by the same relations. As in the simulation, the gear multiplies a driving torque kT*I by its
efficiency, and a braking torque by 1/efficiency. Then friction at the output, n*(c + n*b*|omega|),
opposes the speed. All torques in this module act on the load, net of both losses.
"""

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple, NotRequired, TypedDict, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from codrl_mj.actuators import (
    ActuatorModel,
    ActuatorSetting,
    Drive,
    GearMotor,
    PwmLoop,
    PwmServo,
    Servo,
    ServoLoop,
    override_actuator,
    resolve,
)
from codrl_mj.catalogue import (
    MotorEntry,
    MotorParameters,
    joint_names,
    motor_entry,
    motor_names,
)
from codrl_mj.catalogue.datasheet import QUANTITY_SPECS
from codrl_mj.catalogue.derivation import PRINTED_NAMES
from codrl_mj.fields import check_names

Number = TypeVar("Number", float, np.ndarray)
"""A number or an array; a function of it has the same type."""


def find_drive(
    name: ActuatorSetting,
    gear_ratio: float | None = None,
    sample_rate: float | None = None,
    bandwidth: float | None = None,
    voltage: float | None = None,
    delayed: bool | None = None,
    max_current: float | None = None,
) -> Drive:
    """Return a drive by name, with overridden fields; None keeps a field.

    A servo is returned without its outer loops, also one that has no current loop.

    Args:
        name: anything that `codrl_mj.actuators.resolve` accepts, such as a catalogue motor.
        gear_ratio: turns of the rotor for a turn of the output.
        sample_rate: sample rate of the current loop [Hz].
        bandwidth: bandwidth that the loop's gains are designed for [Hz].
        voltage: voltage of the supply [V].
        delayed: True to apply a sample's voltage one sample later.
        max_current: largest reference current of the drive [A].

    Raises:
        ValueError: the actuator is unknown (the nearest name is suggested) or is not a drive, or a
            value is out of bounds.
    """
    loop = {
        "sample_rate": sample_rate,
        "bandwidth": bandwidth,
        "delayed": delayed,
        "max_current": max_current,
    }
    changes = {
        "motor": {"gear_ratio": gear_ratio},
        "controller": loop,
        "supply": {"voltage": voltage},
    }
    base: ActuatorModel = resolve(name, None, "a motor on its own")
    if isinstance(base, Servo | PwmServo):
        base = override_actuator(base, {"family": Drive.family})
    if type(base) is not Drive:
        raise ValueError(
            f"motor = {name!r}: is not a drive, but of the actuator family {base.family};"
            " name a motor of the catalogue (codrl-mj motor list), a TOML file with a datasheet,"
            f" or an actuator of the family drive{f' ({base.assumed})' * bool(base.assumed)}"
        )
    overrides = {
        part: {key: value for key, value in fields.items() if value is not None}
        for part, fields in changes.items()
    }
    return cast(Drive, override_actuator(base, overrides))


def find_entry(name: object) -> MotorEntry | None:
    """Return the datasheet behind a name of `find_drive`; None if it has no datasheet."""
    if isinstance(name, str) and (name in motor_names() + joint_names() or name.endswith(".toml")):
        return motor_entry(name)
    return None


class DriveLimits(NamedTuple):
    """Limits of a drive at its supply's voltage.

    Only `power` and `peak_torque` respect the drive's `max_current`.
    """

    power: float
    """Largest mechanical power [W] of the motor, without gear and friction: see `max_power`."""
    peak_torque: float
    """Stall torque [N*m] within `max_current`."""

    stall_torque: float
    """Torque at the blocked output with the stall current [N*m]."""
    stall_current: float
    """Current of the blocked motor [A]: V/R."""
    no_load_speed: float
    """Speed of the free output [rad/s]; infinite without back-EMF and viscous friction."""
    no_load_current: float
    """Current of the free motor [A], which overcomes its friction."""
    electrical_time_constant: float
    """Electrical time constant L/R [s]."""
    mechanical_time_constant: float
    """Mechanical time constant R*J/(kT*kE) of the rotor [s]; NaN if its inertia is unknown (0)."""


LIMIT_UNITS = dict(
    zip(DriveLimits._fields, ("W", "N*m", "N*m", "A", "rad/s", "A", "s", "s"), strict=True)
)
"""Units of the fields of `DriveLimits`, by name."""


def drive_limits(drive: Drive) -> DriveLimits:
    """Return the limits of a drive."""
    motor, resistance = drive.motor, drive.motor.resistance + drive.supply_resistance
    torque_per_current = motor.torque_constant * motor.gear_efficiency  # [N*m/A]
    voltage_per_torque = resistance / torque_per_current  # [V/(N*m)]
    voltage_per_speed = motor.back_emf_constant + voltage_per_torque * motor.viscous_friction
    effective_voltage = max(drive.voltage_limit - voltage_per_torque * motor.coulomb_friction, 0.0)
    speed = effective_voltage / voltage_per_speed if voltage_per_speed > 0.0 else math.inf
    friction = motor.coulomb_friction + (
        motor.viscous_friction * speed if motor.viscous_friction > 0.0 else 0.0
    )
    stall_current = drive.voltage_limit / resistance
    peak_torque, blocked_torque = _at_output(
        motor,
        np.array([min(stall_current, drive.controller.max_current), stall_current]),
        np.zeros(2),
    )
    return DriveLimits(
        max_power(drive),
        float(peak_torque),
        float(blocked_torque),
        stall_current,
        speed / motor.gear_ratio,
        friction / torque_per_current,
        motor.electrical_time_constant,
        motor.mechanical_time_constant if motor.rotor_inertia > 0.0 else math.nan,
    )


def max_power(drive: Drive) -> float:
    """Return the largest mechanical power [W], i (V - R i) kT/kE; infinite without back-EMF."""
    # R is the resistance of winding and supply. The power is maximal at half the stall current.
    motor = drive.motor
    limit = drive.voltage_limit
    resistance = drive.motor.resistance + drive.supply_resistance
    current = min(limit / resistance / 2, drive.controller.max_current)
    power = current * (limit - resistance * current) * motor.torque_constant
    return power / motor.back_emf_constant if motor.back_emf_constant else math.inf


def continuous_torque(drive: Drive, current: float | None) -> float | None:
    """Return the standstill torque [N*m] at a continuous current [A]; None if that is unknown."""
    return (
        None
        if current is None
        else float(_at_output(drive.motor, np.array(current), np.array(0.0)))
    )


class DiagramLimit(NamedTuple):
    """Limit of a drive in a torque-speed diagram."""

    name: str
    current: float
    """Current [A]; infinite for the limit by the voltage."""
    kind: int
    """0 for the voltage limit, 1 for the peak current, 2 for the continuous current."""


def diagram_limits(drive: Drive, parameters: MotorParameters | None = None) -> list[DiagramLimit]:
    """Return the limits of a drive for a torque-speed diagram.

    Args:
        drive: drive.
        parameters: parameters of its datasheet; None leaves out the continuous current.

    Raises:
        ValueError: the no-load speed, at which the diagram ends, is not finite or not positive.
    """
    limits, peak_current = drive_limits(drive), drive.controller.max_current
    if not 0.0 < limits.no_load_speed < math.inf or limits.stall_torque <= 0.0:
        raise ValueError(
            f"GearMotor.back_emf_constant = {drive.motor.back_emf_constant:g}, Supply.voltage ="
            f" {drive.voltage_limit:g}: the no-load speed is {limits.no_load_speed:g} rad/s and the"
            f" stall torque {limits.stall_torque:g} N*m, must be finite and > 0 for a torque-speed"
            " diagram; give a back-EMF constant, and a voltage that overcomes the friction"
        )
    lines = [DiagramLimit(f"voltage, {drive.voltage_limit:g} V", math.inf, 0)]
    if math.isfinite(peak_current):
        lines.append(DiagramLimit(f"peak current, {peak_current:.3g} A", peak_current, 1))
    continuous = None if parameters is None else parameters.continuous_current
    if continuous is not None:
        lines.append(DiagramLimit(f"continuous current, {continuous:.3g} A", continuous, 2))
    return lines


def torque_limits(
    drive: Drive, speeds: ArrayLike, current: float = math.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest steady torque [N*m] at the output.

    Above the no-load speed the back-EMF drives a current regardless of the current limit.

    Args:
        drive: drive with motor, gear and supply.
        speeds: speeds of the output [rad/s], any shape.
        current: limit of the absolute current [A], such as the drive's `max_current`.
    """
    speeds = np.asarray(speeds, dtype=float)
    back_emf = drive.motor.back_emf_constant * drive.motor.gear_ratio * speeds
    winding = drive.motor.resistance, drive.voltage_limit, drive.supply_resistance
    lowest, highest = -highest_current(*winding, -back_emf), highest_current(*winding, back_emf)
    low, high = (np.clip(bound, lowest, highest) for bound in (-current, current))
    return _at_output(drive.motor, low, speeds), _at_output(drive.motor, high, speeds)


def highest_current(
    resistance: float, voltage: float, supply_resistance: float, back_emf: np.ndarray
) -> np.ndarray:
    """Return the highest steady current [A] of a winding, for u = max(V - Rs*|i|, 0)."""
    # Beyond the no-load speed i < 0, so that u = V + Rs*i and (R - Rs)*i = V - b, where b is the
    # back-EMF. At u = 0 the back-EMF alone drives -b/R, which is the lower bound.
    reverse_resistance = max(resistance - supply_resistance, 1e-9 * resistance)
    steady = (voltage - back_emf) / np.where(
        back_emf > voltage, reverse_resistance, resistance + supply_resistance
    )
    highest: np.ndarray = np.maximum(steady, -back_emf / resistance)
    return highest


def _at_output(motor: GearMotor, current: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the net torque [N*m] at the output, for a current [A] and an output speed [rad/s]."""
    torque = motor.torque_constant * current
    torque = torque * np.where(
        torque * speed >= 0.0, motor.gear_efficiency, 1.0 / motor.gear_efficiency
    )
    friction = motor.coulomb_friction + motor.viscous_friction * motor.gear_ratio * np.abs(speed)
    friction = friction + motor.stribeck(motor.gear_ratio * speed)
    # At standstill friction only cancels torque; it never moves the joint.
    static = np.sign(torque) * np.maximum(np.abs(torque) - friction, 0.0)
    moving = torque - friction * np.sign(speed)
    net: np.ndarray = motor.gear_ratio * np.where(speed == 0.0, static, moving)
    return net


# -- datasheets ------------------------------------------------------------------------------------

COLUMNS = (
    *(
        "name",
        "kind",
        "voltage",
        "resistance",
        "inductance",
        "torque_constant",
        "rotor_inertia",
        "gear_ratio",
    ),
    *DriveLimits._fields,
    "continuous_torque",
)
"""Columns of `catalogue_rows`, in SI units."""
_ROUNDED = 0.01
"""Relative difference below which a contradiction in a datasheet is attributed to rounding."""


# Names and kinds are texts, and the other values numbers or None; callers loop over the columns.
CatalogueRow = dict[str, Any]
"""Row of the catalogue, with the keys `COLUMNS`."""


def catalogue_rows(sort: str = "name") -> list[CatalogueRow]:
    """Return a row for each catalogue motor at its nominal voltage, or at 24 V.

    Unknown values are None.

    Args:
        sort: one of `COLUMNS`: names and kinds from A to Z, numbers descending, unknown ones last.

    Raises:
        ValueError: the column is unknown; the nearest name is suggested.
    """
    check_names([sort], COLUMNS, "column")
    rows: list[CatalogueRow] = []
    for entry in map(motor_entry, motor_names()):
        parameters, drive = entry.parameters, Drive.from_motor_parameters(entry.parameters)
        limits = drive_limits(drive)._asdict()
        known = {name: getattr(parameters, name) for name in COLUMNS[2:8]}
        known |= {name: value if math.isfinite(value) else None for name, value in limits.items()}
        known["continuous_torque"] = continuous_torque(drive, parameters.continuous_current)
        rows.append({"name": entry.name, "kind": entry.kind, **known})
    if sort in ("name", "kind"):
        return sorted(rows, key=lambda row: row[sort])
    return sorted(rows, key=lambda row: (row[sort] is None, -(row[sort] or 0.0)))


def find_loop(name: ActuatorSetting) -> ServoLoop | PwmLoop | None:
    """Return the outer loops of the servo with a name of `find_drive`; None for other actuators."""
    base: ActuatorModel = resolve(name, None, "a motor on its own")
    return base.loop if isinstance(base, Servo | PwmServo) else None


class Quantity(TypedDict):
    """Value of a report."""

    name: str
    value: object
    """A number; for a drive also a text, True, False or None."""
    unit: str


class CitedQuantity(Quantity):
    """Value of a datasheet."""

    how: str
    """Derivation of the value."""
    sources: list[str]
    places: str
    """Numbers of these sources in the list `MotorReport.cited`, counted from 1."""


class MotorReport(TypedDict):
    """All known data of a motor; the keys after `assumed` exist only with a datasheet."""

    drive: list[Quantity]
    """Fields of motor, controller, supply and loop."""
    abilities: list[Quantity]
    assumed: str
    manufacturer: NotRequired[str]
    product: NotRequired[str]
    kind: NotRequired[str]
    numbers: NotRequired[list[CitedQuantity]]
    cited: NotRequired[list[str]]
    """Sources of the numbers."""
    unknown: NotRequired[list[str]]
    disagreements: NotRequired[list[str]]
    estimated: NotRequired[dict[str, str]]
    notes: NotRequired[str]


def describe_motor(
    drive: Drive,
    entry: MotorEntry | None = None,
    loop: ServoLoop | PwmLoop | None = None,
) -> MotorReport:
    """Return all known data of a motor as JSON-serializable values, of which some may be infinite.

    Args:
        drive: drive with motor, controller and supply.
        entry: datasheet of the motor, or None.
        loop: outer loops of a servo, or None.
    """
    parts = {
        "motor": drive.motor,
        "controller": None if isinstance(loop, PwmLoop) else drive.controller,
        "supply": drive.supply,
        "loop": loop,
    }
    simulated = PwmServo(drive.motor, loop, drive.supply) if isinstance(loop, PwmLoop) else drive
    report: MotorReport = {
        "drive": [
            _value(
                f"{part}.{field.name}", getattr(owner, field.name), field.metadata.get("unit", "")
            )
            for part, owner in parts.items()
            if owner is not None
            for field in dataclasses.fields(owner)
            if not (isinstance(owner, PwmLoop) and field.name in ("position_p", "stiffness"))
        ],
        "abilities": [
            _value(name, value, LIMIT_UNITS[name])
            for name, value in drive_limits(drive)._asdict().items()
        ],
        "assumed": simulated.assumed,
    }
    if entry is None:
        return report
    torque = continuous_torque(drive, entry.parameters.continuous_current)
    report["abilities"].insert(2, _value("continuous_torque", torque, "N*m"))
    names = [
        field.name
        for field in dataclasses.fields(MotorParameters)
        if field.name not in ("derived", "disagreements")
    ]
    derived = entry.parameters.derived
    sources = {name: _sources(derived[name], entry) for name in names if name in derived}
    cited = list(dict.fromkeys(source for group in sources.values() for source in group))
    rounded = [
        disagreement.quantity
        for disagreement in entry.parameters.disagreements
        if abs(disagreement.difference) < _ROUNDED
    ]
    reported = [
        str(disagreement)
        for disagreement in entry.parameters.disagreements
        if disagreement.quantity not in rounded
    ]
    if rounded:
        reported.append(f"less than {_ROUNDED:.0%}, by rounding: {', '.join(rounded)}")
    return {
        **report,
        "manufacturer": entry.manufacturer,
        "product": entry.product,
        "kind": entry.kind,
        "numbers": [
            {
                "name": name,
                "value": getattr(entry.parameters, name),
                "unit": QUANTITY_SPECS[PRINTED_NAMES.get(name, name)].unit,
                "how": derived[name],
                "sources": value_sources,
                "places": ", ".join(str(1 + cited.index(citation)) for citation in value_sources),
            }
            for name, value_sources in sources.items()
        ],
        "cited": cited,
        "unknown": [name for name in names if name not in derived],
        "disagreements": reported,
        "estimated": dict(entry.estimated),
        "notes": entry.notes,
    }


def describe_unknown(names: Sequence[str]) -> str:
    """Return a sentence on the unknown numbers of a motor; empty if all are known."""
    words = ", ".join(name.replace("max_", "highest ").replace("_", " ") for name in names)
    return (
        f"Not known: {words} (no source has it, and no other number implies it)." if words else ""
    )


def _value(name: str, value: object, unit: str) -> Quantity:
    """Return an entry of a report."""
    return {"name": name, "value": value, "unit": unit}


def _sources(sentence: str, entry: MotorEntry) -> list[str]:
    """Return the sources of all values that a derivation in `MotorParameters.derived` names."""
    known = (
        entry.sources.get(word) for word in re.findall(r"\w+", sentence.replace("_at_output", ""))
    )
    return list(dict.fromkeys(source for source in known if source is not None))
