"""Models that are not ours behave as if our callbacks were not installed."""

import mujoco
import numpy as np
import pytest

from codrl_mj import engine
from codrl_mj.actuators import DCMotorActuator
from codrl_mj.engine.families import slot_size, user_header
from tests.engine.models import controls, rotor_spec, trajectory

pytestmark = pytest.mark.usefixtures("bare_engine")

USER_HEADER, SIZE = user_header(DCMotorActuator), slot_size(DCMotorActuator)


OURS = (*USER_HEADER, *DCMotorActuator().parameter_values)


def general(user=(), actdim=SIZE, **kinds):
    """Return an actuator element with user dynamics, user bias or other kinds, and user data."""
    kinds = {
        "dyntype": "user",
        "biastype": "user",
        "actdim": actdim,
        "user": " ".join(map(repr, user)),
    } | kinds
    return (
        '<general joint="a"'
        f' {" ".join(f"""{name}="{value}" """ for name, value in kinds.items() if value)}/>'
    )


FOREIGN = {
    "user dynamics and bias without user data": general(actdim=3),
    "as many activations and no user data": general(),
    "as many activations and other user data": general(
        (USER_HEADER[0], USER_HEADER[1] + 1, *OURS[2:])
    ),
    "our signature and a family that is not loaded": general(
        (*USER_HEADER[:2], (USER_HEADER[2] + 1) % 10**6, *OURS[3:])
    ),
    "our signature and a number that is no family's": general((*USER_HEADER[:2], -1.0, *OURS[3:])),
    "short user data": general(USER_HEADER[:2]),
    "our user data on a plain motor": general(OURS, actdim=0, dyntype="", biastype=""),
    "our user data on another dynamics": general(OURS, actdim=0, dyntype="filter", dynprm="0.1"),
    "our user data on another bias": general(OURS, biastype="affine", biasprm="1 2 3"),
    "our user data with another number of activations": general(OURS, actdim=SIZE - 1),
    "user gain": general(
        (USER_HEADER[0], USER_HEADER[1] + 1),
        actdim=0,
        dyntype="",
        biastype="",
        gaintype="user",
    ),
    "integrator": '<general joint="a" dyntype="integrator"/>',
    "muscle": '<muscle joint="a" lengthrange="-1 1" force="1"/>',
    "dc motor": (
        '<dcmotor joint="a" motorconst="0.5 0.5" resistance="1" inductance="0.1" input="voltage"/>'
    ),
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
def test_other_models_move_as_without_the_callbacks(kind, integrator):
    model = mujoco.MjModel.from_xml_string(_xml(FOREIGN[kind]))
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    inputs = controls(50, model.nu)
    without = trajectory(model, inputs, _start(model))
    engine.load_family(DCMotorActuator)
    engine.install()
    assert engine.installed()
    np.testing.assert_array_equal(trajectory(model, inputs, _start(model)), without)


@pytest.mark.parametrize(
    "build", [rotor_spec, lambda: mujoco.MjSpec.from_string(_xml(FOREIGN["muscle"]))]
)
def test_models_compile_the_same_while_the_callbacks_are_installed(build):
    blobs = []
    for _ in range(2):
        model = build().compile()
        blobs.append(np.empty(mujoco.mj_sizeModel(model), np.uint8))
        mujoco.mj_saveModel(model, None, blobs[-1])
        engine.install()
    np.testing.assert_array_equal(*blobs)


def test_a_spec_is_recompiled_in_an_episode_while_the_callbacks_are_installed():
    engine.load_family(DCMotorActuator)
    engine.install()
    spec = rotor_spec()
    model = spec.compile()
    data = mujoco.MjData(model)
    trajectory(model, controls(20), data)
    act = data.act.copy()
    spec.worldbody.add_geom(size=[0.1, 0.1, 0.1])
    _, moved = spec.recompile(model, data)
    np.testing.assert_array_equal(moved.act, act)
