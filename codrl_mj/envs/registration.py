"""Registers our environments with Gymnasium. Light: it names the environments' classes and imports none."""

from typing import NamedTuple

from gymnasium.envs.registration import register, registry


class Registered(NamedTuple):
    """What Gymnasium is told of an environment."""

    env_id: str
    max_episode_steps: int
    reward_threshold: float | None


ENVIRONMENTS: dict[str, Registered] = {
    # limits and thresholds are Gymnasium's for the environments rebuilt
    "pendulum": Registered("codrl_mj/Pendulum-v0", 200, None),
    "cartpole": Registered("codrl_mj/CartPole-v0", 500, 475.0),
    "acrobot": Registered("codrl_mj/Acrobot-v0", 500, -100.0),
    "mountain_car": Registered("codrl_mj/MountainCar-v0", 200, -110.0),
    "mountain_car_continuous": Registered("codrl_mj/MountainCarContinuous-v0", 999, 90.0),
}
"""Task name -> its registration."""


def register_envs() -> None:
    """Register every environment id under `codrl_mj/`; harmless when repeated."""
    for task, (env_id, max_episode_steps, reward_threshold) in ENVIRONMENTS.items():
        if env_id not in registry:
            register(
                id=env_id,
                entry_point="codrl_mj.envs:ActuatedEnv",
                vector_entry_point="codrl_mj.envs:ActuatedVectorEnv",
                kwargs={"task": task},
                max_episode_steps=max_episode_steps,
                reward_threshold=reward_threshold,
            )
