"""Configuration of a training, from Python, a YAML file or the command line."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, allow_imports
from codrl_mj.agents import AgentConfig, agent_from_mapping, check_fits
from codrl_mj.agents.ppo import PPOConfig
from codrl_mj.agents.presets import OTHER_ENV, find_preset
from codrl_mj.boundary import Argument, Json, JsonObject, Options
from codrl_mj.envs.config import EnvConfig, check_time_limit
from codrl_mj.fields import Checked, check_names, integer
from codrl_mj.user_code import read_yaml

EVALUATION_SEED = 1_000_000
"""Seed of the first evaluation episode, far from the seeds of trainings."""


@dataclasses.dataclass(frozen=True)
class TrainConfig(Checked):
    """Configuration of a training: the environment, the agent and the budget.

    Raises:
        ValueError: a field is out of bounds, or the agent cannot act in the task; the message names
            the alternatives.
    """

    env: EnvConfig
    """Training environment: task, actuator and all other settings."""
    agent: AgentConfig = PPOConfig()
    """The agent's settings."""
    seed: int = integer(0, minimum=0, maximum=2**32 - 1)
    """Seed of weights, actions and environments, from 0 to 2**32 - 1."""
    total_steps: int | None = integer(200_000, minimum=1, optional=True)
    """Total environment steps, >= 1; rounded up to whole rollouts. None: until `total_episodes`."""
    num_envs: int = integer(8, minimum=1)
    """Number of parallel environments, >= 1."""
    total_episodes: int | None = integer(None, minimum=1)
    """Total number of training episodes, >= 1; None: until `total_steps`."""
    checkpoint_interval: int = integer(20_000, minimum=1)
    """Environment steps between two checkpoints, >= 1; rounded up to the end of a rollout."""
    evaluation_interval: int = integer(20_000, minimum=1)
    """Environment steps between two evaluations of the greedy policy, >= 1; the best policy is
    saved.
    """
    evaluation_episodes: int = integer(20, minimum=1)
    """Episodes of each evaluation, >= 1, on the task with Gymnasium's time limit and reward and
    with the training's actuator.
    """

    def __post_init__(self) -> None:
        """Validate."""
        for name, kind in {"agent": AgentConfig, "env": EnvConfig}.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(
                    f"TrainConfig.{name} = {getattr(self, name)!r}: must be a {kind.__name__}"
                )
        check_fits(self.agent.registry_name(), self.env)
        super().__post_init__()
        if self.total_steps is None and self.total_episodes is None:
            raise ValueError(
                "TrainConfig.total_steps = None: must be an integer >= 1 unless total_episodes is"
                " set"
            )
        check_time_limit(self.env)

    @property
    def task(self) -> str:
        """Task name."""
        name: str = self.env.task
        return name

    @property
    def actuator(self) -> object:
        """Actuator in training; a tuple if there are several motors or patterns of motor names."""
        return self.env.actuator

    @property
    def actuators(self) -> tuple[ActuatorModel, ...]:
        """Actuators in training, always as a tuple."""
        return self.env.actuators

    @classmethod
    def preset(
        cls,
        task: str,
        agent: str,
        settings: str = "default",
        actuator: object = "default",
        env: Mapping[str, Argument] | None = None,
        **changes: Argument,
    ) -> "TrainConfig":
        """Return the preset configuration of an agent on a task.

        Args:
            task: task name.
            agent: the agent's name.
            settings: a name of `SETTINGS`: `default`; for some pairs of task and agent `paper`,
                `repaired` or `fast`.
            actuator: actuator in training.
            env: values of other fields of the environment, and of options of the task.
            **changes: values of other fields.

        Raises:
            ValueError: there are no such settings, or a field is out of bounds.
        """
        env_config = EnvConfig(task, options=(env or {}).get("options"))
        check_fits(agent, env_config)
        preset = find_preset(agent, _preset_name(env_config), settings)
        names = {field.name for field in dataclasses.fields(cls)} - {"env"}
        values = {name: value for name, value in vars(preset).items() if name in names}
        fields = {"actuator": actuator, **preset.env, **(env or {}), "task": task}
        return cls(EnvConfig.from_mapping(fields), **(values | changes))

    @property
    def evaluation_env(self) -> EnvConfig:
        """Environment of evaluations: without the training's changes of time limit and reward."""
        changed: dict[str, Argument] = dict.fromkeys(_evaluation_overrides(self.env))
        return dataclasses.replace(self.env, **changed)

    def as_mapping(self) -> JsonObject:
        """Return the configuration as JSON-serializable values, which `from_mapping` reads."""
        return {**vars(self), "env": self.env.as_mapping(), "agent": self.agent.as_mapping()}

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Json], whole: bool = False) -> "TrainConfig":
        """Return the configuration from a mapping: the result of `as_mapping`, or a part of it.

        Missing fields are those of the preset of the agent and `settings` (`default` if missing).
        `agent` is a name, or a mapping with its `name` and fields. `task` and `actuator` may be
        in `env` or at the top level.

        Args:
            mapping: the fields.
            whole: raise an error if fields are missing.

        Raises:
            ValueError: a key is unknown (the message suggests one) or missing, or a value out of
                bounds.
        """
        if not isinstance(mapping, Mapping):
            raise ValueError(f"not a training configuration: {mapping!r} is not a mapping")
        fields = dict(mapping)
        top_level = {name: fields.pop(name) for name in ("task", "actuator") if name in fields}
        if isinstance(fields.get("env", {}), Mapping):
            fields["env"] = {**fields.get("env", {}), **top_level}
        names = [field.name for field in dataclasses.fields(cls)]
        check_names(fields, [*names, "task", "actuator", "settings"], "key")
        missing = [name for name in names if name not in fields] if whole else []
        if missing:
            raise ValueError(f"not a training configuration: it has no {', '.join(missing)}")
        env = fields.pop("env")
        settings = fields.pop("settings", "default")
        agent = fields.pop("agent", None)
        if whole:
            return cls(EnvConfig.from_mapping(env), agent_from_mapping(agent), **fields)
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
        options = {"options": env["options"]} if env.get("options") else {}
        base = cls.preset(task, agent["name"], settings, env.get("actuator", "default"), options)
        agent = agent_from_mapping(base.agent.as_mapping() | dict(agent))
        return dataclasses.replace(
            base, env=EnvConfig.from_mapping(env, base.env), agent=agent, **fields
        )


