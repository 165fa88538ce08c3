"""Agents that learn from a replay buffer, based on Stable-Baselines3: DDPG, TD3, SAC and DQN."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

from gymnasium import spaces

from codrl_mj.agents.base import (
    AgentModel,
    AgentPolicy,
    DeepAgentConfig,
    TrainingEnvs,
    check_buffer,
)
from codrl_mj.envs.config import Space
from codrl_mj.fields import flag, integer, positive_integers, real


@dataclasses.dataclass(frozen=True)
class OffPolicyConfig(DeepAgentConfig):
    """Settings of an agent that learns from a replay buffer."""

    algorithm: ClassVar[str]
    """Name of the algorithm's class in `codrl_mj.agents.models`."""

    learning_rate: float = real(1e-3, above=0, maximum=1)
    """Adam's step size, in (0, 1]."""
    gamma: float = real(0.99, above=0, maximum=1)
    """Discount factor, in (0, 1]."""
    tau: float = real(5e-3, above=0, maximum=1)
    """Fraction by which each update moves the target networks, in (0, 1]."""
    buffer_size: int = integer(100_000, minimum=1)
    """Transitions in the replay buffer, >= 1."""
    batch_size: int = integer(64, minimum=1)
    """Transitions in a gradient step, >= 1."""
    learning_starts: int = integer(1000, minimum=0)
    """Environment steps of uniformly random actions before learning, >= 0."""
    train_every: int | None = integer(1, minimum=1, optional=True)
    """Steps of each environment between trainings, >= 1; None: one training after each
    episode, which requires `num_envs` = 1.
    """
    gradient_steps: int | None = integer(None, minimum=1)
    """Gradient steps per training, >= 1; None: as many as the environment steps since the last
    training.
    """

    def make_model(self, env: TrainingEnvs, seed: int) -> AgentModel:
        """See `AgentConfig.make_model`."""
        if self.train_every is None and env.num_envs > 1:
            raise ValueError(
                f"{type(self).__name__}.train_every = None: training at the end of every episode"
                f" needs num_envs = 1, not {env.num_envs}; set train_every to a number of steps"
            )
        check_buffer(f"{type(self).__name__}.buffer_size", self.buffer_size, env, observations=2)
        from codrl_mj.agents import models

        model: AgentModel = getattr(models, self.algorithm)(
            "MlpPolicy",
            env,
            learning_rate=self.learning_rate,
            gamma=self.gamma,
            tau=self.tau,
            buffer_size=self.buffer_size,
            batch_size=self.batch_size,
            learning_starts=self.learning_starts,
            train_freq=(1, "episode") if self.train_every is None else (self.train_every, "step"),
            gradient_steps=self.gradient_steps or -1,
            policy_kwargs=self._policy_arguments(),
            seed=seed,
            device="cpu",
            **self._algorithm_arguments(env.action_space),
        )
        return model

    def _algorithm_arguments(self, action_space: Space) -> dict[str, object]:
        """Return keyword arguments that are specific to the algorithm."""
        raise NotImplementedError

    def _policy_class(self) -> Callable[..., AgentPolicy]:
        from codrl_mj.agents import models

        policy_class: Callable[..., AgentPolicy] = getattr(models, self.algorithm).policy_aliases[
            "MlpPolicy"
        ]
        return policy_class

    def _policy_arguments(self) -> dict[str, object]:
        # A fused Adam updates all tensors of a network in one call, which gives about 10 % more
        # steps per second.
        return {"optimizer_kwargs": {"fused": True}, **super()._policy_arguments()}


