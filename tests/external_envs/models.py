"""Third-party environments for tests, and comparisons of their episodes."""

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv

V5 = (
    *(
        "Ant-v5",
        "HalfCheetah-v5",
        "Hopper-v5",
        "Humanoid-v5",
        "HumanoidStandup-v5",
        "InvertedDoublePendulum-v5",
    ),
    *("InvertedPendulum-v5", "Pusher-v5", "Reacher-v5", "Swimmer-v5", "Walker2d-v5"),
)
"""Gymnasium's MuJoCo environments."""

ARM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size=".05 .2" mass="1"/>
      <body pos="0 0 0.5">
        <joint name="elbow" axis="0 1 0" damping="0.1"/><geom size=".1" mass=".7"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="shoulder" kp="20" kv="1" ctrlrange="-1 1"/>
    <general name="motor" joint="elbow" gear="5" gainprm="2"/>
  </actuator>
</mujoco>
"""
"""Model with a servo, and with a plain motor that has a gain and no control range."""


class ArmEnv(MujocoEnv):
    """Third-party environment whose model comes from a file."""

    def __init__(self, path, **options):
        """Build the model from the file."""
        space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
        super().__init__(str(path), 1, space, **options)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self.state_vector(), 0.0, False, False, {}

    def reset_model(self):
        self.set_state(self.init_qpos + self.np_random.uniform(-0.1, 0.1, 2), self.init_qvel)
        return self.state_vector()


class BareEnv(gym.Env):
    """Third-party environment that is no `MujocoEnv`, and resets only the state that it knows."""

    observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float64)

    def __init__(self):
        """Build the model from text."""
        self.model = mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.data.time, self.data.qpos[:], self.data.qvel[:] = 0.0, 0.3, 0.0
        mujoco.mj_forward(self.model, self.data)
        return np.concatenate((self.data.qpos, self.data.qvel)), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data)
        return np.concatenate((self.data.qpos, self.data.qvel)), 0.0, False, False, {}


def actions(env, steps, seed=0):
    """Return random actions of an environment, shape (steps, n)."""
    space = env.action_space
    draws = np.random.default_rng(seed).uniform(space.low, space.high, (steps, *space.shape))
    return draws.astype(space.dtype)


def run(env, inputs, seed=None):
    """Return (observation, reward, terminated, truncated, info) of every step and reset."""
    rows = [(env.reset(seed=seed)[0], 0.0, False, False, {})] if seed is not None else []
    for action in inputs:
        rows.append(env.step(action))
        if rows[-1][2] or rows[-1][3]:
            rows.append((env.reset()[0], 0.0, False, False, {}))
    return rows


def assert_same(rows, expected):
    """Compare two runs bit for bit; the infos of the first may have more entries."""
    assert len(rows) == len(expected)
    for row, expected_row in zip(rows, expected, strict=True):
        np.testing.assert_array_equal(row[0], expected_row[0])
        assert row[1:4] == expected_row[1:4]
        for name, value in expected_row[4].items():
            np.testing.assert_array_equal(row[4][name], value, err_msg=name)
