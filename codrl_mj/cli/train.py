"""`codrl-mj train`: its flags depend on the agent, and their defaults on agent, task and configuration file."""

import argparse
import contextlib
import dataclasses
import math
import re
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from codrl_mj.agents import AGENTS
from codrl_mj.agents.presets import SETTINGS
from codrl_mj.cli.environments import (
    AS_CONFIGURED,
    FAMILY,
    ActuatorName,
    environment,
    environment_fields,
    flags,
    scan,
)
from codrl_mj.cli.parsing import AsJson
from codrl_mj.cli.terminal import progress_bar, say
from codrl_mj.envs.sources import find_source
from codrl_mj.fields import command
from codrl_mj.runs import PROGRESS, RESULT, finished
from codrl_mj.runs.files import read_json
from codrl_mj.runs.summaries import read_reports
from codrl_mj.tasks import TASKS
from codrl_mj.training.config import TrainConfig, default_agent, read_config
from codrl_mj.training.folder import load_config, needs_trust, prepare_run
from codrl_mj.training.history import REPORT_COLUMNS

_OWN_FLAGS = ("agent", "env")  # of the configuration: not made from its fields' types


def train_verb(arguments: list[str]) -> Any:
    """The verb's dataclass for a command line, whose agent, task, settings and files decide on flags and defaults."""
    chosen = scan(arguments, "agent", "settings", "actuator", FAMILY, "config", "resume")
    if chosen.task is None and arguments and not arguments[0].startswith("-"):
        try:
            find_source(arguments[0])
        except ValueError as error:
            others = "an environment of Gymnasium's goes by its id, such as HalfCheetah-v5"
            raise ValueError(f"{error}; {others}") from None
    base = _base(chosen)
    resuming = chosen.resume is not None
    configured = resuming or chosen.config is not None
    agent_flags = flags(type(base.agent), base.agent)
    rest = flags(TrainConfig, base, _OWN_FLAGS)
    task_known = configured or chosen.task is not None
    tasks: Any = Literal[tuple(dict.fromkeys([*TASKS, base.task, chosen.task or base.task]))]
    agents: Any = Literal[tuple(dict.fromkeys([*AGENTS, base.agent.registry_name()]))]
    positional: Any = tyro.conf.Positional
    task = "task", Annotated[positional[tasks], tyro.conf.arg(help="What to learn.")]
    fields: list[Any] = [
        (*task, base.task) if task_known else task,
        (
            "agent_name",
            Annotated[
                agents,
                tyro.conf.arg(
                    name="agent",
                    help=(
                        "Who learns. Its settings are below; `codrl-mj train TASK --agent NAME"
                        " --help` shows others'."
                    ),
                ),
            ],
            base.agent.registry_name(),
        ),
        (
            "settings",
            Annotated[
                Literal[SETTINGS],  # type: ignore[valid-type]
                tyro.conf.arg(
                    help=(
                        "Where the defaults come from: `default` (ours), `paper` (as printed),"
                        " `repaired` (the paper's, with what makes it fail changed), or `fast`"
                        " (ours, for the least time)."
                    )
                ),
            ],
            chosen.settings if chosen.settings in SETTINGS else "default",
        ),
        (
            "actuator_name",
            ActuatorName,
            AS_CONFIGURED if configured else base.env.source.default_actuator,
        ),
        *((field.name, field.type, field.default) for field in dataclasses.fields(rest)),
        (
            "agent",
            Annotated[agent_flags, tyro.conf.arg(help="The agent's settings.")],
            agent_flags(),
        ),
        *environment_fields(base.env, chosen, base.task),
    ]
    verb: Any = dataclasses.make_dataclass(
        "Train", fields, bases=(Train,), frozen=True, kw_only=True
    )
    verb.__doc__ = Train.__doc__
    verb.base = base
    return verb


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an agent through an actuator and leave a run folder.

    The folder gets the resolved configuration, tables of episodes and progress, checkpoints, the
    best and the last policy (safetensors and JSON), an evaluation and the learning curve. Ctrl-C
    writes a checkpoint and stops.

    Example: codrl-mj train cartpole --actuator weaker --env.center-radius 0.1 --out
    runs/through-weaker, and after an interruption codrl-mj train --resume runs/through-weaker.
    Environments of others go by their Gymnasium ids: codrl-mj train HalfCheetah-v5 --actuators
    'b.*=maxon-ec45-flat-50w' 'f.*=lag'
    """

    config: Path | None = None
    """YAML file with the configuration: the keys are the flags' names, nested at the dots, with
    underscores (agent: {name: ppo, gamma: 0.98}). Flags win over it. A run's config.json will do as
    well.
    """
    out: Path | None = None
    """Run folder to make; the default is runs/TASK-AGENT-ACTUATOR-SEED."""
    resume: Path | None = None
    """Run folder of a training that was interrupted, to be continued from its last checkpoint to
    the result that it would have had. Needs no other flags.
    """
    accept_changes: bool = False
    """Continue even if the code or a package is no longer the one that the run was started with."""
    trust: bool = False
    """Import the module of an actuator of somebody's own that the file or the run names as
    module:NAME, which executes whatever its author wants.
    """
    tensorboard: bool = True
    """Write events for TensorBoard, if it is installed."""
    wandb: str | None = None
    """Weights & Biases project to report to as well."""
    as_json: AsJson = False
    for_line = staticmethod(train_verb)

    def run(self: Any) -> tuple[int, Any]:
        """Train, with a progress bar."""
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
                f"--out {self.out}: a run continues in its own folder, {self.resume}: leave"
                " --out out"
            )
        config = dataclasses.replace(
            self.base,
            env=environment(self, self.base.task, self.actuator_name, self.base.env),
            agent=type(self.base.agent)(**vars(self.agent)),
            **{
                field.name: getattr(self, field.name)
                for field in dataclasses.fields(TrainConfig)
                if field.name not in _OWN_FLAGS
            },
        )
        through = "-".join(
            dict.fromkeys(Path(each.rpartition("=")[2]).stem for each in self.actuators)
        )
        through = "-".join(
            filter(None, (through or self.actuator_name, self.actuator_fields.family))
        )
        parts = config.task, config.agent.name, through, str(config.seed)
        if (
            self.resume is not None
            and finished(self.resume)
            and config == load_config(self.resume, self.trust)
        ):
            print(f"{self.resume} is finished already; {_following(self.resume)}")
            return 0, _came_to(self.resume) if self.as_json else None
        name = "-".join(re.sub(r"[^\w.]+", "_", part) for part in parts)
        out = self.resume or self.out or Path("runs") / name
        prepare_run(out, config, self.resume is not None, self.accept_changes)
        config.env.make().close()  # what is wrong with it is said before there is a bar
        say(*dict.fromkeys(one.assumed for one in config.env.actuators))
        with training_bars({f"{config.agent.name.upper()} on {config.task}": (config, out)}):
            train(
                config,
                out,
                resume=self.resume is not None,
                accept_changes=self.accept_changes,
                tensorboard=self.tensorboard,
                wandb=self.wandb,
            )
        print(f"wrote {out}: see {out / 'learning_curve.png'}; {_following(out)}")
        return 0, _came_to(out) if self.as_json else None


def _following(run: Path) -> str:
    """Return the command to go on with after a training."""
    return f"next: {command('evaluate', run, trust=needs_trust(run))}"


def _came_to(run: Path) -> dict[str, Any]:
    """What there is to say of a finished run."""
    units = {
        "mean_return": "reward",
        "evaluation_return": "reward",
        "best.return": "reward",
        "seconds": "s",
    }
    return {"run": run, **read_json(run / RESULT, "result of a run"), "units": units}


@contextlib.contextmanager
def training_bars(runs: Mapping[str, tuple[TrainConfig, Path]]) -> Iterator[None]:
    """Show a bar for each training while the block runs, by what the run folders say, whatever process writes them."""
    columns = (
        "{task.completed:,}/{task.total:,} {task.fields[unit]}",
        "return {task.fields[mean_return]:.1f}",
        "end torque err {task.fields[torque_error]:.2g} N·m",
        "{task.fields[steps_per_second]:.0f}/s",
    )
    with progress_bar(
        *(one for one in columns if "torque" not in one or Console(stderr=True).width >= 100)
    ) as bar:
        rows = {}
        for name, (config, folder) in runs.items():
            unit, total = (
                ("episodes", config.total_episodes)
                if config.total_episodes
                else ("steps", config.total_steps)
            )
            nothing: dict[str, Any] = dict.fromkeys(REPORT_COLUMNS, math.nan)
            rows[bar.add_task(name, total=total, unit=unit, **nothing)] = (
                folder / PROGRESS,
                unit,
                total or 0,
            )

        def show() -> None:
            for row, (file, unit, total) in rows.items():
                for last in read_reports(file, [])[-1:]:
                    report: dict[str, Any] = {name: float(value) for name, value in last.items()}
                    bar.update(row, completed=min(int(report[unit]), total), **report)

        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(0.2):
                show()

        follower = threading.Thread(target=follow)
        follower.start()
        try:
            yield
        finally:
            ended.set()
            follower.join()
            show()


def _base(chosen: argparse.Namespace) -> TrainConfig:
    """The configuration whose values are the flags' defaults."""
    if chosen.resume is not None and chosen.config is None:
        begun = load_config(Path(chosen.resume), chosen.trust)
        if chosen.settings is not None or chosen.agent not in (None, begun.agent.registry_name()):
            raise ValueError(
                f"{chosen.resume} is a training of {begun.agent.name} and continues as it began:"
                " leave --agent and --settings out"
            )
        return begun
    if chosen.config is not None:
        given = {name: getattr(chosen, name) for name in ("task", "agent", "settings")}
        return read_config(Path(chosen.config), chosen.trust, **given)
    task = chosen.task or "cartpole"
    world = find_source(task)
    options = world.options_of({"options": chosen.options}) if chosen.options else {}
    agent = (
        chosen.agent
        if chosen.agent in AGENTS or ":" in str(chosen.agent)
        else default_agent(task, options)
    )
    settings = chosen.settings if chosen.settings in SETTINGS else "default"
    return TrainConfig.preset(
        task, agent, settings, world.default_actuator, {"options": options} if options else {}
    )
