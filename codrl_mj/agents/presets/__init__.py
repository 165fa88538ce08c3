"""Presets: settings of an agent for a task.

The presets are ours (`default`, `fast`), the paper's (`paper`), and the paper's with repairs
(`repaired`). Each agent has a TOML file in this folder, with a table of the fields of `Preset` for
each task and name. In a table, `"none"` means None, and `like` names earlier settings of the same
task, from which the table starts.
docs/agents.md has the results of training and tests.
"""

import dataclasses
import tomllib
from collections.abc import Mapping
from importlib.resources import files

from codrl_mj.agents import AGENTS, AgentConfig, find_agent
from codrl_mj.boundary import Json

__all__ = ["OTHER_ENV", "PRESETS", "SETTINGS", "Preset", "find_preset"]

SETTINGS = ("default", "paper", "repaired", "fast")
"""Names of settings: ours; the paper's as printed; the paper's with changes where they fail; and
ours for the shortest training time.
"""
OTHER_ENV = "another's environment"
"""Key that stands for any third-party environment, in place of a task."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """Settings of a training: of the agent, its budget and its environments."""

    agent: AgentConfig
    """The agent's settings."""
    total_steps: int | None = None
    """Total number of environment steps; None if `total_episodes` limits the training."""
    total_episodes: int | None = None
    """Total number of training episodes; None if `total_steps` limits the training."""
    num_envs: int = 1
    """Number of parallel environments."""
    env: Mapping[str, Json] = dataclasses.field(default_factory=dict)
    """Fields of the training environment and options of the task that differ from the defaults."""
    about: str = ""
    """Source of the settings; for `repaired`, each deviation from the paper with its reason."""


def _read(agent: str) -> dict[str, dict[str, Preset]]:
    """Read an agent's file as task -> name of the settings -> preset."""
    tasks = tomllib.loads(files(__name__).joinpath(f"{agent}.toml").read_text())
    presets: dict[str, dict[str, Preset]] = {task: {} for task in tasks}
    for task, by_name in tasks.items():
        for name, table in by_name.items():
            like = table.pop("like", None)
            base = presets[task][like] if like else Preset(AGENTS[agent]())
            fields = {
                key: None if value == "none" else value
                for key, value in table.pop("agent", {}).items()
            }
            presets[task][name] = dataclasses.replace(
                base, agent=dataclasses.replace(base.agent, **fields), **table
            )
    return presets


PRESETS: dict[tuple[str, str], dict[str, Preset]] = {
    (agent, task): named for agent in AGENTS for task, named in _read(agent).items()
}
"""(agent, task) -> name of the settings -> preset."""


def find_preset(agent: str, task: str, settings: str = "default") -> Preset:
    """Return the preset of an agent on a task, by the name of its settings.

    A custom agent, or a custom task, has the agent's default settings as `default`.

    Args:
        agent: the agent's name.
        task: the task's name, or `OTHER_ENV`.
        settings: a name of `SETTINGS`.

    Raises:
        ValueError: there is no such preset; the message names those that exist.
    """
    by_name = PRESETS.get((agent, task), {})
    # Built-in agents have no default for a built-in task that they cannot learn.
    is_built_in = (
        ":" not in agent and task != OTHER_ENV and any(name == task for _, name in PRESETS)
    )
    if settings == "default" and not by_name and not is_built_in:
        return Preset(find_agent(agent)(), total_steps=200_000, num_envs=8)
    if settings not in by_name:
        available = "; ".join(
            f"{other_agent}: {', '.join(names)}"
            for (other_agent, name), names in PRESETS.items()
            if name == task
        )
        raise ValueError(
            f"settings = {settings!r}: {agent} on {task} has no such settings; those on {task} are"
            f" {available or 'none'}"
        )
    return by_name[settings]
