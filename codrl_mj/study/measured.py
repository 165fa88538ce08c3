"""What to do about an actuator, measured: policies trained on ideal forces and through it, tested on it.

It takes the study's tasks, a run (its environment, agent and budget), and whatever else is an environment.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL as IDEAL_ACTUATOR
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy, evaluate
from codrl_mj.study.advice import IDEAL, LOOP, RANDOMISE, THROUGH, Prospect, decide, redesign
from codrl_mj.study.doses import FLOORS, SECONDS, generic, ideal
from codrl_mj.study.evidence import Outcome
from codrl_mj.study.trials import Arm, Collected, Grid, Trial
from codrl_mj.training import TrainConfig, load_config

RANDOM_EPISODES = 100
"""Of random actions, whose mean return is the lower end of the span of a task that the study does not have."""


class Measurement(NamedTuple):
    """Trainings and tests that show what an actuator costs, and what can be done about it."""

    grid: Grid
    """Of all of them."""
    home: Trial
    """Policies that were trained on ideal forces, tested there."""
    options: Mapping[str, Trial]
    """What is done -> its policies, tested on the actuator, or on its motor under a designed loop."""

    def judged(self, collected: Collected) -> "Measured":
        """The verdict, by the rule of `decide`; nothing may be missing, nor ideal-trained policies be like random."""
        if collected.missing:
            why = next((f": {name}: {error}" for name, error in collected.failures.items()), "")
            raise ValueError(f"{len(collected.missing)} of its trainings and tests are missing{why}: run it again")
        env = self.home.env
        floor = FLOORS.get(env.task) if self.home.arm == _ideal_arm(env.task) else None
        if floor is None:
            floor = evaluate(RandomPolicy(env.action_space), env, RANDOM_EPISODES).returns.mean
        level, succeeded = (_values(collected, self.home, name) for name in ("returns", "success"))
        span = float(np.mean(level)) - floor
        if span <= 0.0:
            raise ValueError(f"{env.task}: ideal-trained policies are no better than random actions: train more seeds")
        options = {}
        for name, trial in self.options.items():
            lost = (np.mean(level) - _values(collected, trial, "returns")) / span
            missed = (
                np.mean(succeeded) - _values(collected, trial, "success") if len(succeeded) else np.zeros_like(lost)
            )
            options[name] = Prospect(outcome := Outcome(lost, missed), outcome)
        return Measured(options, decide(options))


class Measured(NamedTuple):
    """What trainings and tests showed."""

    options: Mapping[str, Prospect]
    """What policies lose [shares of the span], by what is done, as if the span were exact."""
    verdict: str
    """One of `OPTIONS`, `BUY` or `MEASURE`, which here is: by more policies."""


def measurement(actuator: Any, subject: str, seeds: int, root: Path, episodes: int = 50) -> Measurement:
    """What there is to be trained and tested.

    `subject` is a task, the Gymnasium id of an environment of others, or the folder of a run, whose environment, agent
    and budget are taken; `actuator` whatever an `EnvConfig` takes; of every kind there are so many runs as `seeds`, in
    folders below `root`.
    """
    if seeds < 2:
        raise ValueError(f"seeds = {seeds}: an interval needs at least 2")
    base = _ideal_arm(subject)
    untouched = base.config.env  # and its reward: it is what policies were trained for
    here = dataclasses.replace(untouched, actuator=actuator)
    if all(one == IDEAL_ACTUATOR for one in here.actuators):
        raise ValueError("actuator = 'ideal': training through it is training on ideal forces: name another")
    env = dataclasses.replace(base.config.env, actuator=actuator)
    through = Arm(f"{base.task}: through it", dataclasses.replace(base.config, env=env), base.seconds)
    options = {IDEAL: Trial(base, "it", here)}
    if "timestep" in here.world.fields and len(here.actuators) == 1:  # a loop is designed, and a lag drawn, for one
        better = redesign(here.actuators[0], base.task)
        if better is not None:
            options[LOOP] = Trial(base, "designed", dataclasses.replace(untouched, actuator=better))
        options[RANDOMISE] = Trial(generic(base), "it", here)
    options[THROUGH] = Trial(through, "it", here)
    home = Trial(base, "ideal", untouched)
    return Measurement(Grid(root, (home, *options.values()), lambda _: range(seeds), episodes), home, options)


def _ideal_arm(subject: str) -> Arm:
    """The training on ideal forces: the study's, that of a run, or the default one of a world."""
    if subject in SECONDS:
        return ideal(subject)
    if (Path(subject) / "config.json").is_file():
        config = load_config(Path(subject))
    else:
        env = EnvConfig(subject)
        config = TrainConfig.preset(subject, env.world.default_agent(env))
    never = max(config.total_steps or 10**9, 10**9)
    env = dataclasses.replace(config.env, actuator=IDEAL_ACTUATOR, randomize=None, allow_unstable=False)
    config = dataclasses.replace(config, env=env, seed=0, evaluation_interval=never, checkpoint_interval=never)
    return Arm(f"{config.task}: ideal", config, 60.0)


def _values(collected: Collected, trial: Trial, measure: str) -> np.ndarray:
    return np.array(list(collected.scores(trial, measure).values()))
