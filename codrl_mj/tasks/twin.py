"""What a task is compared with by the certificate, and where: its twin, mostly a Gymnasium environment, and trials.

The environment is the installed one, unmodified, driven through its attributes.
"""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np


class ReferenceEnv(Protocol):
    """Drives an environment that is not ours by one integration step at a time. Made without arguments.

    Where it has the environment as `env`, this one's numbers can be read and written through the
    analytic physics. Where the environment has its equations of motion as a function,
    `derivative(state, force)` may return the state's time derivative, shape (n,): the certificate
    then compares with that.
    """

    def __call__(
        self, state: np.ndarray, force: Any, timestep: float, integrator: str
    ) -> np.ndarray:
        """The state one integration step later.

        Args:
            state: in the task's order, shape (n,).
            force: on the actuated joint [N or N*m]; of several motors an array.
            timestep: integration step [s].
            integrator: one of the task's.
        """


class GymnasiumReferenceEnv:
    """What drives one of Gymnasium's environments: a subclass says which, and how a force gets into its `step`."""

    env_id: str

    def __init__(self) -> None:
        """Make the environment."""
        self.env = gymnasium_env(self.env_id)

    def after(self, state: Any, action: Any, **attributes: Any) -> Any:
        """The state after one `step` from a state, with attributes set for it."""
        kept = {name: getattr(self.env, name) for name in attributes}
        try:
            for name, value in attributes.items():
                setattr(self.env, name, value)
            self.env.state = state
            self.env.step(action)
        finally:
            for name, value in kept.items():
                setattr(self.env, name, value)
        return self.env.state


def gymnasium_env(env_id: str) -> Any:
    """One of Gymnasium's environments without its wrappers."""
    import gymnasium

    return gymnasium.make(env_id, disable_env_checker=True).unwrapped


class ReferenceStates(NamedTuple):
    """What the certificate tries a task in; in the units of the task's state."""

    bounds: tuple[float, ...]
    """States are drawn uniformly within plus and minus these."""
    edges: tuple[tuple[float, ...], ...]
    """States on the walls, on the speed limits, on the cut of wrapped angles, and beside them: values of each entry."""
    start: tuple[float, ...]
    """Start of a run that stays away from bounds, walls and wrapped angles, where the task's equations are smooth."""
    steps: int
    """Environment steps of that run."""
    balanced_steps: int
    """Of these, the first ones over which energies are balanced, with integration steps many times finer."""
    horizon: int | None = None
    """Environment steps over which two implementations must agree to 1e-9; None for a whole
    episode. A chaotic task's rounding errors, 1e-16 * exp(lambda t), pass that within one.
    """


def around(value: float) -> tuple[float, ...]:
    """A bound, the numbers next to it on both sides, and one just inside; and all of them negated."""
    numbers = (value, math.nextafter(value, math.inf), math.nextafter(value, 0.0), 0.999 * value)
    return (*numbers, *(-number for number in numbers))
