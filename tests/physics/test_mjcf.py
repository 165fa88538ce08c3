"""An actuator written into an MJCF model and read back, and what is refused."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import codrl_mj
from codrl_mj import callbacks
from codrl_mj.motor import Actuator, CurrentLoop, Motor, to_vector
from codrl_mj.motor.parameters import PARAMETER_NAMES
from codrl_mj.physics import motors, set_actuator
from tests.motor.strategies import actuators

XML = """
<mujoco>
  <compiler autolimits="false"/>
  <worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""


def _spec(actuator=None, max_force=None):
    spec = mujoco.MjSpec.from_string(XML)
    set_actuator(spec.actuator("drive"), actuator or Actuator(), max_force)
    return spec


@given(actuators, st.none() | st.floats(1e-3, 1e3))
def test_an_actuator_comes_back_as_it_was_written(actuator, max_force):
    model = _spec(actuator, max_force).compile()
    ((index, found),) = motors(model).items()
    assert index == 0
    assert found.controller == actuator.controller
    for field in ("resistance", "inductance", "torque_constant", "back_emf_constant"):
        assert getattr(found.motor, field) == getattr(actuator.motor, field)
    assert found.motor.arm_radius == pytest.approx(actuator.motor.arm_radius, rel=1e-15)  # through gear = 1/arm


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
    set_actuator(spec.actuator("drive"), None, None)
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
            set_actuator(driver, Actuator(controller=CurrentLoop(kp=float(index + 2))), None)
    found = motors(spec.compile())
    assert {index: actuator.controller.kp for index, actuator in found.items()} == {0: 1.0, 1: 2.0, 3: 4.0}


def test_the_package_offers_both_functions():
    assert codrl_mj.motors is motors
    assert codrl_mj.set_actuator is set_actuator


def _no_motor(field, value):
    def change(model):
        getattr(model, f"actuator_{field}")[0] = value

    return change


def _user(name, value):
    def change(model):
        model.actuator_user[0, PARAMETER_NAMES.index(name)] = value

    return change


REFUSED = {
    "dyntype": (_no_motor("dyntype", mujoco.mjtDyn.mjDYN_FILTER), r'drive: dyntype = 2: .* needs dyntype="user"'),
    "biastype": (_no_motor("biastype", mujoco.mjtBias.mjBIAS_AFFINE), r'drive: biastype = 1: .* needs biastype="user"'),
    "actdim": (_no_motor("actnum", 7), r'drive: actdim = 7: .* needs actdim="8"'),
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
    "resistance": (_user("resistance", -1.0), r"drive: Motor\.resistance = -1: must be > 0"),
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
        '<general name="drive" joint="hinge" dyntype="user" actdim="8" gainprm="0" biastype="user"'
        ' user="2507.00268 1"/>',
    )
    with pytest.raises(ValueError, match=r"drive: actuator user data .* must hold 14 numbers"):
        motors(mujoco.MjModel.from_xml_string(short))


def test_a_default_gain_would_add_the_voltage_to_the_torque():
    """Why a gain is refused: the engine multiplies it with the last activation, which is the voltage."""
    user = " ".join(map(repr, to_vector(Actuator())))
    forgotten = XML.replace(
        '<motor name="drive" joint="hinge"/>',
        f'<general name="drive" joint="hinge" dyntype="user" actdim="8" biastype="user" user="{user}"/>',
    )
    model = mujoco.MjModel.from_xml_string(forgotten)
    data = mujoco.MjData(model)
    callbacks.install()
    data.ctrl[0] = 1.0
    mujoco.mj_step(model, data)
    callbacks.uninstall()
    assert data.actuator_force[0] == pytest.approx(data.act[4] + data.act[7])
    with pytest.raises(ValueError, match="gainprm"):
        motors(model)
