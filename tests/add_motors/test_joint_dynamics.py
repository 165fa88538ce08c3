"""Damping, armature and friction that a model has for a motor: warned of, added or replaced."""

import math
import warnings

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply, TorqueSpeed
from codrl_mj.engine.joint_dynamics import MotorWarning
from codrl_mj.validation import validate_model

_ARM = """
<mujoco model="arm">
  <option gravity="0 0 0"/>
  <default><joint {}/></default>
  <worldbody>
    <body><joint name="shoulder" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 .1 0 0" size=".02" mass=".1"/></body>
  </worldbody>
  <actuator><velocity name="shoulder" joint="shoulder" kv="50" gear="{}"/></actuator>
</mujoco>
"""
OWN = 'damping="0.55" armature="0.03" frictionloss="0.05"'
RATIO, VOLTS, OHMS, CONSTANT = 100.0, 12.0, 2.0, 0.02
MOTOR = Drive(
    GearMotor(
        resistance=OHMS,
        torque_constant=CONSTANT,
        back_emf_constant=CONSTANT,
        rotor_inertia=1e-6,
        gear_ratio=RATIO,
    ),
    SampledLoop(10e3, max_current=math.inf),
    Supply(VOLTS),
)
STALL, FREE = RATIO * CONSTANT * VOLTS / OHMS, VOLTS / (CONSTANT * RATIO)


@pytest.fixture(autouse=True)
def _nothing_warned(monkeypatch):
    monkeypatch.setattr("codrl_mj.engine.joint_dynamics._WARNED", set())


def _arm(attributes=OWN, gear=1.0):
    return mujoco.MjSpec.from_string(_ARM.format(attributes, gear))


def _top_speed(model):
    data = mujoco.MjData(model)
    data.ctrl[0] = 100.0
    for _ in range(4000):
        mujoco.mj_step(model, data)
    return data.qvel[0]


@pytest.mark.parametrize("saved", [False, True])
def test_kept_losses_brake_a_joint_and_replaced_ones_do_not(saved):
    """Without a load, the speeds are (stall - friction)/(stall/free + damping) or the motor's."""
    models = {}
    for joint_dynamics in ("keep", "replace"):
        spec = codrl_mj.add_motors(_arm(), {"shoulder": MOTOR}, joint_dynamics=joint_dynamics)
        models[joint_dynamics] = (
            mujoco.MjModel.from_xml_string(spec.to_xml()) if saved else spec.compile()
        )
    assert _top_speed(models["keep"]) == pytest.approx(
        (STALL - 0.05) / (STALL / FREE + 0.55), rel=1e-3
    )
    assert models["replace"].dof_damping[0] == 0.0
    assert models["replace"].dof_armature[0] == 0.0
    # This motor has no friction of its own, so that of the model stays.
    assert models["replace"].dof_frictionloss[0] == 0.05
    assert _top_speed(models["replace"]) == pytest.approx((STALL - 0.05) / (STALL / FREE), rel=1e-3)


def test_the_warning_names_joint_values_and_remedy_once_at_the_callers_line():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            codrl_mj.add_motors(_arm(gear=2.0), {"shoulder": MOTOR})
    (warned,) = caught
    assert warned.filename == __file__
    text = str(warned.message)
    # kT*kE/R through the motor's gear and the model's; the rotor through both
    braking, rotor = 4 * RATIO**2 * CONSTANT**2 / OHMS, 4 * RATIO**2 * 1e-6
    assert (
        f"joint shoulder has armature 0.03 (the motor's is {rotor:.3g}), damping 0.55 (the"
        " motor's is" in text
    )
    assert f"{braking:.3g})" in text
    assert "joint_dynamics='replace'" in text
    assert "--env.joint-dynamics" in text


QUIET = [
    (OWN, MOTOR, "keep"),
    (OWN, MOTOR, "replace"),
    (OWN, "ideal", None),
    (OWN, "lag", None),
    # This motor has neither a rotor nor friction.
    ('armature="0.03" frictionloss="0.05"', TorqueSpeed(), None),
    # The damping is that of a bearing.
    ('damping="0.001"', TorqueSpeed(stall_torque=1.0, no_load_speed=10.0), None),
]


@pytest.mark.parametrize(("attributes", "actuator", "joint_dynamics"), QUIET)
def test_no_warning_where_nothing_can_be_counted_twice(attributes, actuator, joint_dynamics):
    with warnings.catch_warnings():
        warnings.simplefilter("error", MotorWarning)
        codrl_mj.add_motors(_arm(attributes), {"shoulder": actuator}, joint_dynamics=joint_dynamics)


def test_joint_dynamics_are_kept_by_default():
    with pytest.warns(MotorWarning):
        default = codrl_mj.add_motors(_arm(), {"shoulder": MOTOR}).to_xml()
    assert (
        default == codrl_mj.add_motors(_arm(), {"shoulder": MOTOR}, joint_dynamics="keep").to_xml()
    )


