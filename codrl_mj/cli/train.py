"""`codrl-mj train`: its flags depend on the agent, and their defaults on agent, task and configuration file."""

import argparse
import dataclasses
import itertools
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.agents import AGENTS
from codrl_mj.agents.presets import SETTINGS
from codrl_mj.cli.fields import AS_CONFIGURED, ActuatorFields, ActuatorName, Fields, TaskName, actuator, environment
from codrl_mj.cli.fields import unchecked as flags_of
from codrl_mj.envs.registration import ENVIRONMENTS
from codrl_mj.training.config import TrainConfig, default_agent, read_config
from codrl_mj.training.folder import finished, load_config

AgentName = Literal[tuple(AGENTS)]  # type: ignore[valid-type]
_OWN_FLAGS = ("task", "actuator", "agent", "env")  # of the configuration: not made from its fields' types


def train_verb(arguments: list[str]) -> Any:
    """The verb's dataclass for a command line, whose agent, task, settings and files decide on flags and defaults.

    Args:
        arguments: what follows `train`.

    Raises:
        FileNotFoundError: the configuration file or the run folder is missing.
        ValueError: it cannot be read, there are no such settings for the agent on the task, or the run has another
            agent.
    """
    chosen = _scan(arguments)
    base = _base(chosen)
    resuming = chosen.resume is not None
    configured = resuming or chosen.config is not None
    agent_fields, env_fields = flags_of(base.agent), flags_of(base.env)
    rest = flags_of(base, leaving_out=_OWN_FLAGS)
    task_known = configured or chosen.task is not None
    positional: Any = tyro.conf.Positional
    task = "task", Annotated[positional[TaskName], tyro.conf.arg(help="What to learn.")]
    fields: list[Any] = [
        (*task, base.task) if task_known else task,
        (
            "agent_name",
            Annotated[
                AgentName,
                tyro.conf.arg(
                    name="agent",
                    help="Who learns. Its settings are below; `codrl-mj train TASK --agent NAME --help` shows others'.",
                ),
            ],
            base.agent.name,
        ),
        (
            "settings",
            Annotated[Literal[SETTINGS], tyro.conf.arg(help=_SETTINGS_HELP)],  # type: ignore[valid-type]
            chosen.settings if chosen.settings in SETTINGS else "default",
        ),
        ("actuator_name", ActuatorName, AS_CONFIGURED if configured else "paper"),
        ("actuator_fields", Fields, ActuatorFields()),
        *((field.name, field.type, field.default) for field in dataclasses.fields(rest)),
        ("agent", Annotated[agent_fields, tyro.conf.arg(help="The agent's settings.")], agent_fields()),
        ("env", Annotated[env_fields, tyro.conf.arg(help="The environment.")], env_fields()),
        (
            "config",
            Annotated[Path | None, tyro.conf.arg(help=_CONFIG_HELP)],
            None,
        ),
        ("out", Annotated[Path | None, tyro.conf.arg(help=_OUT_HELP)], None),
        ("resume", Annotated[Path | None, tyro.conf.arg(help=_RESUME_HELP)], None),
        ("accept_changes", Annotated[bool, tyro.conf.arg(help=_ACCEPT_HELP)], False),
        ("tensorboard", Annotated[bool, tyro.conf.arg(help="Write events for TensorBoard, if it is installed.")], True),
        (
            "wandb",
            Annotated[str | None, tyro.conf.arg(help="Weights & Biases project to report to as well.")],
            None,
        ),
    ]
    verb: Any = dataclasses.make_dataclass("Train", fields, bases=(Train,), frozen=True)
    verb.__doc__ = Train.__doc__
    verb.base = base
    return verb


