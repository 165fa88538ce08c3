"""The trained policy that a verb is about, wherever it comes from."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.cli.environments import environment
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.sources import is_source_name
from codrl_mj.fields import did_you_mean
from codrl_mj.runs import CONFIG, finished
from codrl_mj.tasks import TASKS


@dataclasses.dataclass(frozen=True)
class Subject:
    """A policy, and what is known of its training."""

    policy: Any
    """What chooses the actions."""
    env: EnvConfig
    """The environment it was trained in, as far as that is known."""
    agent: str
    """Who was trained, as far as that is known; else what kind of policy it is."""
    run: Path | None = None
    """The run folder that says so; None if there is none."""

    def check_interface(self, env: EnvConfig) -> None:
        """Refuse an environment in which the policy would command or observe something else than in its training."""
        if self.run is None:
            from codrl_mj.runs.policies import check_spaces

            # The bounds of forces are the task's; those of other commands may be another motor's on
            # purpose.
            check_spaces(self.policy, env, exact=env.action == "force")
        for name, trained in self.env.policy_fields.items() if self.run is not None else ():
            if (value := env.policy_fields[name]) != trained:
                flag = f"--env.{name.replace('_', '-')}"
                raise ValueError(
                    f"{flag} = {value!r}: the policy of {self.run} was trained with {trained!r} and"
                    f" knows nothing else: leave {flag} out, or train one with it"
                )


@dataclasses.dataclass(frozen=True)
class Source:
    """What to know of a policy whose folder does not say."""

    which: Annotated[
        Literal["last", "best"],
        tyro.conf.arg(
            help="Of a run: its last policy, or that of its best evaluation in training."
        ),
    ] = "last"
    task: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME", help="What a policy was trained for that is no run folder's."
        ),
    ] = None
    agent: Annotated[
        str | None,
        tyro.conf.arg(
            help="Algorithm of a Stable-Baselines3 zip, such as ppo; the file does not say."
        ),
    ] = None
    normalize: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="FILE.pkl",
            help=(
                "Statistics that VecNormalize.save wrote, if a Stable-Baselines3 zip was trained"
                " behind it (see --trust); none if it was not."
            ),
        ),
    ] = None
    trust: Annotated[
        bool,
        tyro.conf.arg(
            help=(
                "Load a Stable-Baselines3 zip, which holds pickled objects; or import the modules"
                " of a run folder's task, agent or actuator if these are somebody's own. Either"
                " executes whatever its author wants, so it takes this flag. Other run folders of"
                " codrl-mj never need it."
            )
        ),
    ] = False

    def load(self, path: Path) -> Subject:
        """The policy at a path: a run folder, a folder with a policy alone, or a Stable-Baselines3 zip."""
        from codrl_mj.runs.policies import load_policy, load_sb3_zip
        from codrl_mj.training.folder import BEST, load_config, resume_command

        if self.normalize is not None and path.suffix != ".zip":
            raise ValueError(
                f"--normalize {self.normalize}: {path} is no zip of Stable-Baselines3: leave it out"
            )
        alone = path.suffix == ".zip" or (
            (path / "policy.json").exists() and not (path / CONFIG).exists()
        )
        if not alone:
            config = load_config(path, self.trust)
            if self.task not in (None, config.task):
                raise ValueError(
                    f"--task {self.task}: {path} was trained for {config.task}: leave --task out"
                )
            if self.agent not in (None, config.agent.name, config.agent.registry_name()):
                raise ValueError(
                    f"--agent {self.agent}: {path} was trained by {config.agent.name}: leave"
                    " --agent out"
                )
            if self.which == "last" and not finished(path):
                raise FileNotFoundError(
                    f"{path} is not finished and has no last policy yet: continue it with"
                    f" {resume_command(path)}, or take its best one so far with --which best"
                )
            policy = load_policy(path / BEST if self.which == "best" else path, self.trust)
            return Subject(policy, config.env, config.agent.registry_name(), path)
        if self.which == "best":
            raise ValueError(
                f"--which best: {path} is no run folder and holds one policy alone: leave"
                " --which out"
            )
        if self.task is None:
            raise ValueError(
                f"{path} does not say what it was trained for: name its task with --task"
            )
        if path.suffix != ".zip":
            policy = load_policy(path, self.trust)
        elif self.agent is None and self.trust:
            raise ValueError(
                f"{path} does not say which algorithm made it: name it with --agent, such as"
                " --agent ppo"
            )
        else:
            policy = load_sb3_zip(path, self.agent or "", self.trust, self.normalize)
        return Subject(policy, EnvConfig(self.task), self.agent or type(policy).__name__)


def policy_and_environment(verb: Any) -> tuple[Any, EnvConfig, str]:
    """What acts, in what, and a title for both, by a verb's `subject` and its flags: random actions of a task or id."""
    if not (random := is_source_name(verb.subject)) and not Path(verb.subject).exists():
        hint = did_you_mean(verb.subject, TASKS)
        raise FileNotFoundError(
            f"no run configuration at {verb.subject}/{CONFIG}: {hint}It is no run and no task"
        )
    subject = (
        Subject(None, EnvConfig(verb.subject), "")
        if random
        else verb.source.load(Path(verb.subject))
    )
    env = environment(verb, subject.env.task, verb.actuator_name, subject.env)
    subject.check_interface(env)
    policy = subject.policy
    if random:
        from codrl_mj.evaluation import RandomPolicy

        with contextlib.closing(env.make()) as made:
            policy = RandomPolicy(made.action_space, verb.seed)
    return policy, env, f"{Path(verb.subject).name} on {env.actuator_label}"
