"""Drives by name, what they can do, and what is known of them; closed forms of V = R*I + kE*omega, behind the gear.

Source: maxon, *Key information on maxon DC and EC motors*; the same relations that
`codrl_mj.catalogue` derives by. As in the simulation, kT*I passes the gear first, which loses 1 -
efficiency of it where it drives and brakes with 1/efficiency - 1 more where it is driven; friction,
n*(c + n*b*|omega|) at the output, opposes the speed behind it. All here is past both: the torque
that moves the load.
"""

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, GearMotor, Servo, ServoLoop, actuator_over, resolve
from codrl_mj.catalogue import MotorEntry, MotorNumbers, motor_entry, motor_names
from codrl_mj.catalogue.datasheet import KINDS
from codrl_mj.catalogue.derivation import OTHER_NAMES
from codrl_mj.fields import check_names


def find_drive(
    name: Any,
    gear_ratio: float | None = None,
    sample_rate: float | None = None,
    bandwidth: float | None = None,
    voltage: float | None = None,
    delayed: bool | None = None,
    max_current: float | None = None,
) -> Drive:
    """A drive by name, of a servo without its outer loops, with single fields set over it; None leaves a field.

    Args:
        name: whatever `codrl_mj.actuators.resolve` takes, such as a motor of the catalogue.
        gear_ratio: turns of the rotor for a turn of the output.
        sample_rate: of the current loop [Hz].
        bandwidth: that the loop's gains are designed for [Hz].
        voltage: of the supply [V].
        delayed: whether a sample's voltage is applied in the next one.
        max_current: that the drive asks for [A].

    Raises:
        ValueError: there is no such actuator (the nearest is suggested), it is no drive, or a value
            is out of bounds.
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
    base = resolve(name, None, "a motor on its own")
    if isinstance(base, Servo):
        base = actuator_over(base, {"family": Drive.family})
    if type(base) is not Drive:
        raise ValueError(
            f"motor = {name!r}: no motor behind a drive, but the actuator family {base.family};"
            " name a motor of the catalogue (codrl-mj motor list), a TOML file with a datasheet,"
            " or an actuator of the family drive"
        )
    given = {
        part: {key: value for key, value in to.items() if value is not None}
        for part, to in changes.items()
    }
    return actuator_over(base, given)


def find_entry(name: Any) -> MotorEntry | None:
    """The datasheet that a name of `find_drive` stands for; None where it is not one's."""
    known = isinstance(name, str) and (name in motor_names() or name.endswith(".toml"))
    return motor_entry(name) if known else None


class Abilities(NamedTuple):
    """What a drive can do at its supply's voltage, `max_current` aside in all but power and peak torque."""

    power: float
    """The most mechanical power [W] of the motor, gear and friction aside: see `max_power`."""
    peak_torque: float
    """As the stall torque [N*m], within `max_current`."""

    stall_torque: float
    """Of the output that just turns [N*m]; a gear does not lose anything where it stands still."""
    stall_current: float
    """Of the blocked motor [A]: V/R."""
    no_load_speed: float
    """Of the free output [rad/s]; infinite without back-EMF and viscous friction."""
    no_load_current: float
    """Of the free motor [A], which overcomes its friction."""
    electrical_time_constant: float
    """L/R [s]."""
    mechanical_time_constant: float
    """Of the free motor's speed [s], R*J/(kT*kE), at the rotor; NaN where its inertia is not known: 0."""


ABILITY_UNITS = dict(
    zip(Abilities._fields, ("W", "N*m", "N*m", "A", "rad/s", "A", "s", "s"), strict=True)
)
"""Their units."""


def abilities(drive: Drive) -> Abilities:
    """What a drive can do."""
    motor, resistance = drive.motor, drive.motor.resistance + drive.sag
    passed = motor.torque_constant * motor.gear_efficiency  # [N*m/A]
    per_torque = resistance / passed  # [V/(N*m)]
    slope = motor.back_emf_constant + per_torque * motor.viscous_friction
    left = max(drive.voltage_limit - per_torque * motor.coulomb_friction, 0.0)
    speed = left / slope if slope > 0.0 else math.inf
    friction = motor.coulomb_friction + (
        motor.viscous_friction * speed if motor.viscous_friction > 0.0 else 0.0
    )
    stall = drive.voltage_limit / resistance
    peak, blocked = _at_output(
        motor, np.array([min(stall, drive.controller.max_current), stall]), np.zeros(2)
    )
    return Abilities(
        max_power(drive),
        float(peak),
        float(blocked),
        stall,
        speed / motor.gear_ratio,
        friction / passed,
        motor.electrical_time_constant,
        motor.mechanical_time_constant if motor.rotor_inertia > 0.0 else math.nan,
    )


