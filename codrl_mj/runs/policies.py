"""Policies as files that are safe to load: safetensors for the weights, JSON for everything else.

`load_policy` never unpickles, so a malicious policy can only choose bad actions.
`load_sb3_zip` unpickles, and requires `trust`.
"""

import hashlib
import pickle
import warnings
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import allow_imports
from codrl_mj.agents import AgentConfig, agent_from_mapping
from codrl_mj.agents.base import AgentPolicy
from codrl_mj.boundary import JsonObject
from codrl_mj.envs.config import Env, Space
from codrl_mj.runs import DESCRIPTION, DIGEST, WEIGHTS
from codrl_mj.runs.files import atomic_write, check_digest, read_json, with_digest, write_json

FORMAT = "codrl_mj policy 2"
# Stable-Baselines3 takes seconds to import, and mypy does not read it.
SavedModel = Any
"""A Stable-Baselines3 `BaseAlgorithm`."""
SavedNormalization = Any
"""A Stable-Baselines3 `VecNormalize`, the statistics of the observations in a training."""
_ENTRIES = {"format", DIGEST, "agent", "observation_space", "action_space"}


class Policy(Protocol):
    """Protocol of a policy; Stable-Baselines3's policies and models follow it."""

    def predict(
        self, observation: np.ndarray, *, deterministic: bool = False
    ) -> tuple[np.ndarray, object]:
        """Return actions (N, ...) for observations (N, k), and a state, which callers ignore."""


def _describe_space(space: Space) -> JsonObject:
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


def _make_space(description: JsonObject) -> Space:
    if description["type"] == "Discrete":
        return spaces.Discrete(description["n"])
    dtype = np.dtype(description["dtype"]).type
    return spaces.Box(
        np.array(description["low"], dtype), np.array(description["high"], dtype), dtype=dtype
    )


def save_policy(policy: AgentPolicy, agent: AgentConfig, folder: Path) -> None:
    """Write a policy as `policy.safetensors` and `policy.json`, with digests of both.

    Args:
        policy: policy of a model that `agent` made.
        agent: settings of the agent.
        folder: folder of the files.
    """
    from safetensors.torch import save

    weights = save({name: tensor.contiguous() for name, tensor in policy.state_dict().items()})
    description = {
        "format": FORMAT,
        DIGEST: hashlib.sha256(weights).hexdigest(),
        "agent": agent.as_mapping(),
        "observation_space": _describe_space(policy.observation_space),
        "action_space": _describe_space(policy.action_space),
    }
    with atomic_write(folder / WEIGHTS) as temporary:
        temporary.write_bytes(weights)
    write_json(folder / DESCRIPTION, with_digest(description))


def load_policy(folder: Path, trust: bool = False) -> Policy:
    """Load a policy written by `save_policy`, without executing anything in the files.

    Args:
        folder: a run folder, or any folder with `policy.safetensors` and `policy.json`.
        trust: import, and thereby execute, the module of a custom agent.

    Returns:
        The policy (`predict(observations, deterministic=...)`).

    Raises:
        FileNotFoundError: the folder has no policy.
        ValueError: the files are truncated, damaged, of another format, or do not belong together.
            Policies from versions without digests are loaded without that check.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    description = read_json(folder / DESCRIPTION, "policy description")
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise ValueError(
            f"{folder / DESCRIPTION}: not a policy of codrl_mj: its format must be {FORMAT!r}"
        )
    # Without this check, a damaged key of the digest would count as a missing digest.
    if unknown_entries := description.keys() - _ENTRIES:
        raise ValueError(
            f"{folder / DESCRIPTION} has unknown entries:"
            f" {', '.join(sorted(unknown_entries))}. Copy it again"
        )
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise FileNotFoundError(f"no policy weights at {weights}")
    content = weights.read_bytes()
    check_digest(weights, content, description.get(DIGEST), DESCRIPTION)
    try:
        with allow_imports(trust):
            agent = agent_from_mapping(description["agent"])
        spaces_ = (
            _make_space(description["observation_space"]),
            _make_space(description["action_space"]),
        )
        policy = agent.make_policy(*spaces_)  # type: ignore[arg-type]
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        TypeError,
        ValueError,
        RuntimeError,
    ) as error:
        raise ValueError(f"{folder / DESCRIPTION} does not describe a policy: {error!r}") from None
    try:
        tensors = load(content)
        policy.load_state_dict(tensors)
    except SafetensorError as error:
        raise ValueError(f"{weights} is truncated or not a safetensors file: {error}") from None
    except RuntimeError as error:
        raise ValueError(f"{weights} and {DESCRIPTION} do not belong together: {error}") from None
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise ValueError(f"{weights} holds weights that are not finite numbers")
    policy.set_training_mode(False)
    return policy


class NormalizedPolicy:
    """Policy with the observation statistics of Stable-Baselines3's `VecNormalize`."""

    def __init__(self, policy: AgentPolicy, statistics: SavedNormalization) -> None:
        """Combine a policy with the `VecNormalize` of its training."""
        self.policy, self.statistics = policy, statistics
        self.observation_space, self.action_space = policy.observation_space, policy.action_space

    def predict(
        self, observation: np.ndarray, *, deterministic: bool = False
    ) -> tuple[np.ndarray, object]:
        """Return the policy's actions for raw observations."""
        return self.policy.predict(
            self.statistics.normalize_obs(observation), deterministic=deterministic
        )


