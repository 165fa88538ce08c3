"""PPO whose actor and critic learn apart. Imports torch: import it where an agent is made."""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from torch.nn import functional


class TwoRatePPO(PPO):
    """Stable-Baselines3's PPO with separate passes, and separate learning rates, for actor and critic.

    The update of Spinning Up and of Keras's example: passes over the rollout improve the actor until it has moved too
    far (1.5 times `target_kl`), and the critic is fitted whether the actor stopped or not. Gradients are not clipped.
    One Adam optimiser holds both, in two groups: Adam keeps moments and count for each tensor, and leaves out those
    without a gradient, so this is two optimisers in one state dict.
    """

    def __init__(self, *args: Any, critic_learning_rate: float, critic_epochs: int, **kwargs: Any) -> None:
        """Take what `PPO` takes.

        Args:
            *args: as for `PPO`.
            critic_learning_rate: Adam's step size for the critic; `learning_rate` is the actor's.
            critic_epochs: passes over each rollout for the critic; `n_epochs` are the actor's at most.
            **kwargs: as for `PPO`.
        """
        self.critic_learning_rate = critic_learning_rate
        self.critic_epochs = critic_epochs
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        policy = self.policy
        critic = [*policy.mlp_extractor.value_net.parameters(), *policy.value_net.parameters()]
        of_critic = {id(parameter) for parameter in critic}
        actor = [parameter for parameter in policy.parameters() if id(parameter) not in of_critic]
        groups = [{"params": actor}, {"params": critic}]
        policy.optimizer = policy.optimizer_class(groups, lr=self.lr_schedule(1), **policy.optimizer_kwargs)

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
        """One pass over the rollout; False if it stopped because the policy had moved too far."""
        clip_range = self.clip_range(self._current_progress_remaining)
        for rollout in self.rollout_buffer.get(self.batch_size):
            discrete = isinstance(self.action_space, spaces.Discrete)
            actions = rollout.actions.long().flatten() if discrete else rollout.actions
            distribution = self.policy.get_distribution(rollout.observations)
            log_probability = distribution.log_prob(actions)
            log_ratio = log_probability - rollout.old_log_prob
            ratio = log_ratio.exp()
            divergence = (ratio - 1 - log_ratio).mean().item()  # of the old policy from the new, an unbiased estimate
            self.logger.record("train/approx_kl", divergence)
            if self.target_kl is not None and divergence > 1.5 * self.target_kl:
                return False
            advantages = rollout.advantages
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
            clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
            loss = -torch.min(ratio * advantages, clipped * advantages).mean()
            if self.ent_coef:
                entropy = distribution.entropy()
                loss = loss - self.ent_coef * (-log_probability if entropy is None else entropy).mean()
            self._descend(loss)
            self.logger.record("train/policy_gradient_loss", loss.item())
        return True

    def _improve_critic(self) -> None:
        """One pass over the rollout."""
        losses = []
        for rollout in self.rollout_buffer.get(self.batch_size):
            loss = functional.mse_loss(self.policy.predict_values(rollout.observations).flatten(), rollout.returns)
            self._descend(loss)
            losses.append(loss.item())
        self.logger.record("train/value_loss", np.mean(losses))

    def _descend(self, loss: torch.Tensor) -> None:
        self.policy.optimizer.zero_grad()  # to None: the optimiser then leaves the other network alone
        loss.backward()
        self.policy.optimizer.step()
