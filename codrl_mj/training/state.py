"""The whole state of a Stable-Baselines3 model and its environments as plain arrays and JSON, and back.

Everything that the rest of a training depends on: weights, optimisers, replay buffer, action noise, counters, the
environments and every random generator. Nothing is pickled. Rollout buffers are left out: states are taken between two
rollouts, when they are empty.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import get_device

_COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_n_calls",  # DQN: steps towards the next update of the target network
    "_current_progress_remaining",
    "exploration_rate",
)
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class State(NamedTuple):
    """A state: numbers as arrays, the rest as JSON."""

    arrays: dict[str, np.ndarray]
    """Arrays by name."""
    facts: dict[str, Any]
    """JSON-serialisable values by name."""


def capture(model: BaseAlgorithm, envs: Any) -> State:
    """The state of a model between two rollouts.

    Args:
        model: the model.
        envs: its environments (`snapshot()`).
    """
    arrays: dict[str, np.ndarray] = {}
    facts: dict[str, Any] = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    modules, tensors = model._get_torch_save_params()
    for module in modules:
        state = _member(model, module).state_dict()
        if "param_groups" in state:
            facts[f"{module}.groups"] = state["param_groups"]
            for index, moments in state["state"].items():
                arrays |= {f"{module}.{index}.{name}": _array(value) for name, value in moments.items()}
        else:
            arrays |= {f"{module}.{name}": _array(value) for name, value in state.items()}
    arrays |= {f"tensor.{name}": _array(_member(model, name)) for name in tensors}
    arrays |= {f"env.{name}": np.asarray(value) for name, value in envs.snapshot().items()}
    arrays["last_obs"] = np.asarray(model._last_obs)
    arrays["last_episode_starts"] = np.asarray(model._last_episode_starts)
    if (buffer := getattr(model, "replay_buffer", None)) is not None:
        filled = _filled(buffer)
        arrays |= {f"buffer.{name}": getattr(buffer, name)[:filled] for name in _BUFFER}
        facts["buffer"] = {"pos": int(buffer.pos), "full": bool(buffer.full)}
    arrays |= {f"noise.{index}": noise.noise_prev for index, noise in enumerate(_noises(model))}
    if hasattr(model, "snapshot"):
        arrays |= {f"model.{name}": value for name, value in model.snapshot().items()}
    numpy_state: Any = np.random.get_state(legacy=False)  # Stable-Baselines3 draws from NumPy's global generator
    arrays["random.numpy"] = numpy_state["state"].pop("key")
    facts["random.numpy"] = numpy_state
    facts["random.actions"] = model.action_space.np_random.bit_generator.state
    arrays["random.torch"] = torch.get_rng_state().numpy()
    return State(arrays, facts)


def restore(model: BaseAlgorithm, envs: Any, state: State) -> None:
    """Bring a fresh model of the same configuration to a state, once `learn` has set it up.

    Args:
        model: the model.
        envs: its environments (`restore()`).
        state: what `capture` returned.

    Raises:
        ValueError: the state is of another configuration.
    """
    arrays, facts = state
    try:
        for name in _COUNTERS:
            if name in facts:
                setattr(model, name, facts[name])
        modules, tensors = model._get_torch_save_params()
        for module in modules:
            inner = _below(arrays, f"{module}.")
            if f"{module}.groups" in facts:
                moments: dict[int, dict[str, torch.Tensor]] = {}
                for key, value in inner.items():
                    index, _, name = key.partition(".")
                    if index.isdigit():
                        moments.setdefault(int(index), {})[name] = torch.from_numpy(value.copy())
                _member(model, module).load_state_dict({"state": moments, "param_groups": facts[f"{module}.groups"]})
            else:
                own = _member(model, module).state_dict()
                _member(model, module).load_state_dict({key: torch.from_numpy(inner[key].copy()) for key in own})
        for name in tensors:
            with torch.no_grad():
                _member(model, name).copy_(torch.from_numpy(arrays[f"tensor.{name}"]).to(get_device("cpu")))
        envs.restore(_below(arrays, "env."))
        model._last_obs = arrays["last_obs"].copy()
        model._last_episode_starts = arrays["last_episode_starts"].copy()
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            buffer.pos, buffer.full = facts["buffer"]["pos"], facts["buffer"]["full"]
            for name in _BUFFER:
                getattr(buffer, name)[: _filled(buffer)] = arrays[f"buffer.{name}"]
        for place, noise in enumerate(_noises(model)):
            noise.noise_prev = arrays[f"noise.{place}"].copy()
        if hasattr(model, "restore"):
            model.restore(_below(arrays, "model."))
        numpy_state = facts["random.numpy"]
        np.random.set_state(numpy_state | {"state": numpy_state["state"] | {"key": arrays["random.numpy"]}})
        model.action_space.np_random.bit_generator.state = facts["random.actions"]
        torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
    except (KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"the checkpoint is of another configuration: {error!r}") from None


def _member(model: Any, path: str) -> Any:
    for name in path.split("."):
        model = getattr(model, name)
    return model


def _array(value: Any) -> np.ndarray:
    return torch.as_tensor(value).detach().cpu().numpy().copy()


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _filled(buffer: ReplayBuffer) -> int:
    return buffer.buffer_size if buffer.full else buffer.pos


def _noises(model: Any) -> list[OrnsteinUhlenbeckActionNoise]:
    """The action noises that remember something."""
    noise = getattr(model, "action_noise", None)
    every = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [one for one in every if isinstance(one, OrnsteinUhlenbeckActionNoise)]
