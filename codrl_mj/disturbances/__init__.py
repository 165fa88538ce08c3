"""What lies between a command and the joint besides the motor: delay, coarse commands, bad sensors, loads, friction."""

from codrl_mj.disturbances.description import OFF, Disturbances, resolve_disturbances

__all__ = ["OFF", "Disturbances", "resolve_disturbances"]
