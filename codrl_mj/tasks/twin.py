"""A task's twin: the Gymnasium environment that it rebuilds, unmodified, driven through its attributes."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np


class Twin(Protocol):
    """Drives an environment that is not ours by one integration step at a time. Made without arguments.

    Where it has the environment as `env`, this one's numbers can be read and written through the analytic physics.
    Where the environment has its equations of motion as a function, `derivative(state, force)` may return the state's
    time derivative, shape (n,): the certificate then compares with that.
    """

    def __call__(self, state: np.ndarray, force: Any, timestep: float, integrator: str) -> np.ndarray:
        """The state one integration step later.

        Args:
            state: in the task's order, shape (n,).
            force: on the actuated joint [N or N*m]; of several motors an array.
            timestep: integration step [s].
            integrator: one of the task's.
        """


class GymnasiumTwin:
    """What drives one of Gymnasium's environments: a subclass says which, and how a force gets into its `step`."""

    env_id: str

    def __init__(self) -> None:
        """Make the environment."""
        self.env = gymnasium_env(self.env_id)

    def after(self, state: Any, action: Any, **attributes: Any) -> Any:
        """The state after one `step` from a state, with attributes set for it."""
        kept = {name: getattr(self.env, name) for name in attributes}
        try:
            self._set(attributes)
            self.env.state = state
            self.env.step(action)
        finally:
            self._set(kept)
        return self.env.state

    def _set(self, attributes: Mapping[str, Any]) -> None:
        for name, value in attributes.items():
            setattr(self.env, name, value)


def gymnasium_env(env_id: str) -> Any:
    """One of Gymnasium's environments without its wrappers."""
    import gymnasium

    return gymnasium.make(env_id, disable_env_checker=True).unwrapped