def test_actuators_and_tendons_can_have_duplicate_dynamics():
    spec = mujoco.MjSpec.from_string("""
<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1" mass="1"/></body></worldbody>
<tendon><fixed name="rope" damping="2" armature="0.5"><joint joint="j" coef="1"/></fixed></tendon>
<actuator><motor name="pull" tendon="rope" armature="0.25" damping="3"/></actuator></mujoco>""")
    with pytest.warns(
        MotorWarning,
        match=r"actuator pull has armature 0\.25.*damping 3.*tendon rope has armature 0\.5",
    ):
        codrl_mj.add_motors(spec, {"rope": MOTOR})
    model = codrl_mj.add_motors(spec, {"rope": MOTOR}, joint_dynamics="replace").compile()
    rotor = RATIO**2 * 1e-6
    assert (model.tendon_armature[0], model.tendon_damping[0]) == (0.0, 0.0)
    assert (model.actuator_armature[0], model.actuator_damping[0]) == (pytest.approx(rotor), 0.0)


def test_a_certificate_names_possible_duplicate_dynamics():
    def reasons(attributes):
        model = codrl_mj.add_motors(
            _arm(attributes), {"shoulder": MOTOR}, joint_dynamics="keep"
        ).compile()
        skipped = validate_model(model, quick=True).skipped
        return [
            check.reason for check in skipped if check.name == "whether a motor is counted twice"
        ]

    (reason,) = reasons(OWN)
    assert (
        "joint shoulder has armature 0.03 (the motor's is 0.01), damping 0.55 (the motor's is 2)"
        in reason
    )
    assert reasons('damping="0"') == []


def test_environments_and_configurations_have_joint_dynamics():
    arguments = {".*": MOTOR.replaced({"motor.gear_ratio": 1.0, "motor.rotor_inertia": 1e-4})}
    config = codrl_mj.EnvConfig(
        "InvertedPendulum-v5", arguments, joint_dynamics="replace", allow_unstable=True
    )
    again = codrl_mj.EnvConfig.from_mapping(config.as_mapping())
    assert again == config
    with pytest.warns(MotorWarning, match=r"joint slider has .*damping 1 \(") as caught:
        unchanged = codrl_mj.make("InvertedPendulum-v5", arguments, allow_unstable=True)
    assert caught[0].filename == __file__
    replaced, plain = again.build(), unchanged.unwrapped.model
    slider = plain.joint("slider").dofadr[0]
    assert plain.dof_damping[slider] == 1.0
    assert replaced.unwrapped.model.dof_damping[slider] == 0.0
    # A hinge without a motor keeps its damping.
    assert replaced.unwrapped.model.dof_damping[1 - slider] == plain.dof_damping[1 - slider] == 1.0
    for env in (unchanged, replaced):
        env.close()


def test_configurations_without_joint_dynamics_are_unchanged():
    """Names of runs are hashes of the mapping."""
    assert "joint_dynamics" not in codrl_mj.EnvConfig("HalfCheetah-v5").as_mapping()
    assert "joint_dynamics" not in codrl_mj.EnvConfig("pendulum").as_mapping()


@pytest.mark.parametrize(
    ("task", "value", "message"),
    [
        ("HalfCheetah-v5", "both", "joint_dynamics = 'both': must be keep, replace, or None"),
        ("pendulum", "replace", "joint_dynamics = 'replace': pendulum has no such field"),
    ],
)
def test_invalid_joint_dynamics_raise(task, value, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.EnvConfig(task, joint_dynamics=value)
    with pytest.raises(ValueError, match="joint_dynamics = 'both'"):
        codrl_mj.add_motors(_arm(), {"shoulder": MOTOR}, joint_dynamics="both")


def _legs(count, gravcomp=False):
    bodies = "".join(
        f'<body pos="0 {n} 0" gravcomp="{int(gravcomp)}"><joint name="j{n}" axis="0 1 0"'
        ' actuatorgravcomp="true"/><geom size=".1" mass="1" pos=".2 0 0"/></body>'
        for n in range(count)
    )
    motors = "".join(f'<motor name="m{n}" joint="j{n}"/>' for n in range(count))
    return mujoco.MjSpec.from_string(
        f"<mujoco><worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def test_several_supplies_with_resistance_cause_a_warning():
    weak = MOTOR.replaced({"supply.resistance": 0.5})
    with pytest.warns(
        MotorWarning, match=r"supply\.resistance: each of the motors m0, m1 has a separate supply"
    ):
        codrl_mj.add_motors(_legs(3), {"m[01]": weak, "m2": MOTOR})
    with warnings.catch_warnings():
        warnings.simplefilter("error", MotorWarning)
        codrl_mj.add_motors(_legs(2), {"m0": weak, "m1": MOTOR})


def test_gravity_compensation_past_a_motor_causes_a_warning():
    with pytest.warns(
        MotorWarning,
        match="joint j0: actuatorgravcomp: its gravity compensation passes through no motor",
    ):
        model = codrl_mj.add_motors(_legs(1, gravcomp=True), {"m0": "lag"}).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == 0.0  # why: MuJoCo delivers it all the same
    assert data.qfrc_actuator[0] == pytest.approx(-0.2 * 9.81)


def test_a_gear_without_a_rotor_keeps_the_models_armature():
    bare = MOTOR.replaced({"motor.rotor_inertia": 0.0})
    model = codrl_mj.add_motors(_arm(), {"shoulder": bare}, joint_dynamics="replace").compile()
    assert model.dof_armature[0] == 0.03
    np.testing.assert_array_equal(model.dof_damping, [0.0])