def max_power(drive: Drive) -> float:
    """The most mechanical power [W], i (V - R i) kT/kE, R of winding and supply; infinite without back-EMF."""
    motor, limit, resistance = drive.motor, drive.voltage_limit, drive.motor.resistance + drive.sag
    current = min(limit / resistance / 2, drive.controller.max_current)
    power = current * (limit - resistance * current) * motor.torque_constant
    return power / motor.back_emf_constant if motor.back_emf_constant else math.inf


def continuous_torque(drive: Drive, current: float | None) -> float | None:
    """Torque [N*m] that the output that just turns bears for ever, by the winding's current [A]; None: not known."""
    return (
        None
        if current is None
        else float(_at_output(drive.motor, np.array(current), np.array(0.0)))
    )


def diagram_limits(drive: Drive, numbers: Any = None) -> list[tuple[str, float, int]]:
    """The limits in a torque-speed diagram: name, current [A], and 0 of the voltage (infinite), 1 peak, 2 continuous.

    Raises:
        ValueError: the drive has no no-load speed to end the diagram at.
    """
    can, most = abilities(drive), drive.controller.max_current
    if not 0.0 < can.no_load_speed < math.inf or can.stall_torque <= 0.0:
        raise ValueError(
            f"GearMotor.back_emf_constant = {drive.motor.back_emf_constant:g}, Supply.voltage ="
            f" {drive.voltage_limit:g}: the no-load speed is {can.no_load_speed:g} rad/s and the"
            f" stall torque {can.stall_torque:g} N*m, must be finite and > 0 for a torque-speed"
            " diagram; give a back-EMF constant, and a voltage that overcomes the friction"
        )
    lines = [(f"voltage, {drive.voltage_limit:g} V", math.inf, 0)]
    if math.isfinite(most):
        lines.append((f"peak current, {most:.3g} A", most, 1))
    continuous = getattr(numbers, "continuous_current", None)
    return (
        lines
        if continuous is None
        else [*lines, (f"continuous current, {continuous:.3g} A", continuous, 2)]
    )


def torque_limits(
    drive: Drive, speeds: Any, current: float = math.inf
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest steady torque [N*m] at the output, by voltage and current.

    Above the no-load speed the back-EMF alone drives a current, whatever the limit of it.

    Args:
        drive: whose.
        speeds: of the output [rad/s], any shape.
        current: within plus and minus this [A], such as the drive's `max_current`.
    """
    speeds = np.asarray(speeds, dtype=float)
    back_emf = drive.motor.back_emf_constant * drive.motor.gear_ratio * speeds
    winding = drive.motor.resistance, drive.voltage_limit, drive.sag
    lowest, highest = -highest_current(*winding, -back_emf), highest_current(*winding, back_emf)
    low, high = (np.clip(bound, lowest, highest) for bound in (-current, current))
    return _at_output(drive.motor, low, speeds), _at_output(drive.motor, high, speeds)


def highest_current(
    resistance: float, voltage: float, sag: float, back_emf: np.ndarray
) -> np.ndarray:
    """Highest steady current [A] of a winding R: that of u = max(V - Rs*|i|, 0), Rs the sag; at u = 0 it is -b/R."""
    against = max(resistance - sag, 1e-9 * resistance)  # where i < 0, beyond the no-load speed
    driven = (voltage - back_emf) / np.where(back_emf > voltage, against, resistance + sag)
    return np.maximum(driven, -back_emf / resistance)


def _at_output(motor: GearMotor, current: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Torque [N*m] that a current [A] leaves at the output, at its speed [rad/s]."""
    torque = motor.torque_constant * current
    torque = torque * np.where(
        torque * speed >= 0.0, motor.gear_efficiency, 1.0 / motor.gear_efficiency
    )
    friction = motor.coulomb_friction + motor.viscous_friction * motor.gear_ratio * np.abs(speed)
    friction = friction + motor.stribeck(motor.gear_ratio * speed)
    still = np.sign(torque) * np.maximum(np.abs(torque) - friction, 0.0)
    return motor.gear_ratio * np.where(speed == 0.0, still, torque - friction * np.sign(speed))


# -- what is known of them ----------------------------------------------------------------------------------------

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
    *Abilities._fields,
    "continuous_torque",
)
"""What a row of `catalogue_rows` has, in SI."""
_ROUNDED = 0.01
"""Relative difference up to which a datasheet's values are taken to be rounded."""


