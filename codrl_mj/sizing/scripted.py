"""Scripted controllers, which give the demand of a task without training."""

from collections.abc import Callable

import gymnasium
import numpy as np

from codrl_mj.envs.config import Env
from codrl_mj.tasks import Task

Law = Callable[[np.ndarray], np.ndarray]
"""Function (states (N, n)) -> forces [N] or torques [N*m], shape (N,), before clipping."""

HOLD_ANGLE, HOLD_SPEED = 0.5, 3.0
"""Limits around upright [rad, rad/s] within which the pendulum is held instead of swung up."""


def swing_up_and_hold(states: np.ndarray) -> np.ndarray:
    """Return torques for the Pendulum: energy pumping at full torque, then 12 theta + 4 omega.

    Source of the pumping: Astrom and Furuta (2000). The rod's energy relative to upright is
    omega^2/6 + 5 (cos(theta) - 1) J.
    """
    angle, speed = (states[:, 0] + np.pi) % (2 * np.pi) - np.pi, states[:, 1]
    missing_energy = 5.0 * (1.0 - np.cos(angle)) - speed**2 / 6.0
    # `Scripted` clips infinite torques to the largest one.
    pump = np.inf * np.sign(missing_energy) * np.where(speed < 0.0, -1.0, 1.0)
    near_upright = (np.abs(angle) < HOLD_ANGLE) & (np.abs(speed) < HOLD_SPEED)
    return np.where(near_upright, -12.0 * angle - 4.0 * speed, np.nan_to_num(pump))


def swing_up_and_balance(states: np.ndarray) -> np.ndarray:
    """Return torques for the Furuta pendulum: energy pumping, arm centering, then an LQR.

    Source of the pumping: Astrom and Furuta (2000). The rod's energy relative to upright is 6.66e-5
    speed^2 + 0.0152 (cos(angle) - 1) J. The LQR's gains are for 20 ms steps, with weights 1, 1,
    0.01, 0.01 of the state and 1/0.02^2 of the torque.
    """
    arm, rod, arm_speed, rod_speed = states.T
    rod = (rod + np.pi) % (2 * np.pi) - np.pi
    missing_energy = 1.0 - np.cos(rod) - 6.66e-5 / 0.0152 * rod_speed**2
    pump = 0.034 * np.clip(10.0 * missing_energy, -1.0, 1.0) * np.sign(rod_speed * np.cos(rod))
    near_upright = (np.abs(rod) < 0.4) & (np.abs(rod_speed) < 8.0)
    hold = 0.014 * arm - 0.17 * rod + 0.0055 * arm_speed - 0.014 * rod_speed
    torques: np.ndarray = np.where(near_upright, hold, pump - 0.03 * arm - 0.002 * arm_speed)
    return torques


def balance(states: np.ndarray) -> np.ndarray:
    """Return forces for CartPole: full force toward the side to which the pole falls."""
    forces: np.ndarray = np.inf * (states @ np.array([0.1, 0.4, 5.0, 1.5]))
    return forces


def energy_pumping(task: Task) -> Law:
    """Return a control law: full force in the direction of motion, at rest in a random one."""
    generator = np.random.default_rng(0)

    def law(states: np.ndarray) -> np.ndarray:
        random_direction = generator.choice([-1.0, 1.0], len(states))
        speed = states[:, task.speed_indices[0]]
        forces: np.ndarray = np.inf * np.where(np.abs(speed) > 1e-6, speed, random_direction)
        return forces

    return law


class Scripted:
    """Policy that applies a control law to states and returns the task's actions."""

    def __init__(self, task: Task) -> None:
        """Choose the control law of a task; energy pumping is the default."""
        laws: dict[str, tuple[str, Law]] = {
            "pendulum": ("scripted swing-up and hold", swing_up_and_hold),
            "cartpole": ("scripted balancing", balance),
            "furuta": ("scripted swing-up and balance", swing_up_and_balance),
        }
        self.description, self._law = laws.get(
            task.name, ("scripted energy pumping", energy_pumping(task))
        )
        self._task = task

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = False,  # noqa: ARG002 - required by the Policy protocol
    ) -> tuple[np.ndarray, None]:
        """Return actions for states (N, n)."""
        force = np.clip(self._law(observation), -self._task.max_forces[0], self._task.max_forces[0])
        if self._task.forces is None:
            return force[:, np.newaxis].astype(np.float32), None
        return np.abs(np.array(self._task.forces) - force[:, np.newaxis]).argmin(axis=1), None


def observe_state(env: Env) -> Env:
    """Wrap an environment so that it observes its mechanical state, in the task's order."""
    return gymnasium.wrappers.TransformObservation(
        env, lambda _: env.get_wrapper_attr("physics").state, None
    )
