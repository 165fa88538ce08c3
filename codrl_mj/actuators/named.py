"""Families and actuators by name, and whatever a user may write for an actuator."""

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.actuators.current_loop import CurrentLoop, DCMotorActuator
from codrl_mj.actuators.drive import Drive
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.ideal import IDEAL, Ideal
from codrl_mj.actuators.model import FAMILIES, ActuatorModel, Family, check_family, family_name
from codrl_mj.actuators.servo import Servo
from codrl_mj.user_code import look_up, read_yaml, trusting_files

NAMED: dict[str, tuple[str, Callable[[DCMotorActuator], ActuatorModel]]] = {
    "ideal": ("force = desired force: no motor at all", lambda _: IDEAL),
    "paper": ("the paper's motor and gains for the task", lambda paper: paper),
    "weak": (
        "the paper's motor under a weak loop: kp = ki = 1",
        lambda paper: dataclasses.replace(paper, controller=CurrentLoop(kp=1.0, ki=1.0)),
    ),
    "weaker": (
        "a weaker loop: kp = ki = 0.2",
        lambda paper: dataclasses.replace(paper, controller=CurrentLoop(kp=0.2, ki=0.2)),
    ),
    "open_loop": (
        "no feedback, u = R*i_ref + kE*omega, and a slow winding: L = 0.5 H",
        lambda paper: DCMotorActuator(
            dataclasses.replace(paper.motor, inductance=0.5),
            CurrentLoop(kp=0.0, kff=paper.motor.resistance),
        ),
    ),
}
"""Name -> (what it is, function from the task's paper actuator to the actuator): variations of the
task's own motor, so that a name means the same kind of actuator on every task.
"""


def find_family(name: str) -> Family:
    """The family called `name`, one of ours or `module:Class` of anybody's, which is imported.

    Raises:
        ValueError: there is none; the nearest known name is suggested.
    """
    family: Family = look_up(name, FAMILIES, "family", of=ActuatorModel)
    check_family(family)
    return family


def actuator_from_mapping(mapping: Mapping[str, Any]) -> Any:
    """The actuator that a mapping of its fields describes; without a `family` it is a `current_loop`.

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


def mapping_of(actuator: ActuatorModel) -> dict[str, Any] | None:
    """The actuator as JSON-serialisable values, which `resolve` reads: None for the ideal one."""
    return None if actuator == IDEAL else actuator.as_mapping()


def display_name(actuator: ActuatorModel, paper: DCMotorActuator | None = None) -> str:
    """What to call an actuator wherever it is shown.

    What it was asked for by (`display_label`), or the motor of the catalogue that has its numbers but
    for gear, loop and supply; of a current loop the variation of `paper` that it is, `custom` if
    none; else its family.
    """
    kind, known = type(actuator), {}
    if kind is DCMotorActuator:
        known = {name: vary(paper) for name, (_, vary) in NAMED.items()} if paper else {}
    elif kind is Drive and not display_label(actuator):
        known = _catalogue()
    family = "custom" if kind is DCMotorActuator else family_name(kind)
    same = (name for name, one in known.items() if one in (actuator, _own_numbers(actuator)))
    return display_label(actuator) or next(same, family)


def combined_name(
    actuators: Iterable[ActuatorModel], papers: Iterable[DCMotorActuator] | None = None
) -> str:
    """What to call several, each name once."""
    pairs = itertools.zip_longest(actuators, papers or ())
    return ", ".join(dict.fromkeys(display_name(one, paper) for one, paper in pairs))


def display_label(actuator: ActuatorModel) -> str:
    """The motor, file or `module:NAME` that an actuator was asked for by; empty where it was none of these.

    It is no field: equality, mappings and hashes of configurations do not know of it.
    """
    return str(vars(actuator).get("_label", ""))


def set_display_name(actuator: ActuatorModel, label: str) -> Any:
    """The very actuator, which must be nobody else's, called something from now on; but for the ideal one."""
    if label and actuator is not IDEAL:
        vars(actuator)["_label"] = str(label)
    return actuator


def is_family(given: Any) -> bool:
    """Return True for a class of actuators, which stands for an actuator with its defaults."""
    return isinstance(given, type) and issubclass(given, ActuatorModel)


def _unshared(actuator: ActuatorModel) -> ActuatorModel:
    return actuator if actuator is IDEAL else copy.copy(actuator)


@functools.cache
def _catalogue() -> dict[str, Any]:
    from codrl_mj.catalogue import motor_entry, motor_names

    return {name: _own_numbers(Drive.from_motor_parameters(motor_entry(name).parameters)) for name in motor_names()}


