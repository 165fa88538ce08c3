"""Actuators and families by name, and conversion of user settings to actuators."""

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from codrl_mj.actuators.bam import bam_name, from_bam, is_bam
from codrl_mj.actuators.current_loop import CurrentLoop, DCMotorActuator
from codrl_mj.actuators.drive import Drive
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.geared import Geared
from codrl_mj.actuators.ideal import IDEAL, Ideal
from codrl_mj.actuators.model import FAMILIES, ActuatorModel, Family, check_family, family_name
from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.actuators.pwm_servo import PwmServo
from codrl_mj.actuators.servo import Servo
from codrl_mj.actuators.torque_speed import TorqueSpeed
from codrl_mj.catalogue import joint_names, motor_entry, motor_names
from codrl_mj.fields import nested_types
from codrl_mj.user_code import allow_imports_from_files, look_up, read_yaml

Named = TypeVar("Named", bound=ActuatorModel)
"""Actuator that gets a display name."""
ActuatorSetting = str | Path | ActuatorModel | Family | Mapping[str, FieldValue] | None
"""User's setting for an actuator: see `resolve`."""
NAMED: dict[str, tuple[str, Callable[[DCMotorActuator], ActuatorModel]]] = {
    "ideal": ("no motor, the actual force equals the desired one", lambda _: IDEAL),
    "paper": ("the paper's motor and gains for the task", lambda paper: paper),
    "weak": (
        "the paper's motor with a weak current loop (kp = ki = 1)",
        lambda paper: dataclasses.replace(paper, controller=CurrentLoop(kp=1.0, ki=1.0)),
    ),
    "weaker": (
        "the paper's motor with a weaker current loop (kp = ki = 0.2)",
        lambda paper: dataclasses.replace(paper, controller=CurrentLoop(kp=0.2, ki=0.2)),
    ),
    "open_loop": (
        "no current feedback (u = R*i_ref + kE*omega), and a slow winding (L = 0.5 H)",
        lambda paper: DCMotorActuator(
            dataclasses.replace(paper.motor, inductance=0.5),
            CurrentLoop(kp=0.0, kff=paper.motor.resistance),
        ),
    ),
}
"""Variations of the task's paper actuator, by name: (description, function from the paper's
actuator to the variation). A name thus means the same kind of actuator on every task.
"""


def find_family(name: str) -> Family:
    """Return the family with a name: a built-in one, or `module:Class`, which is imported.

    Raises:
        ValueError: there is no such family; the message suggests the nearest known name.
    """
    family: Family = look_up(name, FAMILIES, "family", base_class=ActuatorModel)
    check_family(family)
    return family


def actuator_from_mapping(mapping: Mapping[str, FieldValue]) -> ActuatorModel:
    """Return the actuator that a mapping of fields describes; `family` defaults to `current_loop`.

    Raises:
        ValueError: unknown family or field, or a value out of bounds.
    """
    fields = dict(mapping)
    if isinstance(motor := fields.get("motor"), str | Path):
        raise ValueError(
            f"motor = {str(motor)!r}: must be a mapping of a motor's fields; for a motor of the"
            f" catalogue or of a file write name = {str(motor)!r} beside the family"
        )
    return find_family(fields.pop("family", DCMotorActuator.family)).from_mapping(fields)


def mapping_of(actuator: ActuatorModel) -> dict[str, FieldValue] | None:
    """Return an actuator as a JSON mapping that `resolve` reads; None for the ideal actuator."""
    return None if actuator == IDEAL else actuator.as_mapping()


def display_name(actuator: ActuatorModel, paper: DCMotorActuator | None = None) -> str:
    """Return the name under which an actuator is displayed.

    This is its label (see `display_label`) if it has one. Without a label, a drive has the name of
    the catalogue motor with the same values, whatever its gear, loop and supply. A current loop has
    the name of the matching variation of `paper`, or `custom`. All others have their family's name.
    """
    kind = type(actuator)
    known: Mapping[str, ActuatorModel | GearMotor] = {}
    if kind is DCMotorActuator:
        known = {name: vary(paper) for name, (_, vary) in NAMED.items()} if paper else {}
    elif kind is Drive and not display_label(actuator):
        known = _catalogue()
    family = "custom" if kind is DCMotorActuator else family_name(kind)
    matches = (
        name
        for name, candidate in known.items()
        if candidate in (actuator, _without_gear(actuator))
    )
    return display_label(actuator) or next(matches, family)


def combined_name(
    actuators: Iterable[ActuatorModel], papers: Iterable[DCMotorActuator] | None = None
) -> str:
    """Return the display names of several actuators, each name once."""
    pairs = itertools.zip_longest(actuators, papers or ())
    return ", ".join(dict.fromkeys(display_name(actuator, paper) for actuator, paper in pairs))


