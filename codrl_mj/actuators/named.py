"""Families and actuators by name, and whatever a user may write for an actuator."""

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.actuators.current_loop import Actuator, CurrentLoop
from codrl_mj.actuators.drive import Drive
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.ideal import IDEAL, Ideal
from codrl_mj.actuators.model import FAMILIES, ActuatorModel, Family, check_family, family_name
from codrl_mj.own_code import look_up, trusting_files

NAMED: dict[str, tuple[str, Callable[[Actuator], ActuatorModel]]] = {
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
        lambda paper: Actuator(
            dataclasses.replace(paper.motor, inductance=0.5), CurrentLoop(kp=0.0, kff=paper.motor.resistance)
        ),
    ),
}
"""Name -> (what it is, function from the task's paper actuator to the actuator): variations of the task's own motor, so
that a name means the same kind of actuator on every task."""


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
    return find_family(fields.pop("family", Actuator.family)).from_mapping(fields)


def mapping_of(actuator: ActuatorModel) -> dict[str, Any] | None:
    """The actuator as JSON-serialisable values, which `resolve` reads: None for the ideal one."""
    return None if actuator == IDEAL else actuator.as_mapping()


def name_of(actuator: ActuatorModel, paper: Actuator | None = None) -> str:
    """What to call an actuator wherever it is shown.

    What it was asked for by (`label_of`), or the motor of the catalogue that has its numbers but for gear, loop and
    supply; of a current loop the variation of `paper` that it is, `custom` if none; else its family.
    """
    kind, known = type(actuator), {}
    if kind is Actuator:
        known = {name: vary(paper) for name, (_, vary) in NAMED.items()} if paper else {}
    elif kind is Drive and not label_of(actuator):
        known = _catalogue()
    family = "custom" if kind is Actuator else family_name(kind)
    same = (name for name, one in known.items() if one in (actuator, _own_numbers(actuator)))
    return label_of(actuator) or next(same, family)


def names_together(actuators: Iterable[ActuatorModel], papers: Iterable[Actuator] | None = None) -> str:
    """What to call several, each name once."""
    pairs = itertools.zip_longest(actuators, papers or ())
    return ", ".join(dict.fromkeys(name_of(one, paper) for one, paper in pairs))


def label_of(actuator: ActuatorModel) -> str:
    """The motor, file or `module:NAME` that an actuator was asked for by; empty where it was none of these.

    It is no field: equality, mappings and hashes of configurations do not know of it.
    """
    return str(vars(actuator).get("_label", ""))


def labelled(actuator: ActuatorModel, label: str) -> Any:
    """The very actuator, which must be nobody else's, called something from now on; but for the ideal one."""
    if label and actuator is not IDEAL:
        vars(actuator)["_label"] = str(label)
    return actuator


def _unshared(actuator: ActuatorModel) -> ActuatorModel:
    return actuator if actuator is IDEAL else copy.copy(actuator)


@functools.cache
def _catalogue() -> dict[str, Any]:
    from codrl_mj.catalogue import motor_entry, motor_names

    return {name: _own_numbers(Drive.of(motor_entry(name).numbers)) for name in motor_names()}


def _own_numbers(actuator: Any) -> Any:
    """Of a motor all that it is but for the gear that it has here; of other actuators they themselves."""
    motor = getattr(actuator, "motor", None)
    return dataclasses.replace(motor, gear_ratio=1.0, arm_radius=1.0) if isinstance(motor, GearMotor) else actuator


def named_mapping(actuator: ActuatorModel) -> Any:
    """A mapping for `resolve`: of a motor of the catalogue `name` and what is set over it; else `label` and fields."""
    name, whole = label_of(actuator), mapping_of(actuator) or {}
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


