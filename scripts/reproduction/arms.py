"""Training arms of the paper's experiments, with the motors and settings that the paper prints."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from codrl_mj.actuators import IDEAL, CurrentLoop, DCMotorActuator
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.axes import CENTER_RADIUS
from codrl_mj.study.trials import Arm, Trial
from codrl_mj.tasks import find_task
from codrl_mj.training import TrainConfig

TEST, CENTRE = "test", "centre"
"""Tests of a trained policy: Gymnasium's task; for CartPole also with its training reward."""


@dataclasses.dataclass(frozen=True)
class PaperArm(Arm):
    """Experiment of the paper, or the same without a motor or with Gymnasium's own equations."""

    settings: str
    """Settings of the agent: `paper` or `repaired`."""
    motor: str
    """Name of the actuator in the arm's name, such as `ideal`."""

    @property
    def actuator(self) -> Any:
        """Actuator of the arm's trainings and tests."""
        return self.config.actuator

    @property
    def physics(self) -> str:
        """`mujoco`, or `analytic` for Gymnasium's own equations."""
        return self.config.env.physics

    @property
    def gains(self) -> str:
        """Controller gains as text."""
        if self.actuator == IDEAL:
            return "no motor"
        loop = self.actuator.controller
        feed_forward = f", kFF {loop.kff:g}" if loop.kff else ""
        return f"kP {loop.kp:g}, kI {loop.ki:g}, kD {loop.kd:g}{feed_forward}"

    @property
    def trials(self) -> dict[str, Trial]:
        """Tests of the arm's policies, by name."""
        envs = {TEST: EnvConfig(self.task, self.actuator, self.physics)}
        if self.task == "cartpole":
            envs[CENTRE] = dataclasses.replace(envs[TEST], options={"center_radius": CENTER_RADIUS})
        return {test: Trial(self, test, env) for test, env in envs.items()}

    def cut_off(self, episodes: int) -> "PaperArm":
        """Return the arm with trainings that stop after that many episodes, for quick trials."""
        return dataclasses.replace(
            self, config=dataclasses.replace(self.config, total_episodes=episodes)
        )


FAST: DCMotorActuator = dataclasses.replace(
    find_task("mountain_car").paper[0], controller=CurrentLoop(kp=2.0, ki=10.0, kd=1e-6)
)
"""Mountain car's second set of gains (section Solving the Mountain Car Environment)."""


def _arms(
    task: str, agent: str, settings: str, seconds: Mapping[str, float], physics: str = "mujoco"
) -> tuple[PaperArm, ...]:
    """Return an experiment's arms; `seconds` is the median duration of a training [s], by motor."""
    motors = {"paper gains": find_task(task).paper[0], "fast gains": FAST, "ideal": IDEAL}
    return tuple(
        PaperArm(
            f"{task}, {settings}, {motor}, {physics}",
            TrainConfig.preset(task, agent, settings, motors[motor], {"physics": physics}),
            duration,
            settings,
            motor,
        )
        for motor, duration in seconds.items()
    )


def _with_and_without(seconds: float) -> dict[str, float]:
    return {"paper gains": seconds, "ideal": seconds}


_HILL, _POLE = ("mountain_car", "sarsa", "paper"), ("cartpole", "ppo", "paper")
ARMS: tuple[PaperArm, ...] = (
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
"""All arms of all experiments."""
TASKS: tuple[str, ...] = tuple(dict.fromkeys(arm.task for arm in ARMS))
"""Tasks in the paper's order."""