def display_label(actuator: ActuatorModel) -> str:
    """Return the motor, file or `module:NAME` from which an actuator was made; empty if none.

    The label is not a field: equality, mappings and hashes of configurations ignore it.
    """
    return str(vars(actuator).get("_label", ""))


def set_display_name(actuator: Named, label: str) -> Named:
    """Set the actuator's display name in place; the shared ideal actuator is left unchanged."""
    # The dataclass is frozen, so the label is written past its `__setattr__`. Callers pass an
    # actuator that nothing else refers to.
    if label and actuator is not IDEAL:
        vars(actuator)["_label"] = str(label)
    return actuator


def is_family(value: object) -> TypeGuard[Family]:
    """Return True for an actuator class, which as a setting selects its default fields."""
    return isinstance(value, type) and issubclass(value, ActuatorModel)


def _unshared(actuator: ActuatorModel) -> ActuatorModel:
    """Return a copy that can get a display name; the shared ideal actuator is not copied."""
    return actuator if actuator is IDEAL else copy.copy(actuator)


@functools.cache
def _catalogue() -> dict[str, ActuatorModel | GearMotor]:
    return {
        name: _without_gear(Drive.from_motor_parameters(motor_entry(name).parameters))
        for name in motor_names()
    }


def _without_gear(actuator: ActuatorModel) -> ActuatorModel | GearMotor:
    """Return a drive's motor with gear and arm set to 1; other actuators are unchanged."""
    motor = getattr(actuator, "motor", None)
    return (
        dataclasses.replace(motor, gear_ratio=1.0, arm_radius=1.0)
        if isinstance(motor, GearMotor)
        else actuator
    )


def named_mapping(actuator: ActuatorModel) -> dict[str, FieldValue] | None:
    """Return a short mapping for `resolve`: a catalogue motor's `name` and its changed fields.

    Other actuators give their `label` and all fields.
    """
    name, mapping = display_label(actuator), mapping_of(actuator) or {}
    if name in _catalogue() and isinstance(actuator, Drive):
        base = resolve(name, None, "a motor").as_mapping()
        changes = {
            part: {
                key: value
                for key, value in inner.items()
                if value != (base.get(part) or {}).get(key)
            }
            for part, inner in mapping.items()
            if inner and inner != base.get(part)
        }
        if resolve(candidate := {"name": name, **changes}, None, "a motor") == actuator:
            return candidate
    return {"label": name, **mapping} if name else mapping_of(actuator)


def resolve(actuator: ActuatorSetting, paper: DCMotorActuator | None, owner: str) -> ActuatorModel:
    """Convert any user setting for an actuator to an `ActuatorModel`.

    Args:
        actuator: a name of `NAMED`, `FAMILIES` or the catalogue of motors, a motor's TOML file,
            `module:NAME` of an actuator or a family, an actuator, a family's class, a mapping of an
            actuator's fields (with a `name`: changes to that actuator; with a `label`: its display
            name), a YAML or JSON file with such a mapping or from BAM, or None (ideal). Files may
            be given as a `pathlib.Path`.
        paper: the actuator that the names in `NAMED` vary; None if there is none.
        owner: description of the task or environment that gets the actuator, for messages.

    Returns:
        The actuator. A datasheet gives a drive, or a `torque_speed` actuator if it determines no
        winding.

    Raises:
        ValueError: unknown name or field, or a value out of bounds.
    """
    if actuator is None:
        return IDEAL
    if isinstance(actuator, ActuatorModel):
        return actuator
    if is_family(actuator):
        check_family(actuator)
        return actuator()
    if isinstance(actuator, Mapping) and "label" in actuator:
        rest = {name: value for name, value in actuator.items() if name != "label"}
        return set_display_name(_unshared(resolve(rest, paper, owner)), actuator["label"])
    if isinstance(actuator, Mapping) and "name" in actuator:
        changes = {name: value for name, value in actuator.items() if name != "name"}
        return override_actuator(resolve(actuator["name"], paper, owner), changes)
    if isinstance(actuator, Mapping):
        return actuator_from_mapping(actuator)
    if isinstance(actuator, Path):
        actuator = str(actuator)
    if not isinstance(actuator, str):
        raise ValueError(
            f"actuator = {actuator!r}: must be a name ({', '.join(NAMED)}), an actuator or a"
            " mapping of its fields"
        )
    if actuator == "ideal":
        return IDEAL
    if actuator in NAMED:
        if paper is None:
            raise ValueError(
                f"actuator = {actuator!r}: is a variation of the paper's actuator, but {owner} has"
                f" no such actuator; known names: {', '.join(FAMILIES)}"
            )
        return NAMED[actuator][1](paper)
    if actuator not in FAMILIES and Path(actuator).suffix in _FILES:
        return _from_file(Path(actuator), paper, owner)
    known = motor_names() + joint_names()
    if actuator in known or Path(actuator).suffix == ".toml":
        return set_display_name(_from_catalogue(actuator), Path(actuator).stem)
    imported = look_up(
        actuator,
        {**NAMED, **FAMILIES},
        "actuator",
        suggestions={"the motors of `codrl-mj motor list`": known},
    )
    if is_family(imported):
        return resolve(imported, paper, owner)
    if isinstance(imported, ActuatorModel):
        return set_display_name(_unshared(imported), actuator)
    raise ValueError(
        f"actuator = {actuator!r}: {imported!r} must be an actuator or a family of actuators"
    )


