"""A trained policy as numpy arrays, independent of the library that trained it.

The arrays are the scaling, the layers and the bounds. The module imports torch only while it
extracts them.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from codrl_mj.deploy.spaces import Entry
from codrl_mj.deploy.tiles import AddNode, Float, Tiles
from codrl_mj.runs.policies import NormalizedPolicy, Policy

# torch and Stable-Baselines3 take seconds to import, and their policies have different attributes.
Module = Any
"""A `torch.nn.Module`, such as a layer or a Stable-Baselines3 policy."""
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Tanh": np.tanh,
    "ReLU": lambda values: np.maximum(values, 0.0),
    "Identity": lambda values: values,
}
"""Name of torch's class -> activation function."""


@dataclasses.dataclass(frozen=True)
class Layer:
    """A dense layer, activation(weight @ x + bias)."""

    weight: np.ndarray
    """Weights, shape (out, in), float32."""
    bias: np.ndarray
    """Biases, shape (out,), float32."""
    activation: str
    """Name from `ACTIVATIONS`."""


class Normalization(NamedTuple):
    """Statistics of `VecNormalize`: (x - mean)/std, clipped to +-`clip`, in double."""

    mean: np.ndarray
    """Mean, shape (k,), float64."""
    std: np.ndarray
    """Standard deviation, including the epsilon, shape (k,), float64."""
    clip: float
    """Largest normalized value."""


@dataclasses.dataclass(frozen=True)
class Network:
    """A deterministic policy, which takes its most likely action for an observation (k,).

    The observation is normalized if it was in the training, multiplied by `factors`, and passed
    through the layers, whose output is multiplied by `gains`. For a box action y the output is then
    clipped to `low` and `high` or, if `squashed`, mapped from -1 to 1 onto them. Without bounds the
    action is the index of the largest output.
    """

    factors: np.ndarray
    """Factors of the observation, shape (k,), float32."""
    layers: tuple[Layer, ...]
    """Layers from the observation to the action."""
    gains: np.ndarray
    """Factors of the output, shape (m,), float32."""
    low: np.ndarray | None
    """Smallest action, shape (m,), float32; None for discrete actions."""
    high: np.ndarray | None
    """Largest action, shape (m,), float32; None for discrete actions."""
    squashed: bool
    """True if the output range of -1 to 1 is mapped onto `low` and `high`."""
    normalization: Normalization | None = None
    """Statistics that normalize the observation; None for no normalization."""

    def add_to_graph(self, node: AddNode) -> str:
        """Add the policy's nodes to an ONNX graph and return the name of the output.

        Args:
            node: function `node(kind, *inputs, **attributes)` that adds a node.
        """
        values = "observation"
        if (norm := self.normalization) is not None:
            # ONNX's type 11 is double, type 1 is float.
            values = node("Div", node("Sub", node("Cast", values, to=11), norm.mean), norm.std)
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

    def __call__(self, observations: np.ndarray, dtype: Float = np.float32) -> np.ndarray:
        """Return actions (N, m) or indices (N,) for observations (N, k), computed in `dtype`."""
        values: np.ndarray = observations
        if (norm := self.normalization) is not None:
            values = np.clip((values - norm.mean) / norm.std, -norm.clip, norm.clip)
        values = values.astype(dtype) * self.factors.astype(dtype)
        for layer in self.layers:
            values = ACTIVATIONS[layer.activation](
                values @ layer.weight.astype(dtype).T + layer.bias.astype(dtype)
            )
        values = values * self.gains.astype(dtype)
        if self.low is None or self.high is None:
            indices: np.ndarray = values.argmax(axis=1)
            return indices
        low: np.ndarray = self.low.astype(dtype)
        high: np.ndarray = self.high.astype(dtype)
        actions: np.ndarray = (
            low + dtype(0.5) * (values + dtype(1.0)) * (high - low)
            if self.squashed
            else np.clip(values, low, high)
        )
        return actions

    @property
    def width(self) -> int:
        """Largest number of values between two layers."""
        return max(len(self.factors), *(len(layer.bias) for layer in self.layers))

    @property
    def choices(self) -> int:
        """Number of outputs of the last layer."""
        return len(self.gains)

    @property
    def num_working_values(self) -> int:
        """Number of values that a step stores in addition to the weights."""
        # A layer needs its inputs and its outputs at the same time.
        return 2 * self.width

    @property
    def size(self) -> int:
        """Number of weights, biases and statistics."""
        statistics = 0 if self.normalization is None else 2 * len(self.normalization.mean)
        return statistics + sum(layer.weight.size + layer.bias.size for layer in self.layers)

    def input_scaling(self, index: int) -> Entry:
        """Return the scaling of an observation entry before the first layer, for the contract."""
        factor, norm = float(self.factors[index]), self.normalization
        if norm is None:
            return {"scale": factor, "offset": 0.0}
        mean, std = float(norm.mean[index]), float(norm.std[index])
        statistics: Entry = {
            "mean": mean,
            "variance": std**2,
            "clip": norm.clip if np.isfinite(norm.clip) else None,
        }
        return {"scale": factor / std, "offset": -factor * mean / std, **statistics}


