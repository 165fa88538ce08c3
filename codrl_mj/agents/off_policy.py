"""What the agents that learn from a replay buffer have in common."""

import dataclasses
from typing import Any

from gymnasium import spaces

from codrl_mj.agents.deep import DeepAgentConfig
from codrl_mj.fields import integer, real


@dataclasses.dataclass(frozen=True)
class OffPolicyConfig(DeepAgentConfig):
    """Settings of an agent that learns from a replay buffer."""

    learning_rate: float = real(1e-3, above=0, most=1)
    """Adam's step size, in (0, 1]."""
    gamma: float = real(0.99, above=0, most=1)
    """Discount factor, in (0, 1]."""
    tau: float = real(5e-3, above=0, most=1)
    """Share by which the target networks follow at each of their updates, in (0, 1]."""
    buffer_size: int = integer(100_000, least=1)
    """Transitions in the replay buffer, >= 1."""
    batch_size: int = integer(64, least=1)
    """Transitions in a gradient step, >= 1."""
    learning_starts: int = integer(1000, least=0)
    """Environment steps of uniformly random actions before learning, >= 0."""
    train_every: int | None = integer(1, least=1, optional=True)
    """Steps of every environment between two trainings, >= 1; None: an episode, which needs a single environment."""
    gradient_steps: int | None = integer(None, least=1)
    """Gradient steps of a training, >= 1; None: one for each environment step since the last training."""

    def _model_arguments(self, env: Any, seed: int) -> dict[str, Any]:
        """Keyword arguments of the Stable-Baselines3 model.

        Raises:
            ValueError: the settings do not go with the environments.
        """
        if self.train_every is None and env.num_envs > 1:
            raise ValueError(
                f"{type(self).__name__}.train_every = None: training at the end of every episode needs num_envs = 1, "
                f"not {env.num_envs}; set train_every to a number of steps"
            )
        return {
            "policy": self._policy_class(),
            "env": env,
            "learning_rate": self.learning_rate,
            "gamma": self.gamma,
            "tau": self.tau,
            "buffer_size": self.buffer_size,
            "batch_size": self.batch_size,
            "learning_starts": self.learning_starts,
            "train_freq": (1, "episode") if self.train_every is None else (self.train_every, "step"),
            "gradient_steps": self.gradient_steps or -1,
            "policy_kwargs": self._policy_arguments(),
            "seed": seed,
            "device": "cpu",
        }

    def _policy_arguments(self) -> dict[str, Any]:
        # one call for all tensors of a network: a tenth more steps per second
        return {"optimizer_kwargs": {"fused": True}, **super()._policy_arguments()}


@dataclasses.dataclass(frozen=True)
class ActorCriticConfig(OffPolicyConfig):
    """Settings of an agent for continuous actions that learns from a replay buffer.

    It explores by Ornstein-Uhlenbeck noise on the action, x' = x - theta * x * dt + sigma * sqrt(dt) * N(0, 1), which
    starts at 0 in every episode. `noise_theta = noise_dt = 1` is independent noise of standard deviation sigma.
    """

    critic_learning_rate: float | None = real(None, above=0, most=1)
    """Adam's step size for the critic, in (0, 1]; None: `learning_rate`."""
    noise_sigma: float = real(0.0, least=0)
    """Scale sigma of the exploration noise, >= 0, in shares of half the action's range; 0: none."""
    noise_theta: float = real(0.15, least=0)
    """Rate theta at which the exploration noise returns to 0, >= 0."""
    noise_dt: float = real(1e-2, above=0)
    """Time step dt of the exploration noise, > 0; `noise_theta * noise_dt` must be below 2, where it turns unstable."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.noise_theta * self.noise_dt >= 2:
            raise ValueError(
                f"{type(self).__name__}.noise_theta = {self.noise_theta!r}: noise_theta * noise_dt must be < 2, "
                f"and noise_dt = {self.noise_dt!r}"
            )

    def _model_arguments(self, env: Any, seed: int) -> dict[str, Any]:
        return {
            **super()._model_arguments(env, seed),
            "critic_learning_rate": self.critic_learning_rate or self.learning_rate,
            "action_noise": self._noise(env.action_space),
        }

    def _noise(self, action_space: spaces.Box) -> Any:
        if self.noise_sigma == 0:
            return None
        import numpy as np
        from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

        mean = np.zeros(action_space.shape)
        sigma = np.full(action_space.shape, self.noise_sigma)
        return OrnsteinUhlenbeckActionNoise(mean, sigma, theta=self.noise_theta, dt=self.noise_dt)