_SETTINGS_HELP = (
    "Where the defaults come from: `default` (ours), `paper` (as printed), or `repaired` (the paper's, with what makes "
    "it fail changed)."
)
_CONFIG_HELP = (
    "YAML file with the configuration: the keys are the flags' names, nested at the dots, with underscores (agent: "
    "{name: ppo, gamma: 0.98}). Flags win over it. A run's config.json will do as well."
)
_OUT_HELP = "Run folder to make; the default is runs/TASK-AGENT-ACTUATOR-SEED."
_RESUME_HELP = (
    "Run folder of a training that was interrupted, to be continued from its last checkpoint to the result that it "
    "would have had. Needs no other flags."
)
_ACCEPT_HELP = "Continue even if the code or a package is no longer the one that the run was started with."


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an agent through an actuator and leave a run folder.

    The folder gets the resolved configuration, tables of episodes and progress, checkpoints, the best and the last
    policy (safetensors and JSON), an evaluation and the learning curve. Ctrl-C writes a checkpoint and stops.

    Example: codrl-mj train cartpole --actuator weaker --env.center-radius 0.1 --out runs/through-weaker, and after an
    interruption codrl-mj train --resume runs/through-weaker
    """

    def run(self: Any) -> int:
        """Train, with a progress bar."""
        from codrl_mj.cli.terminal import train_with_bars

        if self.task != self.base.task and self.resume is None:
            raise ValueError(f"name the task before the flags, as in codrl-mj train {self.task} --seed 1")
        if self.resume is not None and self.out not in (None, self.resume):
            raise ValueError(f"--out {self.out}: a run continues in its own folder, {self.resume}: leave --out out")
        config = dataclasses.replace(
            self.base,
            task=self.task,
            actuator=actuator(self.actuator_name, self.actuator_fields, self.task, self.base.actuator),  # type: ignore[arg-type]
            agent=type(self.base.agent)(**vars(self.agent)),
            env=environment(self.env),
            **{
                field.name: getattr(self, field.name)
                for field in dataclasses.fields(TrainConfig)
                if field.name not in _OWN_FLAGS
            },
        )
        if self.resume is not None and finished(self.resume) and config == load_config(self.resume):
            print(f"{self.resume} is finished already; next: codrl-mj evaluate {self.resume}")
            return 0
        out = (
            self.resume
            or self.out
            or Path("runs") / "-".join([config.task, config.agent.name, self.actuator_name, str(config.seed)])
        )
        train_with_bars(
            {f"{config.agent.name.upper()} on {config.task}": (config, out)},
            resume=self.resume is not None,
            accept_changes=self.accept_changes,
            tensorboard=self.tensorboard,
            wandb=self.wandb,
        )
        print(f"wrote {out}: see {out / 'learning_curve.png'}; next: codrl-mj evaluate {out}")
        return 0


def _scan(arguments: list[str]) -> argparse.Namespace:
    """What decides on the other flags and their defaults; the rest is left to the real parser."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("agent", "settings"):
        parser.add_argument(f"--{name}")
    for name in ("config", "resume"):
        parser.add_argument(f"--{name}", type=Path)
    try:
        chosen, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:  # a flag without its value: the real parser says so better
        chosen = argparse.Namespace(agent=None, settings=None, config=None, resume=None)
    behind = itertools.pairwise(["", *arguments])
    chosen.task = next((name for flag, name in behind if name in ENVIRONMENTS and not flag.startswith("--")), None)
    return chosen


def _base(chosen: argparse.Namespace) -> TrainConfig:
    """The configuration whose values are the flags' defaults."""
    if chosen.resume is not None and chosen.config is None:
        begun = load_config(chosen.resume)
        if chosen.settings is not None or chosen.agent not in (None, begun.agent.name):
            raise ValueError(
                f"{chosen.resume} is a training of {begun.agent.name} and continues as it began: leave --agent and "
                "--settings out"
            )
        return begun
    if chosen.config is not None:
        return read_config(chosen.config, task=chosen.task, agent=chosen.agent, settings=chosen.settings)
    task = chosen.task or "cartpole"
    agent = chosen.agent if chosen.agent in AGENTS else default_agent(task)
    return TrainConfig.preset(task, agent, chosen.settings if chosen.settings in SETTINGS else "default")
