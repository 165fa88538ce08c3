"""Actuators written into an MJCF model and read back, and errors."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codrl_mj import engine
from codrl_mj.actuators import (
    IDEAL,
    CurrentLoop,
    DCMotorActuator,
    JointAdditions,
    Lag,
    Motor,
    parameters_type,
)
from codrl_mj.disturbances import Joint
from codrl_mj.engine import motors
from codrl_mj.engine.families import USER_HEADER_SIZE, slot_size, user_header
from codrl_mj.physics import MujocoPhysics, SimulationConfig
from codrl_mj.physics.mjcf import configure_actuator, task_model
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics
from codrl_mj.tasks import TASKS
from codrl_mj.user_code import asset_path
from tests.actuators.strategies import of_every_family

SIZE = slot_size(DCMotorActuator)
XML = """
<mujoco>
  <compiler autolimits="false"/>
  <worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""


def _spec(actuator=None, max_force=None):
    spec = mujoco.MjSpec.from_string(XML)
    configure_actuator(spec.actuator("drive"), actuator or DCMotorActuator(), max_force)
    return spec


@given(of_every_family, st.none() | st.floats(1e-3, 1e3))
def test_every_family_round_trips_and_the_ideal_actuator_is_plain(actuator, max_force):
    engine.load_family(type(actuator))
    model = _spec(actuator, max_force).compile()
    actuators = motors(model)
    assert {index: type(read_actuator) for index, read_actuator in actuators.items()} == (
        {} if actuator == IDEAL else {0: type(actuator)}
    )
    # The arm is stored as gear = 1/arm.
    for read_actuator in actuators.values():
        assert read_actuator.parameter_values == actuator.parameter_values
        assert read_actuator.arm_radius == pytest.approx(actuator.arm_radius, rel=1e-15)
    assert model.actuator_ctrllimited[0] == (max_force is not None)
    # The limit is the largest torque at the shaft.
    if max_force is not None:
        limit = max_force * actuator.arm_radius
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-limit, limit]])


def test_arm_and_limits_are_correct_after_an_actuator_with_several_outputs(tmp_path):
    """Check a compiled, a replaced and a batched actuator."""
    asset, text = tmp_path / "pendulum.xml", asset_path("pendulum.xml").read_text()
    for mark, beside in (
        ("<worldbody>", '<site name="base"/>'),
        ('<body name="rod">', '<site name="tip"/>'),
        ("<actuator>", '<orientation name="wrist" site="tip" refsite="base"/>'),
    ):
        text = text.replace(mark, mark + beside)
    asset.write_text(text)
    task, (short, long) = (
        dataclasses.replace(TASKS["pendulum"], asset=str(asset)),
        (Motor(arm_radius=0.2), Motor()),
    )
    compiled, exchanged = (
        MujocoPhysics(SimulationConfig(task, [DCMotorActuator(motor)])) for motor in (long, short)
    )
    exchanged.set_actuators([DCMotorActuator(long)])
    batch = MujocoBatchPhysics(
        SimulationConfig(task, [DCMotorActuator(short)]), [[DCMotorActuator(long)]]
    )
    assert compiled.model.nout > compiled.model.nactuator
    for field in ("actuator_gear", "actuator_ctrlrange", "actuator_user"):
        np.testing.assert_array_equal(
            getattr(exchanged.model, field), getattr(compiled.model, field)
        )
        np.testing.assert_array_equal(batch.field(field)[0], getattr(compiled.model, field))


def test_the_ideal_actuator_replaces_everything_by_a_plain_motor_of_gear_one():
    spec = _spec(DCMotorActuator(Motor(arm_radius=0.2)), 3.0)
    configure_actuator(spec.actuator("drive"), IDEAL, None)
    model, plain = spec.compile(), mujoco.MjModel.from_xml_string(XML)
    assert (
        motors(model) == motors(plain) == motors(mujoco.MjModel.from_xml_string("<mujoco/>")) == {}
    )
    assert model.na == 0
    for field in (
        "dyntype",
        "gaintype",
        "gainprm",
        "biastype",
        "biasprm",
        "gear",
        "ctrllimited",
        "actnum",
    ):
        np.testing.assert_array_equal(
            getattr(model, f"actuator_{field}"), getattr(plain, f"actuator_{field}")
        )


