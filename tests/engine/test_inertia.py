"""The inertia at a shaft equals MuJoCo's solution with its inertia matrix."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from codrl_mj.engine.model_access import MAX_STACK_DOFS, shaft_inertia

MODELS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


@pytest.mark.parametrize(
    "name", ["humanoid.xml", "half_cheetah.xml", "ant.xml", "reacher.xml", "pusher_v5.xml"]
)
def test_the_inertia_is_one_over_m_inverse_m(name):
    model = mujoco.MjModel.from_xml_path(str(MODELS / name))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(3):
        data.qpos[:] += rng.normal(scale=0.3, size=model.nq)
        mujoco.mj_fwdPosition(model, data)
        moments = np.zeros((model.nu, model.nv))
        mujoco.mju_sparse2dense(
            moments,
            data.actuator_moment,
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind,
        )
        solved = np.zeros_like(moments)
        mujoco.mj_solveM(model, data, solved, moments)
        expected = 1.0 / np.einsum("ij,ij->i", moments, solved)
        inertias = [shaft_inertia(model, data, output, 3.0) for output in range(model.nu)]
        np.testing.assert_allclose(inertias, expected / 9.0, rtol=1e-12)


@pytest.mark.parametrize("count", [3, MAX_STACK_DOFS + 1])
def test_a_separate_slide_joint_has_the_mass_of_its_body(count):
    spec = mujoco.MjSpec()
    for index in range(count):
        body = spec.worldbody.add_body(
            mass=0.5 + index, inertia=[1.0, 1.0, 1.0], explicitinertial=True
        )
        joint = body.add_joint(name=str(index), type=mujoco.mjtJoint.mjJNT_SLIDE)
        spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    for index in (0, 1, count - 1):
        assert shaft_inertia(model, data, index, 2.0) == pytest.approx(
            (0.5 + index) / 4.0, rel=1e-15
        )


def test_an_actuator_that_moves_nothing_has_infinite_inertia():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><joint name='a'/><geom size='1'/></body></worldbody></mujoco>"
    )
    spec.add_actuator(target="a", trntype=mujoco.mjtTrn.mjTRN_JOINT, gear=[0.0] * 6)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    assert np.isinf(shaft_inertia(model, data, 0, 1.0))
