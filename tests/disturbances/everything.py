"""Settings of all disturbances that both physics support, for tests that enable all of them."""

MOST = {
    "command_delay": 0.027,
    "command_quantum": 0.3,
    "command_rate": 25.0,
    "pulse_force": 0.7,
    "pulse_duration": 0.13,
    "pulse_interval": 0.4,
}
"""All disturbances."""
RUBBED = {"damping": 0.03, "friction": 0.02, "armature": 0.01}
"""Additions to a joint, supported by MuJoCo only."""


def imperfect(actuator):
    """Return a mapping of an actuator with sensor errors and a supply with a resistance."""
    controller = {**actuator.get("controller", {}), "current_noise": 0.05, "current_bias": -0.02}
    return {**actuator, "controller": controller, "supply": {"resistance": 0.7}}
