"""What to train, on what, for how long: from Python, a YAML file or the command line."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codrl_mj.actuators import trusting
from codrl_mj.agents import AgentConfig, agent_from_mapping, check_fits
from codrl_mj.agents.ppo import PPOConfig
from codrl_mj.agents.presets import ELSEWHERE, find_preset
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import Checked, check_names, integer
from codrl_mj.user_code import read_yaml

EVALUATION_SEED = 1_000_000
"""Seed of the first episode in which a trained policy is evaluated, away from those that trainings start from."""


@dataclasses.dataclass(frozen=True)
class TrainConfig(Checked):
    """What to train, on what, for how long.

    Raises:
        ValueError: a field is out of bounds, or the agent cannot act in the task; the message says
            what would do.
    """

    env: EnvConfig
    """What to train in: task, actuator and all else."""
    agent: AgentConfig = PPOConfig()
    """The agent's settings."""
    seed: int = integer(0, minimum=0, maximum=2**32 - 1)
    """Seed of weights, actions and environments, from 0 to 2**32 - 1."""
    total_steps: int | None = integer(200_000, minimum=1, optional=True)
    """Environment steps in all, >= 1; rounded up to whole rollouts. None: until `total_episodes`."""
    num_envs: int = integer(8, minimum=1)
    """Environments side by side, >= 1."""
    total_episodes: int | None = integer(None, minimum=1)
    """Training episodes in all, >= 1, where they and not the steps are counted; None: until `total_steps`."""
    checkpoint_interval: int = integer(20_000, minimum=1)
    """Environment steps between two checkpoints, >= 1; the next end of a rollout counts."""
    evaluation_interval: int = integer(20_000, minimum=1)
    """Environment steps between two evaluations of the greedy policy, >= 1, of which the best policy is kept."""
    evaluation_episodes: int = integer(20, minimum=1)
    """Episodes of each evaluation, >= 1: of the task as Gymnasium poses it, on the actuator trained through."""

    def __post_init__(self) -> None:
        """Validate."""
        for name, kind in {"agent": AgentConfig, "env": EnvConfig}.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(
                    f"TrainConfig.{name} = {getattr(self, name)!r}: must be a {kind.__name__}"
                )
        check_fits(self.agent.known_as(), self.env)
        super().__post_init__()
        if self.total_steps is None and self.total_episodes is None:
            raise ValueError(
                "TrainConfig.total_steps = None: must be an integer >= 1, or total_episodes must"
                " be one"
            )
        if self.total_steps is None and self.env.time_limit is None:
            raise ValueError(
                f"TrainConfig.total_steps = None: {self.task} has no time limit: give"
                " max_episode_steps"
            )

    @property
    def task(self) -> str:
        """Task name."""
        return self.env.task

    @property
    def actuator(self) -> Any:
        """What is trained through; with several motors, or patterns of them, a tuple."""
        return self.env.actuator

    @property
    def actuators(self) -> tuple[Any, ...]:
        """The same, always as a tuple."""
        return self.env.actuators

    @classmethod
    def preset(
        cls,
        task: str,
        agent: str,
        settings: str = "default",
        actuator: Any = "default",
        env: Mapping[str, Any] | None = None,
        **changes: Any,
    ) -> "TrainConfig":
        """Settings that suit an agent to a task.

        Args:
            task: task name.
            agent: the agent's name.
            settings: one of `SETTINGS`: `default`, for some pairs `paper`, `repaired` or `fast`.
            actuator: what to train through.
            env: other fields of the environment, and options of the task, to set otherwise.
            **changes: fields to set otherwise.

        Raises:
            ValueError: there are no such settings, or a field is out of bounds.
        """
        posed = EnvConfig(task, options=(env or {}).get("options"))
        check_fits(agent, posed)
        preset = find_preset(agent, posed.world.preset or ELSEWHERE, settings)
        names = {field.name for field in dataclasses.fields(cls)} - {"env"}
        chosen = {name: value for name, value in vars(preset).items() if name in names}
        fields = {"actuator": actuator, **preset.env, **(env or {}), "task": task}
        return cls(EnvConfig.from_mapping(fields), **(chosen | changes))

    @property
    def evaluation_env(self) -> EnvConfig:
        """What policies are evaluated in: the environment without changes of time limit and reward."""
        changed: dict[str, Any] = dict.fromkeys(self.env.world.posed)
        return dataclasses.replace(self.env, **changed)

    def as_mapping(self) -> dict[str, Any]:
        """The configuration as JSON-serialisable values; `from_mapping` reads it."""
        return {**vars(self), "env": self.env.as_mapping(), "agent": self.agent.as_mapping()}

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], whole: bool = False) -> "TrainConfig":
        """The configuration that a mapping describes: `as_mapping`'s, or any part of it.

        What is not given is the preset's of the given agent (a name, or a mapping with its `name`
        and fields to set) and the given `settings` (`default` if none is named). Task and actuator
        may stand in `env` or above it.

        Args:
            mapping: the fields.
            whole: refuse a mapping that leaves fields out.

        Raises:
            ValueError: a key is unknown (the message suggests one) or missing, or a value out of
                bounds.
        """
        if not isinstance(mapping, Mapping):
            raise ValueError(f"not a training configuration: {mapping!r} is no mapping")
        given = dict(mapping)
        above = {name: given.pop(name) for name in ("task", "actuator") if name in given}
        if isinstance(given.get("env", {}), Mapping):
            given["env"] = {**given.get("env", {}), **above}
        names = [field.name for field in dataclasses.fields(cls)]
        check_names(given, [*names, "task", "actuator", "settings"], "key")
        missing = [name for name in names if name not in given] if whole else []
        if missing:
            raise ValueError(f"not a training configuration: it has no {', '.join(missing)}")
        env, settings, agent = (
            given.pop("env"),
            given.pop("settings", "default"),
            given.pop("agent", None),
        )
        if whole:
            return cls(EnvConfig.from_mapping(env), agent_from_mapping(agent), **given)
        if not isinstance(env, Mapping):
            raise ValueError(f"env = {env!r}: must be a mapping of the environment's arguments")
        if "task" not in env:
            raise ValueError("not a training configuration: it has no task")
        task = env["task"]
        if isinstance(agent, str) or agent is None:
            agent = {"name": agent or default_agent(task, env.get("options"))}
        if not isinstance(agent, Mapping) or "name" not in agent:
            raise ValueError(
                f"agent = {agent!r}: must be an agent's name, or a mapping with its name and"
                " settings"
            )
        own = {"options": env["options"]} if env.get("options") else {}
        base = cls.preset(task, agent["name"], settings, env.get("actuator", "default"), own)
        agent = agent_from_mapping(base.agent.as_mapping() | dict(agent))
        return dataclasses.replace(
            base, env=EnvConfig.from_mapping(env, base.env), agent=agent, **given
        )