def _own_numbers(actuator: Any) -> Any:
    """Of a motor all that it is but for the gear that it has here; of other actuators they themselves."""
    motor = getattr(actuator, "motor", None)
    return (
        dataclasses.replace(motor, gear_ratio=1.0, arm_radius=1.0)
        if isinstance(motor, GearMotor)
        else actuator
    )


def named_mapping(actuator: ActuatorModel) -> Any:
    """A mapping for `resolve`: of a motor of the catalogue `name` and what is set over it; else `label` and fields."""
    name, whole = display_label(actuator), mapping_of(actuator) or {}
    if name in _catalogue() and isinstance(actuator, Drive):
        there = resolve(name, None, "a motor").as_mapping()
        short = {
            part: {key: one for key, one in inner.items() if one != (there[part] or {}).get(key)}
            for part, inner in whole.items()
            if inner and inner != there[part]
        }
        if resolve(found := {"name": name, **short}, None, "a motor") == actuator:
            return found
    return {"label": name, **whole} if name else mapping_of(actuator)


def resolve(given: Any, paper: DCMotorActuator | None, whose: str) -> Any:
    """Turn whatever a user may write for an actuator into an `ActuatorModel`.

    Args:
        given: a name of `NAMED`, `FAMILIES` or the catalogue of motors, a motor's TOML file,
            `module:NAME` of an actuator or a family, a YAML or JSON file of such a mapping, an
            actuator, a family's class, a mapping of its fields (with a `name`, over that
            actuator's; with a `label`, what to call it), or None (ideal). Files may be given as a
            `pathlib.Path`.
        paper: the actuator that the names vary; None where there is none.
        whose: whose it is, for messages.

    Raises:
        ValueError: unknown name or field, or a value out of bounds.
    """
    if given is None:
        return IDEAL
    if isinstance(given, ActuatorModel):
        return given
    if is_family(given):
        check_family(given)
        return given()
    if isinstance(given, Mapping) and "label" in given:
        rest = {name: value for name, value in given.items() if name != "label"}
        return set_display_name(_unshared(resolve(rest, paper, whose)), given["label"])
    if isinstance(given, Mapping) and "name" in given:
        changes = {name: value for name, value in given.items() if name != "name"}
        return override_actuator(resolve(given["name"], paper, whose), changes)
    if isinstance(given, Mapping):
        return actuator_from_mapping(given)
    if isinstance(given, Path):
        given = str(given)
    if not isinstance(given, str):
        raise ValueError(
            f"actuator = {given!r}: must be a name ({', '.join(NAMED)}), an actuator or a mapping"
            " of its fields"
        )
    if given == "ideal":
        return IDEAL
    if given in NAMED:
        if paper is None:
            raise ValueError(
                f"actuator = {given!r}: a variation of the paper's actuator, of which {whose} has"
                f" none; known are {', '.join(FAMILIES)}"
            )
        return NAMED[given][1](paper)
    if given not in FAMILIES and Path(given).suffix in _FILES:
        return _from_file(Path(given), paper, whose)
    from codrl_mj.catalogue import motor_entry, motor_names

    if given in motor_names() or Path(given).suffix == ".toml":
        return set_display_name(Drive.from_motor_parameters(motor_entry(given).parameters), Path(given).stem)
    found = look_up(
        given,
        NAMED | FAMILIES,
        "actuator",
        others={"the motors of `codrl-mj motor list`": motor_names()},
    )
    if is_family(found):
        return resolve(found, paper, whose)
    if isinstance(found, ActuatorModel):
        return set_display_name(_unshared(found), given)
    raise ValueError(f"actuator = {given!r}: {found!r} is neither an actuator nor a family of them")


_CHANGED = ", changed"
_FILES = (".yaml", ".yml", ".json")


