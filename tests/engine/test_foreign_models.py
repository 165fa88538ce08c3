"""Models that are not ours behave as if our callbacks were not there."""

import mujoco
import numpy as np
import pytest

from codrl_mj import engine
from codrl_mj.actuators import Actuator
from codrl_mj.engine.families import slot_size, user_head
from tests.engine.models import controls, rotor_spec, trajectory

pytestmark = pytest.mark.usefixtures("bare_engine")

HEAD, SIZE = user_head(Actuator), slot_size(Actuator)


def _user(head):
    return " ".join(map(repr, [*head, *Actuator().numbers]))


OURS = _user(HEAD)
NOT_OURS = _user((HEAD[0], HEAD[1] + 1, HEAD[2]))
NO_FAMILY = _user((*HEAD[:2], (HEAD[2] + 1) % 10**6))
NO_NUMBER = _user((*HEAD[:2], -1.0))

FOREIGN = {
    "user dynamics and bias without user data": '<general joint="a" dyntype="user" actdim="3" biastype="user"/>',
    "as many activations and no user data": f'<general joint="a" dyntype="user" actdim="{SIZE}" biastype="user"/>',
    "as many activations and other user data": (
        f'<general joint="a" dyntype="user" actdim="{SIZE}" biastype="user" user="{NOT_OURS}"/>'
    ),
    "our signature and a family that nobody loaded": (
        f'<general joint="a" dyntype="user" actdim="{SIZE}" biastype="user" user="{NO_FAMILY}"/>'
    ),
    "our signature and a number that is no family's": (
        f'<general joint="a" dyntype="user" actdim="{SIZE}" biastype="user" user="{NO_NUMBER}"/>'
    ),
    "short user data": (
        f'<general joint="a" dyntype="user" actdim="{SIZE}" biastype="user" user="{HEAD[0]} {HEAD[1]}"/>'
    ),
    "our user data on a plain motor": f'<motor joint="a" user="{OURS}"/>',
    "our user data on another dynamics": (
        f'<general joint="a" dyntype="filter" dynprm="0.1" biastype="user" user="{OURS}"/>'
    ),
    "our user data on another bias": (
        f'<general joint="a" dyntype="user" actdim="{SIZE}" biastype="affine" biasprm="1 2 3" user="{OURS}"/>'
    ),
    "our user data with another number of activations": (
        f'<general joint="a" dyntype="user" actdim="{SIZE - 1}" biastype="user" user="{OURS}"/>'
    ),
    "user gain": f'<general joint="a" gaintype="user" user="{NOT_OURS}"/>',
    "integrator": '<general joint="a" dyntype="integrator"/>',
    "muscle": '<muscle joint="a" lengthrange="-1 1" force="1"/>',
    "dc motor": '<dcmotor joint="a" motorconst="0.5 0.5" resistance="1" inductance="0.1" input="voltage"/>',
    "pid": '<pid joint="a" kp="1" kv="1" ki="1"/>',
    "none": "",
}


def _xml(actuator):
    return f"""
    <mujoco>
      <option timestep="0.01"/>
      <worldbody>
        <body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0.1"/></body>
      </worldbody>
      <actuator>{actuator}</actuator>
    </mujoco>
    """


def _start(model):
    data = mujoco.MjData(model)
    data.act[:] = np.linspace(0.1, 0.8, model.na)  # activations that a wrong hand would change
    return data


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_model_moves_as_without_us(kind, integrator):
    model = mujoco.MjModel.from_xml_string(_xml(FOREIGN[kind]))
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    inputs = controls(50, model.nu)
    without = trajectory(model, inputs, _start(model))
    engine.load_family(Actuator)
    engine.install()
    assert engine.installed()
    np.testing.assert_array_equal(trajectory(model, inputs, _start(model)), without)


def test_models_compile_alike_while_installed():
    before = mujoco.MjModel.from_xml_string(_xml(FOREIGN["integrator"]))
    ours_before = rotor_spec().compile()
    engine.install()
    after = mujoco.MjModel.from_xml_string(_xml(FOREIGN["integrator"]))
    ours_after = rotor_spec().compile()
    spec = mujoco.MjSpec.from_string(_xml(FOREIGN["muscle"]))
    spec.compile()
    for one, other in ((before, after), (ours_before, ours_after)):
        blobs = []
        for model in (one, other):
            blob = np.empty(mujoco.mj_sizeModel(model), np.uint8)
            mujoco.mj_saveModel(model, None, blob)
            blobs.append(blob)
        np.testing.assert_array_equal(*blobs)


def test_a_spec_is_recompiled_mid_episode_while_installed():
    engine.load_family(Actuator)
    engine.install()
    spec = rotor_spec()
    model = spec.compile()
    data = mujoco.MjData(model)
    trajectory(model, controls(20), data)
    act = data.act.copy()
    spec.worldbody.add_geom(size=[0.1, 0.1, 0.1])
    _, moved = spec.recompile(model, data)
    np.testing.assert_array_equal(moved.act, act)
