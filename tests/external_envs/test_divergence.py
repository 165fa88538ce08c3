"""Divergence ends a step with an error in third-party environments as in the tasks."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.physics.base import SimulationDivergedError

MESSAGE = r"the simulation diverged at t = .* is not finite, or too large\. Reset the environment"


@pytest.fixture(autouse=True)
def no_log_file():
    mujoco.set_mju_user_warning(lambda _: None)
    yield
    mujoco.set_mju_user_warning(None)


def test_raises_in_gymnasiums_environment_until_a_reset():
    env = codrl_mj.make("InvertedPendulum-v5", {".*": "lag"})
    env.reset(seed=0)
    env.unwrapped.data.qvel[:] = np.nan
    with pytest.raises(SimulationDivergedError, match=f"InvertedPendulum-v5: {MESSAGE}"):
        env.step(np.zeros(1, np.float32))
    assert np.isfinite(env.reset()[0]).all()
    assert np.isfinite(env.step(np.zeros(1, np.float32))[0]).all()


def test_dm_controls_environment_stops():
    env = codrl_mj.make_dm_control("pendulum/swingup", {".*": "lag"})
    env.reset()
    env.mujoco[1].qvel[:] = 1e30
    with pytest.raises(SimulationDivergedError, match=MESSAGE):
        env.step([0.0])
