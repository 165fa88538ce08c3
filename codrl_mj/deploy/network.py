"""A trained policy as what it computes, without the library that trained it: factors, dense layers, and an end.

Imports nothing heavy: torch's tensors come in, numpy's arrays stay.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from codrl_mj.deploy.tiles import Tiles
from codrl_mj.runs.policies import NormalizedPolicy, Policy

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Tanh": np.tanh,
    "ReLU": lambda values: np.maximum(values, 0.0),
    "Identity": lambda values: values,
}
"""By the name of torch's class."""


@dataclasses.dataclass(frozen=True)
class Layer:
    """activation(weight @ x + bias)."""

    weight: np.ndarray
    """Shape (out, in), float32."""
    bias: np.ndarray
    """Shape (out,), float32."""
    activation: str
    """One of `ACTIVATIONS`."""


class Normalization(NamedTuple):
    """Observation statistics of `VecNormalize`: (x - mean)/deviation, clipped to +-`clip`, in double."""

    mean: np.ndarray
    """Shape (k,), float64."""
    deviation: np.ndarray
    """Standard deviation, its epsilon included, shape (k,), float64."""
    clip: float
    """Largest normalized value."""


@dataclasses.dataclass(frozen=True)
class Network:
    """A policy that takes its most likely action: an observation (k,) to an action.

    The observation is normalized if the training's was, multiplied by `factors`, goes through the
    layers, and what they give is multiplied by `gains`. Of a box it is then brought between `low`
    and `high`: clipped or, `squashed`, by (y + 1)/2 of the way. Without bounds the action is the
    index of the largest.
    """

    factors: np.ndarray
    """Shape (k,), float32."""
    layers: tuple[Layer, ...]
    """From the observation to the action."""
    gains: np.ndarray
    """Shape (m,), float32."""
    low: np.ndarray | None
    """Least action, shape (m,), float32; None where actions are discrete."""
    high: np.ndarray | None
    """Largest action, likewise."""
    squashed: bool
    """Whether the layers end in -1 to 1, which stand for `low` and `high`."""
    normalization: Normalization | None = None
    """Statistics of the observations; None where they are taken as they come."""

    def graph(self, node: Any) -> str:
        """The name of what an ONNX graph gives that computes it, by `node(kind, *inputs, **attributes)`."""
        values = "observation"
        if (norm := self.normalization) is not None:
            values = node(
                "Div", node("Sub", node("Cast", values, to=11), norm.mean), norm.deviation
            )  # 11: double
            values = node("Min", node("Max", values, np.full(1, -norm.clip)), np.full(1, norm.clip))
            values = node("Cast", values, to=1)
        values = node("Mul", values, self.factors)
        for layer in self.layers:
            values = node("Gemm", values, layer.weight, layer.bias, transB=1)
            if layer.activation != "Identity":
                values = node({"Tanh": "Tanh", "ReLU": "Relu"}[layer.activation], values)
        values = node("Mul", values, self.gains)
        if self.low is None or self.high is None:
            return str(node("ArgMax", values, axis=1, keepdims=0))
        if not self.squashed:
            return str(node("Min", node("Max", values, self.low), self.high))
        share = node(
            "Mul", node("Add", values, np.ones(1, np.float32)), np.full(1, 0.5, np.float32)
        )
        return str(node("Add", node("Mul", share, self.high - self.low), self.low))

    def __call__(self, observations: np.ndarray, kind: Any = np.float32) -> np.ndarray:
        """Actions (N, m), or their indices (N,), of observations (N, k), computed in numbers of a `kind`."""
        values = observations
        if (norm := self.normalization) is not None:
            values = np.clip((values - norm.mean) / norm.deviation, -norm.clip, norm.clip)
        values = values.astype(kind) * self.factors.astype(kind)
        for layer in self.layers:
            values = ACTIVATIONS[layer.activation](
                values @ layer.weight.astype(kind).T + layer.bias.astype(kind)
            )
        values = values * self.gains.astype(kind)
        if self.low is None or self.high is None:
            return values.argmax(axis=1)
        low, high = self.low.astype(kind), self.high.astype(kind)
        return (
            low + kind(0.5) * (values + kind(1.0)) * (high - low)
            if self.squashed
            else np.clip(values, low, high)
        )

    @property
    def width(self) -> int:
        """The most numbers between two layers."""
        return max(len(self.factors), *(len(layer.bias) for layer in self.layers))

    @property
    def choices(self) -> int:
        """How many numbers the last layer gives."""
        return len(self.gains)

    @property
    def working(self) -> int:
        """Numbers that a step keeps beside the weights."""
        return 2 * self.width

    @property
    def size(self) -> int:
        """How many weights, biases and statistics there are."""
        statistics = 0 if self.normalization is None else 2 * len(self.normalization.mean)
        return statistics + sum(layer.weight.size + layer.bias.size for layer in self.layers)

    def first_step(self, index: int) -> dict[str, float | None]:
        """Return what is done to an entry of the observation before the first layer, as a contract has it."""
        factor, norm = float(self.factors[index]), self.normalization
        if norm is None:
            return {"scale": factor, "offset": 0.0}
        mean, deviation = float(norm.mean[index]), float(norm.deviation[index])
        told = {
            "mean": mean,
            "variance": deviation**2,
            "clip": norm.clip if np.isfinite(norm.clip) else None,
        }
        return {"scale": factor / deviation, "offset": -factor * mean / deviation, **told}