@dataclasses.dataclass(frozen=True)
class ActorCriticConfig(OffPolicyConfig):
    """Settings of an agent for continuous actions that learns from a replay buffer.

    It explores by Ornstein-Uhlenbeck noise on the action, x' = x - theta * x * dt + sigma *
    sqrt(dt) * N(0, 1), which starts at 0 in every episode. With `noise_theta = noise_dt = 1` the
    noise is independent, with standard deviation sigma.
    """

    action_spaces: ClassVar[tuple[type[Space], ...]] = (spaces.Box,)

    critic_learning_rate: float | None = real(None, above=0, maximum=1)
    """Adam's step size for the critic, in (0, 1]; None: `learning_rate`."""
    noise_sigma: float = real(0.0, minimum=0)
    """Scale sigma of the noise, >= 0, as a fraction of half the action's range; 0: no noise."""
    noise_theta: float = real(0.15, minimum=0)
    """Rate theta at which the exploration noise returns to 0, >= 0."""
    noise_dt: float = real(1e-2, above=0)
    """Time step dt of the noise, > 0; it is stable if `noise_theta * noise_dt` is below 2."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.noise_theta * self.noise_dt >= 2:
            raise ValueError(
                f"{type(self).__name__}.noise_theta = {self.noise_theta!r}: noise_theta * noise_dt"
                f" must be < 2, and noise_dt = {self.noise_dt!r}"
            )

    def _algorithm_arguments(self, action_space: Space) -> dict[str, object]:
        import numpy as np
        from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

        shape = action_space.shape or ()
        mean, sigma = np.zeros(shape), np.full(shape, self.noise_sigma)
        noise = OrnsteinUhlenbeckActionNoise(mean, sigma, theta=self.noise_theta, dt=self.noise_dt)
        return {
            "critic_learning_rate": self.critic_learning_rate or self.learning_rate,
            "action_noise": noise if self.noise_sigma else None,
        }


@dataclasses.dataclass(frozen=True)
class DDPGConfig(ActorCriticConfig):
    """Deep deterministic policy gradient, based on Stable-Baselines3, with the paper's critic.

    The critic has separate layers for state and action, then joint layers. Every hidden layer has a
    ReLU; the actor ends in tanh, times half the action's range.
    """

    name: ClassVar[str] = "ddpg"
    algorithm: ClassVar[str] = "TwoRateDDPG"

    noise_sigma: float = real(0.2, minimum=0)
    """Scale sigma of the noise, >= 0, as a fraction of half the action's range; 0: no noise."""
    actor_units: tuple[int, ...] = positive_integers((64, 64))
    """Units of the actor's hidden layers. The paper: 64-64."""
    state_units: tuple[int, ...] = positive_integers((16, 32))
    """Units of the critic's layers for the state only; () passes the state on unchanged. The paper:
    1 (pendulum), 64 (car).
    """
    action_units: tuple[int, ...] = positive_integers((32,))
    """Units of the critic's layers for the action only; () passes the action on unchanged. The
    paper: 32 (pendulum), () (car).
    """
    joint_units: tuple[int, ...] = positive_integers((256, 256))
    """Units of the critic's hidden layers behind the merged state and action layers. The paper:
    256-256 (pendulum), 64 (car).
    """

    def _policy_arguments(self) -> dict[str, object]:
        streams = {
            name: getattr(self, name) for name in ("state_units", "action_units", "joint_units")
        }
        return {
            "net_arch": list(self.actor_units),
            "n_critics": 1,
            **streams,
            **super()._policy_arguments(),
        }


@dataclasses.dataclass(frozen=True)
class TD3Config(ActorCriticConfig):
    """Twin delayed DDPG (Fujimoto et al., 2018), based on Stable-Baselines3; not in the paper."""

    name: ClassVar[str] = "td3"
    algorithm: ClassVar[str] = "TwoRateTD3"

    noise_sigma: float = real(0.1, minimum=0)
    """Scale sigma of the noise, >= 0, as a fraction of half the action's range; 0: no noise."""
    hidden: tuple[int, ...] = positive_integers((64, 64))
    """Units of the hidden layers of the actor and of each critic (ReLU)."""
    policy_delay: int = integer(2, minimum=1)
    """Critic updates for each update of the actor and the targets, >= 1."""
    target_noise: float = real(0.2, minimum=0)
    """Standard deviation of the noise on the target actions, >= 0, in shares of half the action's
    range; clipped at 2.5 times that.
    """

    def _algorithm_arguments(self, action_space: Space) -> dict[str, object]:
        return {
            "policy_delay": self.policy_delay,
            "target_policy_noise": self.target_noise,
            "target_noise_clip": 2.5 * self.target_noise,
            **super()._algorithm_arguments(action_space),
        }

    def _policy_arguments(self) -> dict[str, object]:
        return {"net_arch": list(self.hidden), **super()._policy_arguments()}


