"""The stored models open without this package, and contain the paper's actuators."""

import mujoco
import numpy as np
import pytest

from codrl_mj.physics import motors
from codrl_mj.tasks import TASKS
from codrl_mj.user_code import asset_path


@pytest.mark.parametrize("task", TASKS)
def test_a_stored_model_opens_without_the_package_and_has_the_papers_actuator(task, bare_engine):
    definition = TASKS[task]
    model = mujoco.MjModel.from_xml_path(str(asset_path(definition.asset)))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    assert np.isfinite(data.qpos).all()
    assert (model.nq, model.nv) == (len(definition.qpos), len(definition.qvel))
    assert {model.camera(index).name for index in range(model.ncam)} == {"fixed", "close"}
    if definition.paper:
        assert [*motors(model).values()] == list(definition.paper)
        step = definition.step_duration / definition.motor_inner_steps
        assert model.opt.timestep == pytest.approx(step, rel=1e-15)
        limit = definition.max_force * definition.paper[0].motor.arm_radius
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-limit, limit]])
