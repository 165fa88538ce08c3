"""An actuator written into an MJCF model and read back, and what is refused."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import codrl_mj
from codrl_mj import engine
from codrl_mj.actuators import IDEAL, Actuator, CurrentLoop, JointAdditions, Lag, Motor, parameters_type
from codrl_mj.disturbances import Joint
from codrl_mj.engine.families import HEAD, Slot, signals_at, slot_size, user_head
from codrl_mj.physics import Plant, motors
from codrl_mj.physics.mjcf import drive, task_model
from codrl_mj.tasks import TASKS
from tests.actuators.strategies import actuators, every_actuator, of_every_family

SIZE = slot_size(Actuator)
XML = """
<mujoco>
  <compiler autolimits="false"/>
  <worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""


def _spec(actuator=None, max_force=None):
    spec = mujoco.MjSpec.from_string(XML)
    drive(spec.actuator("drive"), actuator or Actuator(), max_force)
    return spec


@given(every_actuator, st.none() | st.floats(1e-3, 1e3))
def test_an_actuator_comes_back_as_it_was_written(actuator, max_force):
    model = _spec(actuator, max_force).compile()
    ((index, found),) = motors(model).items()
    assert index == 0
    assert found.controller == actuator.controller
    for field in ("resistance", "inductance", "torque_constant", "back_emf_constant"):
        assert getattr(found.motor, field) == getattr(actuator.motor, field)
    assert found.motor.arm_radius == pytest.approx(actuator.motor.arm_radius, rel=1e-15)  # through gear = 1/arm
    assert found.numbers == actuator.numbers  # those of its supply too


@given(of_every_family)
def test_every_family_comes_back_and_the_ideal_one_is_none_of_ours(actuator):
    engine.load_family(type(actuator))
    found = motors(_spec(actuator).compile())
    assert [type(one) for one in found.values()] == ([] if actuator == IDEAL else [type(actuator)])
    assert all(one.numbers == actuator.numbers for one in found.values())


@given(actuators, st.floats(1e-3, 1e3))
def test_the_control_range_is_the_largest_torque_at_the_shaft(actuator, max_force):
    model = _spec(actuator, max_force).compile()
    limit = max_force * actuator.motor.arm_radius
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-limit, limit]])
    assert model.actuator_ctrllimited[0]


def test_without_a_largest_force_the_control_is_unlimited():
    assert not _spec().compile().actuator_ctrllimited[0]


def test_the_ideal_actuator_is_a_plain_motor_of_gear_one_whatever_was_there_before():
    spec = _spec(Actuator(Motor(arm_radius=0.2)), 3.0)
    drive(spec.actuator("drive"), IDEAL, None)
    model, plain = spec.compile(), mujoco.MjModel.from_xml_string(XML)
    assert motors(model) == {}
    assert model.na == 0
    for field in ("dyntype", "gaintype", "gainprm", "biastype", "biasprm", "gear", "ctrllimited", "actnum"):
        np.testing.assert_array_equal(getattr(model, f"actuator_{field}"), getattr(plain, f"actuator_{field}"))


def test_a_model_without_our_motors_has_none():
    assert motors(mujoco.MjModel.from_xml_string(XML)) == {}
    assert motors(mujoco.MjModel.from_xml_string("<mujoco/>")) == {}


def test_motors_are_found_by_their_index_in_order():
    spec = _spec()
    for index in range(3):
        driver = spec.add_actuator(name=f"extra{index}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge")
        if index != 1:
            drive(driver, Actuator(controller=CurrentLoop(kp=float(index + 2))), None)
    found = motors(spec.compile())
    assert {index: actuator.controller.kp for index, actuator in found.items()} == {0: 1.0, 1: 2.0, 3: 4.0}


def test_the_package_offers_the_function():
    assert codrl_mj.engine.motors is motors


def _text(numbers):
    return " ".join(map(repr, numbers))


def _no_motor(field, value):
    def change(model):
        getattr(model, f"actuator_{field}")[0] = value

    return change


def _user(name, value):
    def change(model):
        model.actuator_user[0, HEAD + parameters_type(Actuator)._fields.index(name)] = value

    return change