@dataclasses.dataclass(frozen=True)
class SACConfig(ActorCriticConfig):
    """Soft actor-critic (Haarnoja et al., 2018), based on Stable-Baselines3; not in the paper."""

    name: ClassVar[str] = "sac"
    algorithm: ClassVar[str] = "TwoRateSAC"

    hidden: tuple[int, ...] = positive_integers((64, 64))
    """Units of the hidden layers of the actor and of each critic (ReLU)."""
    entropy_coefficient: float | None = real(None, minimum=0)
    """Weight of the entropy, >= 0; None: learned, for an entropy of -1 nat per action entry."""
    state_dependent_noise: bool = flag(False)
    """Explore by noise that is a function of the state, which is drawn at every training (Raffin et
    al., 2021).
    """
    log_std_init: float = real(-3.0)
    """Natural logarithm of the initial standard deviation of the state-dependent noise."""

    def _algorithm_arguments(self, action_space: Space) -> dict[str, object]:
        return {
            "ent_coef": "auto" if self.entropy_coefficient is None else self.entropy_coefficient,
            "use_sde": self.state_dependent_noise,
            **super()._algorithm_arguments(action_space),
        }

    def _policy_arguments(self) -> dict[str, object]:
        return {
            "net_arch": list(self.hidden),
            "use_sde": self.state_dependent_noise,
            "log_std_init": self.log_std_init,
            **super()._policy_arguments(),
        }


@dataclasses.dataclass(frozen=True)
class DQNConfig(OffPolicyConfig):
    """Deep Q-learning with a target network, based on Stable-Baselines3.

    The loss is Huber's, and gradients are clipped to the norm 10.
    """

    name: ClassVar[str] = "dqn"
    algorithm: ClassVar[str] = "EpisodicDQN"
    action_spaces: ClassVar[tuple[type[Space], ...]] = (spaces.Discrete,)

    hidden: tuple[int, ...] = positive_integers((64, 128))
    """Units of the hidden layers (ReLU). The paper: 64-128."""
    target_every: int = integer(1, minimum=1)
    """Environment steps between two updates of the target network, >= 1."""
    exploration_start: float = real(1.0, minimum=0, maximum=1)
    """Probability epsilon of a random action at the start, in [0, 1]."""
    exploration_end: float = real(0.01, minimum=0, maximum=1)
    """Smallest epsilon, in [0, 1]."""
    exploration_decay: float | None = real(0.99, above=0, maximum=1, optional=True)
    """Factor that multiplies epsilon after every episode, in (0, 1]; None: epsilon falls linearly
    over `exploration_fraction`.
    """
    exploration_fraction: float = real(0.2, above=0, maximum=1)
    """Share of all steps, in (0, 1], over which epsilon falls if `exploration_decay` is None."""

    def _algorithm_arguments(self, action_space: Space) -> dict[str, object]:
        del action_space
        return {
            "target_update_interval": self.target_every,
            "exploration_initial_eps": self.exploration_start,
            "exploration_final_eps": self.exploration_end,
            "exploration_fraction": self.exploration_fraction,
            "exploration_decay": self.exploration_decay,
        }

    def _policy_arguments(self) -> dict[str, object]:
        return {"net_arch": list(self.hidden), **super()._policy_arguments()}