def resolve(given: Any, paper: Actuator | None, whose: str) -> Any:
    """Turn whatever a user may write for an actuator into an `ActuatorModel`.

    Args:
        given: a name of `NAMED`, `FAMILIES` or the catalogue of motors, a motor's TOML file, `module:NAME` of an
            actuator or a family, a YAML or JSON file of such a mapping, an actuator, a mapping of its fields (with a
            `name`, over that actuator's; with a `label`, what to call it), or None (ideal). Files may be given as a
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
    if isinstance(given, Mapping) and "label" in given:
        rest = {name: value for name, value in given.items() if name != "label"}
        return labelled(_unshared(resolve(rest, paper, whose)), given["label"])
    if isinstance(given, Mapping) and "name" in given:
        changes = {name: value for name, value in given.items() if name != "name"}
        return actuator_over(resolve(given["name"], paper, whose), changes)
    if isinstance(given, Mapping):
        return actuator_from_mapping(given)
    if isinstance(given, Path):
        given = str(given)
    if not isinstance(given, str):
        raise ValueError(
            f"actuator = {given!r}: must be a name ({', '.join(NAMED)}), an actuator or a mapping of its fields"
        )
    if given == "ideal":
        return IDEAL
    if given in NAMED:
        if paper is None:
            raise ValueError(
                f"actuator = {given!r}: a variation of the paper's actuator, of which {whose} has none; known are "
                f"{', '.join(FAMILIES)}"
            )
        return NAMED[given][1](paper)
    if given not in FAMILIES and Path(given).suffix in _FILES:
        return _from_file(Path(given), paper, whose)
    from codrl_mj.catalogue import motor_entry, motor_names

    if given in motor_names() or Path(given).suffix == ".toml":
        return labelled(Drive.of(motor_entry(given).numbers), Path(given).stem)
    found = look_up(given, NAMED | FAMILIES, "actuator", others={"the motors of `codrl-mj motor list`": motor_names()})
    made = found
    if isinstance(found, type) and issubclass(found, ActuatorModel):
        check_family(found)  # type: ignore[arg-type]
        made = found()
    if isinstance(made, ActuatorModel):
        return made if made is not found else labelled(_unshared(made), given)
    raise ValueError(f"actuator = {given!r}: {found!r} is neither an actuator nor a family of them")


_CHANGED = ", changed"
_FILES = (".yaml", ".yml", ".json")


def _read(path: Path) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """An actuator's fields as its file has them, and what `codrl-mj identify` wrote beside them: `intervals`, `logs`.

    Refuses a file that is no mapping, and one whose motor was not identified: it has a `problem`.
    """
    import yaml

    if not path.is_file():
        raise FileNotFoundError(f"no actuator file at {path}")
    try:
        fields = yaml.safe_load(path.read_text())
        if not isinstance(fields, dict):
            raise ValueError(f"{fields!r}: must be a mapping of an actuator's fields")
        section = fields.pop("identified", None)
        section = section if isinstance(section, Mapping) else {}
        if section.get("problem"):
            raise ValueError(f"identified from {', '.join(map(str, section.get('logs', ())))}: {section['problem']}")
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    return fields, section


def _from_file(path: Path, paper: Actuator | None, whose: str) -> Any:
    """An actuator from a YAML or JSON file that holds a mapping of its fields."""
    fields, _ = _read(path)
    try:
        if Path(str(fields.get("name"))).suffix in _FILES:
            raise ValueError(f"name = {fields['name']!r}: must be an actuator's name, and no file")
        with trusting_files():
            made = resolve(fields, paper, whose)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
    stem = path.stem if path.stem not in ("actuator", "actuators") else path.absolute().parent.name
    return made if label_of(made) else labelled(_unshared(made), stem)


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


def actuator_over(base: ActuatorModel, changes: Mapping[str, Any]) -> Any:
    """An actuator with single fields set over another's.

    Args:
        base: the other one.
        changes: nested, for example `{"controller": {"kp": 2.0}}`.

    Raises:
        ValueError: a field is unknown or out of bounds, or set over the ideal actuator, which has none.
    """
    given = {name: value for name, value in changes.items() if value != {}}
    family = given.pop("family", family_name(type(base)))
    if family != family_name(type(base)):
        raise ValueError(
            f"family = {family!r}: what it is set over is a {family_name(type(base))!r}; give the fields of a "
            f"{family!r} without a name"
        )
    if not given:
        return base
    if isinstance(base, Ideal):
        raise ValueError(
            "the ideal actuator has no motor and no controller to set fields of: name another actuator, such as paper"
        )
    merged: dict[str, Any] = base.as_mapping()
    for name, value in given.items():
        inner = merged.get(name)
        merged[name] = {**(inner or {}), **value} if isinstance(value, Mapping) else value
    made = type(base).from_mapping({name: value for name, value in merged.items() if name != "family"})
    label = label_of(base).removesuffix(_CHANGED)
    return labelled(made, label + _CHANGED * (_own_numbers(made) != _own_numbers(base))) if label else made


def check_same_family(actuators: Sequence[ActuatorModel]) -> Family:
    """The family of several actuators that one environment simulates together.

    Raises:
        ValueError: they are of several.
    """
    kinds = {type(actuator) for actuator in actuators}
    if len(kinds) > 1:
        names = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise ValueError(f"actuators of several families ({names}): the actuators of one environment must be of one")
    family: Family = kinds.pop()
    check_family(family)
    return family
