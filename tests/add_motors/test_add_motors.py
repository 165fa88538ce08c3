"""`add_motors`: patterns, refusals with their reasons, and additions to joints."""

import re

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Drive, GearMotor, Ideal, Lag
from tests.add_motors.models import LOOP, Worn, arm, controls, own_controls, trajectory

_MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body><joint name="hip_left" axis="0 1 0" range="-2 2"/><joint name="hip_right" type="slide"/>
      <geom size=".1" mass="1"/><site name="here"/><site name="there" pos=".1 0 0"/></body>
    <body pos="1 0 0"><joint name="ball" type="ball"/><geom size=".1" mass="1"/></body>
    <body pos="2 0 0"><freejoint name="free"/><geom size=".1" mass="1"/></body>
  </worldbody>
  <tendon>
    <fixed name="rope"><joint joint="hip_left" coef="1"/></fixed>
    <fixed name="weak_rope" actuatorfrclimited="true" actuatorfrcrange="-1 1"><joint joint="hip_left" coef="1"/></fixed>
  </tendon>
  <actuator>{}</actuator>
</mujoco>
"""


def _spec(*actuators):
    return mujoco.MjSpec.from_string(_MODEL.format("".join(actuators)))


THREE = (
    '<motor name="left" joint="hip_left"/>',
    '<motor joint="hip_right"/>',
    '<motor name="rope" tendon="rope"/>',
)


def test_patterns_match_whole_names_of_actuators_or_their_targets():
    lag = Lag(time_constant=0.1)
    model = codrl_mj.add_motors(_spec(*THREE), {"left": lag, "hip_r.*": LOOP}).compile()
    assert codrl_mj.engine.motors(model) == {0: lag, 1: LOOP}
    model = codrl_mj.add_motors(_spec(*THREE), {"hip_.*": "lag", "rope": "ideal"}).compile()
    assert codrl_mj.engine.motors(model) == {0: Lag(), 1: Lag(), 2: Ideal()}


@pytest.mark.parametrize(
    ("actuator", "expected"),
    [
        (None, Ideal()),
        ({"family": "lag", "time_constant": 0.2}, Lag(time_constant=0.2)),
        ({"controller": {"kp": 3.0}}, DCMotorActuator(controller=CurrentLoop(kp=3.0))),
        ("tests.add_motors.models:Worn", Worn()),
        ("tests.add_motors.models:LOOP", LOOP),
    ],
)
def test_actuators_have_the_usual_forms(actuator, expected):
    assert codrl_mj.engine.motors(codrl_mj.add_motors(arm(), {"one": actuator}).compile()) == {
        0: expected
    }


def test_the_spec_is_not_changed_and_allow_unstable_accepts_unstable_motors():
    spec, unstable = arm(), DCMotorActuator(controller=CurrentLoop(kp=500.0))
    before = spec.to_xml()
    model = codrl_mj.add_motors(spec, {".*": unstable}, allow_unstable=True).compile()
    assert codrl_mj.engine.motors(model) == {0: unstable, 1: unstable}
    assert spec.to_xml() == before


# An actuator that cannot have a motor, and the reason.
IMPOSSIBLE = [
    ('<muscle name="it" joint="hip_left"/>', "mjDYN_MUSCLE"),
    ('<dcmotor name="it" joint="hip_left" motorconst="1" resistance="1"/>', "mjDYN_DCMOTOR"),
    ('<pid name="it" joint="hip_left" kp="1"/>', "mjGAIN_PID"),
    ('<orientation name="it" joint="ball" kp="1" input="quat"/>', "mjGAIN_SO3"),
    ('<general name="it" joint="hip_left" dyntype="user" actdim="1"/>', "mjDYN_USER"),
    ('<general name="it" joint="hip_left" biastype="user"/>', "mjBIAS_USER"),
    ('<adhesion name="it" body="world" ctrlrange="0 1"/>', "mjTRN_BODY"),
    ('<motor name="it" joint="ball" gear="1 0 0"/>', "neither a hinge nor a slide"),
    ('<motor name="it" joint="free" gear="1 0 0 0 0 0"/>', "neither a hinge nor a slide"),
    ('<motor name="it" site="here" refsite="there" gear="1 0 0 0 0 0"/>', "reference site"),
    ('<motor name="it" joint="hip_left" delay="0.02" nsample="3"/>', "delayed"),
    ('<motor name="it" joint="hip_left" user="0 1"/>', "has user data"),
    ('<motor name="it" tendon="weak_rope"/>', "limits the force of its actuators"),
]
STEEP = DCMotorActuator(controller=CurrentLoop(kp=500.0))
RUBBING = Drive(GearMotor(coulomb_friction=1e-3))
TWICE = "'.*' matches both actuator kp of hip_left and actuator kv of hip_left: each"
PAIR = (
    '<position name="kp" joint="hip_left" kp="5"/>',
    '<velocity name="kv" joint="hip_left" kv="0.5"/>',
)
SITE = '<general name="push" site="here" gear="1 0 0 0 0 0"/>'


@pytest.mark.parametrize(
    ("actuators", "patterns", "message"),
    [
        *(
            ((element,), {".*": "ideal"}, f"^actuator it of [a-z_]+: cannot have a motor: .*{why}")
            for element, why in IMPOSSIBLE
        ),
        ((SITE,), {"push": RUBBING}, "it drives neither a joint nor a tendon, to which MuJoCo"),
        (
            THREE,
            {"hip": "lag"},
            "'hip': no actuator has such a name, nor drives a target of this name",
        ),
        (
            THREE,
            {"hip_rihgt": "lag"},
            r"did you mean 'hip_right'\? there are left, hip_left, hip_right, ",
        ),
        ((), {".*": "lag"}, "the model has no actuators.*mechanicalReduction.*Add one per joint"),
        (
            THREE,
            {"left": "lag", "hip_.*": "ideal"},
            r"actuator left of hip_left: both 'left' and 'hip_.*' match it",
        ),
        (PAIR, {".*": "lag"}, re.escape(TWICE)),
        (THREE, {"*": "lag"}, r"'\*': must be a regular expression \(nothing to repeat"),
        (THREE, {3: "lag"}, "3: must be a regular expression"),
        (THREE, [".*"], r"actuators = \['\.\*'\]: must be a mapping of patterns"),
        (
            THREE,
            {"left": STEEP},
            r"'left': actuator: the current loop is unstable at a step of 0.01 s",
        ),
    ],
)
def test_add_motors_raises_and_names_the_reason(actuators, patterns, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.add_motors(_spec(*actuators), patterns)


def test_allow_unstable_does_not_accept_invalid_actuators():
    with pytest.raises(ValueError, match=r"'one': Lag\.delay = 5: must be <= 0\.04 s"):
        codrl_mj.add_motors(arm(), {"one": Lag(delay=5.0)}, allow_unstable=True)


def test_actuators_with_plugins_or_our_motors_do_not_get_a_second_motor():
    once = codrl_mj.add_motors(arm(), {"one": "lag"})
    with pytest.raises(
        ValueError,
        match=r"actuator one of upper: cannot have a motor: it is a plugin, codrl_mj\.actuator",
    ):
        codrl_mj.add_motors(once, {"one": "ideal"})
    twice = codrl_mj.add_motors(once, {"two": "ideal"}).compile()
    assert codrl_mj.engine.motors(twice) == {0: Lag(), 1: Ideal()}


def test_the_limit_of_a_tendon_is_not_applied_to_plugins():
    """Check the reason for a refusal: MuJoCo ignores plugins when it limits a tendon's force."""
    spec = _spec('<motor tendon="weak_rope"/>')
    forces = []
    for plugin in (False, True):
        if plugin:
            spec.activate_plugin("mujoco.pid")
            spec.add_plugin(name="p", plugin_name="mujoco.pid").config = {"kp": "9"}
            target = spec.actuators[0]
            target.plugin.plugin_name, target.plugin.name, target.plugin.active = (
                "mujoco.pid",
                "p",
                True,
            )
        model = spec.compile()
        data = mujoco.MjData(model)
        data.ctrl[:] = 5.0
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force[0])
    assert forces == [1.0, 45.0]


