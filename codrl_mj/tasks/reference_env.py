"""Independent reference for a task's dynamics, and the states in which to compare the two.

Most references are environments of the installed Gymnasium, unmodified and controlled through their
attributes.
"""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

# A number in a task with one motor, else a tuple or an array with a number for each motor. A
# function of one task takes either the one or the other.
Force = Any
"""Force [N] or torque [N*m] on the actuated joints."""
# Each of Gymnasium's environments has attributes of its own.
GymnasiumEnv = Any
"""Environment of Gymnasium without its wrappers."""


class ReferenceEnv(Protocol):
    """Independent implementation of a task's dynamics, driven one integration step at a time.

    The class is constructed without arguments. If it has a Gymnasium environment as `env`, the
    analytic physics reads and writes that environment's numbers. A method `derivative(state,
    force)` may return the state's time derivative, shape (n,); the certificate then compares
    it with that of the model.
    """

    def __call__(
        self, state: np.ndarray, force: Force, timestep: float, integrator: str
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

    A subclass sets `env_id` and defines `__call__`, which applies a force in the environment's
    `step`.
    """

    env_id: str

    def __init__(self) -> None:
        """Create the environment."""
        self.env = make_gymnasium_env(self.env_id)

    def state_after(
        self,
        state: np.ndarray | tuple[float, ...],
        action: int | np.ndarray,
        **attributes: object,
    ) -> np.ndarray:
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
        after: np.ndarray = self.env.state
        return after


def make_gymnasium_env(env_id: str) -> GymnasiumEnv:
    """Create a Gymnasium environment without its wrappers."""
    import gymnasium

    return gymnasium.make(env_id, disable_env_checker=True).unwrapped


class ReferenceStates(NamedTuple):
    """States in which the certificate compares a task with its reference, in the state's units."""

    bounds: tuple[float, ...]
    """Half widths of the range from which states are drawn uniformly."""
    edges: tuple[tuple[float, ...], ...]
    """Values of each state entry at and beside walls, speed limits and the wrap of angles."""
    start: tuple[float, ...]
    """Initial state of a run that reaches no wall, limit or wrap, so the equations are smooth."""
    steps: int
    """Number of environment steps of that run."""
    balanced_steps: int
    """Environment steps of that run in which energy is balanced, with short integration steps."""
    horizon: int | None = None
    """Number of environment steps over which two implementations must agree to 1e-9; None for a
    whole episode. In a chaotic task rounding errors grow as 1e-16 * exp(lambda t), and can exceed
    1e-9 within an episode.
    """


def values_around(value: float) -> tuple[float, ...]:
    """Return a bound, its neighboring floats, a number just inside it, and all of them negated."""
    numbers = (value, math.nextafter(value, math.inf), math.nextafter(value, 0.0), 0.999 * value)
    return (*numbers, *(-number for number in numbers))
