"""One hinge that an actuator drives, in the engine: how fast its torque comes, how exact, and how much; in doses."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import DCMotorActuator, Drive, GearMotor, SampledLoop, Supply
from codrl_mj.engine.specs import add_motors
from codrl_mj.study.doses import REFERENCE_SPEEDS, noise, timestep
from codrl_mj.study.grid import check_chosen
from codrl_mj.tasks import find_task

BLOCKED = 1e12
"""Inertia [kg*m^2] that nothing here turns."""
HORIZON = 20.0
"""Steps of the policy after which a force counts as not there."""


def on_bench(actuator: Any, timestep: float, inertia: float) -> Callable[..., np.ndarray]:
    """One hinge with a load of some inertia [kg*m^2] that an actuator drives in steps of `timestep` [s], to be run."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.compiler.boundmass = timestep, 0.0
    spec.option.tolerance = (
        0.0  # it is relative to the inertia, beside which friction would count as none
    )
    body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[inertia] * 3)
    body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    model = add_motors(spec, {"hinge": actuator}).compile()
    data, moved = mujoco.MjData(model), inertia + actuator.additions.armature

    def run(torque: float, duration: float, speed: float = 0.0) -> np.ndarray:
        """Ask for a torque [N*m] at the joint for a `duration` [s], from a speed of the joint [rad/s].

        Shape (steps, 3): the actuator's torque [N*m] in each step, that which accelerates the hinge
        [N*m], and its speed [rad/s] after the step.
        """
        mujoco.mj_resetData(model, data)
        data.ctrl[:], data.qvel[:] = torque, speed
        rows = np.empty((max(round(duration / timestep), 1), 3))
        for row in rows:
            mujoco.mj_step(model, data)
            row[:] = data.qfrc_actuator[0], data.qacc[0] * moved, data.qvel[0]
        return rows

    return run


class Delivery(NamedTuple):
    """What an actuator makes of a command within `HORIZON`, in steps of the policy and shares of the largest force.

    A loop that is quick at first and creeps to its end much later is thus called quick and weak:
    that is what a policy meets, whose commands change long before.
    """

    dead_time: float
    """Until a thousandth of what comes in the end is there [steps]."""
    lag: float
    """Average residence time less the dead time [steps]: the time constant of the first-order lag
    that comes as late; ringing counts as lateness. Source: Astrom, Hagglund, *PID Controllers*, 2nd
    ed., section 2.4 (area methods).
    """
    at_rest: float
    """What is there in the end, while the joint is blocked."""
    at_speed: float
    """The same at the reference speed, while it drives."""
    friction: float
    """What brakes the joint while nothing is asked for [largest force]: the larger of all of it at
    a twentieth of the reference speed, and of what the actuator rubs away itself at that speed,
    where its back-EMF is no friction.
    """
    noise: float
    """Standard deviation of the force [largest force] from one integration step to the next."""
    unasked: float
    """Mean force [largest force] at rest while nothing is asked for, either sign."""


