"""Trained policies as files that are safe to load: safetensors for the weights, JSON for everything else.

Nothing here unpickles, so a policy from elsewhere can do no more than choose bad actions.
"""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from codrl_mj.files import read_json, write_json, writing

FORMAT = "codrl_mj policy 1"
_WEIGHTS, _DESCRIPTION = "policy.safetensors", "policy.json"
_ACTIVATIONS = ("Tanh", "ReLU")


class Policy(Protocol):
    """Anything that chooses actions; Stable-Baselines3's policies and models are such."""

    def predict(self, observation: np.ndarray, *, deterministic: bool = False) -> tuple[np.ndarray, Any]:
        """(observations (N, k)) -> actions (N, ...), and a state that is not used."""


def _describe_space(space: spaces.Space[Any]) -> dict[str, Any]:
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n)}
    if isinstance(space, spaces.Box):
        return {
            "type": "Box",
            "low": space.low.tolist(),
            "high": space.high.tolist(),
            "dtype": space.dtype.name,
        }
    raise ValueError(f"a policy over {space} cannot be saved: only Box and Discrete spaces can")


def _make_space(described: dict[str, Any]) -> spaces.Space[Any]:
    if described["type"] == "Discrete":
        return spaces.Discrete(described["n"])
    dtype = np.dtype(described["dtype"]).type
    return spaces.Box(np.array(described["low"], dtype), np.array(described["high"], dtype), dtype=dtype)


def save_policy(model: Any, folder: Path) -> None:
    """Write the policy of a Stable-Baselines3 actor-critic model (PPO, A2C) into `folder`.

    Args:
        model: the trained model.
        folder: gets `policy.safetensors` and `policy.json`.

    Raises:
        ValueError: the policy is of a kind that cannot be saved this way.
    """
    from safetensors.torch import save_file
    from stable_baselines3.common.policies import ActorCriticPolicy

    policy = model.policy
    activation = policy.activation_fn.__name__ if isinstance(policy, ActorCriticPolicy) else None
    if activation not in _ACTIVATIONS:
        raise ValueError(
            f"a {type(policy).__name__} with activation {activation} cannot be saved: it must be an "
            f"ActorCriticPolicy with one of {', '.join(_ACTIVATIONS)}"
        )
    description = {
        "format": FORMAT,
        "algorithm": type(model).__name__,
        "net_arch": policy.net_arch,
        "activation": activation,
        "observation_space": _describe_space(policy.observation_space),
        "action_space": _describe_space(policy.action_space),
    }
    with writing(folder / _WEIGHTS) as temporary:
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in policy.state_dict().items()}
        save_file(tensors, temporary)
    write_json(folder / _DESCRIPTION, description)


def load_policy(folder: Path) -> Any:
    """Load a policy that `save_policy` wrote; nothing in the files is executed.

    Args:
        folder: a run folder, or any folder with `policy.safetensors` and `policy.json`.

    Returns:
        The policy (`predict(observations, deterministic=...)`).

    Raises:
        FileNotFoundError: the folder has no policy.
        ValueError: the files are truncated, of another format, or do not belong together.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file
    from stable_baselines3.common.policies import ActorCriticPolicy
    from torch import nn

    description = read_json(folder / _DESCRIPTION, "policy description")
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise ValueError(f"{folder / _DESCRIPTION}: not a policy of this program: its format must be {FORMAT!r}")
    weights = folder / _WEIGHTS
    if not weights.is_file():
        raise FileNotFoundError(f"no policy weights at {weights}")
    if description.get("activation") not in _ACTIVATIONS:
        raise ValueError(
            f"{folder / _DESCRIPTION}: activation {description.get('activation')!r} is not one of "
            f"{', '.join(_ACTIVATIONS)}"
        )
    try:
        policy = ActorCriticPolicy(
            _make_space(description["observation_space"]),  # type: ignore[arg-type]
            _make_space(description["action_space"]),
            lr_schedule=lambda _: 0.0,
            net_arch=description["net_arch"],
            activation_fn=getattr(nn, description["activation"]),
        )
    except (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder / _DESCRIPTION} does not describe a policy: {error!r}") from None
    try:
        tensors = load_file(weights)
        policy.load_state_dict(tensors)
    except SafetensorError as error:
        raise ValueError(f"{weights} is truncated or not a safetensors file: {error}") from None
    except RuntimeError as error:
        raise ValueError(f"{weights} and {_DESCRIPTION} do not belong together: {error}") from None
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise ValueError(f"{weights} holds weights that are not finite numbers")
    policy.set_training_mode(False)
    return policy
