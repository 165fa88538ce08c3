"""Motors in robots of Gymnasium's, in other processes: the same as in this one."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

import codrl_mj
from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from tests.motorised.models import Worn

DRIVE = Actuator(
    Motor(resistance=0.5, inductance=0.01, torque_constant=0.02, back_emf_constant=1e-4),
    CurrentLoop(kp=0.5, ki=5.0, kff=0.5, max_voltage=24.0, substeps=4),
)


class MotorisedCheetah(HalfCheetahEnv):
    """Gymnasium's, with motors."""

    def _initialize_simulation(self):
        spec = mujoco.MjSpec.from_file(self.fullpath)
        self.width, self.height = 480, 480
        model = codrl_mj.motorise(spec, {"b.*": DRIVE, "f.*": Worn()}).compile()
        return model, mujoco.MjData(model)


def _episodes(vector):
    actions = np.random.default_rng(1).uniform(-1, 1, (50, 3, 6)).astype(np.float32)
    rows = [vector.reset(seed=5)[0]]
    for index, action in enumerate(actions):
        rows.append(vector.step(action)[0])
        if index == 30:
            rows.append(vector.reset(seed=7)[0])
    vector.close()
    return np.array(rows)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.matrix)])
def test_processes_have_the_same_motors(context):
    makers = [MotorisedCheetah] * 3
    expected = _episodes(gym.vector.SyncVectorEnv(makers))
    found = _episodes(gym.vector.AsyncVectorEnv(makers, context=context))
    np.testing.assert_array_equal(found, expected)
    assert len(np.unique(expected[-1, :, 0])) == 3
