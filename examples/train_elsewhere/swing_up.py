"""Swing a rod up and hold it. The model is beside this file; at 0 rad the rod hangs down.

`SwingUp-v0` is the environment of our engine. The functions of the task take arrays of numpy or of
JAX, so that MJX has the same task.
"""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import yaml
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv

FOLDER = Path(__file__).parent
MODEL = FOLDER / "rod.xml"
ACTUATORS = {
    "ideal": {"motor": "ideal"},
    "motor": yaml.safe_load((FOLDER / "actuators.yaml").read_text()),
}
FRAME_SKIP = 5  # physics steps of 4 ms in an environment step
TIME_LIMIT = 200  # environment steps
OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (3,), np.float32)

# Arrays of numpy or of JAX.
Array = Any


def observation(position: Array, speed: Array, xp: Any = np) -> Array:
    """Return the observation, shape (..., 3); `xp` is numpy or jax.numpy."""
    return xp.stack([xp.cos(position), xp.sin(position), 0.1 * speed], axis=-1)


def reward(position: Array, speed: Array, torque: Array, xp: Any = np) -> Array:
    """Return 1 for a rod that stands still, and about 0 for one that hangs."""
    return 0.5 - 0.5 * xp.cos(position) - 0.002 * speed**2 - 0.1 * torque**2


def initial_state(generator: np.random.Generator, num: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return angles [rad] and speeds [rad/s], shapes (num,): any angle, nearly at rest."""
    return generator.uniform(-np.pi, np.pi, num), generator.uniform(-1.0, 1.0, num)


class SwingUp(MujocoEnv):
    """Swing-up in MuJoCo. The action is the torque at the joint [N*m]; a step is 20 ms.

    Success: at the end the rod is within 0.2 rad of upright.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 50,
    }

    def __init__(self, **options: Any) -> None:
        """Load the model."""
        super().__init__(str(MODEL), FRAME_SKIP, OBSERVATION_SPACE, camera_name="side", **options)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold the torque for a step; the reward is that of the state afterwards."""
        self.do_simulation(action, self.frame_skip)
        position, speed = self.data.qpos[0], self.data.qvel[0]
        info = {"is_success": bool(np.cos(position) < -np.cos(0.2))}
        return self._observe(), float(reward(position, speed, action[0])), False, False, info

    def reset_model(self) -> np.ndarray:
        """Draw an initial state."""
        self.set_state(*initial_state(self.np_random))
        return self._observe()

    def _observe(self) -> np.ndarray:
        return observation(self.data.qpos[0], self.data.qvel[0]).astype(np.float32)


gymnasium.register("SwingUp-v0", SwingUp, max_episode_steps=TIME_LIMIT)
