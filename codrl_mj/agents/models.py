"""Networks and algorithms of the agents that extend those of Stable-Baselines3.

The module imports torch, so import it only where an agent is created.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    FlattenExtractor,
    create_mlp,
)
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.td3.policies import TD3Policy
from torch import nn
from torch.nn import functional


class ScaledObservation(FlattenExtractor):
    """Features extractor that multiplies an observation's entries by fixed factors.

    Entries without a factor are not scaled.
    """

    def __init__(self, observation_space: spaces.Box, factors: Sequence[float]) -> None:
        """Store the factors, at most one for each entry of an observation."""
        super().__init__(observation_space)
        if len(factors) > self.features_dim:
            raise ValueError(
                f"input_scale = {tuple(factors)}: must have at most {self.features_dim} factors,"
                " one for each entry of the observation"
            )
        padded = torch.ones(self.features_dim)
        padded[: len(factors)] = torch.tensor(factors)
        self.register_buffer("factors", padded, persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return observations (N, k) times the factors (k,)."""
        return super().forward(observations) * self.factors


class UnitActionPolicy(ActorCriticPolicy):
    """Policy whose actor has its mean and noise in units of the largest action.

    For example, the largest torque of 0.08 N*m or the largest voltage of 18 V is 1.
    """

    def _build(self, lr_schedule: Schedule) -> None:
        if not isinstance(self.action_space, spaces.Box):
            raise ValueError(
                "unit_actions = True: must be False for discrete actions, which"
                f" {self.action_space} has"
            )
        super()._build(lr_schedule)
        largest = np.maximum(np.abs(self.action_space.low), np.abs(self.action_space.high))
        self.register_buffer("largest", torch.as_tensor(largest), persistent=False)

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Distribution:
        mean = self.action_net(latent_pi) * self.largest
        return self.action_dist.proba_distribution(mean, self.log_std + self.largest.log())


class TwoStreams(nn.Module):
    """Network for Q(state, action) with separate layers for state and action, then joint layers."""

    def __init__(
        self,
        state_size: int,
        action_size: int,
        state: Sequence[int],
        action: Sequence[int],
        joint: Sequence[int],
    ) -> None:
        """Create layers with ReLUs.

        Args:
            state_size: number of entries of a state.
            action_size: number of entries of an action.
            state: units of the state's layers; an empty sequence passes the state on.
            action: units of the action's layers; an empty sequence passes the action on.
            joint: units of the joint layers.
        """
        super().__init__()
        self.state_size = state_size
        self.state_stream = nn.Sequential(*create_mlp(state_size, -1, list(state), nn.ReLU))
        self.action_stream = nn.Sequential(*create_mlp(action_size, -1, list(action), nn.ReLU))
        joined = [state_size, *state][-1] + [action_size, *action][-1]
        self.joint = nn.Sequential(*create_mlp(joined, 1, list(joint), nn.ReLU))

    def forward(self, state_and_action: torch.Tensor) -> torch.Tensor:
        """Return values (N, 1) of concatenated states and actions (N, state_size + action_size)."""
        state = state_and_action[:, : self.state_size]
        action = state_and_action[:, self.state_size :]
        return self.joint(torch.cat([self.state_stream(state), self.action_stream(action)], dim=1))


class TwoStreamPolicy(TD3Policy):
    """Actor and critic of DDPG, with `TwoStreams` as networks of the critic."""

    def __init__(
        self,
        *args: object,
        state_units: Sequence[int],
        action_units: Sequence[int],
        joint_units: Sequence[int],
        **kwargs: object,
    ) -> None:
        """Take the arguments of `TD3Policy`, and the units of `TwoStreams`."""
        self._streams = state_units, action_units, joint_units
        super().__init__(*args, **kwargs)

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> ContinuousCritic:
        """Create the critic of `TD3Policy`, with `TwoStreams` as its networks."""
        critic = super().make_critic(features_extractor)
        state_size, (action_size,) = critic.features_extractor.features_dim, self.action_space.shape
        for index in range(critic.n_critics):
            critic.q_networks[index] = TwoStreams(state_size, action_size, *self._streams)
            critic.add_module(f"qf{index}", critic.q_networks[index])
        return critic


