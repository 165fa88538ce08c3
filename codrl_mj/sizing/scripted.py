"""Controllers that nobody has to train: they show what a task asks of an actuator."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.tasks import Task

Law = Callable[[np.ndarray], np.ndarray]
"""(states (N, n)) -> forces [N] or torques [N*m], shape (N,), to be clipped to the task's largest."""

HOLD_ANGLE, HOLD_SPEED = 0.5, 3.0
"""Within these [rad, rad/s] of upright the pendulum is held, beyond them swung up."""


def swing_up_and_hold(states: np.ndarray) -> np.ndarray:
    """Pendulum: pump energy up to the top's (Astrom and Furuta 2000, at full torque), then hold by 12 theta + 4 omega.

    The rod's energy over the top is omega^2/6 + 5 (cos(theta) - 1) J.
    """
    angle, speed = (states[:, 0] + np.pi) % (2 * np.pi) - np.pi, states[:, 1]
    missing = 5.0 * (1.0 - np.cos(angle)) - speed**2 / 6.0
    pump = np.inf * np.sign(missing) * np.where(speed < 0.0, -1.0, 1.0)
    held = (np.abs(angle) < HOLD_ANGLE) & (np.abs(speed) < HOLD_SPEED)
    return np.where(held, -12.0 * angle - 4.0 * speed, np.nan_to_num(pump))


def swing_up_and_balance(states: np.ndarray) -> np.ndarray:
    """Furuta: pump energy while the arm is kept near its middle (Astrom and Furuta 2000), then balance by an LQR.

    The rod's energy over the top is 6.66e-5 speed^2 + 0.0152 (cos(angle) - 1) J. The LQR's gains
    are those at 20 ms of weights 1, 1, 0.01, 0.01 of the state and 1/0.02^2 of the torque.
    """
    arm, rod, arm_speed, rod_speed = states.T
    rod = (rod + np.pi) % (2 * np.pi) - np.pi
    missing = 1.0 - np.cos(rod) - 6.66e-5 / 0.0152 * rod_speed**2
    pump = 0.034 * np.clip(10.0 * missing, -1.0, 1.0) * np.sign(rod_speed * np.cos(rod))
    held = (np.abs(rod) < 0.4) & (np.abs(rod_speed) < 8.0)
    hold = 0.014 * arm - 0.17 * rod + 0.0055 * arm_speed - 0.014 * rod_speed
    return np.where(held, hold, pump - 0.03 * arm - 0.002 * arm_speed)


def balance(states: np.ndarray) -> np.ndarray:
    """CartPole: push the cart to where the pole falls."""
    return np.inf * (states @ np.array([0.1, 0.4, 5.0, 1.5]))


def energy_pumping(task: Task) -> Law:
    """Full force in the direction in which the actuated joint moves; at rest in one drawn at random."""
    generator = np.random.default_rng(0)

    def law(states: np.ndarray) -> np.ndarray:
        kick, speed = generator.choice([-1.0, 1.0], len(states)), states[:, task.speeds[0]]
        return np.inf * np.where(np.abs(speed) > 1e-6, speed, kick)

    return law


class Scripted:
    """A law as a policy: it is shown states, and answers with the task's actions."""

    def __init__(self, task: Task) -> None:
        """The law for a task: its own, or energy pumping."""
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
        deterministic: bool = False,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """Actions for states (N, n)."""
        force = np.clip(self._law(observation), -self._task.max_forces[0], self._task.max_forces[0])
        if self._task.forces is None:
            return force[:, np.newaxis].astype(np.float32), None
        return np.abs(np.array(self._task.forces) - force[:, np.newaxis]).argmin(axis=1), None


def observe_state(env: Any) -> Any:
    """An environment that shows its mechanical state, in the task's order."""
    return gymnasium.wrappers.TransformObservation(env, lambda _: env.unwrapped.physics.state, None)
