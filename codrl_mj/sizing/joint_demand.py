"""Demand on a motor as arrays: torque, speed and acceleration of its joint over time."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from codrl_mj.sizing.swing import Swing


@dataclasses.dataclass(frozen=True)
class Demand:
    """Operating points of one joint over T steps; on a slide in N, m/s and m/s^2.

    Where the task stops the joint, at walls and speed limits, `acceleration` includes the stop. The
    demand is then conservative, because in reality the wall, not the motor, stops the rotor.
    """

    source: str
    """Description of the demand's origin, for reports."""
    duration: np.ndarray
    """Duration of each step [s], shape (T,)."""
    torque: np.ndarray
    """Torque at the joint [N*m], shape (T,)."""
    speed: np.ndarray
    """Speed of the joint [rad/s] at the start of each step, which an actuator uses, shape (T,)."""
    acceleration: np.ndarray
    """Acceleration of the joint [rad/s^2], from differences of the speed, shape (T,)."""
    episodes: int = 1
    """Number of episodes."""
    exact: bool = False
    """True if the motor must follow the demand exactly. If False, another policy may need less."""
    linear: bool = False
    """True if the joint is a slide."""
    servo: bool = False
    """True if a position or velocity servo of the model commands the torque. Such a joint also
    works with less torque: it moves more slowly.
    """
    swing: Swing | None = None
    """Pendulum of a swing-up task; None for other tasks."""
    model_gear: float = 1.0
    """Gear of the actuator in a third-party model, which converts its force into joint torque. The
    demand itself, and the gear ratio of a chosen motor, refer to the joint.
    """


def demand_from_arrays(
    time: ArrayLike, torque: ArrayLike, speed: ArrayLike, source: str = "a recording"
) -> Demand:
    """Return a demand from arrays, to be followed exactly.

    Args:
        time: time [s], shape (T,), T >= 2, increasing.
        torque: torque at the joint [N*m], shape (T,).
        speed: speed of the joint [rad/s], shape (T,).
        source: description of the origin.

    Raises:
        ValueError: shapes differ, a value is not finite, or time does not increase.
    """
    arrays = {
        name: np.asarray(values, float)
        for name, values in (("time", time), ("torque", torque), ("speed", speed))
    }
    for name, array in arrays.items():
        if array.ndim != 1 or len(array) < 2 or array.shape != arrays["time"].shape:
            raise ValueError(
                f"{name}: shape {array.shape}: must be (T,), T >= 2, the same for time, torque and"
                " speed"
            )
        if not np.isfinite(array).all():
            index = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ValueError(
                f"{name}[{index}] = {array[index]}: must be finite; leave out what was not measured"
            )
    steps = np.diff(arrays["time"])
    if not (steps > 0.0).all():
        index = int(np.flatnonzero(steps <= 0.0)[0]) + 1
        raise ValueError(
            f"time[{index}] = {arrays['time'][index]:g} s: must be above the previous one; sort the"
            " samples"
        )
    acceleration = np.gradient(arrays["speed"], arrays["time"])
    duration = np.append(steps, steps[-1])
    return Demand(source, duration, arrays["torque"], arrays["speed"], acceleration, exact=True)