def _from_catalogue(name: str) -> ActuatorModel:
    """Return a datasheet's drive, or a torque source if only a torque-speed line is known."""
    entry = motor_entry(name)
    if entry.line is None:
        return Drive.from_motor_parameters(entry.parameters)
    max_torque = math.inf if entry.line.max_torque is None else entry.line.max_torque
    source = TorqueSpeed(entry.line.stall_torque, entry.line.no_load_speed, max_torque)
    # The dataclass is frozen, and the reason is not a field.
    vars(source)["_assumed"] = (
        "assumed: a torque-speed line without winding, current loop and heating, because"
        f" {entry.line.reason}"
    )
    return source


# YAML has no schema: the value may be of any type.
FileEntry = Any
"""Entry of an actuator file's `identified` section."""
_CHANGED = ", changed"
_FILES = (".yaml", ".yml", ".json")


def _read(path: Path) -> tuple[dict[str, FieldValue], Mapping[str, FileEntry]]:
    """Read an actuator's fields, and the `identified` section that `codrl-mj identify` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a mapping, or the identification failed (its section
            has a `problem`).
    """
    if not path.is_file():
        raise FileNotFoundError(f"no actuator file at {path}")
    try:
        fields = read_yaml(path)
        if not isinstance(fields, dict):
            raise ValueError(f"{fields!r}: must be a mapping of an actuator's fields")
        section = fields.pop("identified", None)
        section = section if isinstance(section, Mapping) else {}
        if section.get("problem"):
            raise ValueError(
                f"identified from {', '.join(map(str, section.get('logs', ())))}:"
                f" {section['problem']}"
            )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return fields, section


def _from_file(path: Path, paper: DCMotorActuator | None, owner: str) -> ActuatorModel:
    """Return the actuator in a YAML or JSON file that holds a mapping of its fields."""
    fields, _ = _read(path)
    # Only one level of files is followed, which also excludes files that name each other.
    try:
        named_file = Path(str(fields.get("name")))
        if (
            named_file.suffix in _FILES
            and Path(str(_read(named_file)[0].get("name"))).suffix in _FILES
        ):
            raise ValueError(
                f"name = {fields['name']!r}: must be an actuator's name, or a file that does not"
                " name another file"
            )
        if is_bam(fields):
            return set_display_name(from_bam(fields), bam_name(fields))
        with allow_imports_from_files():
            actuator = resolve(fields, paper, owner)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
    # Runs save their actuator under a generic file name, so the folder's name becomes the label.
    stem = path.stem if path.stem not in ("actuator", "actuators") else path.absolute().parent.name
    return actuator if display_label(actuator) else set_display_name(_unshared(actuator), stem)


def identified_ranges(path: Path | str) -> dict[str, str]:
    """Return distributions for `randomize`: the identified intervals of an actuator's fields.

    Intervals of positive numbers are drawn log-uniformly, so all ratios are equally likely; others
    uniformly.

    Args:
        path: the actuator's file.

    Returns:
        Field -> distribution, as text.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file has no intervals, or the identification failed.
    """
    _, section = _read(Path(path))
    if not section:
        raise ValueError(f"{path}: has no intervals; must be a file that `codrl-mj identify` wrote")
    return {
        name: f"{'loguniform' if low > 0.0 else 'uniform'}({float(low)!r}, {float(high)!r})"
        for name, (low, high) in section.get("intervals", {}).items()
    }


