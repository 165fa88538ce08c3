"""`codrl-mj train`: flags and their defaults depend on agent, task and configuration file."""

import argparse
import contextlib
import dataclasses
import math
import re
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro
from rich.console import Console

from codrl_mj.agents import AGENTS
from codrl_mj.agents.presets import SETTINGS
from codrl_mj.boundary import Json
from codrl_mj.cli.environments import (
    AS_CONFIGURED,
    FAMILY,
    ActuatorName,
    EnvironmentFlags,
    FlagField,
    Flags,
    build_env_config,
    environment_fields,
    flag_dataclass,
    parse_options,
    scan_flags,
)
from codrl_mj.cli.parsing import Annotation, AsJson, Output
from codrl_mj.cli.terminal import print_text, progress_bar
from codrl_mj.envs.config import find_source
from codrl_mj.fields import command
from codrl_mj.runs import PROGRESS, RESULT, finished
from codrl_mj.runs.files import read_json
from codrl_mj.runs.summaries import read_progress
from codrl_mj.tasks import TASKS
from codrl_mj.training.config import TrainConfig, default_agent, read_config
from codrl_mj.training.folder import load_config, needs_trust, prepare_run
from codrl_mj.training.history import REPORT_COLUMNS

# Fields of `TrainConfig` whose flags are not generated from their types.
_SEPARATE_FIELDS = ("agent", "env")


def train_verb(arguments: list[str]) -> type["Train"]:
    """Return the verb's dataclass for a command line.

    Agent, task, settings and files on the line determine the flags and their defaults.
    """
    chosen = scan_flags(arguments, "agent", "settings", "actuator", FAMILY, "config", "resume")
    if chosen.task is None and arguments and not arguments[0].startswith("-"):
        try:
            find_source(arguments[0])
        except ValueError as error:
            hint = "name an environment of Gymnasium by its id, such as HalfCheetah-v5"
            raise ValueError(f"{error}; {hint}") from None
    base = _base_config(chosen)
    resuming = chosen.resume is not None
    has_config = resuming or chosen.config is not None
    agent_flags = flag_dataclass(type(base.agent), base.agent)
    train_flags = flag_dataclass(TrainConfig, base, _SEPARATE_FIELDS)
    task_known = has_config or chosen.task is not None
    tasks: Annotation = Literal[tuple(dict.fromkeys([*TASKS, base.task, chosen.task or base.task]))]
    agents: Annotation = Literal[tuple(dict.fromkeys([*AGENTS, base.agent.registry_name()]))]
    positional: Annotation = tyro.conf.Positional
    task = "task", Annotated[positional[tasks], tyro.conf.arg(help="Task to learn.")]
    fields: list[FlagField] = [
        (*task, base.task) if task_known else task,
        (
            "agent_name",
            Annotated[
                agents,
                tyro.conf.arg(
                    name="agent",
                    help=(
                        "Learning agent. Its settings are below; `codrl-mj train TASK --agent NAME"
                        " --help` lists those of another agent."
                    ),
                ),
            ],
            base.agent.registry_name(),
        ),
        (
            "settings",
            Annotated[
                Literal[SETTINGS],
                tyro.conf.arg(
                    help=(
                        "Source of the defaults: `default` (ours), `paper` (as printed),"
                        " `repaired` (the paper's, but ours where the paper's make training fail),"
                        " or `fast` (ours, for the shortest training)."
                    )
                ),
            ],
            chosen.settings if chosen.settings in SETTINGS else "default",
        ),
        (
            "actuator_name",
            ActuatorName,
            AS_CONFIGURED if has_config else base.env.source.default_actuator,
        ),
        *((field.name, field.type, field.default) for field in dataclasses.fields(train_flags)),
        (
            "agent",
            Annotated[agent_flags, tyro.conf.arg(help="The agent's settings.")],
            agent_flags(),
        ),
        *environment_fields(base.env, chosen, base.task),
    ]
    verb: type[Train] = dataclasses.make_dataclass(
        "Train", fields, bases=(Train,), frozen=True, kw_only=True
    )
    verb.__doc__ = Train.__doc__
    verb.base = base
    return verb


