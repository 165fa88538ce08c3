"""What settings of an agent for a task consist of."""

import dataclasses

from codrl_mj.agents.base import AgentConfig
from codrl_mj.envs.config import EnvConfig


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
    env: EnvConfig = EnvConfig()
    """The environment's arguments in training."""
    about: str = ""
    """Where the settings come from; for `repaired`, every deviation from the paper and why."""
