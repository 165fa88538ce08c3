"""Checkpoints: files with the complete state of a training.

They are written atomically, have a digest of their content in their names, and contain no code. A
state is everything on which the rest of a training depends: weights, optimizers, replay buffer,
exploration noise, counters, environments and all random generators. Nothing is pickled. Rollout
buffers are omitted, because states are captured between two rollouts, when they are empty.
"""

import functools
import hashlib
import json
import operator
import os
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

from codrl_mj.boundary import JsonObject
from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.runs import find_checkpoints
from codrl_mj.runs.files import atomic_write, select_prefix

NUM_CHECKPOINTS = 2
"""Number of checkpoints in a folder: the last, and the previous in case the last is damaged."""
_COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    # The steps of DQN since the last update of the target network.
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
)
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_NOISE_MATRICES = ("exploration_mat", "exploration_matrices")
"""Attributes of state-dependent noise that are in use until its next draw."""


class State(NamedTuple):
    """State of a training: numbers as arrays, other values as JSON."""

    arrays: dict[str, np.ndarray]
    """Arrays by name."""
    facts: JsonObject
    """JSON-serializable values by name."""


def capture(model: BaseAlgorithm, envs: ActuatedVecEnv) -> State:
    """Return the state of a model and its environments between two rollouts."""
    arrays: dict[str, np.ndarray] = {}
    facts: JsonObject = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
    modules, tensors = model._get_torch_save_params()
    for module in modules:
        state = operator.attrgetter(module)(model).state_dict()
        if "param_groups" in state:
            facts[f"{module}.groups"] = state["param_groups"]
            facts[f"{module}.moments"] = {
                str(index): list(moments) for index, moments in state["state"].items()
            }
            for index, moments in state["state"].items():
                arrays |= {
                    f"{module}.{index}.{name}": _array(value) for name, value in moments.items()
                }
        else:
            arrays |= {f"{module}.{name}": _array(value) for name, value in state.items()}
    arrays |= {f"tensor.{name}": _array(operator.attrgetter(name)(model)) for name in tensors}
    arrays |= {f"env.{name}": np.asarray(value) for name, value in envs.snapshot().items()}
    arrays["last_obs"] = np.asarray(model._last_obs)
    arrays["last_episode_starts"] = np.asarray(model._last_episode_starts)
    if (buffer := getattr(model, "replay_buffer", None)) is not None:
        arrays |= {f"buffer.{name}": getattr(buffer, name)[: buffer.size()] for name in _BUFFER}
        facts["buffer"] = {"pos": int(buffer.pos), "full": bool(buffer.full)}
    arrays |= {f"noise.{index}": noise.noise_prev for index, noise in enumerate(_noises(model))}
    if (distribution := _state_dependent_noise(model)) is not None:
        arrays |= {f"noise.{name}": _array(getattr(distribution, name)) for name in _NOISE_MATRICES}
    if hasattr(model, "snapshot"):
        arrays |= {f"model.{name}": value for name, value in model.snapshot().items()}
    # Stable-Baselines3 draws from NumPy's global generator.
    numpy_state: JsonObject = np.random.get_state(legacy=False)
    arrays["random.numpy.key"] = numpy_state["state"].pop("key")
    facts["random.numpy"] = numpy_state
    facts["random.actions"] = model.action_space.np_random.bit_generator.state
    arrays["random.torch"] = torch.get_rng_state().numpy()
    return State(arrays, facts)