REFUSED = {
    "dyntype": (_no_motor("dyntype", mujoco.mjtDyn.mjDYN_FILTER), r'drive: dyntype = 2: .* needs dyntype="user"'),
    "biastype": (_no_motor("biastype", mujoco.mjtBias.mjBIAS_AFFINE), r'drive: biastype = 1: .* needs biastype="user"'),
    "actdim": (_no_motor("actnum", 7), rf'drive: actdim = 7: .* needs actdim="{SIZE}"'),
    "delay": (_no_motor("delay", 0.01), r'drive: delay = 0\.01: .* needs delay="0"'),
    "gaintype": (
        _no_motor("gaintype", mujoco.mjtGain.mjGAIN_AFFINE),
        r'drive: gaintype = 1: .* needs gaintype="fixed"',
    ),
    "gainprm": (_no_motor("gainprm", 1.0), r'drive: gainprm = 1: .* needs gainprm="0"'),
    "actlimited": (_no_motor("actlimited", True), r'drive: actlimited = 1: .* needs actlimited="false"'),
    "negative gear": (_no_motor("gear", [-1, 0, 0, 0, 0, 0]), r"drive: gear = \[-1.*needs gear = 1/arm > 0"),
    "zero gear": (_no_motor("gear", 0.0), r"drive: gear = \[0.*needs gear = 1/arm > 0"),
    "gear of many entries": (_no_motor("gear", [1, 0, 2, 0, 0, 0]), r"drive: gear = .*no other entry"),
    "resistance": (_user("resistance", -1.0), r"drive: Motor\.resistance = -1\.0: must be a finite number > 0"),
    "kp": (_user("kp", np.nan), r"drive: CurrentLoop\.kp = nan: must be a finite number >= 0"),
    "substeps": (_user("substeps", np.inf), r"drive: CurrentLoop\.substeps = inf"),
    "bemf_compensation": (_user("bemf_compensation", 0.5), r"drive: CurrentLoop\.bemf_compensation = 0\.5"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_motor_that_would_not_run_as_described_is_refused_by_name(case):
    change, message = REFUSED[case]
    model = _spec().compile()
    assert len(motors(model)) == 1
    change(model)
    with pytest.raises(ValueError, match=message):
        motors(model)


def test_a_motor_without_a_name_is_called_by_its_index():
    spec = _spec()
    spec.actuator("drive").name = ""
    model = spec.compile()
    model.actuator_gainprm[0, 0] = 1.0
    with pytest.raises(ValueError, match="actuator 0: gainprm = 1"):
        motors(model)


def test_user_data_too_short_for_a_motor_is_refused():
    short = XML.replace(
        '<motor name="drive" joint="hinge"/>',
        f'<general name="drive" joint="hinge" dyntype="user" actdim="{SIZE}" gainprm="0" biastype="user"'
        f' user="{_text(user_head(Actuator))} 1"/>',
    )
    with pytest.raises(ValueError, match=r"drive: user = .*: a Actuator needs 3 numbers and resistance, inductance, "):
        motors(mujoco.MjModel.from_xml_string(short))


def test_a_default_gain_is_refused_though_it_would_add_nothing_to_the_torque():
    """The engine multiplies it with the last activation, which is 0."""
    user = _text([*user_head(Actuator), *Actuator().numbers])
    forgotten = XML.replace(
        '<motor name="drive" joint="hinge"/>',
        f'<general name="drive" joint="hinge" dyntype="user" actdim="{SIZE}" biastype="user" user="{user}"/>',
    )
    model = mujoco.MjModel.from_xml_string(forgotten)
    data = mujoco.MjData(model)
    engine.load_family(Actuator)
    engine.install()
    data.ctrl[0] = 100.0  # the voltage saturates
    mujoco.mj_step(model, data)
    engine.uninstall()
    assert data.act[signals_at(Actuator) + Actuator.Signals._fields.index("saturated")] == 1.0
    assert data.actuator_force[0] == data.act[Slot._fields.index("torque")] != 0.0
    with pytest.raises(ValueError, match="gainprm"):
        motors(model)


def test_a_family_that_nobody_knows_is_refused_with_the_remedy():
    model = _spec(Lag()).compile()
    model.actuator_user[0, 2] = 123456.0
    with pytest.raises(ValueError, match=r"drive: family 123456 is not known .* call codrl_mj\.engine\.load"):
        motors(model)


@pytest.mark.parametrize("task", TASKS)
def test_what_actuator_and_environment_add_to_the_joint_is_summed_there_alone(task):
    definition = TASKS[task]
    plain, added = (
        task_model(Plant(definition, (actuator,), joint=joint))
        for actuator, joint in ((Lag(), Joint()), (_Heavy(), Joint(damping=0.5, friction=0.25, armature=0.125)))
    )
    dof = np.arange(plain.nv) == plain.jnt_dofadr[plain.actuator("motor").trnid[0]]
    for field, sum_of_both in (("armature", 1.125), ("damping", 2.5), ("frictionloss", 3.25)):
        difference = getattr(added, f"dof_{field}") - getattr(plain, f"dof_{field}")
        np.testing.assert_array_equal(difference, np.where(dof, sum_of_both, 0.0))


@dataclasses.dataclass(frozen=True)
class _Heavy(Lag):
    """A lag with a rotor."""

    family = ""
    additions = JointAdditions(armature=1.0, damping=2.0, friction=3.0)
