"""Trained policies as files that are safe to load: safetensors for the weights, JSON for everything else.

`load_policy` never unpickles, so a policy from elsewhere can do no more than choose bad actions.
`load_sb3_zip` does, and says so.
"""

import contextlib
import hashlib
import pickle
import warnings
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import trusting
from codrl_mj.agents import AgentConfig, agent_from_mapping
from codrl_mj.envs.config import EnvConfig
from codrl_mj.runs import DESCRIPTION, DIGEST, WEIGHTS
from codrl_mj.runs.files import check_digest, read_json, with_digest, write_json, atomic_write

FORMAT = "codrl_mj policy 2"
_ENTRIES = {"format", DIGEST, "agent", "observation_space", "action_space"}


class Policy(Protocol):
    """Anything that chooses actions; Stable-Baselines3's policies and models are such."""

    def predict(
        self, observation: np.ndarray, *, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
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
    return spaces.Box(
        np.array(described["low"], dtype), np.array(described["high"], dtype), dtype=dtype
    )


def save_policy(policy: Any, agent: AgentConfig, folder: Path) -> None:
    """Write the policy of a model that `agent` made: `policy.safetensors` and `policy.json`, with digests of both."""
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


def load_policy(folder: Path, trust: bool = False) -> Any:
    """Load a policy that `save_policy` wrote; nothing in the files is executed.

    Args:
        folder: a run folder, or any folder with `policy.safetensors` and `policy.json`.
        trust: whether to import the module of an agent that is none of ours, which executes it.

    Returns:
        The policy (`predict(observations, deterministic=...)`).

    Raises:
        FileNotFoundError: the folder has no policy.
        ValueError: the files are truncated, damaged, of another format, or do not belong together.
            Policies from before there were digests are loaded without that proof.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    description = read_json(folder / DESCRIPTION, "policy description")
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise ValueError(
            f"{folder / DESCRIPTION}: not a policy of this program: its format must be {FORMAT!r}"
        )
    if surplus := description.keys() - _ENTRIES:  # such as the digest's name, damaged
        raise ValueError(
            f"{folder / DESCRIPTION} has unknown entries: {', '.join(sorted(surplus))}. Copy it"
            " anew"
        )
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise FileNotFoundError(f"no policy weights at {weights}")
    content = weights.read_bytes()
    check_digest(weights, content, description.get(DIGEST), DESCRIPTION)
    try:
        with trusting(trust):
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
    """A policy behind the observation statistics of Stable-Baselines3's `VecNormalize`."""

    def __init__(self, policy: Any, statistics: Any) -> None:
        """Combine a policy with the `VecNormalize` through which it was trained."""
        self.policy, self.statistics = policy, statistics
        self.observation_space, self.action_space = policy.observation_space, policy.action_space

    def predict(
        self, observation: np.ndarray, *, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Return the policy's actions for raw observations."""
        return self.policy.predict(
            self.statistics.normalize_obs(observation), deterministic=deterministic
        )


def load_sb3_zip(path: Path, agent: str, trust: bool, normalize: Path | str | None = None) -> Any:
    """Load the policy of a model that Stable-Baselines3 saved, by an algorithm, such as `ppo`, that it does not name.

    Neither file is opened without `trust` that whoever made it may execute code on this machine,
    which loading allows. `normalize` is the file that `VecNormalize.save` wrote, if the model was
    trained behind it, else `"none"`. None refuses a zip that seems to have been.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    if not trust:
        raise ValueError(
            f"{path} is a Stable-Baselines3 model: it holds pickled Python objects, and loading it"
            " executes whatever its author put there. Pass --trust if that author is you, or"
            " somebody whose programs you would run"
        )
    import stable_baselines3
    from stable_baselines3.common.base_class import BaseAlgorithm

    kind: Any = getattr(stable_baselines3, agent.upper(), None)
    if not isinstance(kind, type) or not issubclass(kind, BaseAlgorithm):
        raise ValueError(
            f"agent = {agent!r}: Stable-Baselines3 has no such agent; name the one that made {path}"
        )
    try:
        model = kind.load(path, device="cpu")  # type: ignore[attr-defined]
    except Exception as error:  # whatever the file's objects raise
        raise ValueError(f"{path} is not a model of {agent}: {error!r}") from None
    model.policy.set_training_mode(False)
    if normalize is None:
        _check_whole(path, model)
    if normalize in (None, "none"):
        return model.policy
    return NormalizedPolicy(
        model.policy, _load_statistics(Path(str(normalize)), model.observation_space)
    )


def _load_statistics(path: Path, space: spaces.Space[Any]) -> Any:
    """Unpickle a `VecNormalize` for observations of a space; only for a caller that trusts the file."""
    from stable_baselines3.common.vec_env import VecNormalize

    try:
        statistics = pickle.loads(path.read_bytes())
    except FileNotFoundError:
        raise FileNotFoundError(
            f"--normalize {path}: no such file; name what VecNormalize.save wrote, or none"
        ) from None
    except Exception as error:  # whatever the file's objects raise
        raise ValueError(
            f"--normalize {path}: must be a file that VecNormalize.save wrote: {error!r}"
        ) from None
    if not isinstance(statistics, VecNormalize):
        kind = type(statistics).__name__
        raise ValueError(
            f"--normalize {path}: holds a {kind}: must be a file that VecNormalize.save wrote"
        )
    mean: Any = (
        getattr(statistics.obs_rms, "mean", None)
        if statistics.norm_obs
        else np.zeros(space.shape or ())
    )
    if np.shape(mean) != space.shape:
        raise ValueError(
            f"--normalize {path}: is for {statistics.observation_space}, the policy observes"
            f" {space}: name the file that was saved with the policy"
        )
    return statistics


def _check_whole(path: Path, model: Any) -> None:
    """Refuse a model that seems to have been trained behind `VecNormalize`, and warn where nothing can be told."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    beside, reason = [*path.parent.glob("*.pkl"), *path.parent.glob("*/vecnormalize.pkl")], ""
    seen, space, is_on_policy = (
        model._last_obs,
        model.observation_space,
        isinstance(model, OnPolicyAlgorithm),
    )
    # Only VecNormalize gives PPO and A2C original observations; algorithms with a replay buffer
    # always keep some.
    if is_on_policy and model._last_original_obs is not None:
        reason = "its last observations were normalized"
    elif (
        isinstance(seen, np.ndarray)
        and ((seen < space.low - 1e-4) | (seen > space.high + 1e-4)).any()
    ):
        reason = "its last observations lie outside of its observation space, as normalized ones do"
    elif beside:
        reason = f"{', '.join(map(str, sorted(beside)[:3]))} may have its statistics"
    remedy = "name what VecNormalize.save wrote with --normalize FILE.pkl, or say --normalize none"
    if reason:
        raise ValueError(
            f"{path} may be half of a policy that was trained behind VecNormalize: {reason}:"
            f" {remedy}"
        )
    if model.num_timesteps and not (is_on_policy and seen is not None):
        warnings.warn(
            f"{path} does not say whether it was trained behind VecNormalize: if so, {remedy}",
            stacklevel=3,
        )


def check_spaces(policy: Any, env: EnvConfig, exact: bool = True) -> None:
    """Refuse an environment with other observations or actions than those of a policy's training, if it tells them.

    Unless `exact`, actions that differ in their bounds alone are warned of.
    """
    with contextlib.closing(env.make()) as made:
        present = {name: getattr(made, name) for name in ("observation_space", "action_space")}
    for name, space in present.items():
        if (trained := getattr(policy, name, None)) is None or _is_same(trained, space):
            continue
        text = f"{name}: the policy was trained with {trained}, {env.task} as it is set has {space}"
        frames = np.prod(trained.shape or (1,)) / np.prod(space.shape or (1,))
        if name == "observation_space" and frames > 1 and frames % 1 == 0:
            text += (
                f" ({frames:g} times as many: stacked frames, as of VecFrameStack, are not"
                " supported)"
            )
        text += (
            ": set what it was trained with, by --env.action, --env.observe-actuator, --actuator,"
            " --env.options"
        )
        if exact or name != "action_space" or not _is_same(trained, space, bounds=False):
            raise ValueError(text)
        warnings.warn(text, stacklevel=2)


def _is_same(one: Any, other: Any, bounds: bool = True) -> bool:
    """Return whether two spaces have the same elements, but for rounding to float32."""
    if not (isinstance(one, spaces.Box) and isinstance(other, spaces.Box)):
        return bool(one == other)
    ends = ((one.low, other.low), (one.high, other.high)) if bounds else ()
    return one.shape == other.shape and all(np.allclose(*pair, rtol=1e-5) for pair in ends)
