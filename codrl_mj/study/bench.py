"""Bench test of an actuator: one hinge in MuJoCo measures delay, gain and noise as severities."""

import dataclasses
from typing import NamedTuple, Protocol

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Drive, GearMotor, SampledLoop, Supply
from codrl_mj.engine.specs import add_motors
from codrl_mj.study.axes import REFERENCE_SPEEDS, noise, timestep
from codrl_mj.study.grid import check_selection
from codrl_mj.tasks import find_task

BLOCKED_INERTIA = 1e12
"""Inertia [kg*m^2] so large that the hinge stays at its speed."""
HORIZON_STEPS = 20.0
"""Duration of a bench measurement in policy steps; later forces are ignored."""


class RunBench(Protocol):
    """Function that runs the bench of `make_bench`."""

    def __call__(self, torque: float, duration: float, speed: float = 0.0) -> np.ndarray:
        """Command a torque [N*m] for a `duration` [s], starting at a speed of the joint [rad/s]."""


def make_bench(actuator: ActuatorModel, timestep: float, inertia: float) -> RunBench:
    """Build a hinge with an actuator and return a function that runs it.

    Args:
        actuator: actuator that drives the hinge.
        timestep: integration step [s].
        inertia: inertia of the load [kg*m^2].
    """
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.compiler.boundmass = timestep, 0.0
    # The solver's tolerance is relative to the inertia: with a huge inertia the solver would stop
    # before it has resolved the friction.
    spec.option.tolerance = 0.0
    body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[inertia] * 3)
    body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    model = add_motors(spec, {"hinge": actuator}).compile()
    data, total_inertia = mujoco.MjData(model), inertia + actuator.additions.armature

    def run(torque: float, duration: float, speed: float = 0.0) -> np.ndarray:
        """Command a torque [N*m] for a `duration` [s], starting at a speed of the joint [rad/s].

        Returns:
            Shape (steps, 3): the actuator's torque [N*m], the torque that accelerates the hinge
            [N*m], and the hinge's speed [rad/s] after the step.
        """
        mujoco.mj_resetData(model, data)
        data.ctrl[:], data.qvel[:] = torque, speed
        rows = np.empty((max(round(duration / timestep), 1), 3))
        for row in rows:
            mujoco.mj_step(model, data)
            row[:] = data.qfrc_actuator[0], data.qacc[0] * total_inertia, data.qvel[0]
        return rows

    return run


class ActuatorResponse(NamedTuple):
    """Response of an actuator to a step of the command, measured for `HORIZON_STEPS`.

    Times are in policy steps, forces in shares of the task's largest force. Final values are those
    at the end of the measurement: a loop that rises fast and then creeps on counts as fast and
    weak, because a policy changes its command long before the loop settles.
    """

    dead_time: float
    """Time until a thousandth of the final force is delivered [steps]."""
    lag: float
    """Average residence time minus the dead time [steps]: the time constant of an equivalent
    first-order lag. Ringing counts as lag. Source: Astrom, Hagglund, *PID Controllers*, 2nd ed.,
    section 2.4 (area methods).
    """
    least_lag: float
    """The same, but force beyond the final one makes up for late force [steps]; >= 0. A loop that
    overshoots has an effect between the two lags.
    """
    at_rest: float
    """Final force at standstill (blocked joint) [largest force]."""
    at_speed: float
    """Final force at the reference speed [largest force]."""
    friction: float
    """Braking force at zero command [largest force]: the total braking force at a twentieth of
    the reference speed or, if larger, the mechanical losses alone (without the effect of the
    back-EMF) at the reference speed.
    """
    noise: float
    """Standard deviation of the force [largest force] over the integration steps."""
    unasked: float
    """Magnitude of the mean force at standstill and zero command [largest force]."""


