"""Simulation of a task: in MuJoCo or on Gymnasium's analytic dynamics, behind one small interface."""

from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.physics.base import Physics, Signals, SimulationDivergedError, signal_names, trace_names
from codrl_mj.physics.mjcf import hills, install_callbacks, motors, needed_callbacks
from codrl_mj.physics.mujoco_single import MujocoPhysics
from codrl_mj.physics.registry import register_physics

__all__ = [
    "AnalyticPhysics",
    "MujocoPhysics",
    "Physics",
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
