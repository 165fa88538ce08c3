"""PPO with explicit forward and backward passes, for small networks.

The distributions of the actions come first, with the gradients of their log-probabilities; then the
algorithm. The module imports torch, so import it only where an agent is created.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecEnv

from codrl_mj.agents.stacked_networks import StackedNetworks, VectorAdam

_TRAINING_FIELDS = ("actions", "log_probs", "advantages", "returns")


class ActionEvaluation(NamedTuple):
    """Log-probabilities of N actions, and the entropies of their distributions."""

    log_prob: torch.Tensor
    """Logarithms of the probabilities or densities, shape (N, 1)."""
    entropy: torch.Tensor
    """Entropies of the distributions, shape (N, 1)."""
    backward: Callable[[torch.Tensor, float], tuple[torch.Tensor, torch.Tensor | None]]
    """Function that propagates the gradient of a loss backward.

    Its arguments are the gradient with respect to `log_prob`, shape (N, 1), and the gradient with
    respect to each entry of `entropy`. It returns the gradients with respect to the actor's
    outputs, shape (N, a), and to `log_std`, which is None for discrete actions.
    """


class Categorical:
    """Distribution of discrete actions; the actor's outputs are logits."""

    sample_freq = 1
    """Steps between two draws of noise."""

    def draw_noise(self, steps: int, envs: int, outputs: int) -> torch.Tensor:
        """Draw Gumbel noise, shape (steps, envs, outputs)."""
        # The index of the largest logit plus noise has the probabilities of the softmax.
        return torch.empty(steps, envs, outputs).exponential_().log_().neg_()

    def actions(
        self, hidden: torch.Tensor, outputs: torch.Tensor, draw: torch.Tensor
    ) -> torch.Tensor:
        """Return actions (N,) for outputs (N, a)."""
        del hidden
        return (outputs + draw).argmax(1)

    def evaluate(
        self, hidden: torch.Tensor, outputs: torch.Tensor, actions: torch.Tensor
    ) -> ActionEvaluation:
        """Evaluate actions (N, 1) for outputs (N, a)."""
        del hidden
        log_probs, chosen = torch.log_softmax(outputs, 1), actions.long()
        probs = log_probs.exp()
        entropy = -(probs * log_probs).sum(1, keepdim=True)

        def backward(
            log_prob_gradient: torch.Tensor, entropy_gradient: float
        ) -> tuple[torch.Tensor, None]:
            output_gradient = (probs * -log_prob_gradient).scatter_add_(
                1, chosen, log_prob_gradient
            )
            if entropy_gradient:
                output_gradient -= entropy_gradient * probs * (log_probs + entropy)
            return output_gradient, None

        return ActionEvaluation(log_probs.gather(1, chosen), entropy, backward)


