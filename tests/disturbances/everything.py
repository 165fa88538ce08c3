"""Every imperfection that both physics have, for tests that switch them all on."""

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
"""What is added to a joint, by MuJoCo only."""


def imperfect(actuator):
    """A mapping of an actuator with a sensor that errs and a supply that sags."""
    controller = {**actuator.get("controller", {}), "current_noise": 0.05, "current_bias": -0.02}
    return {**actuator, "controller": controller, "supply": {"resistance": 0.7}}
