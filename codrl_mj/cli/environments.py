"""The environment that a verb's flags describe, a task's or somebody else's."""

import dataclasses
import json
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from codrl_mj.actuators import IDEAL, actuator_over, identified_ranges
from codrl_mj.cli.fields import AS_CONFIGURED, AS_TRAINED, named_actuators, task_options
from codrl_mj.envs.config import EnvConfig
from codrl_mj.foreign.config import EVERY, ForeignConfig, is_gymnasium_id
from codrl_mj.tasks import find_task, resolve_actuators


def default_actuator(task: str) -> str:
    """The name of what a task goes through unless told otherwise; in an environment of somebody else's nothing."""
    return "ideal" if is_gymnasium_id(task) else find_task(task).default_actuator


def through(actuators: Sequence[str], name: str) -> str:
    """What to call what `--actuators`, or else `--actuator`, says."""
    return "-".join(dict.fromkeys(Path(each.rpartition("=")[2]).stem for each in actuators)) or name


def environment(verb: Any, task: str, name: str, known: Any = None) -> EnvConfig | ForeignConfig:
    """The environment that a verb's flags, those of `environment_fields`, describe; `known` has those of its run."""
    _warn_of_draws(verb, name, known)
    if is_gymnasium_id(task):
        return _foreign_environment(verb, task, name, known)
    given: dict[str, Any] = dict(vars(verb.env))
    nested: dict[str, Any] = {name: vars(given.pop(name)) for name in ("disturbances", "joint")}
    options = {name: value for name in task_options() if (value := given.pop(name, None)) is not None}
    from codrl_mj.specs import matched_by, refuse_unmatched  # heavy

    given["randomize"] = _ranges(given["randomize"], name)
    actuators = list(known.actuators if name in (AS_TRAINED, AS_CONFIGURED) else named_actuators(name, task))
    definition = find_task(task)
    for pattern, other in _patterns(verb.actuators).items():
        matched = matched_by(pattern, [[motor] for motor in definition.motors])
        if not matched:
            refuse_unmatched(pattern, [[motor] for motor in definition.motors])
        for index in matched:
            actuators[index] = resolve_actuators(other, definition)[index]
    changed = [actuator_over(one, _given(verb.actuator_fields)) for one in actuators]
    return EnvConfig(task, changed, options=options, **given, **nested)


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


def _foreign_environment(verb: Any, task: str, name: str, known: Any) -> ForeignConfig:
    """`environment` of somebody else's."""
    given: dict[str, Any] = dict(vars(verb.env))
    options = {key: _value(text) for key, text in _pairs(given.pop("options"), "--env.options", str.partition).items()}
    disturbances = vars(given.pop("disturbances"))
    actuators = _patterns(verb.actuators)
    if "identified" in (given["randomize"] or ()) and verb.actuators:
        every = [(pattern, _ranges(("identified",), str(one))) for pattern, one in actuators.items()]
        drawn = [f"{pattern}:{text}" for pattern, texts in every for text in texts]
        given["randomize"] = (*(one for one in given["randomize"] if one != "identified"), *drawn)
    given["randomize"] = _ranges(given["randomize"], name)
    if name in (AS_TRAINED, AS_CONFIGURED):
        base = known.actuators
    else:
        base = dict.fromkeys([EVERY] if known is None else known.actuators, name)
    if not actuators:
        actuators = base
    elif any(one != IDEAL for one in ForeignConfig(task, base).actuator):
        actuators = _overlaid(ForeignConfig(task, base, options=options), actuators)
    made = ForeignConfig(task, actuators).actuators
    over = _given(verb.actuator_fields)
    changed = {pattern: actuator_over(one, over) for pattern, one in made.items()}
    return ForeignConfig(task, changed, options=options, disturbances=disturbances, **given)


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
            found |= _pairs([item], "--actuators")
    return found


def _overlaid(base: ForeignConfig, patterns: Mapping[str, Any]) -> dict[str, Any]:
    """What drives an environment's motors: some patterns, and what else it has, motor by motor."""
    from codrl_mj.specs import matched_by, names_of

    env: Any = base.make()
    names = names_of(env.unwrapped.model)
    env.close()
    taken = {index for pattern in patterns for index in matched_by(pattern, names)}
    left = {
        re.escape(names[index][0]): actuator
        for pattern, actuator in base.actuators.items()
        for index in matched_by(pattern, names)
        if index not in taken
    }
    return {**left, **patterns}


def _pairs(items: Sequence[str], flag: str, split: Callable[[str, str], Any] = str.rpartition) -> dict[str, str]:
    """Name -> value of NAME=VALUE, split at the last '=', as names may be regular expressions, or at the first."""
    pairs = {}
    for item in items:
        name, equals, value = split(item, "=")
        if not equals or not name:
            raise ValueError(f"{flag} {item}: must be NAME=VALUE, or for --actuators a YAML file")
        pairs[name] = value
    return pairs


def _value(text: str) -> Any:
    """What a text is as JSON, or else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _ranges(randomize: Any, actuator: str) -> Any:
    """What `--env.randomize` says, `identified` replaced by the intervals that the actuator's file has."""
    if randomize is None or "identified" not in randomize:
        return randomize
    if Path(actuator).suffix not in (".yaml", ".yml", ".json"):
        raise ValueError(
            f"--env.randomize identified: draws within the intervals of a file; --actuator is {actuator!r}, must be "
            "one that `codrl-mj identify` wrote"
        )
    others = [one for one in randomize if one != "identified"]
    named = {one.partition("=")[0].strip() for one in others}
    return (*others, *(f"{name}={text}" for name, text in identified_ranges(actuator).items() if name not in named))


def _given(fields: Any) -> dict[str, Any]:
    """What was set, nested."""
    return {
        name: _given(value) if dataclasses.is_dataclass(value) else value
        for name, value in vars(fields).items()
        if value is not None
    }
