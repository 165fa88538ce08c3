"""The trained policy that a verb is about, wherever it comes from."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.cli.fields import TaskName
from codrl_mj.envs.config import EnvConfig
from codrl_mj.motor import Actuator


@dataclasses.dataclass(frozen=True)
class Subject:
    """A policy, and what is known of its training."""

    task: str
    """What it was trained for."""
    policy: Any
    """What chooses the actions."""
    actuator: Actuator | None
    """What it was trained on; None is the ideal actuator."""
    env: EnvConfig
    """The environment it was trained in."""


@dataclasses.dataclass(frozen=True)
class Source:
    """What to know of a policy whose folder does not say."""

    which: Annotated[
        Literal["last", "best"],
        tyro.conf.arg(help="Of a run: its last policy, or that of its best evaluation in training."),
    ] = "last"
    task: Annotated[
        TaskName | None,  # type: ignore[valid-type]
        tyro.conf.arg(help="What a policy was trained for that is no run folder's."),
    ] = None
    agent: Annotated[
        str | None, tyro.conf.arg(help="Algorithm of a Stable-Baselines3 zip, such as ppo; the file does not say.")
    ] = None
    trust: Annotated[
        bool,
        tyro.conf.arg(
            help="Load a Stable-Baselines3 zip. It holds pickled objects: loading one executes whatever its author "
            "wants, so it takes this flag. Run folders of codrl-mj hold none and never need it."
        ),
    ] = False

    def load(self, path: Path) -> Subject:
        """The policy at a path: a run folder, a folder with a policy alone, or a Stable-Baselines3 zip.

        Raises:
            FileNotFoundError: nothing is there.
            ValueError: it is damaged, or needs a flag to be loaded.
        """
        from codrl_mj.motor import named_actuator
        from codrl_mj.runs.policies import load_policy, load_sb3_zip
        from codrl_mj.training.folder import BEST, CONFIG, finished, load_config

        alone = path.suffix == ".zip" or ((path / "policy.json").exists() and not (path / CONFIG).exists())
        if not alone:
            config = load_config(path)
            if self.task not in (None, config.task):
                raise ValueError(f"--task {self.task}: {path} was trained for {config.task}: leave --task out")
            if self.which == "last" and not finished(path):
                raise FileNotFoundError(
                    f"{path} is not finished and has no last policy yet: continue it with codrl-mj train --resume "
                    f"{path}, or take its best one so far with --which best"
                )
            policy = load_policy(path / BEST if self.which == "best" else path)
            return Subject(config.task, policy, config.actuator, config.env)  # type: ignore[arg-type]
        if self.which == "best":
            raise ValueError(f"--which best: {path} is no run folder and holds one policy alone: leave --which out")
        if self.task is None:
            raise ValueError(f"{path} does not say what it was trained for: name its task with --task")
        if path.suffix != ".zip":
            policy = load_policy(path)
        elif self.agent is None and self.trust:
            raise ValueError(f"{path} does not say which algorithm made it: name it with --agent, such as --agent ppo")
        else:
            policy = load_sb3_zip(path, self.agent or "", self.trust)
        return Subject(self.task, policy, named_actuator("paper", self.task), EnvConfig())
