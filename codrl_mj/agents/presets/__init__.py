"""Settings that suit an agent to a task, by name: `default`, the paper's own (`paper`), and those mended (`repaired`).

One module an agent. What the numbers gave, in training and in test, is in docs/agents.md.
"""

from codrl_mj.agents import find_agent
from codrl_mj.agents.presets import ddpg, dqn, ppo, sac, sarsa, td3
from codrl_mj.agents.presets.preset import ELSEWHERE, Preset

__all__ = ["ELSEWHERE", "PRESETS", "SETTINGS", "Preset", "find_preset"]

SETTINGS = ("default", "paper", "repaired")
"""Names that settings can have: ours, the paper's as printed, and the paper's with what makes it fail changed."""

PRESETS: dict[tuple[str, str], dict[str, Preset]] = {
    (agent.__name__.rpartition(".")[2], task): named
    for agent in (ppo, ddpg, dqn, td3, sac, sarsa)
    for task, named in agent.PRESETS.items()
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
        there = "; ".join(f"{other}: {', '.join(names)}" for (other, of), names in PRESETS.items() if of == task)
        raise ValueError(
            f"settings = {settings!r}: {agent} on {task} has no such settings; those on {task} are {there or 'none'}"
        )
    return named[settings]
