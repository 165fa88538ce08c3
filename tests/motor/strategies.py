"""Random actuators, over everything that may be constructed."""

from hypothesis import strategies as st

from codrl_mj.motor import Actuator, CurrentLoop, Motor


def between(low, high):
    """Finite floats from low to high."""
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def zero_or(low, high):
    """Zero (a feature that is off), or a float from low to high."""
    return st.just(0.0) | between(low, high)


motors = st.builds(
    Motor,
    resistance=between(0.05, 20),
    inductance=between(1e-3, 2),
    torque_constant=between(0.01, 5),
    back_emf_constant=zero_or(0.01, 5),
    arm_radius=between(0.01, 3),
)
controllers = st.builds(
    CurrentLoop,
    kp=zero_or(1e-3, 50),
    ki=zero_or(1e-3, 50),
    kd=zero_or(1e-6, 0.5),
    kff=zero_or(1e-3, 5),
    max_voltage=between(0.1, 100) | st.just(float("inf")),
    bemf_compensation=st.booleans(),
    substeps=st.integers(1, 5),
    integral_leak=zero_or(1e-3, 50),
    derivative_time_constant=zero_or(1e-4, 0.5),
)
actuators = st.builds(Actuator, motor=motors, controller=controllers)
