"""Times that are set by hand: a step takes no torque from before."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import TorqueSpeed
from tests.motorised.models import arm

UNLIMITED = TorqueSpeed(stall_torque=1e6, no_load_speed=1e6, max_torque=1e6)


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
@pytest.mark.parametrize("share", [0.3, 1.0, 1.7])
def test_a_keyframe_s_time_changes_nothing(integrator, share):
    spec = arm(integrator)
    spec.add_key(name="later", time=share * 0.005, qpos=[0.1, -0.2])
    models = [spec.copy().compile(), codrl_mj.motorise(spec, {".*": UNLIMITED}).compile()]
    found = []
    for model in models:
        data = mujoco.MjData(model)
        data.ctrl[:] = 0.3
        mujoco.mj_step(model, data, 3)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.ctrl[:] = -0.5
        mujoco.mj_step(model, data, 2)
        found.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)
