"""Models for other simulators: inertia and friction in the joints, matched motors, refusals."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, UnstableError
from codrl_mj.arrays.models import prepare_model
from codrl_mj.engine.joint_dynamics import MotorWarning
from tests.arrays.models import (
    CATALOGUE_MOTOR,
    CHEETAH,
    cheetah,
    pendulum,
    servo,
    two_joints,
    with_our_motors,
)


def inertia_matrix(model, qpos):
    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    for row, unit in zip(matrix, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    return matrix


def test_inertia_and_friction_through_a_gear_are_those_of_our_engine():
    motor = CATALOGUE_MOTOR.replaced(
        {"motor.viscous_friction": 1e-6, "motor.coulomb_friction": 1e-3}
    )
    actuators = {"first": motor, "second": motor}
    spec = two_joints()
    model, ours = prepare_model(spec, actuators).spec.compile(), with_our_motors(spec, actuators)
    positions = [0.3, -0.7]
    np.testing.assert_allclose(
        inertia_matrix(model, positions), inertia_matrix(ours, positions), rtol=1e-12
    )
    np.testing.assert_allclose(model.dof_frictionloss, ours.dof_frictionloss, rtol=1e-12)
    damping = motor.additions.damping * np.array([1.0, 4.0])
    np.testing.assert_allclose(model.dof_damping, 0.01 + damping, rtol=1e-12)
    assert model.dof_armature[1] == 4.0 * model.dof_armature[0] > 0.0
    assert not model.actuator_armature.any()
    assert model.nplugin == 0


def test_the_model_is_not_changed():
    spec = two_joints()
    before = spec.to_xml()
    prepare_model(spec, {"first": CATALOGUE_MOTOR, "second": servo()})
    assert spec.to_xml() == before


@pytest.mark.filterwarnings("ignore:compiler attribute", "ignore:the model")
def test_patterns_match_actuators_and_joints_in_a_file():
    mapping = {"name": "maxon-ec45-flat-50w", "motor": {"gear_ratio": 9.0}}
    robot = prepare_model(
        CHEETAH, {"b.*": mapping, "ffoot": "lag", "fshin": "tests.arrays.gearbox:Gearbox"}
    )
    assert [motor.actuator_index for motor in robot.motors] == [0, 1, 2, 4, 5]
    assert [type(motor.actuator).__name__ for motor in robot.motors] == [
        *["Drive"] * 3,
        "Gearbox",
        "Lag",
    ]
    assert robot.motors[0].actuator.motor.gear_ratio == 9.0
    assert robot.names[0] == ("bthigh", "bthigh")
    assert robot.timestep == 0.01


def test_limits_of_the_force_are_kept():
    (motor,) = prepare_model(pendulum(), {"hinge": "lag"}).motors
    assert (motor.min_force, motor.max_force) == (-4.0, 4.0)
    first, _ = prepare_model(two_joints(), {".*": "lag"}).motors
    assert (first.min_force, first.max_force) == (-np.inf, np.inf)


def test_a_servo_gets_the_control_itself():
    first = 'position name="first" joint="a" kp="6" kv="0.3" forcerange="-3 3"'
    robot = prepare_model(two_joints(first=first), {"first": servo()})
    model = robot.spec.compile()
    assert model.actuator_gainprm[0, 0] == 1.0
    assert not model.actuator_biasprm[0].any()
    assert not model.actuator_forcelimited[0]
    assert robot.motors[0].max_force == 3.0


KINDS = {
    "mjTRN_SITE": ('<site name="tip"/>', '<motor site="tip" name="m"/>', ""),
    "mjTRN_TENDON": (
        "",
        '<motor tendon="rope" name="m"/>',
        '<tendon><fixed name="rope"><joint joint="h" coef="1"/></fixed></tendon>',
    ),
    "mjTRN_JOINTINPARENT": ("", '<motor jointinparent="h" name="m"/>', ""),
    "activation dynamics, mjDYN_FILTER": (
        "",
        '<general joint="h" name="m" dyntype="filter" dynprm="0.1"/>',
        "",
    ),
    "armature or a damping of its own": ("", '<motor joint="h" name="m" armature="0.1"/>', ""),
    "group 3 is disabled": (
        "",
        '<motor joint="h" name="m" group="3"/>',
        '<option actuatorgroupdisable="3"/>',
    ),
}


@pytest.mark.parametrize("reason", KINDS)
def test_kinds_that_were_not_tested_are_refused_by_name(reason):
    site, actuator, element = KINDS[reason]
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><worldbody><body><joint name='h'/><geom size='.1'/>{site}</body></worldbody>"
        f"{element}<actuator>{actuator}</actuator></mujoco>"
    )
    with pytest.raises(ValueError, match=f"actuator m.*another simulator: .*{reason}"):
        prepare_model(spec, {"m": "lag"})


def test_a_shared_motor_and_sleeping_bodies_are_refused():
    spec = two_joints()
    spec.add_actuator(name="third", target="a", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    with pytest.raises(ValueError, match="'first & third': several actuators cannot share a motor"):
        prepare_model(spec, {"first & third": "lag"})
    spec = two_joints()
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    with pytest.raises(ValueError, match="remove the flag 'sleep'"):
        prepare_model(spec, {"first": "lag"})


def test_a_model_that_is_no_model_is_refused():
    with pytest.raises(
        ValueError, match=r"model = 'robot.xml': must be a mujoco.MjSpec, or the path"
    ):
        prepare_model("robot.xml", {"first": "lag"})


def test_unstable_motors_are_refused_with_a_remedy_as_in_our_engine():
    unstable, messages = servo().replaced({"loop.velocity_gain": 200.0}), []
    for function in (prepare_model, codrl_mj.add_motors):
        with pytest.raises(
            UnstableError, match=r"unstable: .* A shorter step does not help"
        ) as error:
            function(pendulum(), {"motor": unstable})
        messages.append(str(error.value))
    assert messages[0] == messages[1]
    prepare_model(pendulum(), {"motor": unstable}, allow_unstable=True)
    with pytest.raises(ValueError, match=r"'motor': .*unstable at a step of 0.002 s.*substeps"):
        prepare_model(pendulum(), {"motor": {"family": "current_loop", "controller": {"kp": 1e4}}})


def test_dynamics_that_count_twice_are_reported_or_removed():
    spec = two_joints(joint='armature="0.02"')
    actuators = {"first": Drive(CATALOGUE_MOTOR.motor, CATALOGUE_MOTOR.controller)}
    with pytest.warns(MotorWarning, match="joint a has armature 0.02"):
        prepare_model(spec, actuators)
    replaced = prepare_model(spec, actuators, joint_dynamics="replace").spec.compile()
    assert replaced.dof_armature[0] == CATALOGUE_MOTOR.additions.armature
    summed = prepare_model(spec, actuators, joint_dynamics="keep").spec.compile()
    assert summed.dof_armature[0] == CATALOGUE_MOTOR.additions.armature + 0.02


@pytest.mark.filterwarnings("ignore:compiler attribute")
def test_motors_of_a_cheetah_are_stable():
    assert len(prepare_model(cheetah(), {".*": CATALOGUE_MOTOR}, joint_dynamics="keep").motors) == 6
