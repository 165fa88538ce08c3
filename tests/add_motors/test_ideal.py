"""An ideal actuator in the plugin backend gives the bits of the model without motors."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from tests.add_motors import models
from tests.add_motors.models import (
    GYMNASIUM,
    INTEGRATORS,
    MENAGERIE,
    SUITE,
    own_controls,
    trajectory,
)
from tests.matrix import matrix_params

# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def behind(spec):
    return codrl_mj.add_motors(spec, {".*": "ideal"}).compile()


def _check(path, integrator, steps):
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    plain, ours = spec.compile(), behind(spec)
    assert len(codrl_mj.engine.motors(ours)) == plain.nactuator > 0
    for name in ("gainprm", "biasprm", "ctrlrange", "forcerange", "actrange"):
        of_both = [getattr(model, f"actuator_{name}") for model in (ours, plain)]
        np.testing.assert_array_equal(*of_both, err_msg=name)
    inputs = own_controls(plain, steps)
    np.testing.assert_array_equal(trajectory(ours, inputs), trajectory(plain, inputs))


ROBOTS = [*GYMNASIUM, *SUITE, *MENAGERIE]
SOME = [
    path
    for path in GYMNASIUM
    if path.stem in ("half_cheetah", "pusher_v5", "inverted_double_pendulum")
]


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(
    "path", matrix_params(SOME, ROBOTS), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_ideal_actuators_do_not_change_any_robot(path, integrator):
    _check(path, integrator, 100 if path in SOME else 1000)


def test_there_are_enough_robots():
    assert len(SOME) == 3
    assert (len(GYMNASIUM) >= 11, len(SUITE) >= 12, len(MENAGERIE) >= 5) == (True, True, True)


_EVERYTHING = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}"/>
  <worldbody>
    <body><joint name="a" axis="0 1 0" range="-90 90" limited="true"/><geom type="capsule" size=".05 .2" mass="1"/>
      <body pos="0 0 0.5"><joint name="b" type="slide" axis="1 0 0"/><geom size=".1" mass=".7"/><site name="s"/></body>
    </body>
    <body pos="1 0 0"><joint name="c" axis="0 1 0"/><geom type="capsule" size=".05 .2" mass="1"/></body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="a" coef="0.7"/><joint joint="c" coef="-1.3"/></fixed></tendon>
  <actuator>{actuator}</actuator>
</mujoco>
"""
KINDS = {
    "motor": '<motor joint="a" gear="-3" ctrlrange="-0.4 0.5" ctrllimited="true"/>',
    "unlimited": '<motor joint="b"/>',
    "force limit": '<motor joint="b" gear="2" forcerange="-0.3 0.2" forcelimited="true"/>',
    "position": '<position joint="a" kp="20" kv="1.5" inheritrange="0.9"/>',
    "position, filtered": '<position joint="c" kp="20" dampratio="1" timeconst="0.05"/>',
    "position, force limit": (
        '<position joint="c" kp="20" kv="1" forcerange="-3 2" forcelimited="true"/>'
    ),
    "velocity": '<velocity joint="a" kv="2" gear="0.5"/>',
    "intvelocity": '<intvelocity joint="c" kp="15" kv="1" actrange="-0.3 0.2"/>',
    "damper": '<damper joint="b" kv="4" ctrlrange="0 1"/>',
    "cylinder": '<cylinder joint="b" timeconst="0.1" area="2" bias="0.1 -0.2 -0.3"/>',
    "affine gain": (
        '<general joint="a" gaintype="affine" gainprm="2 .3 -.1" biastype="affine" biasprm=".2 -1'
        ' -.4"/>'
    ),
    "fixed gain, more numbers": (
        '<general joint="a" gaintype="fixed" gainprm="2 9 9" biastype="none" biasprm="1 1 1"/>'
    ),
    "early integrator": (
        '<general joint="b" dyntype="integrator" actearly="true" actrange="-.2 .1"'
        ' actlimited="true"/>'
    ),
    "early filter": '<general joint="b" dyntype="filter" dynprm="0.03" actearly="true"/>',
    "early exact filter": (
        '<general joint="b" dyntype="filterexact" dynprm="0.03" actearly="true" gainprm="3"/>'
    ),
    "tendon": '<position tendon="t" kp="9" kv="0.3"/>',
    "parent": '<motor jointinparent="b" gear="2"/>',
    "site": '<motor site="s" gear="0 0 1 0 0.2 0"/>',
    "armature and damping": '<motor joint="a" gear="3" armature="0.02" damping="0.1 0.01"/>',
    "group": '<motor joint="a" group="3"/>',
}


def everything(kind, integrator="Euler"):
    return mujoco.MjSpec.from_string(
        _EVERYTHING.format(actuator=KINDS[kind], integrator=integrator)
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kind", KINDS)
def test_ideal_actuators_do_not_change_any_kind_of_actuator(kind, integrator):
    spec = everything(kind, integrator)
    inputs, states = models.controls(150, 1, low=-1.2, high=1.2), []
    for model in (spec.compile(), behind(spec)):
        data = mujoco.MjData(model)
        data.qvel[:] = 0.7
        states.append(trajectory(model, inputs, data))
    assert states[0][:, -4].any()  # the force
    np.testing.assert_array_equal(*states)


@pytest.mark.parametrize(
    ("kind", "field", "flags"),
    [
        ("motor", "disableflags", mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL),
        ("motor", "disableflags", mujoco.mjtDisableBit.mjDSBL_ACTUATION),
        ("group", "disableactuator", 1 << 3),
    ],
)
def test_disabled_actuators_stay_disabled(kind, field, flags):
    spec, inputs = everything(kind), models.controls(300, 1, low=-2, high=2)
    setattr(spec.option, field, getattr(spec.option, field) | int(flags))
    expected = trajectory(spec.compile(), inputs)
    np.testing.assert_array_equal(trajectory(behind(spec), inputs), expected)
    assert expected[:, -4:].any() == (flags == mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e11])
def test_bad_controls_are_handled_as_without_motors(bad):
    spec = mujoco.MjSpec.from_string(
        _EVERYTHING.format(actuator=KINDS["motor"] + KINDS["unlimited"], integrator="Euler")
    )
    inputs = np.array([[bad, 0.3], [0.3, bad], [0.3, 0.3]])
    expected = trajectory(spec.compile(), inputs)
    assert expected[0, -5] == (0.0 if np.isnan(bad) else np.clip(bad, -0.4, 0.5))
    np.testing.assert_array_equal(trajectory(behind(spec), inputs), expected)


@pytest.mark.parametrize(
    "fields", ["actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange"]
)
def test_changes_of_a_compiled_model_have_an_effect(fields):
    """Randomization of third-party environments changes these fields."""
    spec = everything("position, force limit", "implicitfast")
    both = spec.compile(), behind(spec)
    inputs = models.controls(300, 1, low=-2, high=2)
    unchanged = trajectory(both[1], inputs)
    for model in both:
        getattr(model, fields)[0, :3] *= 0.3
        model.actuator_ctrllimited[0] = fields == "actuator_ctrlrange"
        model.actuator_ctrlrange[0] = (-0.3, 0.2)
    np.testing.assert_array_equal(trajectory(both[1], inputs), trajectory(both[0], inputs))
    assert not np.array_equal(trajectory(both[1], inputs), unchanged)