def load_sb3_zip(
    path: Path, agent: str, trust: bool, normalize: Path | str | None = None
) -> Policy:
    """Load the policy of a model that Stable-Baselines3 saved as a zip.

    Args:
        path: the zip.
        agent: algorithm of the model, such as `ppo`; the zip does not name it.
        trust: required to load the files, because unpickling executes code from their author.
        normalize: file written by `VecNormalize.save` if the model was trained with it, or "none".
            None raises if the model seems to need one.

    Raises:
        FileNotFoundError: a file does not exist.
        ValueError: `trust` is False, the agent is unknown, or a file has the wrong content.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    if not trust:
        raise ValueError(
            f"{path} is a Stable-Baselines3 model: it holds pickled Python objects, and loading it"
            " executes their code. Pass --trust if you are the author, or if you trust the author"
        )
    import stable_baselines3
    from stable_baselines3.common.base_class import BaseAlgorithm

    kind: type[SavedModel] | None = getattr(stable_baselines3, agent.upper(), None)
    if not isinstance(kind, type) or not issubclass(kind, BaseAlgorithm):
        raise ValueError(
            f"agent = {agent!r}: Stable-Baselines3 has no such agent; name the agent that saved"
            f" {path}"
        )
    try:
        model = kind.load(path, device="cpu")
    # Unpickled objects can raise any exception.
    except Exception as error:
        raise ValueError(f"{path} is not a model of {agent}: {error!r}") from None
    model.policy.set_training_mode(False)
    if normalize is None:
        _check_normalization(path, model)
    policy: AgentPolicy = model.policy
    if normalize in (None, "none"):
        return policy
    return NormalizedPolicy(policy, _load_statistics(Path(str(normalize)), model.observation_space))


def _load_statistics(path: Path, space: Space) -> SavedNormalization:
    """Unpickle a `VecNormalize` for observations of a space; only for trusted files."""
    from stable_baselines3.common.vec_env import VecNormalize

    try:
        statistics = pickle.loads(path.read_bytes())
    except FileNotFoundError:
        raise FileNotFoundError(
            f"--normalize {path}: no such file; name the file that VecNormalize.save wrote, or none"
        ) from None
    # Unpickled objects can raise any exception.
    except Exception as error:
        raise ValueError(
            f"--normalize {path}: must be a file that VecNormalize.save wrote: {error!r}"
        ) from None
    if not isinstance(statistics, VecNormalize):
        kind = type(statistics).__name__
        raise ValueError(
            f"--normalize {path}: holds a {kind}: must be a file that VecNormalize.save wrote"
        )
    mean: object = (
        getattr(statistics.obs_rms, "mean", None)
        if statistics.norm_obs
        else np.zeros(space.shape or ())
    )
    if np.asarray(mean).shape != space.shape:
        raise ValueError(
            f"--normalize {path}: is for {statistics.observation_space}, but the policy observes"
            f" {space}: name the file that was saved with the policy"
        )
    return statistics


def _check_normalization(path: Path, model: SavedModel) -> None:
    """Raise if a model was probably trained with `VecNormalize`; warn if that is unknown."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    statistics_files = [*path.parent.glob("*.pkl"), *path.parent.glob("*/vecnormalize.pkl")]
    reason = ""
    last_observations = model._last_obs
    space = model.observation_space
    is_on_policy = isinstance(model, OnPolicyAlgorithm)
    # Only VecNormalize gives PPO and A2C original observations; algorithms with a replay buffer
    # always keep some.
    if is_on_policy and model._last_original_obs is not None:
        reason = "its last observations were normalized"
    elif (
        isinstance(last_observations, np.ndarray)
        and ((last_observations < space.low - 1e-4) | (last_observations > space.high + 1e-4)).any()
    ):
        reason = "its last observations are outside its observation space, as normalized ones are"
    elif statistics_files:
        reason = f"{', '.join(map(str, sorted(statistics_files)[:3]))} may have its statistics"
    remedy = "pass the file of VecNormalize.save as --normalize FILE.pkl, or --normalize none"
    if reason:
        raise ValueError(
            f"{path} was probably trained with VecNormalize and needs its statistics: {reason}:"
            f" {remedy}"
        )
    if model.num_timesteps and not (is_on_policy and last_observations is not None):
        warnings.warn(
            f"{path} does not say whether it was trained with VecNormalize: {remedy}",
            stacklevel=3,
        )


def check_spaces(policy: object, env: Env, exact: bool = True) -> None:
    """Raise if the spaces of an environment differ from those of a policy's training.

    A space that the policy does not have is not compared. If `exact` is False, a difference
    in nothing but the bounds of the actions causes a warning instead of an error.
    """
    for name in ("observation_space", "action_space"):
        trained, space = getattr(policy, name, None), getattr(env, name)
        if trained is None or _is_same(trained, space):
            continue
        text = f"{name}: the policy was trained with {trained}, but the environment has {space}"
        frames = np.prod(trained.shape or (1,)) / np.prod(space.shape or (1,))
        if name == "observation_space" and frames > 1 and frames % 1 == 0:
            text += (
                f" ({frames:g} times as many: stacked frames, as with VecFrameStack, are not"
                " supported)"
            )
        text += (
            ": repeat the settings of its training (--env.action, --env.observe-actuator,"
            " --actuator, --env.options)"
        )
        if exact or name != "action_space" or not _is_same(trained, space, bounds=False):
            raise ValueError(text)
        warnings.warn(text, stacklevel=4)


def _is_same(space: Space, other_space: Space, bounds: bool = True) -> bool:
    """Return True if two spaces have the same elements, up to rounding to float32."""
    if not (isinstance(space, spaces.Box) and isinstance(other_space, spaces.Box)):
        return bool(space == other_space)
    ends = ((space.low, other_space.low), (space.high, other_space.high)) if bounds else ()
    return space.shape == other_space.shape and all(np.allclose(*pair, rtol=1e-5) for pair in ends)
