"""Actor and critic as one batch of two networks, with explicit gradients.

The module imports torch, so import it only where an agent is created.

With networks of 64 units most of a gradient step's time is overhead: modules, the graph of
automatic differentiation, an optimizer that handles tensor by tensor. This module computes both
networks, forward and backward, by a few batched matrix products, and keeps all parameters in one
vector.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

StateDict = dict[str, Any]
"""Result of an optimizer's `state_dict`: nested mappings and lists, of tensors and settings."""
_ACTIVATIONS: dict[
    type[nn.Module],
    tuple[
        Callable[[torch.Tensor], torch.Tensor], Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    ],
] = {
    nn.Tanh: (torch.tanh, torch.ops.aten.tanh_backward),
    nn.ReLU: (
        torch.relu,
        lambda gradient, output: torch.ops.aten.threshold_backward(gradient, output, 0.0),
    ),
}
"""Activation -> its function, and its backward function.

The latter maps the gradient with respect to the output, and the output, to the gradient with
respect to the input.
"""


class StackedNetworks:
    """Networks of an `ActorCriticPolicy`, whose parameters become views of one vector.

    The critic's last layer is padded with zeros to the actor's number of outputs. The padding
    remains zero, because its gradient is zero.
    """

    def __init__(self, policy: ActorCriticPolicy) -> None:
        """Move the policy's parameters into the vector `parameters`, with its `gradient`."""
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
                f" {' or '.join(activation.__name__ for activation in _ACTIVATIONS)}; use"
                " Stable-Baselines3's PPO"
            )
        num_network_parameters = sum(
            (inputs + 1) * outputs for tower in sizes for inputs, outputs in tower
        )
        num_policy_parameters = sum(
            parameter.numel() for parameter in policy.parameters() if parameter is not log_std
        )
        if num_network_parameters != num_policy_parameters:
            raise ValueError(
                f"the policy has {num_policy_parameters} weights and biases, but its two networks"
                f" have {num_network_parameters}: a features extractor must not learn; use"
                " Stable-Baselines3's PPO for one that does"
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
        # The shapes for each layer are (2, outputs, inputs) and (2, 1, outputs).
        self.weights, self.biases = _carve(self.parameters, shapes)
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
        """Return True if the policy's parameters are views of `parameters`.

        The parameters of a copied policy are not.
        """
        return bool(policy.action_net.weight.data_ptr() == self.weights[-1].data_ptr())

    def act(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actor's last hidden layer (N, h) and outputs (N, a) for features (N, k)."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            features = self._activation(torch.addmm(bias[0], features, weight[0].T))
        return features, torch.addmm(self.biases[-1][0], features, self.weights[-1][0].T)

    def forward(self, features: torch.Tensor) -> list[torch.Tensor]:
        """Return the inputs of each layer, (2, N, units), then the outputs (2, N, a).

        The first index is 0 for the actor and 1 for the critic, whose value is the first output.

        Args:
            features: inputs of both networks, shape (N, k).
        """
        layers = [features.expand(2, *features.shape)]
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            outputs = torch.baddbmm(bias, layers[-1], weight.mT)
            layers.append(outputs if index == len(self.weights) - 1 else self._activation(outputs))
        return layers

    def backward(self, layers: list[torch.Tensor], gradient: torch.Tensor) -> None:
        """Compute the attribute `gradient`, except for the part of `log_std`.

        Args:
            layers: result of `forward`.
            gradient: gradient with respect to the outputs, shape (2, N, a).
        """
        for index in reversed(range(len(self.weights))):
            torch.bmm(gradient.mT, layers[index], out=self._weight_gradients[index])
            torch.sum(gradient, 1, keepdim=True, out=self._bias_gradients[index])
            if index:
                gradient = self._slope(torch.bmm(gradient, self.weights[index]), layers[index])


class VectorAdam(torch.optim.Adam):
    """Adam on one vector, with the state dict of an Adam on the parameters that are views of it.

    Saved models can therefore be exchanged with Stable-Baselines3 in both directions.
    """

    def __init__(
        self, vector: torch.Tensor, views: Iterable[nn.Parameter], **options: object
    ) -> None:
        """Optimize a vector by `vector.grad`; the views are in the order of an ordinary Adam."""
        super().__init__([vector], fused=True, **options)
        self._layout = [(view.shape, view.stride(), view.storage_offset()) for view in views]

    def state_dict(self) -> StateDict:
        """Return the state dict, with the moments of each parameter."""
        own_state = super().state_dict()
        moments = own_state["state"].get(0, {})
        state = {
            number: {
                name: (moment.as_strided(*view) if moment.ndim else moment).clone()
                for name, moment in moments.items()
            }
            for number, view in enumerate(self._layout)
        }
        group = own_state["param_groups"][0] | {"params": list(state)}
        return {"state": state if moments else {}, "param_groups": [group]}

    def load_state_dict(self, state_dict: StateDict) -> None:
        """Load a state dict with the moments of each parameter."""
        state, group = state_dict["state"], state_dict["param_groups"][0]
        if len(group["params"]) != len(self._layout):
            raise ValueError(
                f"{len(group['params'])} parameters are optimized: must be {len(self._layout)}"
            )
        vector = self.param_groups[0]["params"][0]
        moments = {
            name: moment if not moment.ndim else torch.zeros_like(vector)
            for name, moment in state.get(0, {}).items()
        }
        for number, view in enumerate(self._layout if moments else ()):
            for name, moment in state[number].items():
                if moment.ndim:
                    moments[name].as_strided(*view).copy_(moment)
        vector_state = {0: moments} if moments else {}
        super().load_state_dict(
            {"state": vector_state, "param_groups": [group | {"params": [0], "fused": True}]}
        )


def _carve(
    vector: torch.Tensor, shapes: list[tuple[int, int]]
) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Return the weights and biases of both networks, layer by layer, as views of a vector."""
    weights: list[torch.Tensor] = []
    biases: list[torch.Tensor] = []
    start = 0
    for outputs, inputs in shapes:
        for views, size in ((weights, inputs), (biases, 1)):
            length = 2 * outputs * size
            piece = vector[start : start + length]
            views.append(
                piece.view(2, outputs, inputs) if views is weights else piece.view(2, 1, outputs)
            )
            start += length
    return weights, biases


def _move(parameter: nn.Parameter, view: torch.Tensor) -> None:
    # The order matters: the view takes the values before it becomes the parameter's storage.
    view.copy_(parameter.data)
    parameter.data = view
