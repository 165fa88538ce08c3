"""One hinge that an actuator drives, in the engine: how fast its torque comes, how exact, and how much there is."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from codrl_mj.specs import motorise

BLOCKED = 1e12
"""Inertia [kg*m^2] that nothing here turns."""
HORIZON = 20.0
"""Steps of the policy after which a force counts as not there."""


class Bench:
    """One hinge with a load of some inertia [kg*m^2] that an actuator drives in steps of `timestep` [s]."""

    def __init__(self, actuator: Any, timestep: float, inertia: float) -> None:
        """Build it."""
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.compiler.boundmass = timestep, 0.0
        spec.option.tolerance = 0.0  # it is relative to the inertia, beside which friction would count as none
        body = spec.worldbody.add_body(explicitinertial=True, mass=1.0, inertia=[inertia] * 3)
        body.add_joint(name="hinge", axis=[0.0, 0.0, 1.0])
        spec.add_actuator(target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
        self._model = motorise(spec, {"hinge": actuator}).compile()
        self._data = mujoco.MjData(self._model)
        self._inertia = inertia + actuator.additions.armature

    def run(self, torque: float, duration: float, speed: float = 0.0) -> np.ndarray:
        """Ask for a torque [N*m] at the joint for a `duration` [s], from a speed of the joint [rad/s].

        Shape (steps, 3): the actuator's torque [N*m] in each step, that which accelerates the hinge [N*m], and its
        speed [rad/s] after the step.
        """
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        data.ctrl[:], data.qvel[:] = torque, speed
        rows = np.empty((max(round(duration / model.opt.timestep), 1), 3))
        for row in rows:
            mujoco.mj_step(model, data)
            row[:] = data.qfrc_actuator[0], data.qacc[0] * self._inertia, data.qvel[0]
        return rows


class Delivery(NamedTuple):
    """What an actuator makes of a command within `HORIZON`, in steps of the policy and shares of the largest force.

    A loop that is quick at first and creeps to its end much later is thus called quick and weak: that is what a policy
    meets, whose commands change long before.
    """

    dead_time: float
    """Until a thousandth of what comes in the end is there [steps]."""
    lag: float
    """Average residence time less the dead time [steps]: the time constant of the first-order lag that comes as late;
    ringing counts as lateness. Source: Astrom, Hagglund, *PID Controllers*, 2nd ed., section 2.4 (area methods)."""
    at_rest: float
    """What is there in the end, while the joint is blocked."""
    at_speed: float
    """The same at the reference speed, while it drives."""
    friction: float
    """What brakes the joint while nothing is asked for [largest force]: the larger of all of it at a twentieth of the
    reference speed, and of what the actuator rubs away itself at that speed, where its back-EMF is no friction."""
    noise: float
    """Standard deviation of the force [largest force] from one integration step to the next."""
    unasked: float
    """Mean force [largest force] at rest while nothing is asked for, either sign."""


def delivery(actuator: Any, timestep: float, step: float, force: float, speed: float) -> Delivery:
    """Measure what an actuator makes of commands up to a force [N*m; N on a slide] at a reference speed [rad/s; m/s].

    `timestep` is that of the integration, `step` the policy's [s].
    """
    duration = HORIZON * step
    blocked = Bench(actuator, timestep, BLOCKED)
    unasked = blocked.run(0.0, duration)[:, 0]  # its noise is every run's, and thus taken from them

    def asked(at: float) -> np.ndarray:
        return (blocked.run(force, duration, at)[:, 0] - unasked) / force

    def braked(at: float) -> tuple[float, float]:
        turned = _end(Bench(actuator, timestep, 1e4 * force * duration / at).run(0.0, duration, at))
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