def _read(path: Path) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """An actuator's fields as its file has them, and what `codrl-mj identify` wrote beside them: `intervals`, `logs`.

    Refuses a file that is no mapping, and one whose motor was not identified: it has a `problem`.
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


def _from_file(path: Path, paper: DCMotorActuator | None, whose: str) -> Any:
    """An actuator from a YAML or JSON file that holds a mapping of its fields."""
    fields, _ = _read(path)
    try:
        other = Path(str(fields.get("name")))
        if other.suffix in _FILES and Path(str(_read(other)[0].get("name"))).suffix in _FILES:
            raise ValueError(
                f"name = {fields['name']!r}: must be an actuator's name, or a file that names no"
                " other"
            )
        with trusting_files():
            made = resolve(fields, paper, whose)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
    stem = path.stem if path.stem not in ("actuator", "actuators") else path.absolute().parent.name
    return made if display_label(made) else set_display_name(_unshared(made), stem)


def identified_ranges(path: Path | str) -> dict[str, str]:
    """What `randomize` draws of an identified actuator: every ratio alike within each interval, or every number.

    Args:
        path: the actuator's file.

    Returns:
        Field -> distribution, as text.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it has no intervals, or must not be used.
    """
    _, section = _read(Path(path))
    if not section:
        raise ValueError(f"{path}: has no intervals; must be a file that `codrl-mj identify` wrote")
    return {
        name: f"{'loguniform' if low > 0.0 else 'uniform'}({float(low)!r}, {float(high)!r})"
        for name, (low, high) in section.get("intervals", {}).items()
    }


def override_actuator(base: ActuatorModel, changes: Mapping[str, Any]) -> Any:
    """An actuator with single fields set over another's.

    Args:
        base: the other one.
        changes: nested, for example `{"controller": {"kp": 2.0}}`. A `family` turns a drive into a
            servo, or back: the motor, the controller and the supply stay the same. A servo that is
            made so and is given no `loop.velocity_gain` gets `Servo.default_velocity_gain`.

    Raises:
        ValueError: a field is unknown or out of bounds, or set over the ideal actuator, which has
            none; or the family is not related to the actuator's.
    """
    given = {name: value for name, value in changes.items() if value != {}}
    kind: Any = type(base)
    family = given.pop("family", family_name(kind))
    family = family_name(family) if is_family(family) else family
    if family == family_name(kind) and not given:
        return base
    if isinstance(base, Ideal):
        raise ValueError(
            "the ideal actuator has no motor and no controller to set fields of: name another"
            " actuator, such as paper"
        )
    if family != family_name(kind):
        kind = _related_family(family, kind)
    _check_fields(given, kind)
    merged: dict[str, Any] = {
        key: value for key, value in base.as_mapping().items() if key in _field_names(kind)
    }
    for name, value in given.items():
        inner = merged.get(name)
        merged[name] = {**(inner or {}), **value} if isinstance(value, Mapping) else value
    made = kind.from_mapping(merged)
    if (
        issubclass(kind, Servo)
        and not isinstance(base, Servo)
        and isinstance(given.get("loop", {}), Mapping)
    ):
        made = made.with_default_gain(given.get("loop", {}))
    label = display_label(base).removesuffix(_CHANGED)
    if kind is not type(base) and label:  # a motor's name alone stands for its drive
        label = label.removesuffix(f" {family_name(type(base))}") + (
            "" if kind is Drive else f" {family}"
        )
    return (
        set_display_name(made, label + _CHANGED * (_own_numbers(made) != _own_numbers(base)))
        if label
        else made
    )


def _related_family(family: str, kind: Any) -> Any:
    """Return the family of a name, to be set over an actuator of a `kind`: one of the two is a subclass of the other.

    A servo is a drive with outer loops, so a drive's motor, controller and supply become a servo's,
    and back.

    Raises:
        ValueError: there is no such family, or it is not related to the kind.
    """
    other = find_family(family)
    if not (issubclass(other, kind) or issubclass(kind, other)):
        raise ValueError(
            f"family = {family!r}: cannot be set over an actuator of the family"
            f" {family_name(kind)!r}, whose fields are others. Name an actuator of a related"
            f" family, or give all fields of the {family!r} without a name. Motors of `codrl-mj"
            " motor list` and of datasheets are drives, which can become servos"
        )
    return other


def _field_names(kind: Any) -> set[str]:
    """Return the names of a family's fields."""
    return {field.name for field in dataclasses.fields(kind)}


def _check_fields(given: Mapping[str, Any], kind: Any) -> None:
    """Refuse fields that the family does not have, but a related family has, with the name of that family."""
    for name in given:
        owners = [
            other
            for other, one in FAMILIES.items()
            if issubclass(one, kind) and name in _field_names(one)
        ]
        if owners and name not in _field_names(kind):
            raise ValueError(
                f"unknown actuator field {name} of a {family_name(kind)}: add family ="
                f" {owners[0]!r}"
            )


def check_same_family(actuators: Sequence[ActuatorModel]) -> Family:
    """The family of several actuators that one environment simulates together.

    Raises:
        ValueError: they are of several.
    """
    kinds = {type(actuator) for actuator in actuators}
    if len(kinds) > 1:
        names = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise ValueError(
            f"actuators of several families ({names}): the actuators of one environment must be"
            " of one"
        )
    family: Family = kinds.pop()
    check_family(family)
    return family