def restore(model: BaseAlgorithm, envs: ActuatedVecEnv, state: State) -> None:
    """Restore the result of `capture` in a model of the same configuration while it learns.

    Raises:
        ValueError: the state belongs to another configuration. Model and environments are then
            partly changed, and must not be used.
    """
    arrays, facts = state
    try:
        for name in filter(functools.partial(hasattr, model), _COUNTERS):
            setattr(model, name, facts[name])
        modules, tensors = model._get_torch_save_params()
        for module in modules:
            part = operator.attrgetter(module)(model)
            if (state_dict := part.state_dict()).keys() == {"state", "param_groups"}:
                moments = {
                    int(index): {
                        name: torch.tensor(arrays[f"{module}.{index}.{name}"]) for name in names
                    }
                    for index, names in facts[f"{module}.moments"].items()
                }
                part.load_state_dict({"state": moments, "param_groups": facts[f"{module}.groups"]})
            else:
                part.load_state_dict(
                    {name: torch.tensor(arrays[f"{module}.{name}"]) for name in state_dict}
                )
        for name in tensors:
            with torch.no_grad():
                operator.attrgetter(name)(model).copy_(torch.tensor(arrays[f"tensor.{name}"]))
        new_observations = envs.restore(select_prefix("env.", arrays))
        model._last_obs = (
            arrays["last_obs"].copy() if new_observations is None else new_observations
        )
        model._last_episode_starts = arrays["last_episode_starts"].copy()
        if new_observations is not None:
            # The environments cannot restore their states and have started new episodes.
            model._last_episode_starts[:] = True
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            buffer.pos, buffer.full = facts["buffer"]["pos"], facts["buffer"]["full"]
            for name in _BUFFER:
                getattr(buffer, name)[: buffer.size()] = arrays[f"buffer.{name}"]
        for index, noise in enumerate(_noises(model)):
            noise.noise_prev = arrays[f"noise.{index}"].copy()
        if (distribution := _state_dependent_noise(model)) is not None:
            for name in _NOISE_MATRICES:
                setattr(distribution, name, torch.tensor(arrays[f"noise.{name}"]))
        if hasattr(model, "restore"):
            model.restore(select_prefix("model.", arrays))
        numpy_state = facts["random.numpy"]
        np.random.set_state(
            numpy_state | {"state": numpy_state["state"] | {"key": arrays["random.numpy.key"]}}
        )
        model.action_space.np_random.bit_generator.state = facts["random.actions"]
        torch.set_rng_state(torch.tensor(arrays["random.torch"]))
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"the checkpoint belongs to another configuration: {error!r}") from None


def _array(value: torch.Tensor | float) -> np.ndarray:
    array: np.ndarray = torch.as_tensor(value).detach().cpu().numpy().copy()
    return array


def _noises(model: BaseAlgorithm) -> list[OrnsteinUhlenbeckActionNoise]:
    """Return the action noises that have a state."""
    noise = getattr(model, "action_noise", None)
    parts = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [part for part in parts if isinstance(part, OrnsteinUhlenbeckActionNoise)]


def _state_dependent_noise(model: BaseAlgorithm) -> StateDependentNoiseDistribution | None:
    """Return the distribution with state-dependent noise, or None if the model has none."""
    distribution = getattr(getattr(model, "actor", model.policy), "action_dist", None)
    return distribution if isinstance(distribution, StateDependentNoiseDistribution) else None


def save_checkpoint(folder: Path, state: State, run: str) -> Path:
    """Write a checkpoint, then delete those that are no longer needed.

    If it cannot be written, the previous ones remain. Its name contains its step and a digest of
    its content.

    Args:
        folder: folder of checkpoints.
        state: the state.
        run: identity of the run: its configuration as text. A run never continues from a checkpoint
            with another identity.

    Returns:
        The path of the checkpoint.
    """
    content = save(state.arrays, metadata={"run": run, "facts": json.dumps(state.facts)})
    step = f"{state.facts['num_timesteps']:012d}"
    path = folder / f"step-{step}-{_digest(content)}.safetensors"
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        # The content must be on the disk before an older checkpoint is deleted.
        os.fsync(file.fileno())
    existing = find_checkpoints(folder)
    older = [name for name, parts in existing.items() if parts["step"] < step]
    # All other files are obsolete: older ones, ones of the same step, and damaged ones of later
    # steps, which are left over if the run was resumed from an earlier checkpoint.
    for obsolete in existing.keys() - {path, *older[1 - NUM_CHECKPOINTS :]}:
        obsolete.unlink(missing_ok=True)
    return path


def load_checkpoint(folder: Path, run: str) -> State | None:
    """Return the last intact checkpoint of a run; None if there is none.

    Each checkpoint that cannot be used causes a warning.
    """
    for remaining, (path, parts) in reversed(list(enumerate(find_checkpoints(folder).items()))):
        try:
            return _read(path, parts["digest"], run)
        except (ValueError, OSError) as error:
            remedy = (
                "going back to the previous one"
                if remaining
                else "there is no other: starting from the beginning"
            )
            warnings.warn(f"checkpoint {path} cannot be used ({error}): {remedy}", stacklevel=2)
    return None


def _read(path: Path, digest: str, run: str) -> State:
    """Read a checkpoint.

    Raises:
        ValueError: its content is damaged, or it belongs to another run.
    """
    content = path.read_bytes()
    if _digest(content) != digest:
        raise ValueError("it is damaged: its content does not match the digest in its name")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
        if metadata["run"] != run:
            raise ValueError("it belongs to another run")
        return State(load(content), json.loads(metadata["facts"]))
    except (SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"it is not a checkpoint: {error!r}") from None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
