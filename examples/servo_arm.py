"""Third-party environment with position servos: a two-link arm reaches for a point in a plane.

The plane is vertical. The action is the desired angles of the joints. `ServoArm-v0` is registered
with Gymnasium when this module is imported.
"""

import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv

XML = """
<mujoco model="servo_arm">
  <option timestep="0.005" integrator="implicitfast"/>
  <visual><global offwidth="640" offheight="480"/></visual>
  <default>
    <joint axis="0 -1 0" damping="0.02" armature="0.001"/>
    <geom type="capsule" size="0.015" rgba="0.3 0.5 0.7 1" contype="0" conaffinity="0"/>
    <position kp="12" kv="0.6" forcerange="-1.5 1.5"/>
  </default>
  <worldbody>
    <light pos="0 -2 2" dir="0 0.7 -0.7"/>
    <camera name="side" pos="0 -1.2 0.3" xyaxes="1 0 0 0 0 1"/>
    <body pos="0 0 0.3">
      <joint name="shoulder" range="-170 170" limited="true"/>
      <geom fromto="0 0 0 0.2 0 0" mass="0.25"/>
      <body pos="0.2 0 0">
        <joint name="elbow" range="-150 150" limited="true"/>
        <geom fromto="0 0 0 0.18 0 0" mass="0.15"/>
        <site name="hand" pos="0.18 0 0" size="0.02" rgba="0.8 0.3 0.2 1"/>
      </body>
    </body>
    <body name="target" mocap="true"><site size="0.025" rgba="0.2 0.7 0.3 0.7"/></body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" ctrlrange="-2.5 2.5"/>
    <position name="elbow" joint="elbow" ctrlrange="-2.5 2.5"/>
  </actuator>
</mujoco>
"""
REACH, NEAR = 0.36, 0.03  # [m]
SHOULDER = np.array([0.0, 0.3])  # [m], x and z


class ServoArm(MujocoEnv):
    """Two-link arm that observes its joints and the target; the reward is minus the distance.

    The observation is the cosines and sines of the angles, their speeds, the target, and the
    vector from the hand to the target.

    A step is 25 ms, an episode 100. Success: the hand is within 3 cm of the target at the end.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 40,
    }

    def __init__(self, **options: Any) -> None:
        """Build the model."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "servo_arm.xml"
            path.write_text(XML)
            space = spaces.Box(-np.inf, np.inf, (10,), np.float64)
            super().__init__(str(path), 5, space, camera_name="side", **options)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Set the desired angles of the servos and simulate a step."""
        self.do_simulation(action, self.frame_skip)
        distance = float(np.linalg.norm(self._error()))
        return self._observe(), -distance, False, False, {"is_success": distance < NEAR}

    @property
    def _target(self) -> np.ndarray:
        """Desired position of the hand [m], from the shoulder.

        It is stored in MuJoCo's state, like everything in an environment that a reset restores.
        """
        return self.data.mocap_pos[0, ::2] - SHOULDER

    def _error(self) -> np.ndarray:
        """Return the vector from the hand to the target [m]."""
        shoulder, forearm = self.data.qpos[0], self.data.qpos.sum()
        hand = 0.2 * np.array([np.cos(shoulder), np.sin(shoulder)]) + 0.18 * np.array(
            [np.cos(forearm), np.sin(forearm)]
        )
        return self._target - hand

    def _observe(self) -> np.ndarray:
        angles = self.data.qpos
        return np.concatenate(
            [np.cos(angles), np.sin(angles), 0.1 * self.data.qvel, self._target, self._error()]
        )

    def reset_model(self) -> np.ndarray:
        """Start at rest in a random pose, with a target within reach."""
        angle, radius = self.np_random.uniform(-np.pi, np.pi), self.np_random.uniform(0.12, REACH)
        self.data.mocap_pos[0, ::2] = SHOULDER + radius * np.array([np.cos(angle), np.sin(angle)])
        self.set_state(self.np_random.uniform(-1.0, 1.0, 2), np.zeros(2))
        return self._observe()


gymnasium.register("ServoArm-v0", ServoArm, max_episode_steps=100)
