"""PPO whose arithmetic is written out for small networks.

How an actor's outputs become actions, and the slopes of the actions' probabilities; then the
algorithm. Imports torch: import it where an agent is made.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import explained_variance

from codrl_mj.agents.twin_networks import TwinNetworks, VectorAdam

_LEARNT_FROM = ("actions", "log_probs", "advantages", "returns")


class Judged(NamedTuple):
    """How probable N actions are."""

    log_prob: torch.Tensor
    """Logarithm of their probability or density, shape (N, 1)."""
    entropy: torch.Tensor
    """Of the distributions that they are held against, shape (N, 1)."""
    backward: Callable[[torch.Tensor, float], tuple[torch.Tensor, torch.Tensor | None]]
    """A loss's gradient by `log_prob` (N, 1), and that by every entry of `entropy` -> its gradient
    by the actor's outputs (N, a), and that by `log_std` where there is one.
    """


class Categorical:
    """Discrete actions, whose outputs are logits."""

    every = 1
    """Steps between two draws."""

    def draws(self, steps: int, envs: int, outputs: int) -> torch.Tensor:
        """Gumbel's noise (steps, envs, outputs): the largest of logits plus this has the softmax's probabilities."""
        return torch.empty(steps, envs, outputs).exponential_().log_().neg_()

    def actions(
        self, hidden: torch.Tensor, outputs: torch.Tensor, draw: torch.Tensor
    ) -> torch.Tensor:
        """Actions (N,) from outputs (N, a)."""
        del hidden
        return (outputs + draw).argmax(1)

    def judge(self, hidden: torch.Tensor, outputs: torch.Tensor, actions: torch.Tensor) -> Judged:
        """Actions (N, 1) against outputs (N, a)."""
        del hidden
        log_probs, chosen = torch.log_softmax(outputs, 1), actions.long()
        probs = log_probs.exp()
        entropy = -(probs * log_probs).sum(1, keepdim=True)

        def backward(by_log_prob: torch.Tensor, by_entropy: float) -> tuple[torch.Tensor, None]:
            by_outputs = (probs * -by_log_prob).scatter_add_(1, chosen, by_log_prob)
            if by_entropy:
                by_outputs -= by_entropy * probs * (log_probs + entropy)
            return by_outputs, None

        return Judged(log_probs.gather(1, chosen), entropy, backward)


class Gaussian:
    """Continuous actions, whose outputs are means.

    The logarithms of the standard deviations are a parameter (a,). With state-dependent noise they
    are (h, a), and the noise is a linear function of the actor's h last hidden units, the factors
    of which are drawn every so many steps.
    """

    def __init__(self, policy: ActorCriticPolicy, every: int) -> None:
        """Share the policy's parameter."""
        self.log_std, self.every = policy.log_std, every
        self._state_dependent = policy.use_sde
        self._least = (
            policy.action_dist.epsilon if policy.use_sde else 0.0
        )  # variance, as Stable-Baselines3 has it
        self._unit = getattr(policy, "largest", torch.ones(policy.log_std.shape[-1]))

    def draws(self, steps: int, envs: int, outputs: int) -> torch.Tensor:
        """Noise (steps, envs, a), or its factors (steps / every, envs, h, a)."""
        del outputs
        return torch.randn(-(-steps // self.every), envs, *self.log_std.shape) * self.log_std.exp()

    def actions(
        self, hidden: torch.Tensor, outputs: torch.Tensor, draw: torch.Tensor
    ) -> torch.Tensor:
        """Actions (N, a) from outputs (N, a) and hidden units (N, h)."""
        noise = torch.bmm(hidden[:, None], draw)[:, 0] if self._state_dependent else draw
        return (outputs + noise) * self._unit

    def judge(self, hidden: torch.Tensor, outputs: torch.Tensor, actions: torch.Tensor) -> Judged:
        """Actions (N, a) against outputs (N, a) and hidden units (N, h)."""
        squares = (2 * self.log_std).exp()
        features = hidden.square() if self._state_dependent else torch.ones(len(hidden), 1)
        variances = features @ squares.view(features.shape[1], -1) + self._least
        error = actions / self._unit - outputs
        slope = error / variances
        entropy = 0.5 * (2 * math.pi * math.e * self._unit.square() * variances).log().sum(
            1, keepdim=True
        )
        log_prob = 0.5 * (1 - slope * error).sum(1, keepdim=True) - entropy

        def backward(
            by_log_prob: torch.Tensor, by_entropy: float
        ) -> tuple[torch.Tensor, torch.Tensor]:
            # hidden units count as constants in the noise, as in Stable-Baselines3
            by_variances = 0.5 * (by_log_prob * (slope * error - 1) + by_entropy) / variances
            return slope * by_log_prob, (features.T @ by_variances).view_as(squares) * (2 * squares)

        return Judged(log_prob, entropy, backward)


class FastPPO(PPO):
    """Stable-Baselines3's PPO in a fraction of its time: the same policy, rollouts, losses and minibatches.

    Only the order in which floating-point numbers are added and the way in which noise is drawn
    differ. A rollout takes the actor's products for each step; values and probabilities of all its
    actions are found in one go at its end. Gradients are written out and not found by automatic
    differentiation.

    Raises:
        ValueError: observations of several parts, a clipped value loss, or a policy with other
            parameters than those of its two networks, such as a features extractor that learns:
            those are Stable-Baselines3's own `PPO`'s.
    """

    _last_obs: Any
    _last_episode_starts: Any

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
        self._networks = TwinNetworks(policy)
        every = self.sde_sample_freq if self.sde_sample_freq > 0 else self.n_steps
        discrete = isinstance(policy.action_space, spaces.Discrete)
        self._exploration = (
            Categorical() if discrete else Gaussian(policy, every if policy.use_sde else 1)
        )
        self._networks.parameters.grad = self._networks.gradient
        policy.optimizer = VectorAdam(
            self._networks.parameters,
            policy.parameters(),
            lr=self.lr_schedule(1),
            **policy.optimizer_kwargs,
        )

    def _excluded_save_params(self) -> list[str]:
        """What a saved model leaves out: `_setup_model` makes it anew, of the policy that is loaded."""
        return [*super()._excluded_save_params(), "_networks", "_exploration"]

    @torch.no_grad()
    def collect_rollouts(
        self, env: Any, callback: Any, rollout_buffer: Any, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer, as `PPO.collect_rollouts` does."""
        callback.on_rollout_start()
        seen, starts = self._last_obs, self._last_episode_starts
        rollout_buffer.reset()
        draws = self._exploration.draws(n_rollout_steps, env.num_envs, self._networks.outputs)
        box = self.action_space if isinstance(self.action_space, spaces.Box) else None
        cut: list[
            tuple[int, int, np.ndarray]
        ] = []  # step, environment and last observation where time ran out
        for step in range(n_rollout_steps):
            acted = self._networks.act(self._features(seen))
            actions = self._exploration.actions(
                *acted, draws[step // self._exploration.every]
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
                self._last_obs, self._last_episode_starts = seen, starts
                return False
            self._update_info_buffer(infos, dones)
            timed_out = [
                row
                for row in np.flatnonzero(dones).tolist()
                if infos[row].get("TimeLimit.truncated")
            ]
            cut += [(step, row, infos[row]["terminal_observation"]) for row in timed_out]
            rollout_buffer.observations[step] = seen.reshape(rollout_buffer.observations.shape[1:])
            rollout_buffer.actions[step] = actions.reshape(env.num_envs, -1)
            rollout_buffer.rewards[step] = rewards
            rollout_buffer.episode_starts[step] = starts
            seen, starts = observations, dones
        self._last_obs, self._last_episode_starts = seen, starts
        rollout_buffer.pos, rollout_buffer.full = n_rollout_steps, True
        layers = self._networks.forward(self._features(_rows(rollout_buffer.observations)))
        actions = torch.as_tensor(_rows(rollout_buffer.actions)).float()
        judged = self._exploration.judge(layers[-2][0], layers[-1][0], actions)
        rollout_buffer.log_probs[:] = judged.log_prob.view(rollout_buffer.log_probs.shape)
        rollout_buffer.values[:] = layers[-1][1, :, 0].view(rollout_buffer.values.shape)
        if cut:  # a time limit is no failure: the value of the last state is added
            steps, rows, last = zip(*cut, strict=True)
            rollout_buffer.rewards[list(steps), list(rows)] += (
                self.gamma * self._values(np.array(last)).numpy()
            )
        rollout_buffer.compute_returns_and_advantage(self._values(observations), dones)
        callback.on_rollout_end()
        return True

    @torch.no_grad()
    def train(self) -> None:
        """Learn from the rollout."""
        if not self._networks.holds(self.policy):
            raise RuntimeError(
                "the policy is another than the model was made with: copy a model by save and load"
            )
        optimizer, buffer = self.policy.optimizer, self.rollout_buffer
        self._update_learning_rate(optimizer)
        features = self._features(buffer.swap_and_flatten(buffer.observations))
        rest = [
            torch.as_tensor(buffer.swap_and_flatten(getattr(buffer, name))).float()
            for name in _LEARNT_FROM
        ]
        for _ in range(self.n_epochs):
            order = torch.as_tensor(
                np.random.permutation(len(features))
            )  # as Stable-Baselines3 draws it
            shuffled = [one[order].split(self.batch_size) for one in (features, *rest)]
            going_on = all(self._improve(*minibatch) for minibatch in zip(*shuffled, strict=True))
            self._n_updates += 1
            if not going_on:
                break
        layers, (actions, _, _, returns) = self._networks.forward(features), rest  # as they are now
        entropy = self._exploration.judge(layers[-2][0], layers[-1][0], actions).entropy
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
        """A step down the gradient of a minibatch; False, and no step, if the policy has moved too far."""
        networks, count = self._networks, len(features)
        layers = networks.forward(features)
        judged = self._exploration.judge(layers[-2][0], layers[-1][0], actions)
        log_ratio = judged.log_prob - old_log_prob
        ratio = log_ratio.exp()
        if self.target_kl is not None:
            divergence = (ratio - 1 - log_ratio).mean().item()
            self.logger.record("train/approx_kl", divergence)
            if divergence > 1.5 * self.target_kl:
                return False
        if self.normalize_advantage and count > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        reach = self.clip_range(self._current_progress_remaining)
        gains = advantages * ratio
        # where the clipped gain is the smaller one, it is constant
        by_log_prob = gains * (gains <= advantages * ratio.clamp(1 - reach, 1 + reach)) / -count
        gradient = torch.zeros_like(layers[-1])
        gradient[0], by_log_std = judged.backward(by_log_prob, -self.ent_coef / count)
        torch.sub(layers[-1][1, :, :1], returns, out=gradient[1, :, :1]).mul_(
            2 * self.vf_coef / count
        )
        networks.backward(layers, gradient)
        if networks.log_std_gradient is not None:
            networks.log_std_gradient.copy_(by_log_std)
        networks.gradient.mul_(
            (self.max_grad_norm / (networks.gradient.norm() + 1e-6)).clamp(max=1.0)
        )
        self.policy.optimizer.step()
        return True

    def _features(self, observations: np.ndarray) -> torch.Tensor:
        """Observations (N, ...) as the networks take them (N, k)."""
        return self.policy.extract_features(torch.as_tensor(observations))

    def _values(self, observations: np.ndarray) -> torch.Tensor:
        """What the critic thinks of observations (N, ...), shape (N,)."""
        return self._networks.forward(self._features(observations))[-1][1, :, 0]


def _rows(array: np.ndarray) -> np.ndarray:
    """An array (steps, envs, ...) as (steps * envs, ...)."""
    return array.reshape(-1, *array.shape[2:])