def extract_network(policy: Policy) -> Network | Tiles:
    """Extract the dense layers of a Stable-Baselines3 policy, or the tiles of SARSA.

    Args:
        policy: a policy of PPO, SAC, TD3, DDPG, DQN or SARSA, as
            `codrl_mj.runs.policies.load_policy` returns it.

    Raises:
        ValueError: the policy is of another class, or has parts other than scaling factors and
            dense layers.
    """
    if isinstance(policy, NormalizedPolicy):
        network, rms = extract_network(policy.policy), policy.statistics
        if not rms.norm_obs or isinstance(network, Tiles):
            return network
        std = np.sqrt(rms.obs_rms.var + rms.epsilon)
        return dataclasses.replace(
            network, normalization=Normalization(rms.obs_rms.mean, std, float(rms.clip_obs))
        )

    # The imports are local because SARSA's policy does not need Stable-Baselines3.
    from codrl_mj.agents.sarsa_algorithm import TileCodingPolicy

    if isinstance(policy, TileCodingPolicy):
        factors = np.ones(policy.observation_space.shape or (), np.float32)
        return Tiles(policy.coder, policy.table.copy(), factors)

    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.dqn.policies import DQNPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    model: Module = policy
    squashed = isinstance(model, SACPolicy | TD3Policy)
    if isinstance(model, ActorCriticPolicy) and not model.squash_output:
        extractor = model.pi_features_extractor
        parts = [*model.mlp_extractor.policy_net, model.action_net]
    elif isinstance(model, SACPolicy):
        extractor, parts = model.actor.features_extractor, [*model.actor.latent_pi, model.actor.mu]
    elif isinstance(model, TD3Policy):
        extractor, parts = model.actor.features_extractor, [*model.actor.mu]
    elif isinstance(model, DQNPolicy):
        extractor, parts = model.q_net.features_extractor, [*model.q_net.q_net]
    else:
        raise ValueError(
            f"policy: a {type(model).__name__} cannot be exported: it must be of PPO, SAC, TD3,"
            " DDPG or DQN, with dense layers, or of SARSA"
        )
    observation_space, action_space = model.observation_space, model.action_space
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        raise ValueError(f"policy: observations are {observation_space}: must be vectors")
    layers = _layers(parts)
    # SAC's most likely action is the tanh of the mean, which its distribution applies.
    if isinstance(model, SACPolicy):
        layers[-1] = dataclasses.replace(layers[-1], activation="Tanh")
    scales, gains = getattr(extractor, "factors", None), getattr(model, "largest", None)
    outputs = len(layers[-1].bias)
    return Network(
        np.ones(observation_space.shape, np.float32) if scales is None else scales.numpy().copy(),
        tuple(layers),
        np.ones(outputs, np.float32) if gains is None else gains.numpy().astype(np.float32),
        action_space.low.astype(np.float32) if isinstance(action_space, spaces.Box) else None,
        action_space.high.astype(np.float32) if isinstance(action_space, spaces.Box) else None,
        squashed,
    )


def _layers(modules: list[Module]) -> list[Layer]:
    """Return the dense layers of a list of modules, with the activations that follow them."""
    layers: list[Layer] = []
    for module in modules:
        kind = type(module).__name__
        if kind == "Linear":
            layers.append(
                Layer(
                    module.weight.detach().numpy().copy(),
                    module.bias.detach().numpy().copy(),
                    "Identity",
                )
            )
        elif kind in ACTIVATIONS and layers and layers[-1].activation == "Identity":
            layers[-1] = dataclasses.replace(layers[-1], activation=kind)
        else:
            raise ValueError(
                f"policy: a layer is {module}: must be Linear, or {', '.join(ACTIVATIONS)} after"
                " a Linear"
            )
    return layers
