"""Settings that suit an agent and a task: ours (`default`, `fast`), the paper's (`paper`), these mended (`repaired`).

One TOML file an agent beside this module: a table for each task and name with the fields of
`Preset`, where `"none"` stands for None, and `like` names the settings above that it starts from.
What the numbers gave, in training and in test, is in docs/agents.md.
"""

import dataclasses
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from codrl_mj.agents import AGENTS, AgentConfig, find_agent

__all__ = ["ELSEWHERE", "PRESETS", "SETTINGS", "Preset", "find_preset"]

SETTINGS = ("default", "paper", "repaired", "fast")
"""Names that settings can have: ours, the paper's as printed, the paper's with what makes it fail
changed, and ours for the least time.
"""
ELSEWHERE = "another's environment"
"""Instead of a task: any environment that is none of ours."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """How an agent learns a task: its settings, its budget and what it trains in."""

    agent: AgentConfig
    """The agent's settings."""
    total_steps: int | None = None
    """Environment steps in all; None where the episodes are counted."""
    total_episodes: int | None = None
    """Training episodes in all; None where the steps are counted."""
    num_envs: int = 1
    """Environments side by side."""
    env: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the environment in training, and options of the task, that are not at their defaults."""
    about: str = ""
    """Where the settings come from; for `repaired`, every deviation from the paper and why."""


def _read(agent: str) -> dict[str, dict[str, Preset]]:
    """An agent's file: task -> name of the settings -> the settings."""
    tasks = tomllib.loads(files(__name__).joinpath(f"{agent}.toml").read_text())
    presets: dict[str, dict[str, Preset]] = {task: {} for task in tasks}
    for task, named in tasks.items():
        for name, table in named.items():
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
"""(agent, task) -> name of the settings -> the settings."""


def find_preset(agent: str, task: str, settings: str = "default") -> Preset:
    """The settings of that name for an agent on a task; the agent's own defaults where somebody brought one of them.

    Args:
        agent: its name.
        task: the task's name, or `ELSEWHERE`.
        settings: one of `SETTINGS`.

    Raises:
        ValueError: there are none; the message names those that exist.
    """
    named = PRESETS.get((agent, task), {})
    ours = ":" not in agent and task != ELSEWHERE and any(of == task for _, of in PRESETS)
    if settings == "default" and not named and not ours:
        return Preset(find_agent(agent)(), total_steps=200_000, num_envs=8)
    if settings not in named:
        there = "; ".join(
            f"{other}: {', '.join(names)}" for (other, of), names in PRESETS.items() if of == task
        )
        raise ValueError(
            f"settings = {settings!r}: {agent} on {task} has no such settings; those on {task} are"
            f" {there or 'none'}"
        )
    return named[settings]
