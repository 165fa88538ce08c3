"""One step of the current loop and the winding, as a pure function.

The function is plain Python on purpose: numba compiles it into MuJoCo's callbacks and into the analytic
physics, and it also runs as it stands (the stability analysis steps it once per state).
"""

from collections.abc import Sequence

from codrl_mj.motor.noise import standard_normal
from codrl_mj.motor.parameters import (
    BACK_EMF_CONSTANT,
    BEMF_COMPENSATION,
    DERIVATIVE_TIME_CONSTANT,
    INDUCTANCE,
    INTEGRAL_LEAK,
    KD,
    KFF,
    KI,
    KP,
    MAX_VOLTAGE,
    RESISTANCE,
    SUBSTEPS,
    TORQUE_CONSTANT,
)


def advance(
    parameters: Sequence[float],
    timestep: float,
    current: float,
    integral: float,
    previous_error: float,
    desired_torque: float,
    speed: float,
) -> tuple[float, float, float, float]:
    """Advance the loop by one mechanical step, with desired torque and speed held over it.

    The paper's Algorithm 1 (function DCMotorENVStep), with its CartPole feed-forward and its appendix's
    filters, repeated `substeps` times with timestep/substeps. With both filters off, every operation is the paper's.

    The integral leaks as dI/dt = e - leak*I and the derivative is that of the error seen through
    1/(1 + Td*s); both by backward Euler, so they are stable at any step and become the paper's sum and
    difference at leak = 0 and Td = 0.

    Args:
        parameters: the parameter vector, indexed as in `codrl_mj.motor.parameters.PARAMETER_NAMES`.
        timestep: mechanical step [s].
        current: motor current i [A].
        integral: integral of the current error [A*s].
        previous_error: current error of the step before [A]; low-passed when the derivative filter is on.
        desired_torque: torque asked for at the motor shaft [N*m].
        speed: speed of the motor shaft [rad/s].

    Returns:
        current [A], integral [A*s], error [A] to be the next step's `previous_error`, terminal voltage [V].
    """
    substeps = int(parameters[SUBSTEPS])
    dt = timestep / substeps
    limit = parameters[MAX_VOLTAGE]
    voltage = 0.0
    for _ in range(substeps):
        current, integral, previous_error, voltage = electrical_step(
            parameters, dt, current, integral, previous_error, desired_torque, speed, 0.0, limit
        )
    return current, integral, previous_error, voltage


def advance_imperfect(
    parameters: Sequence[float],
    timestep: float,
    current: float,
    integral: float,
    previous_error: float,
    desired_torque: float,
    speed: float,
    current_bias: float,
    current_noise: float,
    supply_resistance: float,
    noise_key: float,
    time: float,
) -> tuple[float, float, float, float, float]:
    """What `advance` does, with a sensor that errs and a supply that sags; with all of them 0 they are the same.

    The controller reads i + current_bias + current_noise*n, with a new standard normal n for each electrical step, and
    the voltage is limited to max_voltage - supply_resistance*|i|, at least 0, by the current at the electrical step's
    start. The noise is a function of key, time and electrical step: whoever computes the step again gets it again.

    Args:
        parameters: as for `advance`, and so are the next six.
        timestep: see there.
        current: see there.
        integral: see there.
        previous_error: see there.
        desired_torque: see there.
        speed: see there.
        current_bias: offset of the current sensor [A].
        current_noise: standard deviation of its white noise [A].
        supply_resistance: resistance between supply and motor [ohm].
        noise_key: a whole number below `codrl_mj.motor.noise.LARGEST_KEY`.
        time: since the start of the episode [s], whose number of steps counts the noise.

    Returns:
        What `advance` returns, and the voltage [V] that was available to the last electrical step.
    """
    substeps = int(parameters[SUBSTEPS])
    dt = timestep / substeps
    voltage, available = 0.0, parameters[MAX_VOLTAGE]
    for substep in range(substeps):
        sensor_error = current_bias
        if current_noise > 0.0:
            sensor_error += current_noise * standard_normal(noise_key, int(time / timestep + 0.5), substep)
        if supply_resistance > 0.0:
            available = max(parameters[MAX_VOLTAGE] - supply_resistance * abs(current), 0.0)
        current, integral, previous_error, voltage = electrical_step(
            parameters, dt, current, integral, previous_error, desired_torque, speed, sensor_error, available
        )
    return current, integral, previous_error, voltage, available


def electrical_step(
    parameters: Sequence[float],
    dt: float,
    current: float,
    integral: float,
    previous_error: float,
    desired_torque: float,
    speed: float,
    sensor_error: float,
    limit: float,
) -> tuple[float, float, float, float]:
    """One sample of the controller and one step of the winding: the only place where their equations stand.

    Args:
        parameters: as for `advance`.
        dt: electrical step [s].
        current: as for `advance`, and so are the next four.
        integral: see there.
        previous_error: see there.
        desired_torque: see there.
        speed: see there.
        sensor_error: measured minus real current [A].
        limit: largest magnitude of the voltage [V].

    Returns:
        What `advance` returns.
    """
    back_emf = parameters[BACK_EMF_CONSTANT] * speed
    reference = desired_torque / parameters[TORQUE_CONSTANT]
    feed_forward = parameters[KFF] * reference + parameters[BEMF_COMPENSATION] * back_emf
    error = reference - current - sensor_error
    integral = (integral + error * dt) / (1.0 + parameters[INTEGRAL_LEAK] * dt)
    derivative = (error - previous_error) / (dt + parameters[DERIVATIVE_TIME_CONSTANT])
    previous_error = error - parameters[DERIVATIVE_TIME_CONSTANT] * derivative
    voltage = parameters[KP] * error + parameters[KI] * integral + parameters[KD] * derivative + feed_forward
    voltage = min(max(voltage, -limit), limit)
    current = current + (voltage - back_emf - parameters[RESISTANCE] * current) / parameters[INDUCTANCE] * dt
    return current, integral, previous_error, voltage
