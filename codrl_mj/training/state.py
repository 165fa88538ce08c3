"""The whole state of a Stable-Baselines3 model and its environments as plain arrays and JSON, and back.

Everything that the rest of a training depends on: weights, optimisers, replay buffer, exploration noise, counters, the
environments and every random generator. Nothing is pickled. Rollout buffers are left out: states are taken between two
rollouts, when they are empty.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

_COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_n_calls",  # DQN: steps towards the next update of the target network
    "_current_progress_remaining",
    "exploration_rate",
)
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_DRAWN = ("exploration_mat", "exploration_matrices")  # of state-dependent noise, in use until it is drawn anew


class State(NamedTuple):
    """A state: numbers as arrays, the rest as JSON."""

    arrays: dict[str, np.ndarray]
    """Arrays by name."""
    facts: dict[str, Any]
    """JSON-serialisable values by name."""


def capture(model: BaseAlgorithm, envs: Any) -> State:
    """The state of a model and its environments between two rollouts."""
    arrays: dict[str, np.ndarray] = {}
    facts: dict[str, Any] = {name: getattr(model, name) for name in _counters(model)}
    modules, tensors = model._get_torch_save_params()
    for module in modules:
        state = _member(model, module).state_dict()
        if "param_groups" in state:
            facts[f"{module}.groups"] = state["param_groups"]
            facts[f"{module}.moments"] = {str(index): list(moments) for index, moments in state["state"].items()}
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
    if (distribution := _state_dependent_noise(model)) is not None:
        arrays |= {f"noise.{name}": _array(getattr(distribution, name)) for name in _DRAWN}
    if hasattr(model, "snapshot"):
        arrays |= {f"model.{name}": value for name, value in model.snapshot().items()}
    numpy_state: Any = np.random.get_state(legacy=False)  # Stable-Baselines3 draws from NumPy's global generator
    arrays["random.numpy.key"] = numpy_state["state"].pop("key")
    facts["random.numpy"] = numpy_state
    facts["random.actions"] = model.action_space.np_random.bit_generator.state
    arrays["random.torch"] = torch.get_rng_state().numpy()
    return State(arrays, facts)


def restore(model: BaseAlgorithm, envs: Any, state: State) -> None:
    """Bring a model of the same configuration to what `capture` returned, once `learn` has set it up.

    Model and environments are no good after a state that is refused, which is another configuration's.
    """
    arrays, facts = state
    try:
        for name in _counters(model):
            setattr(model, name, facts[name])
        modules, tensors = model._get_torch_save_params()
        for module in modules:
            own = _member(model, module)
            if (state_dict := own.state_dict()).keys() == {"state", "param_groups"}:
                moments = {
                    int(index): {name: _tensor(arrays[f"{module}.{index}.{name}"]) for name in names}
                    for index, names in facts[f"{module}.moments"].items()
                }
                own.load_state_dict({"state": moments, "param_groups": facts[f"{module}.groups"]})
            else:
                own.load_state_dict({name: _tensor(arrays[f"{module}.{name}"]) for name in state_dict})
        for name in tensors:
            with torch.no_grad():
                _member(model, name).copy_(_tensor(arrays[f"tensor.{name}"]))
        begun = envs.restore(_below(arrays, "env."))
        model._last_obs = arrays["last_obs"].copy() if begun is None else begun
        model._last_episode_starts = arrays["last_episode_starts"].copy()
        if begun is not None:  # environments whose state nobody can set
            model._last_episode_starts[:] = True
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            buffer.pos, buffer.full = facts["buffer"]["pos"], facts["buffer"]["full"]
            for name in _BUFFER:
                getattr(buffer, name)[: _filled(buffer)] = arrays[f"buffer.{name}"]
        for place, noise in enumerate(_noises(model)):
            noise.noise_prev = arrays[f"noise.{place}"].copy()
        if (distribution := _state_dependent_noise(model)) is not None:
            for name in _DRAWN:
                setattr(distribution, name, _tensor(arrays[f"noise.{name}"]))
        if hasattr(model, "restore"):
            model.restore(_below(arrays, "model."))
        numpy_state = facts["random.numpy"]
        np.random.set_state(numpy_state | {"state": numpy_state["state"] | {"key": arrays["random.numpy.key"]}})
        model.action_space.np_random.bit_generator.state = facts["random.actions"]
        torch.set_rng_state(_tensor(arrays["random.torch"]))
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"the checkpoint is of another configuration: {error!r}") from None


def _counters(model: BaseAlgorithm) -> list[str]:
    return [name for name in _COUNTERS if hasattr(model, name)]


def _member(model: Any, path: str) -> Any:
    for name in path.split("."):
        model = getattr(model, name)
    return model


def _array(value: Any) -> np.ndarray:
    return torch.as_tensor(value).detach().cpu().numpy().copy()


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array.copy())


def _below(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _filled(buffer: ReplayBuffer) -> int:
    return buffer.buffer_size if buffer.full else buffer.pos


def _noises(model: Any) -> list[OrnsteinUhlenbeckActionNoise]:
    """The action noises that remember something."""
    noise = getattr(model, "action_noise", None)
    every = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [one for one in every if isinstance(one, OrnsteinUhlenbeckActionNoise)]


def _state_dependent_noise(model: Any) -> StateDependentNoiseDistribution | None:
    """What explores by noise that is a function of the state, if the model does."""
    distribution = getattr(getattr(model, "actor", model.policy), "action_dist", None)
    return distribution if isinstance(distribution, StateDependentNoiseDistribution) else None