class Gaussian:
    """Distribution of continuous actions; the actor's outputs are means.

    The logarithms of the standard deviations are a parameter, shape (a,). With state-dependent
    noise its shape is (h, a), and the noise is a linear function of the h units of the actor's last
    hidden layer; its coefficients are drawn every `sample_freq` steps.
    """

    def __init__(self, policy: ActorCriticPolicy, sample_freq: int) -> None:
        """Store `log_std`, which is shared with the policy."""
        self.log_std, self.sample_freq = policy.log_std, sample_freq
        self._state_dependent = policy.use_sde
        # Stable-Baselines3 adds this to the variance of state-dependent noise.
        self._min_variance = policy.action_dist.epsilon if policy.use_sde else 0.0
        self._action_scale = getattr(policy, "largest", torch.ones(policy.log_std.shape[-1]))

    def draw_noise(self, steps: int, envs: int, outputs: int) -> torch.Tensor:
        """Draw noise (steps, envs, a), or its coefficients (steps / sample_freq, envs, h, a)."""
        del outputs
        return (
            torch.randn(-(-steps // self.sample_freq), envs, *self.log_std.shape)
            * self.log_std.exp()
        )

    def actions(
        self, hidden: torch.Tensor, outputs: torch.Tensor, draw: torch.Tensor
    ) -> torch.Tensor:
        """Return actions (N, a) for outputs (N, a) and hidden units (N, h)."""
        noise = torch.bmm(hidden[:, None], draw)[:, 0] if self._state_dependent else draw
        return (outputs + noise) * self._action_scale

    def evaluate(
        self, hidden: torch.Tensor, outputs: torch.Tensor, actions: torch.Tensor
    ) -> ActionEvaluation:
        """Evaluate actions (N, a) for outputs (N, a) and hidden units (N, h)."""
        squares = (2 * self.log_std).exp()
        features = hidden.square() if self._state_dependent else torch.ones(len(hidden), 1)
        variances = features @ squares.view(features.shape[1], -1) + self._min_variance
        error = actions / self._action_scale - outputs
        slope = error / variances
        entropy = 0.5 * (2 * math.pi * math.e * self._action_scale.square() * variances).log().sum(
            1, keepdim=True
        )
        log_prob = 0.5 * (1 - slope * error).sum(1, keepdim=True) - entropy

        def backward(
            log_prob_gradient: torch.Tensor, entropy_gradient: float
        ) -> tuple[torch.Tensor, torch.Tensor]:
            # The hidden units that multiply the noise count as constants, as in Stable-Baselines3.
            variance_gradient = (
                0.5 * (log_prob_gradient * (slope * error - 1) + entropy_gradient) / variances
            )
            return slope * log_prob_gradient, (features.T @ variance_gradient).view_as(squares) * (
                2 * squares
            )

        return ActionEvaluation(log_prob, entropy, backward)


class FastPPO(PPO):
    """Faster implementation of Stable-Baselines3's PPO.

    The policy, rollouts, losses and minibatches are the same. Only the order of floating-point
    additions and the draws of noise differ. In a rollout only the actor runs; the values and the
    probabilities of all actions are computed together at the end of the rollout. Gradients are
    explicit formulas instead of automatic differentiation.

    Raises:
        ValueError: the observations are a `Dict`, the value loss is clipped, or the policy has
            parameters outside of its two networks, such as a features extractor that learns. Use
            Stable-Baselines3's `PPO` for these.
    """

    _last_obs: np.ndarray
    _last_episode_starts: np.ndarray

    def _setup_model(self) -> None:
        if isinstance(self.observation_space, spaces.Dict):
            raise ValueError(
                f"observation_space = {self.observation_space}: must be a single space; flatten it,"
                " as gymnasium's FlattenObservation does"
            )
        if self.clip_range_vf is not None:
            raise ValueError(
                f"clip_range_vf = {self.clip_range_vf!r}: must be None; use Stable-Baselines3's PPO"
            )
        super()._setup_model()
        policy = self.policy
        self._networks = StackedNetworks(policy)
        sample_freq = self.sde_sample_freq if self.sde_sample_freq > 0 else self.n_steps
        discrete = isinstance(policy.action_space, spaces.Discrete)
        self._exploration = (
            Categorical() if discrete else Gaussian(policy, sample_freq if policy.use_sde else 1)
        )
        self._networks.parameters.grad = self._networks.gradient
        policy.optimizer = VectorAdam(
            self._networks.parameters,
            policy.parameters(),
            lr=self.lr_schedule(1),
            **policy.optimizer_kwargs,
        )

    def _excluded_save_params(self) -> list[str]:
        """Return the attributes that a saved model omits."""
        # `_setup_model` creates them again from the loaded policy.
        return [*super()._excluded_save_params(), "_networks", "_exploration"]

    @torch.no_grad()  # type: ignore[untyped-decorator] # mypy does not read torch
    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the buffer as `PPO.collect_rollouts` does."""
        callback.on_rollout_start()
        obs, starts = self._last_obs, self._last_episode_starts
        rollout_buffer.reset()
        noise = self._exploration.draw_noise(n_rollout_steps, env.num_envs, self._networks.outputs)
        box = self.action_space if isinstance(self.action_space, spaces.Box) else None
        # (step, environment, last observation) of each episode that a time limit ended.
        truncated: list[tuple[int, int, np.ndarray]] = []
        for step in range(n_rollout_steps):
            actor_layers = self._networks.act(self._features(obs))
            actions = self._exploration.actions(
                *actor_layers, noise[step // self._exploration.sample_freq]
            ).numpy()
            clipped = (
                actions
                if box is None
                else np.clip(actions.reshape(-1, *box.shape), box.low, box.high)
            )
            observations, rewards, dones, infos = env.step(clipped)
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                self._last_obs, self._last_episode_starts = obs, starts
                return False
            self._update_info_buffer(infos, dones)
            timed_out = [
                row
                for row in np.flatnonzero(dones).tolist()
                if infos[row].get("TimeLimit.truncated")
            ]
            truncated += [(step, row, infos[row]["terminal_observation"]) for row in timed_out]
            rollout_buffer.observations[step] = obs.reshape(rollout_buffer.observations.shape[1:])
            rollout_buffer.actions[step] = actions.reshape(env.num_envs, -1)
            rollout_buffer.rewards[step] = rewards
            rollout_buffer.episode_starts[step] = starts
            obs, starts = observations, dones
        self._last_obs, self._last_episode_starts = obs, starts
        rollout_buffer.pos, rollout_buffer.full = n_rollout_steps, True
        layers = self._networks.forward(self._features(_rows(rollout_buffer.observations)))
        actions = torch.as_tensor(_rows(rollout_buffer.actions)).float()
        evaluation = self._exploration.evaluate(layers[-2][0], layers[-1][0], actions)
        rollout_buffer.log_probs[:] = evaluation.log_prob.view(rollout_buffer.log_probs.shape)
        rollout_buffer.values[:] = layers[-1][1, :, 0].view(rollout_buffer.values.shape)
        if truncated:
            # The task itself did not end, so the value of the last state is added to the reward.
            steps, rows, last = zip(*truncated, strict=True)
            rollout_buffer.rewards[list(steps), list(rows)] += (
                self.gamma * self._values(np.array(last)).numpy()
            )
        rollout_buffer.compute_returns_and_advantage(self._values(observations), dones)
        callback.on_rollout_end()
        return True

    @torch.no_grad()  # type: ignore[untyped-decorator] # mypy does not read torch
    def train(self) -> None:
        """Learn from the rollout."""
        if not self._networks.holds(self.policy):
            raise RuntimeError(
                "the policy is not the one that the model was created with: copy a model by save"
                " and load"
            )
        optimizer, buffer = self.policy.optimizer, self.rollout_buffer
        self._update_learning_rate(optimizer)
        features = self._features(buffer.swap_and_flatten(buffer.observations))
        rest = [
            torch.as_tensor(buffer.swap_and_flatten(getattr(buffer, name))).float()
            for name in _TRAINING_FIELDS
        ]
        for _ in range(self.n_epochs):
            # The global generator of numpy is the one that Stable-Baselines3 seeds and uses for
            # minibatches.
            order = torch.as_tensor(np.random.permutation(len(features)))
            shuffled = [values[order].split(self.batch_size) for values in (features, *rest)]
            is_within_limit = all(
                self._improve(*minibatch) for minibatch in zip(*shuffled, strict=True)
            )
            self._n_updates += 1
            if not is_within_limit:
                break
        # Losses are logged for the networks after all updates.
        layers, (actions, _, _, returns) = self._networks.forward(features), rest
        entropy = self._exploration.evaluate(layers[-2][0], layers[-1][0], actions).entropy
        self.logger.record(
            "train/value_loss", (layers[-1][1, :, :1] - returns).square().mean().item()
        )
        self.logger.record("train/entropy_loss", -entropy.mean().item())
        self.logger.record(
            "train/explained_variance",
            explained_variance(buffer.values.ravel(), buffer.returns.ravel()),
        )
        if isinstance(self._exploration, Gaussian):
            self.logger.record("train/std", self._exploration.log_std.exp().mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _improve(
        self,
        features: torch.Tensor,
        actions: torch.Tensor,
        old_log_prob: torch.Tensor,
        advantages: torch.Tensor,
        returns: torch.Tensor,
    ) -> bool:
        """Take a gradient step on a minibatch; return False if no step was taken.

        No step is taken if the policy has diverged too far from the policy of the rollout.
        """
        networks, size = self._networks, len(features)
        layers = networks.forward(features)
        evaluation = self._exploration.evaluate(layers[-2][0], layers[-1][0], actions)
        log_ratio = evaluation.log_prob - old_log_prob
        ratio = log_ratio.exp()
        if self.target_kl is not None:
            divergence = (ratio - 1 - log_ratio).mean().item()
            self.logger.record("train/approx_kl", divergence)
            if divergence > 1.5 * self.target_kl:
                return False
        if self.normalize_advantage and size > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        clip_range = self.clip_range(self._current_progress_remaining)
        gains = advantages * ratio
        # If the clipped gain is the smaller one, it is constant, and its gradient is 0.
        log_prob_gradient = (
            gains * (gains <= advantages * ratio.clamp(1 - clip_range, 1 + clip_range)) / -size
        )
        gradient = torch.zeros_like(layers[-1])
        gradient[0], log_std_gradient = evaluation.backward(
            log_prob_gradient, -self.ent_coef / size
        )
        torch.sub(layers[-1][1, :, :1], returns, out=gradient[1, :, :1]).mul_(
            2 * self.vf_coef / size
        )
        networks.backward(layers, gradient)
        if networks.log_std_gradient is not None:
            networks.log_std_gradient.copy_(log_std_gradient)
        networks.gradient.mul_(
            (self.max_grad_norm / (networks.gradient.norm() + 1e-6)).clamp(max=1.0)
        )
        self.policy.optimizer.step()
        return True

    def _features(self, observations: np.ndarray) -> torch.Tensor:
        """Return the networks' inputs (N, k) for observations (N, ...)."""
        return self.policy.extract_features(torch.as_tensor(observations))

    def _values(self, observations: np.ndarray) -> torch.Tensor:
        """Return the critic's values, shape (N,), of observations (N, ...)."""
        return self._networks.forward(self._features(observations))[-1][1, :, 0]


def _rows(array: np.ndarray) -> np.ndarray:
    """Reshape an array (steps, envs, ...) to (steps * envs, ...)."""
    return array.reshape(-1, *array.shape[2:])