def override_actuator(base: ActuatorModel, changes: Mapping[str, FieldValue]) -> ActuatorModel:
    """Return an actuator with some fields changed.

    Args:
        base: actuator to start from.
        changes: nested, for example `{"controller": {"kp": 2.0}}`. A `family` turns a drive into a
            servo, or back, with the same motor, controller and supply. A servo that is made in this
            way gets `Servo.default_velocity_gain` unless `loop.velocity_gain` is specified.

    Raises:
        ValueError: a field is unknown or out of bounds, or is set on the ideal actuator, which has
            none; or the family is not related to the actuator's.
    """
    fields_set = {name: value for name, value in changes.items() if value != {}}
    kind = type(base)
    family = fields_set.pop("family", family_name(kind))
    family = family_name(family) if is_family(family) else family
    if family == family_name(kind) and not fields_set:
        return base
    if isinstance(base, Ideal):
        raise ValueError(
            "the ideal actuator has no motor and no controller, and so no fields to set: name"
            " another actuator, such as paper"
        )
    if family != family_name(kind):
        kind = _related_family(family, kind)
    _check_fields(fields_set, kind)
    merged = _shared_fields(base, kind)
    loop_fields = fields_set.get("loop", {})
    if issubclass(kind, PwmServo) and type(base) is not kind and isinstance(loop_fields, Mapping):
        merged["loop"] = kind.factory_settings(display_label(base), loop_fields)
    for name, value in fields_set.items():
        inner = merged.get(name)
        merged[name] = {**(inner or {}), **value} if isinstance(value, Mapping) else value
    actuator = kind.from_mapping(merged)
    if (
        isinstance(actuator, Servo)
        and not isinstance(base, Servo)
        and isinstance(loop_fields, Mapping)
    ):
        actuator = actuator.with_default_gain(loop_fields)
    # The plain name of a catalogue motor means its drive, so for other families the label includes
    # the family.
    label = display_label(base).removesuffix(_CHANGED)
    if kind is not type(base) and label:
        label = label.removesuffix(f" {family_name(type(base))}") + (
            "" if kind is Drive else f" {family}"
        )
    return (
        set_display_name(
            actuator, label + _CHANGED * (_without_gear(actuator) != _without_gear(base))
        )
        if label
        else actuator
    )


def _related_family(family: str, kind: Family) -> Family:
    """Return the family with a name, which must have a motor as `kind` has, or be related to it.

    A servo is a drive with outer loops, so a drive's motor, controller and supply become a servo's,
    and back. Motor and supply become those of a `pwm_servo`.

    Raises:
        ValueError: there is no such family, or it is not related to the kind.
    """
    related = find_family(family)
    if not all(issubclass(family, Geared) for family in (related, kind)) and not (
        issubclass(related, kind) or issubclass(kind, related)
    ):
        raise ValueError(
            f"family = {family!r}: cannot replace the family {family_name(kind)!r}, which has"
            f" different fields. Name an actuator of a related family, or leave out the name and"
            f" specify all fields of family {family!r}. Motors of `codrl-mj motor list` and of"
            " datasheets are drives, which can become a servo or a pwm_servo"
        )
    return related


def _field_names(kind: Family) -> set[str]:
    """Return the names of a family's fields."""
    return {field.name for field in dataclasses.fields(kind)}


def _shared_fields(base: ActuatorModel, kind: Family) -> dict[str, FieldValue]:
    """Return those fields of an actuator that a family also has.

    Parts of related classes share fields too: a `SharedSupply` has those of a `Supply`. Parts of
    other classes, such as the loops of two kinds of servo, share none.
    """
    parts, base_parts = nested_types(kind), nested_types(type(base))
    shared = {}
    for name, value in base.as_mapping().items():
        part, base_part = parts.get(name), base_parts.get(name)
        if name not in _field_names(kind):
            continue
        if part is base_part:
            shared[name] = value
        elif part and base_part and (issubclass(part, base_part) or issubclass(base_part, part)):
            known = {field.name for field in dataclasses.fields(part)}
            shared[name] = value and {key: value[key] for key in value if key in known}
    return shared


def _has_field(family: Family, path: str) -> bool:
    """Return True if a family has a field, or a part with a field such as `supply.number`."""
    name, _, inner = path.partition(".")
    part = nested_types(family).get(name)
    return name in _field_names(family) and (
        not inner or part is None or inner in {field.name for field in dataclasses.fields(part)}
    )


def _check_fields(fields_set: Mapping[str, FieldValue], kind: Family) -> None:
    """Raise if only families that the actuator can become have a field; the message names them."""
    paths = [
        path
        for name, value in fields_set.items()
        for path in ([f"{name}.{key}" for key in value] if isinstance(value, Mapping) else [name])
    ]
    for path in paths:
        owners = [
            repr(family)
            for family, family_class in FAMILIES.items()
            if (
                issubclass(family_class, kind)
                or (issubclass(family_class, Geared) and issubclass(kind, Geared))
            )
            and _has_field(family_class, path)
        ]
        if owners and not _has_field(kind, path):
            raise ValueError(
                f"unknown actuator field {path} of a {family_name(kind)}: add family ="
                f" {' or '.join(owners)}"
            )


def check_same_family(actuators: Sequence[ActuatorModel]) -> Family:
    """Return the common family of the actuators of one environment.

    Raises:
        ValueError: the actuators are of several families.
    """
    kinds = {type(actuator) for actuator in actuators}
    if len(kinds) > 1:
        names = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise ValueError(
            f"actuators of several families ({names}): all actuators of an environment must have"
            " the same family"
        )
    family: Family = kinds.pop()
    check_family(family)
    return family