class _TrainingVerb(EnvironmentFlags):
    """Verb with flags for a training; `train_verb` adds their fields."""

    task: str
    actuator_name: str
    """Name of an actuator, or `AS_CONFIGURED`."""
    agent: Flags
    """Settings of the agent."""
    base: ClassVar[TrainConfig]
    """Configuration that gives the flags their defaults."""


@dataclasses.dataclass(frozen=True)
class Train(_TrainingVerb):
    """Train an agent through an actuator, and write a run folder.

    The folder gets the resolved configuration, tables of episodes and progress, checkpoints, the
    best and the last policy (safetensors and JSON), an evaluation and the learning curve. If you
    press Ctrl-C, the training writes a checkpoint and stops.

    Example: codrl-mj train cartpole --actuator weaker --env.center-radius 0.1 --out
    runs/through-weaker, and after an interruption codrl-mj train --resume runs/through-weaker. Name
    other environments by their
    Gymnasium ids: codrl-mj train HalfCheetah-v5 --actuators 'b.*=maxon-ec45-flat-50w' 'f.*=lag'
    """

    config: Path | None = None
    """YAML file with the configuration: the keys are the names of the flags, nested at the dots,
    with underscores (agent: {name: ppo, gamma: 0.98}). Flags override it. The config.json of a
    run works too.
    """
    out: Path | None = None
    """Run folder to create; default: runs/TASK-AGENT-ACTUATOR-SEED."""
    resume: Path | None = None
    """Run folder of an interrupted training to continue from its last checkpoint. The result is
    the same as without the interruption. No other flags are needed.
    """
    accept_changes: bool = False
    """Continue even if the code or a package has changed since the run was started."""
    trust: bool = False
    """Import the module of a custom actuator that the file or the run names as module:NAME. This
    executes the code of its author.
    """
    tensorboard: bool = True
    """Write events for TensorBoard, if it is installed."""
    wandb: str | None = None
    """Weights & Biases project to which progress is also reported."""
    as_json: AsJson = False
    for_line = staticmethod(train_verb)

    def run(self) -> Output:
        """Train with a progress bar."""
        from codrl_mj.training import train

        if (
            find_source(self.task).reference != find_source(self.base.task).reference
            and self.resume is None
        ):
            raise ValueError(
                f"name the task before the flags, as in {command('train', self.task, '--seed', 1)}"
            )
        if self.resume is not None and self.out not in (None, self.resume):
            raise ValueError(
                f"--out {self.out}: a run continues in its own folder, {self.resume}: omit --out"
            )
        config = dataclasses.replace(
            self.base,
            env=build_env_config(self, self.base.task, self.actuator_name, self.base.env),
            agent=type(self.base.agent)(**vars(self.agent)),
            **{
                field.name: getattr(self, field.name)
                for field in dataclasses.fields(TrainConfig)
                if field.name not in _SEPARATE_FIELDS
            },
        )
        actuator_text = "-".join(
            dict.fromkeys(Path(item.rpartition("=")[2]).stem for item in self.actuators)
        )
        actuator_text = "-".join(
            filter(None, (actuator_text or self.actuator_name, self.actuator_fields.family))
        )
        name_parts = config.task, config.agent.name, actuator_text, str(config.seed)
        if (
            self.resume is not None
            and finished(self.resume)
            and config == load_config(self.resume, self.trust)
        ):
            print(f"{self.resume} is already finished; {_next_command(self.resume)}")
            return 0, _result_mapping(self.resume) if self.as_json else None
        name = "-".join(re.sub(r"[^\w.]+", "_", part) for part in name_parts)
        out = self.resume or self.out or Path("runs") / name
        prepare_run(out, config, self.resume is not None, self.accept_changes)
        # Build the environment once, so that an invalid setting is reported before the progress bar
        # starts.
        config.env.build().close()
        print_text(*dict.fromkeys(actuator.assumed for actuator in config.env.actuators))
        with training_bars({f"{config.agent.name.upper()} on {config.task}": (config, out)}):
            train(
                config,
                out,
                resume=self.resume is not None,
                accept_changes=self.accept_changes,
                tensorboard=self.tensorboard,
                wandb=self.wandb,
            )
        print(f"wrote {out}: see {out / 'learning_curve.png'}; {_next_command(out)}")
        return 0, _result_mapping(out) if self.as_json else None


