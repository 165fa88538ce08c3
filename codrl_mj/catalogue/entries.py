"""The motors in `assets/motors/`, one TOML file each, and anybody's own files of the kind."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codrl_mj.catalogue.datasheet import KINDS, Datasheet, named
from codrl_mj.catalogue.derivation import MotorNumbers
from codrl_mj.fields import check_names
from codrl_mj.tasks.assets import asset_folder

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
    def numbers(self) -> MotorNumbers:
        """What follows from the datasheet, in SI."""
        return self.datasheet.numbers(tolerance=self.tolerance)


def motor_names() -> list[str]:
    """The motors of the catalogue."""
    return sorted(path.stem for path in (asset_folder() / "motors").glob("*.toml"))


def new_motor(path: Path) -> None:
    """Write a file for a motor, to be filled in with what its datasheet prints.

    Raises:
        ValueError: its name does not end in .toml, or it is there already.
    """
    if path.suffix != ".toml" or path.exists():
        raise ValueError(f"{path}: {'is there already' if path.exists() else 'must end in .toml'}: give another name")
    path.write_bytes((asset_folder() / "motor_template.toml").read_bytes())


def motor_entry(name: str) -> MotorEntry:
    """A motor of the catalogue.

    Args:
        name: one of `motor_names()`, or the path of a TOML file of your own, of which [datasheet] is enough.

    Raises:
        ValueError: there is no such motor (the nearest is suggested); the file lacks something or has something
            unknown; or its datasheet is refused, see `from_datasheet`.
    """
    path = Path(name)
    if path.suffix != ".toml":
        check_names([name], motor_names(), "motor", listed_by="codrl-mj motor list")
        path = asset_folder() / "motors" / f"{name}.toml"
    try:
        return _entry(path.stem, tomllib.loads(path.read_text(encoding="utf-8")), name.endswith(".toml"))
    except FileNotFoundError as error:
        raise ValueError(f"motor {name!r}: there is no such file; codrl-mj motor new {name} writes one") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"motor {name!r}: {path} is no TOML file that can be read: {error}") from error
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
            raise ValueError(f"{key} = {value!r}: must be {f'a table, [{key}]' if table else 'text'}")
    printed = {key: value for key, value in named(content["datasheet"]).items() if value != ""}
    content |= {"name": name, "datasheet": Datasheet(**printed), "estimated": named(content["estimated"])}
    _ = MotorEntry(**content).numbers  # refused here, not at first use
    check_names(content["estimated"], printed, "entry", "estimated.")
    sourced = [key for key in printed if key in KINDS and key not in content["estimated"]]
    if content["sources"] or not own:
        content["sources"] = _sources(content["sources"], sourced)
    return MotorEntry(**content)


def _sources(sources: Mapping[str, Any], printed: list[str]) -> dict[str, str]:
    """The source of each printed value, from the values of each source."""
    found: dict[str, str] = {}
    for source, values in sources.items():
        if values != _THE_REST and not (isinstance(values, list) and all(isinstance(one, str) for one in values)):
            raise ValueError(f'sources.{source!r} = {values!r}: must be a list of entries, or "{_THE_REST}"')
        if values != _THE_REST:
            values = named(dict.fromkeys(values, source))
            check_names(values, printed, "entry", f"sources.{source!r}: ")
            found |= values
    rest = [name for name in printed if name not in found]
    for_the_rest = [source for source, values in sources.items() if values == _THE_REST]
    if rest and len(for_the_rest) != 1:
        raise ValueError(f'sources: not one for {", ".join(rest)}; list these, or write "one source" = "{_THE_REST}"')
    return found | dict.fromkeys(rest, "".join(for_the_rest))
