"""Actor and critic as one stack of networks, with its gradient written out.

Imports torch: import it where an agent is made.

Networks of 64 units are so small that most of a gradient step is the bookkeeping around its
arithmetic: modules, the graph of automatic differentiation, tensor by tensor optimisation. Here
both networks pass through the same few batched products, forwards and backwards, and all their
parameters are one vector.
"""

from collections.abc import Iterable
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

_ACTIVATIONS: dict[type[nn.Module], tuple[Any, Any]] = {
    nn.Tanh: (torch.tanh, torch.ops.aten.tanh_backward),
    nn.ReLU: (
        torch.relu,
        lambda gradient, output: torch.ops.aten.threshold_backward(gradient, output, 0.0),
    ),
}
"""Activation -> its function, and (gradient by its output, its output) -> gradient by its input."""


class TwinNetworks:
    """The networks of a Stable-Baselines3 `ActorCriticPolicy`, whose parameters become views of one vector.

    The critic's last layer is filled up with zeros to as many outputs as the actor has; they stay
    zero.
    """

    def __init__(self, policy: ActorCriticPolicy) -> None:
        """Move the policy's parameters into the vector `parameters`, whose gradient is `gradient`."""
        towers = [
            [layer for layer in (*hidden, last) if isinstance(layer, nn.Linear)]
            for hidden, last in (
                (policy.mlp_extractor.policy_net, policy.action_net),
                (policy.mlp_extractor.value_net, policy.value_net),
            )
        ]
        log_std = getattr(policy, "log_std", None)
        sizes = [[(layer.in_features, layer.out_features) for layer in tower] for tower in towers]
        inputs = [[size[0] for size in tower] for tower in sizes]
        if inputs[0] != inputs[1] or policy.activation_fn not in _ACTIVATIONS:
            raise ValueError(
                f"actor and critic of {policy.net_arch} with {policy.activation_fn.__name__}: must"
                " have the same hidden layers, with"
                f" {' or '.join(one.__name__ for one in _ACTIVATIONS)}; use Stable-Baselines3's PPO"
            )
        ours = sum((inputs + 1) * outputs for tower in sizes for inputs, outputs in tower)
        theirs = sum(one.numel() for one in policy.parameters() if one is not log_std)
        if ours != theirs:
            raise ValueError(
                f"the policy has {theirs} weights and biases, of which {ours} are those of its two"
                " networks: a features extractor must not learn; use Stable-Baselines3's PPO for"
                " one that does"
            )
        shapes = [
            (max(layer.out_features for layer in pair), pair[0].in_features)
            for pair in zip(*towers, strict=True)
        ]
        self.outputs = shapes[-1][0]
        noise = 0 if log_std is None else log_std.numel()
        self.parameters = torch.zeros(
            sum(2 * outputs * (inputs + 1) for outputs, inputs in shapes) + noise
        )
        self.gradient = torch.zeros_like(self.parameters)
        self.weights, self.biases = _carve(
            self.parameters, shapes
        )  # (2, outputs, inputs), (2, 1, outputs)
        self._weight_gradients, self._bias_gradients = _carve(self.gradient, shapes)
        for tower, linears in enumerate(towers):
            for layer, weight, bias in zip(linears, self.weights, self.biases, strict=True):
                _move(layer.weight, weight[tower, : layer.out_features])
                _move(layer.bias, bias[tower, 0, : layer.out_features])
        self.log_std_gradient = None
        if log_std is not None:
            _move(log_std, self.parameters[-noise:].view_as(log_std))
            self.log_std_gradient = self.gradient[-noise:].view_as(log_std)
        self._activation, self._slope = _ACTIVATIONS[policy.activation_fn]

    def holds(self, policy: ActorCriticPolicy) -> bool:
        """Whether the policy's parameters are views of `parameters` still: a copy of a policy has its own."""
        return policy.action_net.weight.data_ptr() == self.weights[-1].data_ptr()

    def act(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The actor alone: features (N, k) -> its last hidden layer (N, h) and its outputs (N, a)."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            features = self._activation(torch.addmm(bias[0], features, weight[0].T))
        return features, torch.addmm(self.biases[-1][0], features, self.weights[-1][0].T)

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Both networks: features (N, k) -> the inputs of each layer, (2, N, units), and then the outputs (2, N, a).

        The critic's value is the first of its outputs.
        """
        layers = [features.expand(2, *features.shape)]
        for place, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            outputs = torch.baddbmm(bias, layers[-1], weight.mT)
            layers.append(outputs if place == len(self.weights) - 1 else self._activation(outputs))
        return layers

    def backward(self, layers: list[torch.Tensor], gradient: torch.Tensor) -> None:
        """Fill in `gradient`, but for that of `log_std`, from `forward`'s layers and that by the outputs (2, N, a)."""
        for place in reversed(range(len(self.weights))):
            torch.bmm(gradient.mT, layers[place], out=self._weight_gradients[place])
            torch.sum(gradient, 1, keepdim=True, out=self._bias_gradients[place])
            if place:
                gradient = self._slope(torch.bmm(gradient, self.weights[place]), layers[place])


class VectorAdam(torch.optim.Adam):
    """Adam on one vector, whose state reads as that of the parameters that are views of it: as a plain Adam's.

    So saved models are Stable-Baselines3's, which reads them, and whose own are read.
    """

    def __init__(self, vector: torch.Tensor, views: Iterable[nn.Parameter], **options: Any) -> None:
        """Optimise the vector by `vector.grad`; the views are in the order in which a plain Adam would have them."""
        super().__init__([vector], fused=True, **options)
        self._layout = [(view.shape, view.stride(), view.storage_offset()) for view in views]

    def state_dict(self) -> dict[str, Any]:
        """Moments of each parameter."""
        whole = super().state_dict()
        moments = whole["state"].get(0, {})
        state = {
            number: {
                name: (one.as_strided(*place) if one.ndim else one).clone()
                for name, one in moments.items()
            }
            for number, place in enumerate(self._layout)
        }
        group = whole["param_groups"][0] | {"params": list(state)}
        return {"state": state if moments else {}, "param_groups": [group]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the moments of each parameter."""
        state, group = state_dict["state"], state_dict["param_groups"][0]
        if len(group["params"]) != len(self._layout):
            raise ValueError(
                f"{len(group['params'])} parameters are optimised: must be {len(self._layout)}"
            )
        vector = self.param_groups[0]["params"][0]
        moments = {
            name: one if not one.ndim else torch.zeros_like(vector)
            for name, one in state.get(0, {}).items()
        }
        for number, place in enumerate(self._layout if moments else ()):
            for name, one in state[number].items():
                if one.ndim:
                    moments[name].as_strided(*place).copy_(one)
        kept = {0: moments} if moments else {}
        super().load_state_dict(
            {"state": kept, "param_groups": [group | {"params": [0], "fused": True}]}
        )


def _carve(
    vector: torch.Tensor, shapes: list[tuple[int, int]]
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Weights and biases of both networks as views of a vector, layer by layer."""
    weights: list[torch.Tensor] = []
    biases: list[torch.Tensor] = []
    start = 0
    for outputs, inputs in shapes:
        for views, size in ((weights, inputs), (biases, 1)):
            count = 2 * outputs * size
            piece = vector[start : start + count]
            views.append(
                piece.view(2, outputs, inputs) if views is weights else piece.view(2, 1, outputs)
            )
            start += count
    return weights, biases


def _move(parameter: nn.Parameter, view: torch.Tensor) -> None:
    view.copy_(parameter.data)
    parameter.data = view
