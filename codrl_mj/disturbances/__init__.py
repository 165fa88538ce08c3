"""What lies between the agent's command and the joint besides the actuator: pure functions, and their description."""

from codrl_mj.disturbances.description import (
    OFF,
    PLAIN,
    Disturbances,
    Joint,
    resolve_disturbances,
    resolve_joint,
)

__all__ = ["OFF", "PLAIN", "Disturbances", "Joint", "resolve_disturbances", "resolve_joint"]
