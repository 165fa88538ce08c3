"""Simulation of a task: in MuJoCo or on Gymnasium's analytic dynamics, behind one small interface."""

from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.physics.base import Physics, Signals, SimulationDivergedError
from codrl_mj.physics.mjcf import hills, install_callbacks, motors, needed_callbacks, set_actuator
from codrl_mj.physics.mujoco_single import MujocoPhysics

PHYSICS = ("mujoco", "analytic")
"""The physics that an environment can be built on."""

__all__ = [
    "PHYSICS",
    "AnalyticPhysics",
    "MujocoPhysics",
    "Physics",
    "Signals",
    "SimulationDivergedError",
    "hills",
    "install_callbacks",
    "motors",
    "needed_callbacks",
    "set_actuator",
]