def test_motors_are_read_by_index_in_order():
    spec = _spec()
    for index in range(3):
        driver = spec.add_actuator(
            name=f"extra{index}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge"
        )
        if index != 1:
            configure_actuator(
                driver, DCMotorActuator(controller=CurrentLoop(kp=float(index + 2))), None
            )
    actuators = motors(spec.compile())
    assert {index: actuator.controller.kp for index, actuator in actuators.items()} == {
        0: 1.0,
        1: 2.0,
        3: 4.0,
    }


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("dyntype", mujoco.mjtDyn.mjDYN_FILTER, r'dyntype = 2: .* needs dyntype="user"'),
        ("biastype", mujoco.mjtBias.mjBIAS_AFFINE, r'biastype = 1: .* needs biastype="user"'),
        ("actnum", 7, rf'actdim = 7: .* needs actdim="{SIZE}"'),
        ("delay", 0.01, r'delay = 0\.01: .* needs delay="0"'),
        ("gaintype", mujoco.mjtGain.mjGAIN_AFFINE, r'gaintype = 1: .* needs gaintype="fixed"'),
        ("gainprm", 1.0, r'gainprm = 1: .* needs gainprm="0"'),
        ("actlimited", True, r'actlimited = 1: .* needs actlimited="false"'),
        ("gear", [-1, 0, 0, 0, 0, 0], r"gear = \[-1.*needs gear = 1/arm > 0"),
        ("gear", 0.0, r"gear = \[0.*needs gear = 1/arm > 0"),
        ("gear", [1, 0, 2, 0, 0, 0], r"gear = .*no other entry"),
        ("resistance", -1.0, r"Motor\.resistance = -1\.0: must be a finite number > 0"),
        ("kp", np.nan, r"CurrentLoop\.kp = nan: must be a finite number >= 0"),
        ("substeps", np.inf, r"CurrentLoop\.substeps = inf"),
        ("bemf_compensation", 0.5, r"CurrentLoop\.bemf_compensation = 0\.5"),
        ("family", 123456.0, r"family 123456 is not known .* call codrl_mj\.engine\.load"),
    ],
)
@pytest.mark.parametrize(("name", "called"), [("drive", "drive"), ("", "actuator 0")])
def test_raises_with_the_name_of_an_inconsistent_motor(name, called, field, value, message):
    spec = _spec()
    spec.actuator("drive").name = name
    model = spec.compile()
    assert len(motors(model)) == 1
    numbers = parameters_type(DCMotorActuator)._fields
    if field in numbers:
        model.actuator_user[0, USER_HEADER_SIZE + numbers.index(field)] = value
    elif field == "family":
        model.actuator_user[0, 2] = value
    else:
        getattr(model, f"actuator_{field}")[0] = value
    with pytest.raises(ValueError, match=f"{called}: {message}"):
        motors(model)


def test_raises_if_the_user_data_is_too_short():
    user = " ".join(map(repr, [*user_header(DCMotorActuator), 1]))
    short = XML.replace(
        '<motor name="drive" joint="hinge"/>',
        f'<general name="drive" joint="hinge" dyntype="user" actdim="{SIZE}" gainprm="0"'
        f' biastype="user" user="{user}"/>',
    )
    with pytest.raises(
        ValueError,
        match=r"drive: user = .*: a DCMotorActuator needs 3 numbers and resistance, inductance, ",
    ):
        motors(mujoco.MjModel.from_xml_string(short))


@dataclasses.dataclass(frozen=True)
class _Heavy(Lag):
    """Lag with a rotor."""

    family = ""
    additions = JointAdditions(armature=1.0, damping=2.0, friction=3.0)


@pytest.mark.parametrize("task", TASKS)
def test_additions_of_actuator_and_environment_are_summed_at_the_joint(task):
    plain, added = (
        task_model(SimulationConfig(TASKS[task], (actuator,), joint=joint))
        for actuator, joint in (
            (Lag(), Joint()),
            (_Heavy(), Joint(damping=0.5, friction=0.25, armature=0.125)),
        )
    )
    dof = np.arange(plain.nv) == plain.jnt_dofadr[plain.actuator("motor").trnid[0]]
    for field, sum_of_both in (("armature", 1.125), ("damping", 2.5), ("frictionloss", 3.25)):
        difference = getattr(added, f"dof_{field}") - getattr(plain, f"dof_{field}")
        np.testing.assert_array_equal(difference, np.where(dof, sum_of_both, 0.0))
