"""What an experiment of the mismatch study consists of: ways to train, tests, and comparisons."""

import dataclasses
from collections.abc import Iterable
from typing import Literal

from codrl_mj.study.conditions import Condition
from codrl_mj.tasks import find_task
from codrl_mj.training import TrainConfig

AGENTS: dict[str, tuple[str, str]] = {
    "cartpole": ("ppo", "dqn"),
    "pendulum": ("ppo", "sac"),
    "acrobot": ("ppo", "dqn"),
}
"""Task -> the agent of all experiments, the cheapest that learns it, and the one that `agents` compares it with."""
PAPER_RADIUS = 0.1
"""CartPole: distance from the centre [m] beyond which the paper's training reward is 0."""


@dataclasses.dataclass(frozen=True)
class Arm:
    """A way to train, to be repeated with every seed."""

    task: str
    """Task name."""
    agent: str
    """The agent's name; its settings are the task's default ones."""
    condition: Condition
    """What it trains on."""
    action: Literal["force", "voltage"] = "force"
    """What it commands: `force` or `voltage`."""
    observe: bool = False
    """Whether it also observes measured and reference current."""
    plain_reward: bool = False
    """CartPole: train with Gymnasium's reward instead of the paper's."""

    @property
    def name(self) -> str:
        """What sets it apart from the task's other arms."""
        parts = [
            self.condition.name,
            self.action if self.action != "force" else "",
            "current observed" if self.observe else "",
            "plain reward" if self.plain_reward else "",
            self.agent if self.agent != AGENTS[self.task][0] else "",
        ]
        return ", ".join(part for part in parts if part)

    def config(self, seed: int, total_steps: int | None = None) -> TrainConfig:
        """The training with a seed.

        Args:
            seed: training seed.
            total_steps: environment steps; None: the settings' own budget.
        """
        base = TrainConfig.preset(self.task, self.agent, seed=seed)
        radius = PAPER_RADIUS if self.task == "cartpole" and not self.plain_reward else None
        env = dataclasses.replace(
            self.condition.env,
            action=self.action,
            levels=self._levels(),
            observe_actuator=self.observe,
            options={} if radius is None else {"center_radius": radius},
        )
        return dataclasses.replace(base, env=env, total_steps=total_steps or base.total_steps)

    def _levels(self) -> tuple[float, ...] | None:
        """The voltages [V] that discrete actions choose from.

        All of the supply, which changes the current fastest, and a quarter and a sixteenth of it: with 24 V the last is
        1.5 V, which is what CartPole's force takes at standstill.
        """
        if self.action != "voltage" or find_task(self.task).forces is None:
            return None
        supply = self.condition.actuator.controller.max_voltage
        steps = (supply / 16, supply / 4, supply)
        return (*(-step for step in reversed(steps)), 0.0, *steps)


@dataclasses.dataclass(frozen=True)
class Trial:
    """The policies of an arm, tested."""

    arm: Arm
    """How they were trained."""
    test: Condition
    """What they are tested on, with the task's own reward and time limit."""

    @property
    def name(self) -> str:
        """What sets it apart from all others."""
        return f"{self.arm.task}: {self.arm.name} on {self.test.name}"


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Two trials that answer a question."""

    question: str
    """What is asked, such as `trained on it, over trained on ideal`; comparisons that ask the same are pooled."""
    one: Trial
    """The trial of which it is asked whether it is better."""
    other: Trial
    """The trial that it is compared with, on the same test condition."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """An experiment on one task."""

    trials: tuple[Trial, ...]
    """What is trained and tested, each once, in the order of rows and then of columns."""
    comparisons: tuple[Comparison, ...]
    """What is compared; all their trials are among `trials`."""
    series: tuple[tuple[str, tuple[Trial, ...]], ...] = ()
    """What is drawn as points over the test conditions, by label; without any, the trials are drawn as a heat map."""

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms: rows of tables."""
        return tuple({trial.arm.name: trial.arm for trial in self.trials}.values())

    @property
    def tests(self) -> tuple[Condition, ...]:
        """The test conditions: columns of tables."""
        return tuple({trial.test.name: trial.test for trial in self.trials}.values())

    def only(self, names: Iterable[str]) -> "Plan":
        """What is left of it if arms and tests are on the conditions of these names."""
        chosen = set(names)

        def stays(trial: Trial) -> bool:
            return {trial.arm.condition.name, trial.test.name} <= chosen

        return Plan(
            tuple(trial for trial in self.trials if stays(trial)),
            tuple(pair for pair in self.comparisons if stays(pair.one) and stays(pair.other)),
            tuple((label, tuple(filter(stays, drawn))) for label, drawn in self.series if any(map(stays, drawn))),
        )
