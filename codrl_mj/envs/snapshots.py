"""Parts of environments' snapshots (generators, time limits, MuJoCo's state), and their checks."""

import itertools
from collections.abc import Mapping
from typing import Protocol, cast

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils import seeding
from mujoco.introspect.structs import STRUCTS

from codrl_mj.envs.config import Env
from codrl_mj.physics.streams import set_generator_words

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class TimeLimitWrapper(Protocol):
    """Gymnasium's `TimeLimit`, or the class that rl-zoo3 replaces it by."""

    _elapsed_steps: int | None


def time_limits(env: Env) -> list[TimeLimitWrapper]:
    """Return the time-limit wrappers, outermost first, up to a wrapper with its own snapshots."""
    limits: list[TimeLimitWrapper] = []
    while isinstance(env, gymnasium.Wrapper) and not hasattr(type(env), "snapshot"):
        # The attribute identifies Gymnasium's TimeLimit and the class that rl-zoo3 replaces it by.
        if "_elapsed_steps" in vars(env):
            limits.append(cast(TimeLimitWrapper, env))
        env = env.env
    return limits


def elapsed_steps(env: Env) -> np.ndarray:
    """Return the steps that the `time_limits` have counted, int64; -1 before the first reset."""
    counted = [limit._elapsed_steps for limit in time_limits(env)]
    return np.array([-1 if steps is None else steps for steps in counted], dtype=np.int64)


def set_elapsed_steps(env: Env, elapsed: np.ndarray) -> None:
    """Write the steps that `elapsed_steps` returned into the `time_limits`."""
    for limit, steps in zip(time_limits(env), elapsed.tolist(), strict=True):
        limit._elapsed_steps = None if steps < 0 else steps


def encode_name(name: str) -> np.ndarray:
    """Return an environment's name as an array of bytes."""
    return np.frombuffer(name.encode(), dtype=np.uint8).copy()


def generator_from_words(words: np.ndarray) -> np.random.Generator:
    """Create a generator with the state that `generator_words` of `physics.streams` returned."""
    generator, _ = seeding.np_random(0)
    set_generator_words(generator, words)
    return generator


def check_snapshot(
    snapshot: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray], name: str = ""
) -> None:
    """Raise if a snapshot's entries, shapes or types differ from those of an expected snapshot.

    If `name` is not empty, the entry of that name, which `encode_name` wrote, must be equal.
    """
    for entry in [*expected, *(key for key in snapshot if key not in expected)]:
        present, required = (
            (
                f"of shape {arrays[entry].shape} and type {arrays[entry].dtype}"
                if entry in arrays
                else "missing"
            )
            for arrays in (snapshot, expected)
        )
        if present != required:
            raise ValueError(
                f"snapshot[{entry!r}] is {present}: must be {required}; it is of another task,"
                " other arguments or another number of environments"
            )
    if name and not np.array_equal(snapshot[name], expected[name]):
        expected_name = bytes(expected[name]).decode()
        raise ValueError(
            f"snapshot[{name!r}] is of {bytes(snapshot[name])!r}: must be of {expected_name!r}"
        )


_COMPUTED = tuple(
    field.name
    for field in itertools.takewhile(
        lambda field: field.name != "contact", STRUCTS["mjData"].fields
    )
    if getattr(getattr(field.type, "inner_type", None), "name", "") == "mjtNum"
)
"""Arrays of numbers in `MjData` whose sizes do not depend on contacts: MuJoCo lists them first."""


def state_of(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """Return MuJoCo's state vector (`mjSTATE_INTEGRATION`) and the arrays computed from it.

    After a step, poses and forces are those at the beginning of its last integration step.
    Environments compute observations and rewards from them, so the state alone could not continue
    bit for bit.
    """
    state = np.empty(mujoco.mj_stateSize(data.model, _STATE))
    mujoco.mj_getState(data.model, data, state, _STATE)
    return {
        "state": state,
        "computed": np.concatenate([getattr(data, name).ravel() for name in _COMPUTED]),
    }


def set_state_of(data: mujoco.MjData, state: np.ndarray, computed: np.ndarray) -> None:
    """Restore the arrays of `state_of` in a simulation of the same model."""
    mujoco.mj_setState(data.model, data, state, _STATE)
    start = 0
    for name in _COMPUTED:
        view = getattr(data, name)
        view[...] = computed[start : start + view.size].reshape(view.shape)
        start += view.size