def test_actuators_of_one_joint_get_several_motors_by_several_patterns():
    plain, ours = (
        _spec(*PAIR).compile(),
        codrl_mj.add_motors(_spec(*PAIR), {"kp": "ideal", "kv": "ideal"}).compile(),
    )
    inputs = controls(100, 2)
    np.testing.assert_array_equal(trajectory(ours, inputs), trajectory(plain, inputs))


def test_two_motors_of_one_joint_equal_one_that_is_twice_as_strong():
    """A lag is linear, and halves and doubles are exact."""
    lag = Lag(time_constant=0.05)
    two = _spec(
        '<motor name="a" joint="hip_left" gear="2"/>', '<motor name="b" joint="hip_left" gear="2"/>'
    )
    single = _spec('<motor name="a" joint="hip_left" gear="4"/>')
    inputs = controls(100, 1)
    together = trajectory(
        codrl_mj.add_motors(two, {"a": lag, "b": lag}).compile(), np.tile(inputs, 2)
    )
    expected = trajectory(codrl_mj.add_motors(single, {"a": lag}).compile(), inputs)
    count = single.compile().nq + single.compile().nv
    np.testing.assert_array_equal(together[:, :count], expected[:, :count])


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
def test_inertia_and_friction_are_added_to_the_joint_through_the_gear(integrator):
    """The gear acts once on torque, twice on inertia and damping; existing values are kept."""

    def make_spec():
        spec = arm(integrator)
        spec.actuator("one").gear = [3.0, 0, 0, 0, 0, 0]
        spec.actuator("one").armature = 0.01
        spec.joint("upper").armature, spec.joint("upper").frictionloss = 0.02, 0.03
        return spec

    by_hand = make_spec()
    by_hand.joint("upper").armature += 9 * 0.004
    by_hand.joint("upper").damping[0] += 9 * 2 * 0.004
    by_hand.joint("upper").frictionloss += 3 * 3 * 0.004
    added = codrl_mj.add_motors(make_spec(), {"one": Worn(rotor=0.004)}, joint_dynamics="keep")
    expected = codrl_mj.add_motors(by_hand, {"one": Worn()})
    inputs = controls(200, 2)
    np.testing.assert_allclose(
        trajectory(added.compile(), inputs), trajectory(expected.compile(), inputs), atol=1e-11
    )
    plain = trajectory(codrl_mj.add_motors(make_spec(), {"one": Worn()}).compile(), inputs)
    assert not np.allclose(trajectory(added.compile(), inputs), plain, atol=1e-3)