class TwoRatePPO(PPO):
    """Stable-Baselines3's PPO with separate passes and learning rates for actor and critic.

    This is the update of Spinning Up and of Keras's example: passes over the rollout improve the
    actor until its KL divergence exceeds 1.5 times `target_kl`; the critic is fitted in any case.
    Gradients are not clipped. A single Adam optimizer has the two networks as parameter groups. It
    keeps moments and step counts for each tensor and skips tensors without a gradient, so it acts
    like two optimizers, but has one state dict.
    """

    def __init__(
        self, *args: object, critic_learning_rate: float, critic_epochs: int, **kwargs: object
    ) -> None:
        """Take the arguments of `PPO`, and two for the critic.

        `learning_rate` is the actor's, and `n_epochs` the largest number of its passes.
        """
        self.critic_learning_rate = critic_learning_rate
        self.critic_epochs = critic_epochs
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        policy = self.policy
        critic = [*policy.mlp_extractor.value_net.parameters(), *policy.value_net.parameters()]
        critic_ids = {id(parameter) for parameter in critic}
        actor = [parameter for parameter in policy.parameters() if id(parameter) not in critic_ids]
        groups = [{"params": actor}, {"params": critic}]
        policy.optimizer = policy.optimizer_class(
            groups, lr=self.lr_schedule(1), **policy.optimizer_kwargs
        )

    def train(self) -> None:
        """Learn from the rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        self.policy.optimizer.param_groups[1]["lr"] = self.critic_learning_rate
        passes = 0
        while passes < self.n_epochs and self._improve_actor():
            passes += 1
        for _ in range(self.critic_epochs):
            self._improve_critic()
        self._n_updates += passes
        self.logger.record("train/actor_passes", passes)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _improve_actor(self) -> bool:
        """Improve the actor in one pass over the rollout; return True if the pass was completed.

        The pass stops early if the policy has diverged too far from the policy of the rollout.
        """
        clip_range = self.clip_range(self._current_progress_remaining)
        for rollout in self.rollout_buffer.get(self.batch_size):
            discrete = isinstance(self.action_space, spaces.Discrete)
            actions = rollout.actions.long().flatten() if discrete else rollout.actions
            distribution = self.policy.get_distribution(rollout.observations)
            log_probability = distribution.log_prob(actions)
            log_ratio = log_probability - rollout.old_log_prob
            ratio = log_ratio.exp()
            # An unbiased estimate, with low variance, of the KL divergence of the old policy from
            # the new.
            divergence = (ratio - 1 - log_ratio).mean().item()
            self.logger.record("train/approx_kl", divergence)
            if self.target_kl is not None and divergence > 1.5 * self.target_kl:
                return False
            advantages = rollout.advantages
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
            clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
            loss = -torch.min(ratio * advantages, clipped * advantages).mean()
            if self.ent_coef:
                entropy = distribution.entropy()
                loss = (
                    loss - self.ent_coef * (-log_probability if entropy is None else entropy).mean()
                )
            self._descend(loss)
            self.logger.record("train/policy_gradient_loss", loss.item())
        return True

    def _improve_critic(self) -> None:
        """Fit the critic in one pass over the rollout."""
        losses = []
        for rollout in self.rollout_buffer.get(self.batch_size):
            loss = functional.mse_loss(
                self.policy.predict_values(rollout.observations).flatten(), rollout.returns
            )
            self._descend(loss)
            losses.append(loss.item())
        self.logger.record("train/value_loss", np.mean(losses))

    def _descend(self, loss: torch.Tensor) -> None:
        # This sets gradients to None, so that the optimizer skips the other network.
        self.policy.optimizer.zero_grad()
        loss.backward()
        self.policy.optimizer.step()


class _CriticLearningRate:
    """Mixin for off-policy algorithms whose critic has a separate learning rate."""

    def __init__(self, *args: object, critic_learning_rate: float, **kwargs: object) -> None:
        """Take the arguments of the Stable-Baselines3 model, and the critic's learning rate.

        `learning_rate` is that of all other networks.
        """
        self.critic_learning_rate = critic_learning_rate
        super().__init__(*args, **kwargs)

    def _update_learning_rate(
        self, optimizers: list[torch.optim.Optimizer] | torch.optim.Optimizer
    ) -> None:
        super()._update_learning_rate(optimizers)  # type: ignore[misc]
        update_learning_rate(self.critic.optimizer, self.critic_learning_rate)  # type: ignore[attr-defined]


class TwoRateDDPG(_CriticLearningRate, DDPG):
    """DDPG with a separate learning rate of the critic, and with `TwoStreams` as its network."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": TwoStreamPolicy}


class TwoRateTD3(_CriticLearningRate, TD3):
    """TD3 with a separate learning rate of the critics."""


class TwoRateSAC(_CriticLearningRate, SAC):
    """SAC with a separate learning rate of the critics."""


class EpisodicDQN(DQN):
    """DQN whose exploration rate is multiplied by a factor, unless None, after every episode."""

    def __init__(self, *args: object, exploration_decay: float | None, **kwargs: object) -> None:
        """Take the arguments of `DQN`, and the factor.

        With a factor, `exploration_fraction` has no effect.
        """
        self.exploration_decay = exploration_decay
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        if (decay := self.exploration_decay) is not None:
            initial, final = self.exploration_initial_eps, self.exploration_final_eps
            self.exploration_schedule: Schedule = lambda _: max(
                final, initial * decay**self._episode_num
            )

    def _sample_action(self, *args: object, **kwargs: object) -> tuple[np.ndarray, np.ndarray]:
        # DQN updates epsilon before it counts an episode as ended, so that the next episode would
        # begin with the epsilon of the last one.
        if self.exploration_decay is not None:
            self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
        actions: tuple[np.ndarray, np.ndarray] = super()._sample_action(*args, **kwargs)
        return actions