def default_agent(task: str, options: Any = None) -> str:
    """The agent that is trained on a task unless another is named; of the five tasks the paper's.

    In environments of others, SAC for continuous actions and PPO for others; their `options` may
    decide on that.
    """
    posed = EnvConfig(task, options=options)
    return posed.world.default_agent(posed)


def read_config(path: Path, trust: bool = False, **overriding: Any) -> TrainConfig:
    """Read a configuration from a YAML (or JSON) file, as `TrainConfig.from_mapping` understands it.

    Args:
        path: the file; a run folder's `config.json` will do as well.
        trust: whether to import the module of an actuator that it names as `module:NAME`, which
            executes it.
        **overriding: top-level keys to set otherwise; None leaves them, and so does the name of the
            agent that the file has settings for.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not YAML, has an unknown key, or a value out of bounds; the message has
            the file's name.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no configuration file at {path}")
    try:
        content = read_yaml(path)
        if isinstance(content, Mapping) and "train" in content:
            content = content["train"]
        if isinstance(content, Mapping):
            agent = content.get("agent")
            if isinstance(agent, Mapping) and agent.get("name") == overriding.get("agent"):
                overriding["agent"] = None
            content = {
                **content,
                **{key: value for key, value in overriding.items() if value is not None},
            }
        with trusting(trust):
            return TrainConfig.from_mapping(content)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