def default_agent(task: str, options: Options = None) -> str:
    """Return the default agent of a task; for the paper's five tasks, the paper's agent.

    In third-party environments it is SAC for continuous actions and PPO for other actions. The
    actions may depend on the environment's `options`.
    """
    env = EnvConfig(task, options=options)
    if env.source.task is not None:
        return str(env.source.task.agent)
    return "sac" if isinstance(env.action_space, spaces.Box) else "ppo"


def _preset_name(env: EnvConfig) -> str:
    """Return the name under which an environment has presets."""
    return OTHER_ENV if env.source.task is None else env.source.task.name


def _evaluation_overrides(env: EnvConfig) -> tuple[str, ...]:
    """Return the fields that evaluations reset to their defaults, such as a changed time limit."""
    if env.source.task is not None:
        return ("max_episode_steps", "options")
    return () if env.source.time_limit is None else ("max_episode_steps",)


def read_config(path: Path, trust: bool = False, **overriding: Json) -> TrainConfig:
    """Read a configuration from a YAML (or JSON) file for `TrainConfig.from_mapping`.

    Args:
        path: the file; the `config.json` of a run folder is possible, too.
        trust: import, and thereby execute, the module of an actuator that the file names as
            `module:NAME`.
        **overriding: values that replace top-level keys of the file. None has no effect. If `agent`
            is the agent in the file, its settings in the file are kept.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not YAML, has an unknown key, or a value out of bounds; the message
            has the file's name.
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
        with allow_imports(trust):
            return TrainConfig.from_mapping(content)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
