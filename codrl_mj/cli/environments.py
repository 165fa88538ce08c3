"""The environment that a verb's flags describe."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.actuators import actuator_over, identified_ranges
from codrl_mj.cli.fields import AS_CONFIGURED, AS_TRAINED
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.worlds import find_world


def through(actuators: Sequence[str], name: str) -> str:
    """What to call what `--actuators`, or else `--actuator`, says."""
    return "-".join(dict.fromkeys(Path(each.rpartition("=")[2]).stem for each in actuators)) or name


def environment(verb: Any, task: str, name: str, known: EnvConfig) -> EnvConfig:
    """The environment that a verb's flags, those of `environment_fields`, describe; `known` has their defaults."""
    _warn_of_draws(verb, name, known)
    world, flags = find_world(task), dict(vars(verb.env))
    names = [field.name for field in dataclasses.fields(EnvConfig) if field.name != "options"]
    fields = {name: flags.pop(name) for name in names if name in flags}
    fields |= {part: vars(fields[part]) for part in ("disturbances", "joint") if part in fields}
    options = world.options_of(flags)
    patterns = _patterns(verb.actuators)
    fields["randomize"] = _ranges(fields["randomize"], name, patterns)
    named = known.driven if name in (AS_TRAINED, AS_CONFIGURED) else dict.fromkeys(known.driven, name)
    config = EnvConfig(task, named, options=options)
    if patterns:
        config = EnvConfig(task, world.overlaid(config, patterns), options=options)
    over = _given(verb.actuator_fields)
    changed = {pattern: actuator_over(one, over) for pattern, one in config.driven.items()}
    return EnvConfig(task, changed, options=options, **fields)


def _warn_of_draws(verb: Any, name: str, known: Any) -> None:
    """Say so where draws that come with a run or a file replace numbers of an actuator that was asked for by name."""
    if known is None or not known.randomize or name in (AS_TRAINED, AS_CONFIGURED):
        return
    fields = [text.partition("=")[0] for text in known.randomize if not text.startswith("model.")]
    if fields and tuple(verb.env.randomize or ()) == tuple(known.randomize):
        warnings.warn(
            f"{', '.join(fields)} of {name} are drawn as in the training, whatever {name} has there: for {name} as it "
            "is add --env.randomize None",
            stacklevel=2,
        )


def _patterns(items: Sequence[str]) -> dict[str, Any]:
    """Pattern -> what is behind these actuators, of PATTERN=NAME and of files."""
    from codrl_mj.specs import resolve_patterns

    found: dict[str, Any] = {}
    for item in items:
        if "=" not in item and Path(item).suffix in (".yaml", ".yml", ".json"):
            import yaml

            try:
                content = yaml.safe_load(Path(item).read_text())
                if not isinstance(content, Mapping):
                    raise ValueError("must be a mapping of patterns to actuators")
                found |= resolve_patterns(content, f"the file {item}")
            except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
                raise ValueError(f"--actuators {item}: {error}") from None
        else:
            pattern, equals, name = item.rpartition("=")  # the last: a regular expression may have its own
            if not equals or not pattern:
                raise ValueError(f"--actuators {item}: must be PATTERN=NAME, or a YAML file")
            found[pattern] = name
    return found


def _ranges(randomize: Any, actuator: str, patterns: Mapping[str, Any]) -> Any:
    """What `--env.randomize` says, `identified` replaced by the intervals that the actuators' files have."""
    if randomize is None or "identified" not in randomize:
        return randomize
    others = [one for one in randomize if one != "identified"]
    named = {one.partition("=")[0].strip() for one in others}
    for before, one in [(f"{pattern}:", str(one)) for pattern, one in patterns.items()] or [("", actuator)]:
        if Path(one).suffix not in (".yaml", ".yml", ".json"):
            raise ValueError(
                f"--env.randomize identified: draws within the intervals of a file; --actuator is {one!r}, must be "
                "one that `codrl-mj identify` wrote"
            )
        ranges = {f"{before}{name}": text for name, text in identified_ranges(one).items()}
        others += [f"{name}={text}" for name, text in ranges.items() if name not in named]
    return tuple(others)


def _given(fields: Any) -> dict[str, Any]:
    """What was set, nested."""
    return {
        name: _given(value) if dataclasses.is_dataclass(value) else value
        for name, value in vars(fields).items()
        if value is not None
    }
