"""Trained policies as files that are safe to load: safetensors for the weights, JSON for everything else.

`load_policy` never unpickles, so a policy from elsewhere can do no more than choose bad actions. `load_sb3_zip` does,
and says so.
"""

import hashlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import trusting
from codrl_mj.agents import AgentConfig, agent_from_mapping
from codrl_mj.runs import DESCRIPTION, DIGEST, WEIGHTS
from codrl_mj.runs.files import check_digest, read_json, sealed, write_json, writing

FORMAT = "codrl_mj policy 2"
_ENTRIES = {"format", DIGEST, "agent", "observation_space", "action_space"}


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
    with writing(folder / WEIGHTS) as temporary:
        temporary.write_bytes(weights)
    write_json(folder / DESCRIPTION, sealed(description))


def load_policy(folder: Path, trust: bool = False) -> Any:
    """Load a policy that `save_policy` wrote; nothing in the files is executed.

    Args:
        folder: a run folder, or any folder with `policy.safetensors` and `policy.json`.
        trust: whether to import the module of an agent that is none of ours, which executes it.

    Returns:
        The policy (`predict(observations, deterministic=...)`).

    Raises:
        FileNotFoundError: the folder has no policy.
        ValueError: the files are truncated, damaged, of another format, or do not belong together. Policies from before
            there were digests are loaded without that proof.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    description = read_json(folder / DESCRIPTION, "policy description")
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise ValueError(f"{folder / DESCRIPTION}: not a policy of this program: its format must be {FORMAT!r}")
    if surplus := description.keys() - _ENTRIES:  # such as the digest's name, damaged
        raise ValueError(f"{folder / DESCRIPTION} has unknown entries: {', '.join(sorted(surplus))}. Copy it anew")
    weights = folder / WEIGHTS
    if not weights.is_file():
        raise FileNotFoundError(f"no policy weights at {weights}")
    content = weights.read_bytes()
    check_digest(weights, content, description.get(DIGEST), DESCRIPTION)
    try:
        with trusting(trust):
            agent = agent_from_mapping(description["agent"])
        spaces_ = _make_space(description["observation_space"]), _make_space(description["action_space"])
        policy = agent.make_policy(*spaces_)  # type: ignore[arg-type]
    except (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
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


def load_sb3_zip(path: Path, agent: str, trust: bool) -> Any:
    """The policy of a model that Stable-Baselines3 saved, of an algorithm such as `ppo`: the file does not say which.

    It is not opened without `trust` that whoever made it may execute code on this machine, which loading it allows.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    if not trust:
        raise ValueError(
            f"{path} is a Stable-Baselines3 model: it holds pickled Python objects, and loading it executes whatever "
            "its author put there. Pass --trust if that author is you, or somebody whose programs you would run"
        )
    import stable_baselines3
    from stable_baselines3.common.base_class import BaseAlgorithm

    kind: Any = getattr(stable_baselines3, agent.upper(), None)
    if not isinstance(kind, type) or not issubclass(kind, BaseAlgorithm):
        raise ValueError(f"agent = {agent!r}: Stable-Baselines3 has no such agent; name the one that made {path}")
    try:
        policy = kind.load(path, device="cpu").policy  # type: ignore[attr-defined]
    except Exception as error:  # whatever the file's objects raise
        raise ValueError(f"{path} is not a model of {agent}: {error!r}") from None
    policy.set_training_mode(False)
    return policy
