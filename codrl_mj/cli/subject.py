"""The trained policy that a verb is about, loaded from a run folder, a policy folder or a zip."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import tyro

from codrl_mj.cli.environments import (
    AS_TRAINED,
    ActuatorName,
    EnvironmentVerb,
    build_env_config,
)
from codrl_mj.envs.config import EnvConfig, check_time_limit, is_source_name
from codrl_mj.fields import did_you_mean
from codrl_mj.runs import BEST, CONFIG, finished
from codrl_mj.runs.policies import Policy
from codrl_mj.tasks import TASKS


@dataclasses.dataclass(frozen=True)
class Subject:
    """A policy, with the known facts about its training."""

    policy: Policy
    """Policy that chooses the actions."""
    env: EnvConfig
    """Environment of its training; unknown settings have their defaults."""
    agent: str
    """Agent that was trained; the class of the policy if the agent is unknown."""
    run: Path | None = None
    """Run folder of the training; None if there is none."""

    def check_interface(self, env: EnvConfig) -> None:
        """Raise ValueError if the policy has other observations or commands in an environment."""
        # A run folder stores these settings, so every difference is an error. Without one only the
        # spaces can be compared, which `run_episodes` does.
        for name, trained in self.env.policy_fields.items() if self.run is not None else ():
            if (value := env.policy_fields[name]) != trained:
                flag = f"--env.{name.replace('_', '-')}"
                raise ValueError(
                    f"{flag} = {value!r}: the policy of {self.run} was trained with {trained!r} and"
                    f" works only with that: omit {flag}, or train a policy with it"
                )


@dataclasses.dataclass(frozen=True)
class Source:
    """Choice of a policy, and facts about it that its files do not contain."""

    which: Annotated[
        Literal["last", "best"],
        tyro.conf.arg(
            help=(
                "Policy of a run: the last one, or the one with the best evaluation during"
                " training."
            )
        ),
    ] = "last"
    task: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME", help="Task of a policy that does not come from a run folder."
        ),
    ] = None
    agent: Annotated[
        str | None,
        tyro.conf.arg(
            help="Algorithm of a Stable-Baselines3 zip, such as ppo; the file does not name it."
        ),
    ] = None
    normalize: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="FILE.pkl",
            help=(
                "Statistics that VecNormalize.save wrote, if a Stable-Baselines3 policy was trained"
                " with it (see --trust)."
            ),
        ),
    ] = None
    trust: Annotated[
        bool,
        tyro.conf.arg(
            help=(
                "Load a Stable-Baselines3 zip, which contains pickled objects, or import the custom"
                " modules of a run folder's task, agent or actuator. Both execute code of their"
                " authors. Run folders without custom modules do not need this flag."
            )
        ),
    ] = False

    def load(self, path: Path) -> Subject:
        """Load the policy of a run folder, of a policy folder, or of a Stable-Baselines3 zip."""
        from codrl_mj.runs.policies import load_policy, load_sb3_zip
        from codrl_mj.training.folder import load_config, resume_command

        if self.normalize is not None and path.suffix != ".zip":
            raise ValueError(
                f"--normalize {self.normalize}: {path} is not a Stable-Baselines3 zip: omit"
                " the flag"
            )
        is_policy_only = path.suffix == ".zip" or (
            (path / "policy.json").exists() and not (path / CONFIG).exists()
        )
        if not is_policy_only:
            config = load_config(path, self.trust)
            if self.task not in (None, config.task):
                raise ValueError(
                    f"--task {self.task}: {path} was trained for {config.task}: omit --task"
                )
            if self.agent not in (None, config.agent.name, config.agent.registry_name()):
                raise ValueError(
                    f"--agent {self.agent}: {path} was trained by {config.agent.name}: omit --agent"
                )
            if self.which == "last" and not finished(path):
                raise FileNotFoundError(
                    f"{path} is not finished and has no last policy yet: continue it with"
                    f" {resume_command(path)}, or use its best policy so far with --which best"
                )
            policy = load_policy(path / BEST if self.which == "best" else path, self.trust)
            return Subject(policy, config.env, config.agent.registry_name(), path)
        if self.which == "best":
            raise ValueError(
                f"--which best: {path} is not a run folder and has a single policy: omit --which"
            )
        if self.task is None:
            raise ValueError(f"{path} does not contain its task: name it with --task")
        if path.suffix != ".zip":
            policy = load_policy(path, self.trust)
        elif self.agent is None and self.trust:
            raise ValueError(
                f"{path} does not contain its algorithm: name it with --agent, such as --agent ppo"
            )
        else:
            policy = load_sb3_zip(path, self.agent or "", self.trust, self.normalize)
        return Subject(policy, EnvConfig(self.task), self.agent or type(policy).__name__)


@dataclasses.dataclass(frozen=True)
class EpisodeVerb(EnvironmentVerb):
    """Common flags of the verbs that show an episode: policy, environment and seed."""

    subject: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            help=(
                "Run folder, a folder with only a policy, or a Stable-Baselines3 zip (see"
                " --trust); or a task name or an environment's id, for random actions."
            )
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    seed: int = 0
    """Seed of the episode; `view` uses it for the first episode."""


class ShownPolicy(NamedTuple):
    """Policy that a verb shows, and where."""

    policy: Policy
    env: EnvConfig
    title: str
    """Name of the policy, and the actuator."""


def policy_and_environment(verb: EpisodeVerb) -> ShownPolicy:
    """Return the policy, the environment and a title, from a verb's `subject` and flags.

    If the subject is a task or the id of an environment, the policy is random.
    """
    if not (is_random := is_source_name(verb.subject)) and not Path(verb.subject).exists():
        hint = did_you_mean(verb.subject, TASKS)
        raise FileNotFoundError(
            f"no run configuration at {verb.subject}/{CONFIG}: {hint}It is neither a run"
            " folder nor a task"
        )
    subject = None if is_random else verb.source.load(Path(verb.subject))
    trained_env = EnvConfig(verb.subject) if subject is None else subject.env
    env = build_env_config(verb, trained_env.task, verb.actuator_name, trained_env)
    check_time_limit(env)
    policy: Policy
    if subject is None:
        from codrl_mj.evaluation import RandomPolicy

        with contextlib.closing(env.build()) as sample_env:
            policy = RandomPolicy(sample_env.action_space, verb.seed)
    else:
        subject.check_interface(env)
        policy = subject.policy
    return ShownPolicy(policy, env, f"{Path(verb.subject).name} on {env.actuator_label}")