def test_friction_goes_to_a_tendon_that_is_driven():
    model = codrl_mj.add_motors(
        _spec('<motor name="m" tendon="rope" gear="-2"/>'), {"m": Worn(rotor=0.1)}
    ).compile()
    assert model.tendon_frictionloss[0] == pytest.approx(2 * 3 * 0.1)
    assert model.actuator_armature[0] == 0.1


def test_models_with_motors_are_attached_to_others():
    child = codrl_mj.add_motors(arm(), {"one": LOOP, "two": "lag"})
    scene = mujoco.MjSpec()
    scene.option.timestep = child.option.timestep
    for name in ("a", "b"):
        scene.attach(child.copy(), prefix=f"{name}/", frame=scene.worldbody.add_frame())
    model = scene.compile()
    assert list(codrl_mj.engine.motors(model).values()) == [LOOP, Lag(), LOOP, Lag()]
    single = child.compile()
    inputs = own_controls(single, 100)
    both, expected = trajectory(model, np.tile(inputs, 2)), trajectory(single, inputs)
    np.testing.assert_allclose(both[:, :2], expected[:, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(both[:, 2:4], expected[:, :2], rtol=0, atol=1e-12)


CABLE = """
<mujoco>
  <worldbody><site name="spool" pos="-.05 0 .02"/>
    <body><joint name="knuckle" axis="0 1 0"/><geom name="pulley" type="cylinder" size=".01 .01" euler="90 0 0"/>
      <geom type="capsule" fromto="0 0 0 .05 0 0" size=".006"/><site name="pull" pos=".03 0 .008"/>
      <site name="side" pos="0 0 .02"/></body></worldbody>
  <tendon><spatial name="rope"><site site="spool"/>{}<site site="pull"/></spatial></tendon>
  <actuator><motor name="flexor" tendon="rope"/></actuator>
</mujoco>
"""
PULLEY = '<geom geom="pulley" sidesite="side"/>'


def test_a_rotor_on_a_tendon_around_a_geom_raises():
    around, straight = (mujoco.MjSpec.from_string(CABLE.format(via)) for via in (PULLEY, ""))
    message = (
        "actuator flexor of rope: cannot have a motor: its tendon wraps around geom pulley, where"
        " MuJoCo has no"
    )
    with pytest.raises(ValueError, match=message):
        codrl_mj.add_motors(around, {"flexor": Worn(rotor=0.1)})
    codrl_mj.add_motors(around, {"flexor": Worn()}).compile()
    assert (
        codrl_mj.add_motors(straight, {"flexor": Worn(rotor=0.1)}).compile().actuator_armature[0]
        == 0.1
    )
    around.actuators[0].armature = 0.1
    with pytest.raises(
        ValueError, match="geom wrapping"
    ):  # why: MuJoCo says this of any armature there
        around.compile()


def test_a_urdf_s_joint_gets_a_motor_as_the_message_says():
    urdf = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/><origin xyz="0.1 0 0"/>
<inertia ixx=".001" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="shoulder"
type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5"
velocity="3"/></joint></robot>"""
    spec = mujoco.MjSpec.from_string(urdf)
    with pytest.raises(ValueError, match="'shoulder': the model has no actuators") as refused:
        codrl_mj.add_motors(spec, {"shoulder": "lag"})
    remedy = (
        re.search(r"spec\.add_actuator\(.*\)", str(refused.value))
        .group()
        .replace("'JOINT'", "'shoulder'")
    )
    eval(remedy, {"spec": spec, "mujoco": mujoco})
    model = codrl_mj.add_motors(spec, {"shoulder": "ideal"}).compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.5
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == 0.5


@pytest.mark.parametrize(("kind", "controls"), [("position", "velocity"), ("velocity", "position")])
def test_a_servo_reads_controls_in_the_models_units(kind, controls):
    """Otherwise 0.5 rad/s would be read as 0.5 rad, or the reverse."""
    spec = _spec(f'<{kind} name="it" joint="hip_left"/>')
    servo = {"family": "servo", "controller": {"sample_rate": 10e3}, "loop": {"controls": controls}}
    with pytest.raises(
        ValueError, match=f"its control is a {kind}, but its motor's command is a {controls}"
    ):
        codrl_mj.add_motors(spec, {"it": servo}, allow_unstable=True)
    servo["loop"]["controls"] = kind
    codrl_mj.add_motors(spec, {"it": servo}, allow_unstable=True)
