"""Checkpoints: the whole state of a training, as files that appear whole, prove themselves intact, and hold no code.

A state is all that the rest of a training depends on: weights, optimisers, replay buffer,
exploration noise, counters, the environments and every random generator. Nothing is pickled.
Rollout buffers are left out: states are taken between two rollouts, when they are empty.
"""

import functools
import hashlib
import json
import operator
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

from codrl_mj.runs import find_checkpoints
from codrl_mj.runs.files import select_prefix, atomic_write

KEPT = 2
"""Checkpoints that are kept: the last, and the one before in case the last is damaged."""
_COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_n_calls",  # DQN: steps towards the next update of the target network
    "_current_progress_remaining",
    "exploration_rate",
)
_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_DRAWN = (
    "exploration_mat",
    "exploration_matrices",
)  # of state-dependent noise, in use until it is drawn anew


class State(NamedTuple):
    """A state: numbers as arrays, the rest as JSON."""

    arrays: dict[str, np.ndarray]
    """Arrays by name."""
    facts: dict[str, Any]
    """JSON-serialisable values by name."""


def capture(model: BaseAlgorithm, envs: Any) -> State:
    """The state of a model and its environments between two rollouts."""
    arrays: dict[str, np.ndarray] = {}
    facts: dict[str, Any] = {
        name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)
    }
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
        arrays |= {f"noise.{name}": _array(getattr(distribution, name)) for name in _DRAWN}
    if hasattr(model, "snapshot"):
        arrays |= {f"model.{name}": value for name, value in model.snapshot().items()}
    numpy_state: Any = np.random.get_state(
        legacy=False
    )  # Stable-Baselines3 draws from NumPy's global generator
    arrays["random.numpy.key"] = numpy_state["state"].pop("key")
    facts["random.numpy"] = numpy_state
    facts["random.actions"] = model.action_space.np_random.bit_generator.state
    arrays["random.torch"] = torch.get_rng_state().numpy()
    return State(arrays, facts)


def restore(model: BaseAlgorithm, envs: Any, state: State) -> None:
    """Bring a model of the same configuration to what `capture` returned, once `learn` has set it up.

    Model and environments are no good after a state that is refused, which is another
    configuration's.
    """
    arrays, facts = state
    try:
        for name in filter(functools.partial(hasattr, model), _COUNTERS):
            setattr(model, name, facts[name])
        modules, tensors = model._get_torch_save_params()
        for module in modules:
            own = operator.attrgetter(module)(model)
            if (state_dict := own.state_dict()).keys() == {"state", "param_groups"}:
                moments = {
                    int(index): {
                        name: torch.tensor(arrays[f"{module}.{index}.{name}"]) for name in names
                    }
                    for index, names in facts[f"{module}.moments"].items()
                }
                own.load_state_dict({"state": moments, "param_groups": facts[f"{module}.groups"]})
            else:
                own.load_state_dict(
                    {name: torch.tensor(arrays[f"{module}.{name}"]) for name in state_dict}
                )
        for name in tensors:
            with torch.no_grad():
                operator.attrgetter(name)(model).copy_(torch.tensor(arrays[f"tensor.{name}"]))
        begun = envs.restore(select_prefix("env.", arrays))
        model._last_obs = arrays["last_obs"].copy() if begun is None else begun
        model._last_episode_starts = arrays["last_episode_starts"].copy()
        if begun is not None:  # environments whose state nobody can set
            model._last_episode_starts[:] = True
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            buffer.pos, buffer.full = facts["buffer"]["pos"], facts["buffer"]["full"]
            for name in _BUFFER:
                getattr(buffer, name)[: buffer.size()] = arrays[f"buffer.{name}"]
        for place, noise in enumerate(_noises(model)):
            noise.noise_prev = arrays[f"noise.{place}"].copy()
        if (distribution := _state_dependent_noise(model)) is not None:
            for name in _DRAWN:
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
        raise ValueError(f"the checkpoint is of another configuration: {error!r}") from None


def _array(value: Any) -> np.ndarray:
    return torch.as_tensor(value).detach().cpu().numpy().copy()


def _noises(model: Any) -> list[OrnsteinUhlenbeckActionNoise]:
    """The action noises that remember something."""
    noise = getattr(model, "action_noise", None)
    every = noise.noises if isinstance(noise, VectorizedActionNoise) else [noise]
    return [one for one in every if isinstance(one, OrnsteinUhlenbeckActionNoise)]


def _state_dependent_noise(model: Any) -> StateDependentNoiseDistribution | None:
    """What explores by noise that is a function of the state, if the model does."""
    distribution = getattr(getattr(model, "actor", model.policy), "action_dist", None)
    return distribution if isinstance(distribution, StateDependentNoiseDistribution) else None


def save_checkpoint(folder: Path, state: State, run: str) -> Path:
    """Write a checkpoint and delete those that are no longer needed; those before stay where it cannot be written.

    Its name has its step and a digest of its content. `run` says what the run is (its
    configuration), so that none is continued from another's checkpoint.
    """
    content = save(state.arrays, metadata={"run": run, "facts": json.dumps(state.facts)})
    step = f"{state.facts['num_timesteps']:012d}"
    path = folder / f"step-{step}-{_digest(content)}.safetensors"
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())  # on the disk before the last but one is deleted
    there = find_checkpoints(folder)
    before = [other for other, named in there.items() if named["step"] < step]
    # the rest is of the same step or, damaged, of a later one, from which the run fell back
    for superfluous in there.keys() - {path, *before[1 - KEPT :]}:
        superfluous.unlink(missing_ok=True)
    return path


def load_checkpoint(folder: Path, run: str) -> State | None:
    """The last checkpoint of a run that is intact; None if there is none. Of damaged ones it warns."""
    for left, (path, named) in reversed(list(enumerate(find_checkpoints(folder).items()))):
        try:
            return _read(path, named["digest"], run)
        except (ValueError, OSError) as error:
            remedy = "going back to the one before" if left else "no other is left: starting anew"
            warnings.warn(f"checkpoint {path} cannot be used ({error}): {remedy}", stacklevel=2)
    return None


def _read(path: Path, digest: str, run: str) -> State:
    """Read one checkpoint, refused if it is not what was written, or another run's."""
    content = path.read_bytes()
    if _digest(content) != digest:
        raise ValueError("it is damaged: its content does not have the digest in its name")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
        if metadata["run"] != run:
            raise ValueError("it is another run's")
        return State(load(content), json.loads(metadata["facts"]))
    except (SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"it is no checkpoint: {error!r}") from None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
