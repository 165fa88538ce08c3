"""One step of the current loop and the winding, as a pure function.

The function is plain Python on purpose: numba compiles it into MuJoCo's callbacks and into the analytic
physics, and it also runs as it stands (the stability analysis steps it once per state).
"""

from collections.abc import Sequence

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
    back_emf = parameters[BACK_EMF_CONSTANT] * speed
    reference = desired_torque / parameters[TORQUE_CONSTANT]
    feed_forward = parameters[KFF] * reference + parameters[BEMF_COMPENSATION] * back_emf
    voltage = 0.0
    for _ in range(substeps):
        error = reference - current
        integral = (integral + error * dt) / (1.0 + parameters[INTEGRAL_LEAK] * dt)
        derivative = (error - previous_error) / (dt + parameters[DERIVATIVE_TIME_CONSTANT])
        previous_error = error - parameters[DERIVATIVE_TIME_CONSTANT] * derivative
        voltage = parameters[KP] * error + parameters[KI] * integral + parameters[KD] * derivative + feed_forward
        voltage = min(max(voltage, -limit), limit)
        current = current + (voltage - back_emf - parameters[RESISTANCE] * current) / parameters[INDUCTANCE] * dt
    return current, integral, previous_error, voltage
