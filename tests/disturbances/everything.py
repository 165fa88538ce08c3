"""Every disturbance that both physics have, for tests that switch them all on."""

MOST = {
    "command_delay": 0.027,
    "command_quantum": 0.3,
    "command_rate": 25.0,
    "current_noise": 0.05,
    "current_bias": -0.02,
    "supply_resistance": 0.7,
    "pulse_force": 0.7,
    "pulse_duration": 0.13,
    "pulse_interval": 0.4,
}
ALL = MOST | {"joint_damping": 0.03, "joint_friction": 0.02}
