"""What settings of an agent for a task consist of."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from codrl_mj.agents.base import AgentConfig

ELSEWHERE = "another's environment"
"""Instead of a task: any environment that is none of ours."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """How an agent learns a task: its settings, its budget and what it trains in."""

    agent: AgentConfig
    """The agent's settings."""
    total_steps: int | None
    """Environment steps in all; None where the episodes are counted."""
    total_episodes: int | None = None
    """Training episodes in all; None where the steps are counted."""
    num_envs: int = 1
    """Environments side by side."""
    env: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the environment in training, and options of the task, that are not at their defaults."""
    about: str = ""
    """Where the settings come from; for `repaired`, every deviation from the paper and why."""
