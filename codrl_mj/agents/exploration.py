"""How an actor's outputs become actions, and the slopes of the actions' probabilities.

Imports torch: import it where an agent is made.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy


class Judged(NamedTuple):
    """How probable N actions are."""

    log_prob: torch.Tensor
    """Logarithm of their probability or density, shape (N, 1)."""
    entropy: torch.Tensor
    """Of the distributions that they are held against, shape (N, 1)."""
    backward: Callable[[torch.Tensor, float], tuple[torch.Tensor, torch.Tensor | None]]
    """A loss's gradient by `log_prob` (N, 1), and that by every entry of `entropy` -> its gradient by the actor's
    outputs (N, a), and that by `log_std` where there is one."""


class Categorical:
    """Discrete actions, whose outputs are logits."""

    every = 1
    """Steps between two draws."""

    def draws(self, steps: int, envs: int, outputs: int) -> torch.Tensor:
        """Gumbel's noise (steps, envs, outputs): the largest of logits plus this has the softmax's probabilities."""
        return torch.empty(steps, envs, outputs).exponential_().log_().neg_()

    def actions(self, hidden: torch.Tensor, outputs: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
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

    The logarithms of the standard deviations are a parameter (a,). With state-dependent noise they are (h, a), and the
    noise is a linear function of the actor's h last hidden units, the factors of which are drawn every so many steps.
    """

    def __init__(self, policy: ActorCriticPolicy, every: int) -> None:
        """Share the policy's parameter."""
        self.log_std, self.every = policy.log_std, every
        self._state_dependent = policy.use_sde
        self._least = policy.action_dist.epsilon if policy.use_sde else 0.0  # variance, as Stable-Baselines3 has it
        self._unit = getattr(policy, "largest", torch.ones(policy.log_std.shape[-1]))

    def draws(self, steps: int, envs: int, outputs: int) -> torch.Tensor:
        """Noise (steps, envs, a), or its factors (steps / every, envs, h, a)."""
        del outputs
        return torch.randn(-(-steps // self.every), envs, *self.log_std.shape) * self.log_std.exp()

    def actions(self, hidden: torch.Tensor, outputs: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
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
        entropy = 0.5 * (2 * math.pi * math.e * self._unit.square() * variances).log().sum(1, keepdim=True)
        log_prob = 0.5 * (1 - slope * error).sum(1, keepdim=True) - entropy

        def backward(by_log_prob: torch.Tensor, by_entropy: float) -> tuple[torch.Tensor, torch.Tensor]:
            # hidden units count as constants in the noise, as in Stable-Baselines3
            by_variances = 0.5 * (by_log_prob * (slope * error - 1) + by_entropy) / variances
            return slope * by_log_prob, (features.T @ by_variances).view_as(squares) * (2 * squares)

        return Judged(log_prob, entropy, backward)


def exploration(policy: ActorCriticPolicy, every: int) -> Categorical | Gaussian:
    """How a policy explores; state-dependent noise is drawn every so many steps."""
    if isinstance(policy.action_space, spaces.Discrete):
        return Categorical()
    return Gaussian(policy, every if policy.use_sde else 1)