def measure_response(
    actuator: ActuatorModel, timestep: float, step: float, force: float, speed: float
) -> ActuatorResponse:
    """Measure the response of an actuator to a command.

    Args:
        actuator: actuator to measure.
        timestep: integration step [s].
        step: policy step [s].
        force: largest command [N*m; N on a slide].
        speed: reference speed [rad/s; m/s].
    """
    duration = HORIZON_STEPS * step
    blocked = make_bench(actuator, timestep, BLOCKED_INERTIA)
    # Every run draws the same noise, so that subtracting the run at zero command removes it.
    unasked = blocked(0.0, duration)[:, 0]

    def delivered_torque(joint_speed: float) -> np.ndarray:
        torques: np.ndarray = blocked(force, duration, joint_speed)[:, 0] - unasked
        return torques / force

    # The inertia is so large that friction hardly slows the hinge within the measurement.
    def braking(joint_speed: float) -> tuple[float, float]:
        rows = _end(
            make_bench(actuator, timestep, 1e4 * force * duration / joint_speed)(
                0.0, duration, joint_speed
            )
        )
        motor_torque, net_torque, _ = np.mean(rows, axis=0)
        return (
            float(np.mean(_end(unasked)) - net_torque) / force,
            float(motor_torque - net_torque) / force,
        )

    # The area between the step response and its final value is the average residence time.
    torques = delivered_torque(0.0)
    last = float(np.mean(_end(torques)))
    started = np.flatnonzero(np.abs(torques) > 1e-3 * abs(last))
    dead = int(started[0]) if len(started) else 0
    missing = 1.0 - torques / last if last else np.zeros(1)
    lag, least_lag = (max(float(np.sum(part)) - dead, 0.0) for part in (np.abs(missing), missing))
    settled = unasked[len(unasked) // 2 :] / force
    return ActuatorResponse(
        dead_time=dead * timestep / step,
        lag=lag * timestep / step,
        least_lag=least_lag * timestep / step,
        at_rest=last,
        at_speed=float(np.mean(_end(delivered_torque(speed)))),
        friction=max(braking(0.05 * speed)[0], braking(speed)[1], 0.0),
        noise=float(np.std(settled)),
        unasked=abs(float(np.mean(settled))),
    )


def _end(rows: np.ndarray) -> np.ndarray:
    """Return the rows of the last policy step."""
    return rows[-max(round(len(rows) / HORIZON_STEPS), 1) :]


# -- on a task of the study ------------------------------------------------------------------------


def measure_on_task(actuator: ActuatorModel, task: str, share: float = 1.0) -> ActuatorResponse:
    """Measure the response of an actuator to a `share` of the largest force of a task."""
    check_selection("task", [task], REFERENCE_SPEEDS)
    if actuator.MOTION:
        raise ValueError(
            f"actuator: a {actuator.family} is commanded a motion, not a force: name an"
            " actuator of another family"
        )
    definition = find_task(task)
    return measure_response(
        actuator,
        timestep(task),
        definition.step_duration,
        share * definition.max_force,
        REFERENCE_SPEEDS[task],
    )


def severities(response: ActuatorResponse, task: str) -> dict[str, float]:
    """Return the severity on each axis that corresponds to a measured response.

    With a gain g (weakness 1 - g) and a supply that lacks a share d of the needed voltage, the
    force is g*min(1, 2*(1 - d)) at standstill and g*(1 - 2*d) at the reference speed
    (`axes.supply`), in shares of the largest force. Both equations are solved for g <= 1 and d.
    """
    rest, speed = max(response.at_rest, 0.0), min(response.at_speed, response.at_rest)
    strength = rest if speed >= 0.0 else rest - speed
    if rest == 0.0:
        missing = 1.0
    elif speed >= 0.0:
        missing = (1.0 - speed / rest) / 2.0
    else:
        missing = 1.0 - rest / (2.0 * strength)
    noise_severity = (
        response.noise
        and response.noise / measure_on_task(noise(task, 1.0).actuators[0], task).noise
    )
    return {
        "lag": response.lag,
        "weakness": max(1.0 - strength, 0.0),
        "supply": missing,
        "delay": response.dead_time,
        "friction": response.friction,
        "noise": noise_severity,
    }


def measure_with_larger_command(
    actuator: ActuatorModel, task: str, response: ActuatorResponse
) -> ActuatorResponse | None:
    """Return the response to commands that are scaled up to compensate for the force lost at rest.

    The result is None if at most 2 % or at least 90 % of the force is lost, and if the loop can be
    redesigned: its force is then late rather than lost.
    """
    if not 0.1 < response.at_rest < 0.98 or redesign_loop(actuator, task) is not None:
        return None
    factor = 1.0 / response.at_rest
    boosted = measure_on_task(actuator, task, factor)
    shares = {name: min(getattr(boosted, name) * factor, 1.0) for name in ("at_rest", "at_speed")}
    scaled = {name: getattr(boosted, name) * factor for name in ("friction", "noise", "unasked")}
    return boosted._replace(**shares, **scaled)


def redesign_loop(actuator: ActuatorModel, task: str) -> Drive | None:
    """Return the motor and supply with a designed loop; None if a new design would not help."""
    if isinstance(actuator, DCMotorActuator):
        # No loop can correct an error of its current sensor.
        sensor_error = actuator.controller.current_noise or actuator.controller.current_bias
        return None if sensor_error else drive_with_designed_loop(actuator, task)
    if isinstance(actuator, Drive):
        loop = dataclasses.replace(
            actuator.controller, bandwidth=0.0, kp=0.0, ki=0.0, anti_windup="back_calculation"
        )
        return (
            None if loop == actuator.controller else dataclasses.replace(actuator, controller=loop)
        )
    return None


def has_wind_up(actuator: ActuatorModel) -> bool:
    """Return True if the integrator of a current loop continues while the voltage saturates."""
    if isinstance(actuator, Drive):
        loop = actuator.controller
        # Without own gains, the loop is designed, with an integrator.
        return loop.anti_windup == "none" and (loop.ki > 0.0 or loop.kp == 0.0)
    return isinstance(actuator, DCMotorActuator) and actuator.controller.ki > 0.0


def fix_sensor(actuator: ActuatorModel) -> DCMotorActuator | None:
    """Return the motor and loop with an exact current sensor; None if it is exact already."""
    if not isinstance(actuator, DCMotorActuator):
        return None
    exact = dataclasses.replace(actuator.controller, current_noise=0.0, current_bias=0.0)
    fixed = dataclasses.replace(actuator, controller=exact)
    return None if fixed == actuator else fixed


def drive_with_designed_loop(actuator: DCMotorActuator, task: str) -> Drive:
    """Return a `Drive` with the same motor and supply, a designed loop and a current limit."""
    motor, voltage = actuator.motor, actuator.controller.max_voltage
    if actuator.supply is not None:
        voltage = min(voltage, actuator.supply.voltage)
    limit = motor.arm_radius * find_task(task).max_force / motor.torque_constant
    return Drive(
        GearMotor(
            motor.resistance,
            motor.inductance,
            motor.torque_constant,
            motor.back_emf_constant,
            rotor_inertia=0.0,
            arm_radius=motor.arm_radius,
        ),
        SampledLoop(sample_rate=20.0 / timestep(task), max_current=limit),
        (
            Supply(voltage)
            if actuator.supply is None
            else dataclasses.replace(actuator.supply, voltage=voltage)
        ),
    )
