"""Hypothesis strategies for actuators, over all values that their constructors accept."""

import dataclasses

from hypothesis import strategies as st

from codrl_mj.actuators import (
    IDEAL,
    CurrentLoop,
    DCMotorActuator,
    Drive,
    GearMotor,
    Lag,
    Motor,
    PwmLoop,
    PwmServo,
    SampledLoop,
    Supply,
    TorqueSpeed,
)


def between(low, high):
    """Return a strategy for finite floats from low to high."""
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def zero_or(low, high):
    """Return a strategy for zero (a feature that is off) or a float from low to high."""
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
actuators = st.builds(DCMotorActuator, motor=motors, controller=controllers)
"""Current loops with perfect sensors and supplies."""


def _with_sensor(actuator, bias, noise):
    errors = {"current_bias": bias, "current_noise": noise}
    return dataclasses.replace(
        actuator, controller=dataclasses.replace(actuator.controller, **errors)
    )


supplies = st.none() | st.builds(
    Supply, voltage=between(0.1, 100) | st.just(float("inf")), resistance=zero_or(1e-3, 10)
)
every_actuator = st.builds(
    _with_sensor,
    st.builds(DCMotorActuator, motor=motors, controller=controllers, supply=supplies),
    between(-5, 5),
    zero_or(1e-3, 5),
)
"""Current loops with all of their options."""
gear_motors = st.builds(
    GearMotor,
    resistance=between(0.01, 20),
    inductance=between(1e-5, 1e-2),
    torque_constant=between(1e-3, 2),
    back_emf_constant=zero_or(1e-3, 2),
    rotor_inertia=zero_or(1e-8, 1e-2),
    gear_ratio=between(0.5, 200),
    gear_efficiency=between(0.1, 1.0),
    coulomb_friction=zero_or(1e-5, 0.1),
    viscous_friction=zero_or(1e-7, 1e-3),
    arm_radius=between(0.01, 3),
)
sampled_loops = st.builds(
    SampledLoop,
    sample_rate=st.sampled_from([1e3, 1e4, 2e4, 4e4]),
    bandwidth=zero_or(1.0, 150.0),
    kp=zero_or(1e-3, 0.5),
    ki=zero_or(1e-3, 50),
    anti_windup=st.sampled_from(["back_calculation", "clamping", "none"]),
    delayed=st.booleans(),
    bemf_compensation=st.booleans(),
    max_current=between(0.1, 100) | st.just(float("inf")),
)
drives = st.builds(
    Drive,
    gear_motors,
    sampled_loops,
    st.none() | st.builds(Supply, between(1, 60), zero_or(1e-3, 0.1)),
)
"""Motors in the range of commercial ones."""
pwm_servos = st.builds(
    PwmServo,
    gear_motors,
    st.builds(
        PwmLoop,
        position_gain=between(0.1, 50),
        integral_gain=zero_or(0.01, 20),
        derivative_gain=zero_or(1e-3, 0.1),
        servo_rate=st.sampled_from([100.0, 1000.0, 700.0]),
        max_duty=between(0.3, 1),
        start_duty=zero_or(1e-3, 0.2),
        encoder_counts=st.sampled_from([0.0, 4096.0]),
        command_rate=st.sampled_from([30.0, 50.0, 1000.0]),
        command_delay=zero_or(1e-3, 0.1),
        command_jitter=zero_or(1e-4, 0.01),
    ),
    st.none() | st.builds(Supply, between(1, 60), zero_or(1e-3, 0.1)),
)
"""Servos without a current loop, on a bus."""
of_every_family = st.one_of(
    every_actuator,
    drives,
    pwm_servos,
    st.just(IDEAL),
    st.builds(Lag, time_constant=zero_or(1e-3, 5), delay=zero_or(1e-3, 5)),
    st.builds(
        TorqueSpeed,
        stall_torque=between(1e-3, 50),
        no_load_speed=between(0.1, 500),
        max_torque=between(1e-3, 50),
    ),
)
"""Actuators of all built-in families."""
