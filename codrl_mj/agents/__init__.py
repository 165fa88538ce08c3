"""Agents: learning algorithms with their settings."""

from collections.abc import Mapping

from codrl_mj.agents.base import AgentConfig, DeepAgentConfig
from codrl_mj.agents.off_policy import DDPGConfig, DQNConfig, SACConfig, TD3Config
from codrl_mj.agents.ppo import PPOConfig
from codrl_mj.agents.sarsa import SARSAConfig
from codrl_mj.boundary import Json
from codrl_mj.envs.config import EnvConfig
from codrl_mj.user_code import look_up

AGENTS: dict[str, type[AgentConfig]] = {
    config.name: config
    for config in (PPOConfig, DDPGConfig, DQNConfig, TD3Config, SACConfig, SARSAConfig)
}
"""Classes of the agents' settings by the agents' names."""

__all__ = [
    "AGENTS",
    "AgentConfig",
    "DDPGConfig",
    "DQNConfig",
    "DeepAgentConfig",
    "PPOConfig",
    "SACConfig",
    "SARSAConfig",
    "TD3Config",
    "agent_from_mapping",
    "check_fits",
    "find_agent",
]


def find_agent(name: str) -> type[AgentConfig]:
    """Return the class of an agent's settings by its name.

    Args:
        name: a key of `AGENTS`, or `module:Class` of a custom `AgentConfig`, which is imported.

    Raises:
        ValueError: unknown agent; the nearest known one is suggested.
    """
    agent: type[AgentConfig] = look_up(name, AGENTS, "agent", base_class=AgentConfig)
    return agent


def agent_from_mapping(mapping: Mapping[str, Json]) -> AgentConfig:
    """Return an agent's settings from the result of `AgentConfig.as_mapping`.

    Raises:
        ValueError: unknown agent, or a field that is unknown or out of bounds.
    """
    settings = dict(mapping)
    return find_agent(str(settings.pop("name", None))).from_mapping(settings)


def check_fits(agent: str, env: EnvConfig) -> None:
    """Raise an error if an agent cannot act in an environment's action space.

    Args:
        agent: the agent's name.
        env: settings of the environment.

    Raises:
        ValueError: it cannot; the message names the agents that can.
    """
    space = env.action_space
    if not isinstance(space, find_agent(agent).action_spaces):
        fitting = [
            name for name, config in AGENTS.items() if isinstance(space, config.action_spaces)
        ]
        raise ValueError(
            f"agent = {agent!r}: cannot act in the {type(space).__name__} actions of {env.task};"
            f" agents that can: {', '.join(fitting) or 'none'}"
        )
