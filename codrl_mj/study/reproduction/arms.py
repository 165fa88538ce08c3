"""The arms of the paper's experiments: who learns what on which motor, with the settings that the paper prints."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from codrl_mj.actuators import IDEAL, Actuator
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.grid import Deployment
from codrl_mj.tasks import find_task
from codrl_mj.training import EVALUATION_SEED, TrainConfig

TEST, CENTRE = "test", "centre"
"""Tests of a trained policy: the task as Gymnasium poses it; CartPole's with the reward that it was trained with."""
CENTRE_RADIUS = 0.1  # m, the paper's, CartPole


@dataclasses.dataclass(frozen=True)
class Arm:
    """One way to learn a task, to be repeated with many seeds."""

    task: str
    """Task name."""
    agent: str
    """The agent's name."""
    settings: str
    """Of the agent: `paper` or `repaired`."""
    motor: str
    """What the arm is called for its actuator, such as `ideal`."""
    actuator: Any
    """What it learns, and is tested, on."""
    seconds: float
    """Computing time of a run and its tests on one core [s]: about the median of the results in docs/results."""
    physics: Literal["mujoco", "analytic"] = "mujoco"
    """MuJoCo, or Gymnasium's own equations."""

    @property
    def name(self) -> str:
        """A name that no other arm has."""
        return f"{self.task}, {self.settings}, {self.motor}, {self.physics}"

    @property
    def gains(self) -> str:
        """The controller's gains as text."""
        if self.actuator == IDEAL:
            return "no motor"
        loop = self.actuator.controller
        feed_forward = f", kFF {loop.kff:g}" if loop.kff else ""
        return f"kP {loop.kp:g}, kI {loop.ki:g}, kD {loop.kd:g}{feed_forward}"

    def config(self, seed: int, episodes: int | None = None) -> TrainConfig:
        """The training run of a seed: the preset's, on this arm's actuator and physics.

        Args:
            seed: training seed.
            episodes: stop after that many training episodes already; for trying things out.
        """
        changes: dict[str, Any] = {} if episodes is None else {"total_episodes": episodes}
        return TrainConfig.preset(
            self.task, self.agent, self.settings, self.actuator, {"physics": self.physics}, seed=seed, **changes
        )

    def deployments(self, run: Path, episodes: int) -> dict[str, Deployment]:
        """The tests of a trained policy, by name."""
        env = EnvConfig(self.task, self.actuator, self.physics)
        envs = {TEST: env}
        if self.task == "cartpole":
            envs[CENTRE] = dataclasses.replace(env, options={"center_radius": CENTRE_RADIUS})
        return {name: Deployment(run, one, episodes, EVALUATION_SEED) for name, one in envs.items()}


FAST: Actuator = dataclasses.replace(
    find_task("mountain_car").paper[0],
    controller=dataclasses.replace(find_task("mountain_car").paper[0].controller, kp=2.0, ki=10.0, kd=1e-6),
)
"""The mountain car's second set of gains (Solving the Mountain Car Environment)."""


def _arms(
    task: str,
    agent: str,
    settings: str,
    seconds: Mapping[str, float],
    physics: Literal["mujoco", "analytic"] = "mujoco",
) -> tuple[Arm, ...]:
    """The arms of an experiment, by motor: how long a run takes."""
    motors = {"paper gains": find_task(task).paper[0], "fast gains": FAST, "ideal": IDEAL}
    return tuple(Arm(task, agent, settings, name, motors[name], took, physics) for name, took in seconds.items())


def _with_and_without(seconds: float) -> dict[str, float]:
    return {"paper gains": seconds, "ideal": seconds}


_HILL, _POLE = ("mountain_car", "sarsa", "paper"), ("cartpole", "ppo", "paper")
ARMS: tuple[Arm, ...] = (
    *_arms("pendulum", "ddpg", "paper", _with_and_without(290)),
    *_arms("pendulum", "ddpg", "repaired", _with_and_without(300)),
    *_arms(*_HILL, {"paper gains": 5, "fast gains": 5, "ideal": 3}),
    *_arms(*_HILL, {"paper gains": 30, "fast gains": 30, "ideal": 8}, "analytic"),
    *_arms("mountain_car_continuous", "ddpg", "paper", _with_and_without(330)),
    *_arms("mountain_car_continuous", "ddpg", "repaired", _with_and_without(60)),
    *_arms("acrobot", "dqn", "paper", _with_and_without(75)),
    *_arms(*_POLE, _with_and_without(100)),
    *_arms(*_POLE, _with_and_without(110), "analytic"),
)
"""Every arm of every experiment."""


TASKS: tuple[str, ...] = tuple(dict.fromkeys(arm.task for arm in ARMS))
"""The tasks in the paper's order."""


def arms_of(tasks: Sequence[str]) -> list[Arm]:
    """The arms of some tasks, in the paper's order."""
    return [arm for arm in ARMS if arm.task in tasks]
