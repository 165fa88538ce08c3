"""A task's twin: the Gymnasium environment that it rebuilds, unmodified, driven through its attributes."""

from typing import Any, Protocol

import numpy as np


class Twin(Protocol):
    """Drives an environment that is not ours by one integration step at a time. Made without arguments."""

    def __call__(self, state: np.ndarray, force: Any, timestep: float, integrator: str) -> np.ndarray:
        """The state one integration step later.

        Args:
            state: in the task's order, shape (n,).
            force: on the actuated joint [N or N*m]; of several motors an array.
            timestep: integration step [s].
            integrator: one of the task's.
        """


def gymnasium_env(env_id: str) -> Any:
    """One of Gymnasium's environments without its wrappers."""
    import gymnasium

    return gymnasium.make(env_id, disable_env_checker=True).unwrapped
