"""PPO: proximal policy optimization with clipping, based on Stable-Baselines3."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar, Literal

from gymnasium import spaces

from codrl_mj.agents.base import (
    AgentModel,
    AgentPolicy,
    DeepAgentConfig,
    TrainingEnvs,
    check_buffer,
)
from codrl_mj.envs.config import Space
from codrl_mj.fields import choice, flag, integer, positive_integers, real


@dataclasses.dataclass(frozen=True)
class PPOConfig(DeepAgentConfig):
    """Proximal policy optimization with clipping, based on Stable-Baselines3.

    Discount, clip range and network are the paper's; the other defaults were chosen so that a run
    takes a minute on two cores. With `critic_learning_rate`, actor and critic learn separately, as
    in the paper.
    """

    name: ClassVar[str] = "ppo"
    action_spaces: ClassVar[tuple[type[Space], ...]] = (spaces.Box, spaces.Discrete)

    learning_rate: float = real(1e-3, above=0, maximum=1)
    """Adam's step size for the actor, in (0, 1], and for the critic if `critic_learning_rate` is
    None. The paper: 3e-4.
    """
    critic_learning_rate: float | None = real(None, above=0, maximum=1)
    """Adam's step size for the critic, in (0, 1]: actor and critic then take separate passes over a
    rollout, and `target_kl` stops only the actor's. None: one optimizer and one loss for both. The
    paper: 1e-3.
    """
    rollout_steps: int = integer(2048, minimum=2)
    """Steps of all environments together between two updates, >= 2; a multiple of `num_envs`."""
    batch_size: int | None = integer(256, minimum=2, optional=True)
    """Minibatch size, >= 2, a divisor of `rollout_steps`. None: all of it. The paper: 4000, all."""
    epochs: int = integer(10, minimum=1)
    """Passes over each rollout, >= 1, unless `target_kl` stops them."""
    critic_epochs: int | None = integer(None, minimum=1)
    """Passes over each rollout for the critic with `critic_learning_rate`, >= 1; None: `epochs`."""
    gamma: float = real(0.99, above=0, maximum=1)
    """Discount factor, in (0, 1]. The paper: 0.99."""
    gae_lambda: float = real(0.97, minimum=0, maximum=1)
    """Lambda of generalized advantage estimation, in [0, 1]. The paper: 0.97."""
    clip_range: float = real(0.2, above=0)
    """Clip range of the probability ratio, > 0. The paper: 0.2."""
    entropy_coefficient: float = real(0.0, minimum=0)
    """Weight of the entropy bonus, >= 0."""
    target_kl: float | None = real(0.03, above=0, optional=True)
    """Divergence of the policy [nat], > 0; passes over a rollout stop at 1.5 times this. None: they
    never stop. The paper: 0.01.
    """
    hidden: tuple[int, ...] = positive_integers((64, 64))
    """Units of the hidden layers of the actor, and of the critic. The paper: 64-64."""
    activation: Literal["tanh", "relu"] = choice("tanh", "tanh", "relu")
    """Activation of the hidden layers. The paper: tanh."""
    log_std_init: float = real(0.0, minimum=-20, maximum=10)
    """Continuous actions: natural logarithm of the initial standard deviation, in [-20, 10]."""
    state_dependent_noise: bool = flag(False)
    """Continuous actions: explore by noise that is a function of the state, which is drawn every
    `noise_steps` (Raffin et al., 2021). It moves a system more than independent noise at every
    step.
    """
    noise_steps: int | None = integer(None, minimum=1)
    """Steps between two draws of the state-dependent noise, >= 1; None: one draw per rollout."""

    unit_actions: bool = flag(False)
    """Continuous actions: the actor's mean and noise are in units of the largest action, so that
    the same settings suit commands in torque, current and voltage. Not with
    `state_dependent_noise`.
    """

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.unit_actions and self.state_dependent_noise:
            raise ValueError(
                "PPOConfig.unit_actions = True: must be False with state_dependent_noise, which has"
                " another scale; set one of them"
            )

    def make_model(self, env: TrainingEnvs, seed: int) -> AgentModel:
        """See `AgentConfig.make_model`.

        Raises:
            ValueError: the rollout is not a multiple of the environments, or of the minibatch.
        """
        from stable_baselines3 import PPO

        from codrl_mj.agents.fast_ppo import FastPPO
        from codrl_mj.agents.models import TwoRatePPO

        batch_size = self.batch_size or self.rollout_steps
        for name, size in (("num_envs", env.num_envs), ("batch_size", batch_size)):
            if self.rollout_steps % size:
                raise ValueError(
                    f"PPOConfig.rollout_steps = {self.rollout_steps}: must be a multiple of {name}"
                    f" = {size}"
                )
        check_buffer("PPOConfig.rollout_steps", self.rollout_steps, env, observations=1)
        arguments: dict[str, object] = {
            "learning_rate": self.learning_rate,
            "n_steps": self.rollout_steps // env.num_envs,
            "batch_size": batch_size,
            "n_epochs": self.epochs,
            "gamma": self.gamma,
            "gae_lambda": self.gae_lambda,
            "clip_range": self.clip_range,
            "ent_coef": self.entropy_coefficient,
            "target_kl": self.target_kl,
            "use_sde": self.state_dependent_noise,
            "sde_sample_freq": self.noise_steps or -1,
            "policy_kwargs": self._network(),
            "seed": seed,
            "device": "cpu",
        }
        if self.critic_learning_rate is None:
            algorithm = (
                FastPPO if isinstance(env.action_space, spaces.Box | spaces.Discrete) else PPO
            )
            model: AgentModel = algorithm(self._policy_class(), env, **arguments)
            return model
        return TwoRatePPO(
            self._policy_class(),
            env,
            critic_learning_rate=self.critic_learning_rate,
            critic_epochs=self.critic_epochs or self.epochs,
            **arguments,
        )

    def _policy_class(self) -> Callable[..., AgentPolicy]:
        from stable_baselines3.common.policies import ActorCriticPolicy

        from codrl_mj.agents.models import UnitActionPolicy

        policy_class: Callable[..., AgentPolicy] = (
            UnitActionPolicy if self.unit_actions else ActorCriticPolicy
        )
        return policy_class

    def _policy_arguments(self) -> dict[str, object]:
        return {"use_sde": self.state_dependent_noise, **self._network()}

    def _network(self) -> dict[str, object]:
        from torch import nn

        return {
            "net_arch": list(self.hidden),
            "activation_fn": {"tanh": nn.Tanh, "relu": nn.ReLU}[self.activation],
            "log_std_init": self.log_std_init,
            **super()._policy_arguments(),
        }
