"""Sources of numeric attributes of environments, such as `env.unwrapped.gravity`."""

import enum
from collections.abc import Callable
from typing import NamedTuple

COMPILED = (
    "it is compiled into the task's functions: use a `gymnasium.Wrapper` for other limits or ends"
)


class ModelNumber(NamedTuple):
    """Number of the MuJoCo model; a written value takes effect at once."""

    field: str
    """Field of the `mjModel`: `body_mass`, `jnt_user`; or of its options: `opt.gravity`."""
    owner: str = ""
    """Name of the body, joint or other element that the field belongs to; empty for options."""
    entry: int = 0
    """Index into the owner's numbers."""
    scale: float = 1.0
    """Ratio of the attribute to the model's number."""
    inverse: bool = False
    """True if the attribute is the reciprocal of the number."""
    varies: tuple[str, ...] = ()
    """Quantities that scale with the number, by their names in `randomize`; it must then be > 0."""
    only: tuple[str, ...] = ()
    """Fields of the model to which the scaling is limited; all if empty."""


class Fixed(NamedTuple):
    """Number or word that cannot be written."""

    value: float | str
    """The number or the word."""
    remedy: str = COMPILED
    """Instruction on what to do instead of writing the number."""


class Derived(NamedTuple):
    """Number that is a function of other attributes."""

    names: tuple[str, ...]
    """Names of the other attributes."""
    function: Callable[..., float]
    """Function (their values) -> the number."""


class Setting(enum.Enum):
    """Setting of the environment; one that is a field of the task can be written."""

    STEP = "step_duration"
    LARGEST_FORCE = "max_force"
    """A written value scales the forces of all actions."""
    FORCES = "forces"
    INTEGRATOR = "integrator"


Attribute = ModelNumber | Fixed | Derived | Setting
GRAVITY = ModelNumber("opt.gravity", entry=2, scale=-1.0)


def mass(body: str, only: tuple[str, ...] = (), inverse: bool = False) -> ModelNumber:
    """Return the attribute for a body's mass [kg]; a written mass also scales its inertia."""
    return ModelNumber(
        "body_mass", body, inverse=inverse, varies=(f"model.mass.{body}",), only=only
    )


def center_of_mass(body: str, scale: float = 1.0, only: tuple[str, ...] = ()) -> ModelNumber:
    """Return the attribute for the distance [m] of a body's center of mass from its joint.

    A written distance scales all lengths along the body.
    """
    return ModelNumber("body_ipos", body, 2, scale, varies=(f"model.length.{body}",), only=only)
