"""All of a simulation that another's environment may read: its state, and what was computed from it."""

import mujoco
import numpy as np
from mujoco.introspect.structs import STRUCTS

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


def _computed() -> tuple[str, ...]:
    """The arrays of numbers in `MjData` whose sizes do not depend on contacts; in MuJoCo's order they come first."""
    names = []
    for field in STRUCTS["mjData"].fields:
        if field.name == "contact":
            break
        if getattr(getattr(field.type, "inner_type", None), "name", "") == "mjtNum":
            names.append(field.name)
    return tuple(names)


_COMPUTED = _computed()


def state_of(data: mujoco.MjData) -> dict[str, np.ndarray]:
    """MuJoCo's state vector (`mjSTATE_INTEGRATION`), motors included, and what was computed from it, by name.

    A step leaves poses and forces where its last integration step began, and environments take observations and rewards
    from them: the state alone would not continue bit for bit.
    """
    state = np.empty(mujoco.mj_stateSize(data.model, _STATE))
    mujoco.mj_getState(data.model, data, state, _STATE)
    return {"state": state, "computed": np.concatenate([getattr(data, name).ravel() for name in _COMPUTED])}


def set_state_of(data: mujoco.MjData, state: np.ndarray, computed: np.ndarray) -> None:
    """Continue from what `state_of` returned, of the same model."""
    mujoco.mj_setState(data.model, data, state, _STATE)
    start = 0
    for name in _COMPUTED:
        view = getattr(data, name)
        view[...] = computed[start : start + view.size].reshape(view.shape)
        start += view.size
