"""What snapshots of environments are made of: generators, time limits, MuJoCo's state; and whether one fits."""

import itertools
from collections.abc import Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils import seeding
from mujoco.introspect.structs import STRUCTS

from codrl_mj.physics.streams import set_generator_words

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


def time_limits(env: "gymnasium.Env[Any, Any]") -> list[Any]:
    """The time limits among an environment's wrappers, from the outermost to what has snapshots of its own."""
    limits = []
    while isinstance(env, gymnasium.Wrapper) and not hasattr(type(env), "snapshot"):
        if "_elapsed_steps" in vars(env):  # TimeLimit, or what rl-zoo3 puts in its place
            limits.append(env)
        env = env.env
    return limits


def elapsed_steps(env: "gymnasium.Env[Any, Any]") -> np.ndarray:
    """The steps that the `time_limits` have counted, int64; -1 before the first reset."""
    counted = [limit._elapsed_steps for limit in time_limits(env)]
    return np.array([-1 if steps is None else steps for steps in counted], dtype=np.int64)


def set_elapsed_steps(env: "gymnasium.Env[Any, Any]", elapsed: np.ndarray) -> None:
    """Let the `time_limits` have counted what `elapsed_steps` returned."""
    for limit, steps in zip(time_limits(env), elapsed.tolist(), strict=True):
        limit._elapsed_steps = None if steps < 0 else steps


def encode_name(name: str) -> np.ndarray:
    """What an environment is called, as an array."""
    return np.frombuffer(name.encode(), dtype=np.uint8).copy()


def generator_of(words: np.ndarray) -> np.random.Generator:
    """A generator that goes on from what `codrl_mj.physics.streams.generator_words` returned."""
    generator, _ = seeding.np_random(0)
    set_generator_words(generator, words)
    return generator


def check_snapshot(
    snapshot: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray], name: str = ""
) -> None:
    """Refuse a snapshot of other entries, shapes or types than those of the environment's own, `expected`.

    The entry of a `name`, if there is one, has the `encode_name` of what it is of.
    """
    for entry in [*expected, *(one for one in snapshot if one not in expected)]:
        found, wanted = (
            (
                f"of shape {arrays[entry].shape} and type {arrays[entry].dtype}"
                if entry in arrays
                else "missing"
            )
            for arrays in (snapshot, expected)
        )
        if found != wanted:
            raise ValueError(
                f"snapshot[{entry!r}] is {found}: must be {wanted}; it is of another task, other"
                " arguments or another number of environments"
            )
    if name and not np.array_equal(snapshot[name], expected[name]):
        whose = bytes(expected[name]).decode()
        raise ValueError(
            f"snapshot[{name!r}] is of {bytes(snapshot[name])!r}: must be of {whose!r}"
        )


_COMPUTED = tuple(
    field.name
    for field in itertools.takewhile(
        lambda field: field.name != "contact", STRUCTS["mjData"].fields
    )
    if getattr(getattr(field.type, "inner_type", None), "name", "") == "mjtNum"
)
"""The arrays of numbers in `MjData` whose sizes do not depend on contacts; in MuJoCo's order they come first."""


def state_of(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """MuJoCo's state vector (`mjSTATE_INTEGRATION`), motors included, and what was computed from it, by name.

    A step leaves poses and forces where its last integration step began, and environments take
    observations and rewards from them: the state alone would not continue bit for bit.
    """
    state = np.empty(mujoco.mj_stateSize(data.model, _STATE))
    mujoco.mj_getState(data.model, data, state, _STATE)
    return {
        "state": state,
        "computed": np.concatenate([getattr(data, name).ravel() for name in _COMPUTED]),
    }


def set_state_of(data: mujoco.MjData, state: np.ndarray, computed: np.ndarray) -> None:
    """Continue from what `state_of` returned, of the same model."""
    mujoco.mj_setState(data.model, data, state, _STATE)
    start = 0
    for name in _COMPUTED:
        view = getattr(data, name)
        view[...] = computed[start : start + view.size].reshape(view.shape)
        start += view.size