def _next_command(run: Path) -> str:
    """Return the command that evaluates a finished run."""
    return f"next: {command('evaluate', run, trust=needs_trust(run))}"


def _result_mapping(run: Path) -> dict[str, Json]:
    """Return the result of a finished run, with units, for --json."""
    units = {
        "mean_return": "reward",
        "evaluation_return": "reward",
        "best.return": "reward",
        "seconds": "s",
    }
    return {"run": run, **read_json(run / RESULT, "result of a run"), "units": units}


@contextlib.contextmanager
def training_bars(runs: Mapping[str, tuple[TrainConfig, Path]]) -> Iterator[None]:
    """Show a progress bar for each training while the block runs.

    The bars follow the progress files in the run folders, which other processes may write.
    """
    columns = (
        "{task.completed:,}/{task.total:,} {task.fields[unit]}",
        "return {task.fields[mean_return]:.1f}",
        "end torque err {task.fields[torque_error]:.2g} N·m",
        "{task.fields[steps_per_second]:.0f}/s",
    )
    with progress_bar(
        *(
            column
            for column in columns
            if "torque" not in column or Console(stderr=True).width >= 100
        )
    ) as bar:
        rows = {}
        for name, (config, folder) in runs.items():
            unit, total = (
                ("episodes", config.total_episodes)
                if config.total_episodes
                else ("steps", config.total_steps)
            )
            # Columns of NaN stay hidden until the first report (see `progress_bar`).
            no_report: dict[str, float] = dict.fromkeys(REPORT_COLUMNS, math.nan)
            rows[bar.add_task(name, total=total, unit=unit, **no_report)] = (
                folder / PROGRESS,
                unit,
                total or 0,
            )

        def show() -> None:
            for row, (file, unit, total) in rows.items():
                for last in read_progress(file, [])[-1:]:
                    report: dict[str, float] = {name: float(value) for name, value in last.items()}
                    bar.update(row, completed=min(int(report[unit]), total), **report)

        finished = threading.Event()

        def update_bars() -> None:
            # The thread reads the progress files instead of being called by the training, so that
            # it also shows trainings of other processes.
            while not finished.wait(0.2):
                show()

        thread = threading.Thread(target=update_bars)
        thread.start()
        try:
            yield
        finally:
            finished.set()
            # One last update shows the final numbers.
            thread.join()
            show()


def _base_config(chosen: argparse.Namespace) -> TrainConfig:
    """Return the configuration that gives the flags their defaults."""
    if chosen.resume is not None and chosen.config is None:
        stored = load_config(Path(chosen.resume), chosen.trust)
        if chosen.settings is not None or chosen.agent not in (None, stored.agent.registry_name()):
            raise ValueError(
                f"{chosen.resume} is a training of {stored.agent.name} and continues unchanged:"
                " omit --agent and --settings"
            )
        return stored
    if chosen.config is not None:
        overrides = {name: getattr(chosen, name) for name in ("task", "agent", "settings")}
        return read_config(Path(chosen.config), chosen.trust, **overrides)
    task = chosen.task or "cartpole"
    source = find_source(task)
    options = parse_options(source, {"options": chosen.options}) if chosen.options else {}
    agent = (
        chosen.agent
        if chosen.agent in AGENTS or ":" in str(chosen.agent)
        else default_agent(task, options)
    )
    settings = chosen.settings if chosen.settings in SETTINGS else "default"
    return TrainConfig.preset(
        task, agent, settings, source.default_actuator, {"options": options} if options else {}
    )
