"""Simulations of a task behind one interface: in MuJoCo, or by analytic equations of motion.

Read `base`, then `mjcf` (actuators in the model), `stepping` (a compiled step) and `mujoco_single`.
Batches store many simulations as rows of arrays, which several threads step: `rows`, `sharing` and
`mujoco_batch`.
"""

from collections.abc import Callable

from codrl_mj.engine.reading import motors
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
from codrl_mj.physics.mjcf import hills, install_callbacks, needed_callbacks
from codrl_mj.physics.mujoco_single import MujocoPhysics

PHYSICS.update(mujoco=MujocoPhysics, analytic=AnalyticPhysics)


def register_physics(name: str, make: Callable[[SimulationConfig], Physics]) -> None:
    """Register a custom physics; `physics=name` then selects it in single environments.

    Args:
        name: value of `physics` that selects it.
        make: (`codrl_mj.physics.SimulationConfig`) -> `codrl_mj.physics.Physics`.

    Raises:
        ValueError: the name belongs to another physics.
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
