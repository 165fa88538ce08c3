"""The motors in `assets/motors/`, one TOML file each, and anybody's own files of the kind."""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codrl_mj.catalogue.datasheet import KINDS, Datasheet
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

    @functools.cached_property
    def numbers(self) -> MotorNumbers:
        """What follows from the datasheet, in SI."""
        return self.datasheet.numbers(tolerance=self.tolerance)


def motor_names() -> list[str]:
    """The motors of the catalogue."""
    return sorted(path.stem for path in (asset_folder() / "motors").glob("*.toml"))


def motor_entry(name: str) -> MotorEntry:
    """A motor of the catalogue.

    Args:
        name: one of `motor_names()`, or the path of a TOML file of your own.

    Raises:
        ValueError: there is no such motor (the nearest is suggested); the file lacks something or has something
            unknown; or its datasheet is refused, see `from_datasheet`.
    """
    path = Path(name)
    if path.suffix != ".toml":
        check_names([name], motor_names(), "motor", listed_by="codrl-mj motor list")
        path = asset_folder() / "motors" / f"{name}.toml"
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        return _entry(path.stem, content)
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"motor {name!r}: {path} is no TOML file that can be read: {error}") from error
    except ValueError as error:
        raise ValueError(f"motor {name!r} ({path}): {error}") from error


def _entry(name: str, content: dict[str, Any]) -> MotorEntry:
    optional = {"estimated": {}, "notes": "", "tolerance": 0.2}
    known = [f.name for f in dataclasses.fields(MotorEntry) if f.name != "name"]
    check_names(content, known, "entry")
    for key in known:
        if key not in content and key not in optional:
            raise ValueError(f"{key} is missing: write {', '.join(k for k in known if k not in optional)}")
        if key in ("datasheet", "sources", "estimated") and not isinstance(content.get(key, {}), Mapping):
            raise ValueError(f"{key} = {content[key]!r}: must be a table, [{key}]")
    printed, estimated = content["datasheet"], content.get("estimated", {})
    check_names(printed, ("shaft", *KINDS), "entry", "datasheet.", every=True)
    check_names(estimated, printed, "entry", "estimated.")
    entry = MotorEntry(
        **{
            **optional,
            **content,
            "name": name,
            "datasheet": Datasheet(**printed),
            "sources": _sources(content["sources"], [key for key in printed if key in KINDS and key not in estimated]),
        }
    )
    _ = entry.numbers  # refused here, not at first use
    return entry


def _sources(sources: Mapping[str, Any], printed: list[str]) -> dict[str, str]:
    """The source of each printed value, from the values of each source."""
    found: dict[str, str] = {}
    for source, values in sources.items():
        if isinstance(values, str) and values != _THE_REST:
            raise ValueError(f'sources.{source!r} = {values!r}: must be a list of entries, or "{_THE_REST}"')
        if values != _THE_REST:
            check_names(values, printed, "entry", f"sources.{source!r}: ")
            found |= dict.fromkeys(values, source)
    rest = [name for name in printed if name not in found]
    for_the_rest = [source for source, values in sources.items() if values == _THE_REST]
    if rest and len(for_the_rest) != 1:
        raise ValueError(f'sources: not one for {", ".join(rest)}; list these, or write "one source" = "{_THE_REST}"')
    return found | dict.fromkeys(rest, "".join(for_the_rest))
