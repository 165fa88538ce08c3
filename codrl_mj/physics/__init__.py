"""Simulation of a task: in MuJoCo or on Gymnasium's analytic dynamics, behind one small interface, by name.

Read `base`, then `mjcf` (actuators into the model), `stepping` (a step, compiled), `mujoco_single`;
many simulations are rows in threads' hands: `rows`, `sharing`, `mujoco_batch`.
"""

from collections.abc import Callable

from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.physics.base import (
    PHYSICS,
    Physics,
    Signals,
    SimulationConfig,
    SimulationDivergedError,
    signal_names,
    trace_names,
)
from codrl_mj.physics.mjcf import hills, install_callbacks, motors, needed_callbacks
from codrl_mj.physics.mujoco_single import MujocoPhysics

PHYSICS.update(mujoco=MujocoPhysics, analytic=AnalyticPhysics)


def register_physics(name: str, make: Callable[[SimulationConfig], Physics]) -> None:
    """Make a physics of one's own known: every face but the batched one takes its name as `physics`.

    Args:
        name: what to call it.
        make: (`codrl_mj.physics.SimulationConfig`) -> a simulation of it, a `codrl_mj.physics.Physics`.

    Raises:
        ValueError: the name is taken by another.
    """
    if PHYSICS.setdefault(name, make) is not make:
        raise ValueError(
            f"physics {name!r} is registered already, as {PHYSICS[name]!r}: choose another name"
        )


__all__ = [
    "PHYSICS",
    "AnalyticPhysics",
    "MujocoPhysics",
    "Physics",
    "SimulationConfig",
    "Signals",
    "SimulationDivergedError",
    "hills",
    "install_callbacks",
    "motors",
    "needed_callbacks",
    "register_physics",
    "signal_names",
    "trace_names",
]
