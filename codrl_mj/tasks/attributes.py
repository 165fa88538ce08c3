"""Where the numbers live that a task's environments have as attributes, as Gymnasium's do: `env.unwrapped.gravity`."""

import enum
from collections.abc import Callable
from typing import Any, NamedTuple

COMPILED = (
    "it is compiled into the task's functions: limit or end episodes in a `gymnasium.Wrapper`"
)


class ModelNumber(NamedTuple):
    """A number of the MuJoCo model; it can be written, and takes effect at once."""

    field: str
    """Field of the `mjModel`: `body_mass`, `jnt_user`; or of its options: `opt.gravity`."""
    owner: str = ""
    """Name of the body, joint or whatever the field belongs to; empty for options."""
    entry: int = 0
    """Which of the owner's numbers."""
    scale: float = 1.0
    """The attribute for a 1 in the model."""
    inverse: bool = False
    """Whether the attribute is the number's inverse."""
    varies: tuple[str, ...] = ()
    """What is multiplied as the number is, as `randomize` names it; then the number must be > 0."""
    only: tuple[str, ...] = ()
    """The fields of the model to which that is limited; all if empty."""


class Fixed(NamedTuple):
    """A number that cannot be written."""

    value: Any
    """What it is."""
    remedy: str = COMPILED
    """What to do instead of writing it."""


class Follows(NamedTuple):
    """A number that follows from others."""

    names: tuple[str, ...]
    """Names of these attributes."""
    of: Callable[..., float]
    """(their values) -> its value."""


class Setting(enum.Enum):
    """What the environment was made with; what a field of the task says can be written."""

    STEP = "step_duration"
    LARGEST_FORCE = "max_force"
    """Written, it scales the forces of all actions."""
    FORCES = "forces"
    INTEGRATOR = "integrator"


Attribute = ModelNumber | Fixed | Follows | Setting
GRAVITY = ModelNumber("opt.gravity", entry=2, scale=-1.0)


def mass(body: str, only: tuple[str, ...] = (), inverse: bool = False) -> ModelNumber:
    """A body's mass [kg], and its inertia with it."""
    return ModelNumber(
        "body_mass", body, inverse=inverse, varies=(f"model.mass.{body}",), only=only
    )


def centre(body: str, scale: float = 1.0, only: tuple[str, ...] = ()) -> ModelNumber:
    """How far a body's centre of mass is from its joint [m], and all lengths along the body with it."""
    return ModelNumber("body_ipos", body, 2, scale, varies=(f"model.length.{body}",), only=only)