def catalogue_rows(sort: str = "name") -> list[dict[str, Any]]:
    """Every motor of the catalogue at its nominal voltage, or 24 V; None where a number is not known.

    Args:
        sort: one of `COLUMNS`: names and kinds from A, numbers from the highest, unknown ones last.

    Raises:
        ValueError: there is no such column; the nearest is suggested.
    """
    check_names([sort], COLUMNS, "column")
    rows = []
    for entry in map(motor_entry, motor_names()):
        numbers, drive = entry.numbers, Drive.of(entry.numbers)
        can = abilities(drive)._asdict()
        known = {name: getattr(numbers, name) for name in COLUMNS[2:8]}
        known |= {name: value if math.isfinite(value) else None for name, value in can.items()}
        known["continuous_torque"] = continuous_torque(drive, numbers.continuous_current)
        rows.append({"name": entry.name, "kind": entry.kind, **known})
    if sort in ("name", "kind"):
        return sorted(rows, key=lambda row: row[sort])
    return sorted(rows, key=lambda row: (row[sort] is None, -(row[sort] or 0.0)))


def find_loop(name: Any) -> ServoLoop | None:
    """Return the outer loops of the servo that a name of `find_drive` stands for; None where it is no servo's."""
    base = resolve(name, None, "a motor on its own")
    return base.loop if isinstance(base, Servo) else None


def explain(
    drive: Drive, entry: MotorEntry | None = None, loop: ServoLoop | None = None
) -> dict[str, Any]:
    """All that is known of a motor: JSON-serialisable but for infinite values.

    Args:
        drive: the motor with its drive.
        entry: its datasheet, where it has one.
        loop: the outer loops, where it is a servo's.

    Returns:
        `drive`, the fields of motor, controller, supply and loop, and `abilities`, each a list of
        mappings with `name`, `value` and `unit`; `assumed`; and of a datasheet `manufacturer`,
        `product`, `kind`, `numbers`, such mappings with `how` it came about, its `sources` and
        their `places`, from 1, among all that are `cited`, `unknown`, `disagreements`, `estimated`
        and `notes`.
    """
    parts: dict[str, Any] = {
        "motor": drive.motor,
        "controller": drive.controller,
        "supply": drive.supply,
    }
    parts["loop"] = loop
    found: dict[str, Any] = {
        "drive": [
            _value(
                f"{part}.{field.name}", getattr(owner, field.name), field.metadata.get("unit", "")
            )
            for part, owner in parts.items()
            if owner is not None
            for field in dataclasses.fields(owner)
        ],
        "abilities": [
            _value(name, value, ABILITY_UNITS[name])
            for name, value in abilities(drive)._asdict().items()
        ],
        "assumed": drive.assumed,
    }
    if entry is None:
        return found
    torque = continuous_torque(drive, entry.numbers.continuous_current)
    found["abilities"].insert(2, _value("continuous_torque", torque, "N*m"))
    names = [
        field.name
        for field in dataclasses.fields(MotorNumbers)
        if field.name not in ("derived", "disagreements")
    ]
    derived = entry.numbers.derived
    sources = {name: _sources(derived[name], entry) for name in names if name in derived}
    cited = list(dict.fromkeys(source for several in sources.values() for source in several))
    rounded = [
        one.quantity for one in entry.numbers.disagreements if abs(one.difference) < _ROUNDED
    ]
    told = [str(one) for one in entry.numbers.disagreements if one.quantity not in rounded]
    if rounded:
        told.append(f"less than {_ROUNDED:.0%}, by rounding: {', '.join(rounded)}")
    return found | {
        **{name: getattr(entry, name) for name in ("manufacturer", "product", "kind")},
        "numbers": [
            _value(name, getattr(entry.numbers, name), KINDS[OTHER_NAMES.get(name, name)].unit)
            | {
                "how": derived[name],
                "sources": own,
                "places": ", ".join(str(1 + cited.index(one)) for one in own),
            }
            for name, own in sources.items()
        ],
        "cited": cited,
        "unknown": [name for name in names if name not in derived],
        "disagreements": told,
        "estimated": dict(entry.estimated),
        "notes": entry.notes,
    }


def describe_unknown(names: Sequence[str]) -> str:
    """What is said of a motor's unknown numbers; empty where all are known."""
    words = ", ".join(name.replace("max_", "highest ").replace("_", " ") for name in names)
    return (
        f"Not known: {words} (no source has it, and no other number implies it)." if words else ""
    )


def _value(name: str, value: Any, unit: str) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit}


def _sources(sentence: str, entry: MotorEntry) -> list[str]:
    """Where the printed values that a sentence of `MotorNumbers.derived` names were found."""
    known = (
        entry.sources.get(word) for word in re.findall(r"\w+", sentence.replace("_at_output", ""))
    )
    return list(dict.fromkeys(source for source in known if source is not None))