def network_of(policy: Policy) -> Network | Tiles:
    """What a policy computes: dense layers, of Stable-Baselines3's PPO, SAC, TD3, DDPG or DQN; or the tiles of SARSA.

    Args:
        policy: as `codrl_mj.runs.policies.load_policy` returns it.

    Raises:
        ValueError: it is none of these, or has parts that are no factors and dense layers.
    """
    if isinstance(policy, NormalizedPolicy):
        network, rms = network_of(policy.policy), policy.statistics
        if not rms.norm_obs or isinstance(network, Tiles):
            return network
        deviation = np.sqrt(rms.obs_rms.var + rms.epsilon)
        return dataclasses.replace(
            network, normalization=Normalization(rms.obs_rms.mean, deviation, float(rms.clip_obs))
        )

    from codrl_mj.agents.sarsa_algorithm import TileCodingPolicy

    if isinstance(policy, TileCodingPolicy):
        factors = np.ones(policy.observation_space.shape or (), np.float32)
        return Tiles(policy.coder, policy.table.copy(), factors)

    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.dqn.policies import DQNPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    one: Any = policy
    squashed = isinstance(one, SACPolicy | TD3Policy)
    if isinstance(one, ActorCriticPolicy) and not one.squash_output:
        extractor, parts = (
            one.pi_features_extractor,
            [*one.mlp_extractor.policy_net, one.action_net],
        )
    elif isinstance(one, SACPolicy):
        extractor, parts = one.actor.features_extractor, [*one.actor.latent_pi, one.actor.mu]
    elif isinstance(one, TD3Policy):
        extractor, parts = one.actor.features_extractor, [*one.actor.mu]
    elif isinstance(one, DQNPolicy):
        extractor, parts = one.q_net.features_extractor, [*one.q_net.q_net]
    else:
        raise ValueError(
            f"policy: a {type(one).__name__} cannot be exported: it must be of PPO, SAC, TD3, DDPG"
            " or DQN, which are dense layers, or SARSA's"
        )
    seen, acts = one.observation_space, one.action_space
    if not isinstance(seen, spaces.Box) or len(seen.shape) != 1:
        raise ValueError(f"policy: observations are {seen}: must be vectors")
    layers = _layers(parts)
    if isinstance(one, SACPolicy):  # its distribution ends in it
        layers[-1] = dataclasses.replace(layers[-1], activation="Tanh")
    scales, gains = getattr(extractor, "factors", None), getattr(one, "largest", None)
    outputs = len(layers[-1].bias)
    return Network(
        np.ones(seen.shape, np.float32) if scales is None else scales.numpy().copy(),
        tuple(layers),
        np.ones(outputs, np.float32) if gains is None else gains.numpy().astype(np.float32),
        acts.low.astype(np.float32) if isinstance(acts, spaces.Box) else None,
        acts.high.astype(np.float32) if isinstance(acts, spaces.Box) else None,
        squashed,
    )


def _layers(parts: list[Any]) -> list[Layer]:
    """Dense layers with the activations that follow them."""
    found: list[Layer] = []
    for part in parts:
        kind = type(part).__name__
        if kind == "Linear":
            found.append(
                Layer(
                    part.weight.detach().numpy().copy(),
                    part.bias.detach().numpy().copy(),
                    "Identity",
                )
            )
        elif kind in ACTIVATIONS and found and found[-1].activation == "Identity":
            found[-1] = dataclasses.replace(found[-1], activation=kind)
        else:
            raise ValueError(
                f"policy: a layer is {part}: must be Linear, or {', '.join(ACTIVATIONS)} after one"
            )
    return found