def delivery(actuator: Any, timestep: float, step: float, force: float, speed: float) -> Delivery:
    """Measure what an actuator makes of commands up to a force [N*m; N on a slide] at a reference speed [rad/s; m/s].

    `timestep` is that of the integration, `step` the policy's [s].
    """
    duration = HORIZON * step
    blocked = on_bench(actuator, timestep, BLOCKED)
    unasked = blocked(0.0, duration)[:, 0]  # its noise is every run's, and thus taken from them

    def asked(at: float) -> np.ndarray:
        return (blocked(force, duration, at)[:, 0] - unasked) / force

    def braked(at: float) -> tuple[float, float]:
        turned = _end(on_bench(actuator, timestep, 1e4 * force * duration / at)(0.0, duration, at))
        driven, moved, _ = np.mean(turned, axis=0)
        return float(np.mean(_end(unasked)) - moved) / force, float(driven - moved) / force

    torques = asked(0.0)
    last = float(np.mean(_end(torques)))
    begun = np.flatnonzero(np.abs(torques) > 1e-3 * abs(last))
    dead = int(begun[0]) if len(begun) else 0
    lag = max(float(np.sum(np.abs(1.0 - torques / last))) - dead, 0.0) if last else 0.0
    settled = unasked[len(unasked) // 2 :] / force
    return Delivery(
        dead_time=dead * timestep / step,
        lag=lag * timestep / step,
        at_rest=last,
        at_speed=float(np.mean(_end(asked(speed)))),
        friction=max(braked(0.05 * speed)[0], braked(speed)[1], 0.0),
        noise=float(np.std(settled)),
        unasked=abs(float(np.mean(settled))),
    )


def _end(rows: np.ndarray) -> np.ndarray:
    """The last step of the policy."""
    return rows[-max(round(len(rows) / HORIZON), 1) :]


# -- on a task of the study ---------------------------------------------------------------------------------------


def delivered(actuator: Any, task: str, share: float = 1.0) -> Delivery:
    """What an actuator makes of the commands of a task, on the bench, or of a `share` of its largest force."""
    check_chosen("task", [task], REFERENCE_SPEEDS)
    if actuator.MOTION:
        raise ValueError(
            f"actuator: a {actuator.family} is asked for motion, not for forces: name one of"
            " another family"
        )
    known = find_task(task)
    return delivery(
        actuator,
        timestep(task),
        known.step_duration,
        share * known.max_force,
        REFERENCE_SPEEDS[task],
    )


def doses(found: Delivery, task: str) -> dict[str, float]:
    """The dose of every axis that does to a command what the actuator does, as it was `found` on the task, by axis.

    Weakness g and a supply that lacks a share d leave g*min(1, 2*(1 - d)) of the largest force at
    rest, and g*(1 - 2*d) at the reference speed (`doses.supply`): solved for both, with g at most
    1.
    """
    rest, speed = max(found.at_rest, 0.0), min(found.at_speed, found.at_rest)
    strength = rest if speed >= 0.0 else rest - speed
    if rest == 0.0:
        lacks = 1.0
    elif speed >= 0.0:
        lacks = (1.0 - speed / rest) / 2.0
    else:
        lacks = 1.0 - rest / (2.0 * strength)
    loud = found.noise and found.noise / delivered(noise(task, 1.0).actuator, task).noise
    return {
        "lag": found.lag,
        "weakness": max(1.0 - strength, 0.0),
        "supply": lacks,
        "delay": found.dead_time,
        "friction": found.friction,
        "noise": loud,
    }


def commanded(actuator: Any, task: str, found: Delivery) -> Delivery | None:
    """What comes of commands that are larger by what is lost at rest, where that is more than a fiftieth.

    None for a loop that could be designed: what it has not delivered yet is no gear's loss.
    """
    if not 0.1 < found.at_rest < 0.98 or redesign(actuator, task) is not None:
        return None
    more = 1.0 / found.at_rest
    there = delivered(actuator, task, more)
    share = {name: min(getattr(there, name) * more, 1.0) for name in ("at_rest", "at_speed")}
    scaled = {name: getattr(there, name) * more for name in ("friction", "noise", "unasked")}
    return there._replace(**share, **scaled)


def redesign(actuator: Any, task: str) -> Drive | None:
    """The same motor and supply under a designed loop; None if it has one, or no loop that could be designed."""
    if isinstance(actuator, DCMotorActuator):  # what a sensor gets wrong no loop makes right
        wrong = actuator.controller.current_noise or actuator.controller.current_bias
        return None if wrong else redesigned(actuator, task)
    if isinstance(actuator, Drive):
        loop = dataclasses.replace(
            actuator.controller, bandwidth=0.0, kp=0.0, ki=0.0, anti_windup="back_calculation"
        )
        return (
            None if loop == actuator.controller else dataclasses.replace(actuator, controller=loop)
        )
    return None


def redesigned(actuator: DCMotorActuator, task: str) -> Drive:
    """The motor and supply of a current loop under a designed one: pole-zero cancellation, anti-windup, a limit."""
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
