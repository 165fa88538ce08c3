"""Files of actuators that were identified: beside the fields, their intervals, or why none can be used.

Their entry `identified` has `intervals`, dotted paths of fields with [low, high], or `problem`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

ENTRY = "identified"


def usable_fields(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """An actuator's fields as its file has them, without the entry."""
    fields = dict(mapping)
    section = fields.pop(ENTRY, None)
    if isinstance(section, Mapping) and section.get("problem"):
        raise ValueError(f"identified from {', '.join(map(str, section.get('logs', ())))}: {section['problem']}")
    return fields


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
    import yaml

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no actuator file at {path}")
    try:
        mapping = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}") from None
    section = mapping.get(ENTRY) if isinstance(mapping, Mapping) else None
    if not isinstance(section, Mapping):
        raise ValueError(f"{path}: has no intervals; must be a file that `codrl-mj identify` wrote")
    try:
        usable_fields(mapping)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return {
        name: f"{'loguniform' if low > 0.0 else 'uniform'}({float(low)!r}, {float(high)!r})"
        for name, (low, high) in section.get("intervals", {}).items()
    }
