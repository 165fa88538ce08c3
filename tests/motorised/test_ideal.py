"""An ideal actuator behind the plugin delivers, bit for bit, what the actuator would have delivered without it."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from tests.motorised import models
from tests.motorised.models import GYMNASIUM, INTEGRATORS, MENAGERIE, SUITE, own_controls, trajectory

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # deprecated attributes in other people's models


def _check(path, integrator, steps):
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    plain = spec.compile()
    ours = codrl_mj.motorise(spec, {".*": "ideal"}).compile()
    assert len(codrl_mj.engine.motors(ours)) == plain.nactuator > 0
    for name in (
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_ctrlrange",
        "actuator_forcerange",
        "actuator_actrange",
    ):
        np.testing.assert_array_equal(getattr(ours, name), getattr(plain, name), err_msg=name)
    inputs = own_controls(plain, steps)
    np.testing.assert_array_equal(trajectory(ours, inputs), trajectory(plain, inputs))


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", ["half_cheetah", "pusher_v5", "inverted_double_pendulum"])
def test_some_of_gymnasiums_robots_are_as_before(name, integrator):
    _check(next(path for path in GYMNASIUM if path.stem == name), integrator, 100)


@pytest.mark.matrix
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("path", [*GYMNASIUM, *SUITE, *MENAGERIE], ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_every_robot_is_as_before(path, integrator):
    _check(path, integrator, 1000)


def test_there_are_enough_robots():
    assert len(GYMNASIUM) >= 11
    assert len(SUITE) >= 12
    assert len(MENAGERIE) >= 5


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
    "position, force limit": '<position joint="c" kp="20" kv="1" forcerange="-3 2" forcelimited="true"/>',
    "velocity": '<velocity joint="a" kv="2" gear="0.5"/>',
    "intvelocity": '<intvelocity joint="c" kp="15" kv="1" actrange="-0.3 0.2"/>',
    "damper": '<damper joint="b" kv="4" ctrlrange="0 1"/>',
    "cylinder": '<cylinder joint="b" timeconst="0.1" area="2" bias="0.1 -0.2 -0.3"/>',
    "affine gain": '<general joint="a" gaintype="affine" gainprm="2 .3 -.1" biastype="affine" biasprm=".2 -1 -.4"/>',
    "fixed gain, more numbers": '<general joint="a" gaintype="fixed" gainprm="2 9 9" biastype="none" biasprm="1 1 1"/>',
    "early integrator": '<general joint="b" dyntype="integrator" actearly="true" actrange="-.2 .1" actlimited="true"/>',
    "early filter": '<general joint="b" dyntype="filter" dynprm="0.03" actearly="true"/>',
    "early exact filter": '<general joint="b" dyntype="filterexact" dynprm="0.03" actearly="true" gainprm="3"/>',
    "tendon": '<position tendon="t" kp="9" kv="0.3"/>',
    "parent": '<motor jointinparent="b" gear="2"/>',
    "site": '<motor site="s" gear="0 0 1 0 0.2 0"/>',
    "armature and damping": '<motor joint="a" gear="3" armature="0.02" damping="0.1 0.01"/>',
    "group": '<motor joint="a" group="3"/>',
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_actuator_is_as_before(kind, integrator):
    spec = mujoco.MjSpec.from_string(_EVERYTHING.format(actuator=KINDS[kind], integrator=integrator))
    plain, ours = spec.compile(), codrl_mj.motorise(spec, {".*": "ideal"}).compile()
    inputs = models.controls(150, 1, low=-1.2, high=1.2)
    expected, found = (trajectory(model, inputs, _moving(model)) for model in (plain, ours))
    assert expected[:, -4].any()  # the force
    np.testing.assert_array_equal(found, expected)


def _moving(model):
    data = mujoco.MjData(model)
    data.qvel[:] = 0.7
    return data


@pytest.mark.parametrize("flags", ["clampctrl", "actuation"])
def test_flags_act_as_before(flags):
    spec = mujoco.MjSpec.from_string(_EVERYTHING.format(actuator=KINDS["motor"], integrator="Euler"))
    spec.option.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{flags.upper()}")
    inputs = models.controls(300, 1, low=-2, high=2)
    expected = trajectory(spec.compile(), inputs)
    np.testing.assert_array_equal(trajectory(behind(spec), inputs), expected)


def test_disabled_groups_are_off_as_before():
    spec = mujoco.MjSpec.from_string(_EVERYTHING.format(actuator=KINDS["group"], integrator="Euler"))
    spec.option.disableactuator = 1 << 3
    inputs = models.controls(20, 1)
    ours = trajectory(behind(spec), inputs)
    np.testing.assert_array_equal(ours, trajectory(spec.compile(), inputs))
    assert not ours[:, -4:].any()


def behind(spec):
    return codrl_mj.motorise(spec, {".*": "ideal"}).compile()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e11])
def test_bad_controls_are_treated_as_before(bad):
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
def test_what_is_changed_in_a_compiled_model_has_its_effect(fields):
    """Randomisation of other people's environments sets these."""
    spec = mujoco.MjSpec.from_string(
        _EVERYTHING.format(actuator=KINDS["position, force limit"], integrator="implicitfast")
    )
    both = spec.compile(), behind(spec)
    inputs = models.controls(300, 1, low=-2, high=2)
    unchanged = trajectory(both[1], inputs)
    for model in both:
        getattr(model, fields)[0, :3] *= 0.3
        model.actuator_ctrllimited[0] = fields == "actuator_ctrlrange"
        model.actuator_ctrlrange[0] = (-0.3, 0.2)
    np.testing.assert_array_equal(trajectory(both[1], inputs), trajectory(both[0], inputs))
    assert not np.array_equal(trajectory(both[1], inputs), unchanged)
