"""Reference of a task for the certificate: an environment to compare with, and states to try.

The environment is mostly one of the installed Gymnasium, unmodified and driven through its
attributes.
"""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np


class ReferenceEnv(Protocol):
    """Independent implementation of a task's dynamics, driven one integration step at a time.

    The class is constructed without arguments. If it has a Gymnasium environment as `env`, the
    analytic physics reads and writes that environment's numbers. A method `derivative(state,
    force)` may return the state's time derivative, shape (n,), with which the certificate then
    compares the model's.
    """

    def __call__(
        self, state: np.ndarray, force: Any, timestep: float, integrator: str
    ) -> np.ndarray:
        """Return the state one integration step later.

        Args:
            state: the state in the task's order, shape (n,).
            force: force on the actuated joint [N or N*m]; an array if there are several motors.
            timestep: integration step [s].
            integrator: a name of `Task.integrators`.
        """


class GymnasiumReferenceEnv:
    """Base of references that are Gymnasium environments.

    A subclass sets `env_id`, and defines how a force gets into the environment's `step`.
    """

    env_id: str

    def __init__(self) -> None:
        """Create the environment."""
        self.env = make_gymnasium_env(self.env_id)

    def after(self, state: Any, action: Any, **attributes: Any) -> Any:
        """Return the state after one `step` from a state, with attributes set during the step."""
        previous = {name: getattr(self.env, name) for name in attributes}
        try:
            for name, value in attributes.items():
                setattr(self.env, name, value)
            self.env.state = state
            self.env.step(action)
        finally:
            for name, value in previous.items():
                setattr(self.env, name, value)
        return self.env.state


def make_gymnasium_env(env_id: str) -> Any:
    """Create a Gymnasium environment without its wrappers."""
    import gymnasium

    return gymnasium.make(env_id, disable_env_checker=True).unwrapped


class ReferenceStates(NamedTuple):
    """States in which the certificate tries a task, in the units of the task's state."""

    bounds: tuple[float, ...]
    """Half widths of the range from which states are drawn uniformly."""
    edges: tuple[tuple[float, ...], ...]
    """Values of each state entry on and beside walls, speed limits and the cut of angles."""
    start: tuple[float, ...]
    """Start of a run without bounds, walls and wrapped angles, so that the equations are smooth."""
    steps: int
    """Environment steps of that run."""
    balanced_steps: int
    """Number of its first steps over which the energy balance is checked, with much finer steps."""
    horizon: int | None = None
    """Environment steps over which two implementations must agree to 1e-9; None for a whole
    episode. Rounding errors of a chaotic task, 1e-16 * exp(lambda t), exceed 1e-9 within an
    episode.
    """


def values_around(value: float) -> tuple[float, ...]:
    """Return a bound, its neighboring floats, a number just inside it, and all of them negated."""
    numbers = (value, math.nextafter(value, math.inf), math.nextafter(value, 0.0), 0.999 * value)
    return (*numbers, *(-number for number in numbers))
