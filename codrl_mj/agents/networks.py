"""Network parts that Stable-Baselines3 does not have. Imports torch: import it where an agent is made."""

from collections.abc import Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import FlattenExtractor, create_mlp
from stable_baselines3.td3.policies import TD3Policy
from torch import nn


class ScaledObservation(FlattenExtractor):
    """Multiplies the entries of an observation by fixed factors; entries without a factor stay as they are."""

    def __init__(self, observation_space: spaces.Box, factors: Sequence[float]) -> None:
        """Take at most as many factors as an observation has entries.

        Raises:
            ValueError: there are more.
        """
        super().__init__(observation_space)
        if len(factors) > self.features_dim:
            raise ValueError(
                f"input_scale = {tuple(factors)}: must have at most {self.features_dim} factors, one for each entry of "
                "the observation"
            )
        padded = torch.ones(self.features_dim)
        padded[: len(factors)] = torch.tensor(factors)
        self.register_buffer("factors", padded, persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Observations (N, k) times the factors (k,)."""
        return super().forward(observations) * self.factors


class UnitActionPolicy(ActorCriticPolicy):
    """Its actor's mean and noise are in units of the largest action: a torque of 0.08 N*m or a voltage of 18 V is 1."""

    def _build(self, lr_schedule: Any) -> None:
        if not isinstance(self.action_space, spaces.Box):
            raise ValueError(f"unit_actions = True: must be False for discrete actions, which {self.action_space} has")
        super()._build(lr_schedule)
        self.register_buffer("largest", torch.as_tensor(self.action_space.high), persistent=False)

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        mean = self.action_net(latent_pi) * self.largest
        return self.action_dist.proba_distribution(mean, self.log_std + self.largest.log())


class TwoStreams(nn.Module):
    """Q(state, action): state and action each through layers of their own, then joined, then through joint layers."""

    def __init__(
        self, state_size: int, action_size: int, state: Sequence[int], action: Sequence[int], joint: Sequence[int]
    ) -> None:
        """Make the layers, every hidden one followed by a ReLU.

        Args:
            state_size: entries of the state.
            action_size: entries of the action.
            state: units of the state's own layers; none lets it through.
            action: units of the action's own layers; none lets it through.
            joint: units of the hidden layers after the two are concatenated; one output unit follows.
        """
        super().__init__()
        self.state_size = state_size
        self.state_stream = nn.Sequential(*_hidden_layers(state_size, state))
        self.action_stream = nn.Sequential(*_hidden_layers(action_size, action))
        joined = [state_size, *state][-1] + [action_size, *action][-1]
        self.joint = nn.Sequential(*create_mlp(joined, 1, list(joint), nn.ReLU))

    def forward(self, state_and_action: torch.Tensor) -> torch.Tensor:
        """States and actions, concatenated, (N, state_size + action_size) -> values (N, 1)."""
        state, action = state_and_action[:, : self.state_size], state_and_action[:, self.state_size :]
        return self.joint(torch.cat([self.state_stream(state), self.action_stream(action)], dim=1))


def _hidden_layers(inputs: int, units: Sequence[int]) -> list[nn.Module]:
    return create_mlp(inputs, -1, list(units), nn.ReLU) if units else []


class TwoStreamPolicy(TD3Policy):
    """Actor and critic of DDPG, the critic's networks being `TwoStreams`."""

    def __init__(
        self,
        *args: Any,
        state_units: Sequence[int],
        action_units: Sequence[int],
        joint_units: Sequence[int],
        **kwargs: Any,
    ) -> None:
        """Take what `TD3Policy` takes, and the critic's layers as `TwoStreams` does."""
        self._streams = state_units, action_units, joint_units
        super().__init__(*args, **kwargs)

    def make_critic(self, features_extractor: Any = None) -> ContinuousCritic:
        """A critic, as `TD3Policy` asks for it."""
        critic = super().make_critic(features_extractor)
        state_size, (action_size,) = critic.features_extractor.features_dim, self.action_space.shape
        for index in range(critic.n_critics):
            critic.q_networks[index] = TwoStreams(state_size, action_size, *self._streams)
            critic.add_module(f"qf{index}", critic.q_networks[index])
        return critic
