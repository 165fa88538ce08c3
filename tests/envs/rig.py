"""Custom env source that is registered nowhere: `tests.envs.rig:RIG`."""

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

import codrl_mj

XML = """
<mujoco model="rig">
  <option timestep="0.002"/>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="rod"><joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="0.2"/></body>
  </worldbody>
  <actuator>
    <motor name="drive" joint="hinge" gear="1" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


class RigEnv(gymnasium.Env):
    """Hanging rod that must be held at one radian."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, target: float = 1.0, render_mode: str | None = None) -> None:
        """Build the model with the rod at rest."""
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data, self.dt, self._target, self.render_mode = (
            mujoco.MjData(self.model),
            0.02,
            target,
            render_mode,
        )
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = self.np_random.uniform(-0.1, 0.1)
        return self._observation(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        for _ in range(10):
            mujoco.mj_step(self.model, self.data)
        error = abs(float(self.data.qpos[0]) - self._target)
        return self._observation(), -error, False, False, {"is_success": error < 0.1}

    def render(self):
        renderer = mujoco.Renderer(self.model, 120, 160)
        renderer.update_scene(self.data)
        image = renderer.render()
        renderer.close()
        return image

    def _observation(self):
        return np.concatenate([self.data.qpos, self.data.qvel])


RIG = codrl_mj.ExternalEnvSource("rig", RigEnv, time_limit=30)
