"""The physics that an environment can be built on, by name."""

from collections.abc import Callable
from typing import Any

from codrl_mj.own_code import look_up
from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.physics.base import Physics
from codrl_mj.physics.mujoco_single import MujocoPhysics

PHYSICS: dict[str, Callable[..., Any]] = {"mujoco": MujocoPhysics, "analytic": AnalyticPhysics}
"""Name -> (task, actuators, inner steps, integrator, max_forces=, disturbances=, joint=) -> `Physics`."""


def register_physics(name: str, make: Callable[..., Any]) -> None:
    """Make a physics of one's own known: every face but the batched one takes its name as `physics`.

    Args:
        name: what to call it.
        make: makes a simulation, a `codrl_mj.physics.Physics`; its arguments are those of
            `codrl_mj.physics.MujocoPhysics`.

    Raises:
        ValueError: the name is taken by another.
    """
    if PHYSICS.setdefault(name, make) is not make:
        raise ValueError(f"physics {name!r} is registered already, as {PHYSICS[name]!r}: choose another name")


def find_physics(name: str) -> Callable[..., Physics]:
    """The physics called `name`."""
    return look_up(name, PHYSICS, "physics", anybodys=False)
