"""`motorise`: what goes where, what is refused and why, and what is added to joints."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Actuator, CurrentLoop, Ideal, Lag
from tests.motorised.models import LOOP, Worn, arm, controls, own_controls, trajectory

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


def test_patterns_match_names_or_what_is_driven_from_beginning_to_end():
    lag, loop = Lag(time_constant=0.1), LOOP
    model = codrl_mj.motorise(_spec(*THREE), {"left": lag, "hip_r.*": loop}).compile()
    assert codrl_mj.engine.motors(model) == {0: lag, 1: loop}
    model = codrl_mj.motorise(_spec(*THREE), {"hip_.*": "lag", "rope": "ideal"}).compile()
    assert codrl_mj.engine.motors(model) == {0: Lag(), 1: Lag(), 2: Ideal()}
    with pytest.raises(ValueError, match="'hip': no actuator has such a name, nor drives anything that has"):
        codrl_mj.motorise(_spec(*THREE), {"hip": "lag"})


def test_a_pattern_that_matches_nothing_is_refused_with_what_there_is():
    with pytest.raises(
        ValueError, match=r"'hip_rihgt'.*did you mean 'hip_right'\? there are left, hip_left, hip_right, "
    ):
        codrl_mj.motorise(_spec(*THREE), {"hip_rihgt": "lag"})
    with pytest.raises(ValueError, match="there are none"):
        codrl_mj.motorise(_spec(), {".*": "lag"})


def test_two_patterns_for_one_actuator_are_refused():
    with pytest.raises(ValueError, match=r"actuator left of hip_left: both 'left' and 'hip_.*' match it"):
        codrl_mj.motorise(_spec(*THREE), {"left": "lag", "hip_.*": "ideal"})


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, Ideal()),
        ({"family": "lag", "time_constant": 0.2}, Lag(time_constant=0.2)),
        ({"controller": {"kp": 3.0}}, Actuator(controller=CurrentLoop(kp=3.0))),
        ("tests.motorised.models:Worn", Worn()),
        ("tests.motorised.models:LOOP", LOOP),
    ],
)
def test_actuators_are_given_as_everywhere(given, expected):
    assert codrl_mj.engine.motors(codrl_mj.motorise(arm(), {"one": given}).compile()) == {0: expected}


def test_an_actuator_may_come_from_a_file(tmp_path):
    path = tmp_path / "drive.yaml"
    path.write_text("family: lag\ntime_constant: 0.3\n")
    assert codrl_mj.engine.motors(codrl_mj.motorise(arm(), {"one": str(path)}).compile()) == {0: Lag(time_constant=0.3)}


def test_the_given_spec_is_not_changed():
    spec = arm()
    before = spec.to_xml()
    codrl_mj.motorise(spec, {".*": LOOP})
    assert spec.to_xml() == before


REFUSED = {
    "a muscle": ('<muscle joint="hip_left"/>', "mjDYN_MUSCLE"),
    "a dcmotor": ('<dcmotor joint="hip_left" motorconst="1" resistance="1"/>', "mjDYN_DCMOTOR"),
    "a pid": ('<pid joint="hip_left" kp="1"/>', "mjGAIN_PID"),
    "an orientation": ('<orientation joint="ball" kp="1" input="quat"/>', "mjGAIN_SO3"),
    "a user's dynamics": ('<general joint="hip_left" dyntype="user" actdim="1"/>', "mjDYN_USER"),
    "a user's bias": ('<general joint="hip_left" biastype="user"/>', "mjBIAS_USER"),
    "adhesion": ('<adhesion body="world" ctrlrange="0 1"/>', "mjTRN_BODY"),
    "a ball": ('<motor joint="ball" gear="1 0 0"/>', "neither a hinge nor a slide"),
    "a free joint": ('<motor joint="free" gear="1 0 0 0 0 0"/>', "neither a hinge nor a slide"),
    "a reference site": ('<motor site="here" refsite="there" gear="1 0 0 0 0 0"/>', "reference site"),
    "a delay": ('<motor joint="hip_left" delay="0.02" nsample="3"/>', "delayed"),
    "user data": ('<motor joint="hip_left" user="0 1"/>', "has user data"),
    "a limited tendon": ('<motor tendon="weak_rope"/>', "limits the force of its actuators"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_motorised_is_refused_by_name(kind):
    actuator, reason = REFUSED[kind]
    named = actuator.replace(" ", ' name="it" ', 1)
    with pytest.raises(ValueError, match=f"^actuator it of [a-z_]+: cannot be motorised: .*{reason}"):
        codrl_mj.motorise(_spec(named), {".*": "ideal"})


def test_plugins_and_motors_of_ours_are_not_motorised_again():
    once = codrl_mj.motorise(arm(), {"one": "lag"})
    with pytest.raises(
        ValueError, match=r"actuator one of upper: cannot be motorised: it is a plugin, codrl_mj\.actuator"
    ):
        codrl_mj.motorise(once, {"one": "ideal"})
    twice = codrl_mj.motorise(once, {"two": "ideal"}).compile()
    assert codrl_mj.engine.motors(twice) == {0: Lag(), 1: Ideal()}


def test_the_limit_of_a_tendon_is_not_applied_to_plugins():
    """Why such a tendon is refused: MuJoCo looks for it among actuators that are no plugins."""
    spec = _spec('<motor tendon="weak_rope"/>')
    forces = []
    for plugin in (False, True):
        if plugin:
            spec.activate_plugin("mujoco.pid")
            spec.add_plugin(name="p", plugin_name="mujoco.pid").config = {"kp": "9"}
            target = spec.actuators[0]
            target.plugin.plugin_name, target.plugin.name, target.plugin.active = "mujoco.pid", "p", True
        model = spec.compile()
        data = mujoco.MjData(model)
        data.ctrl[:] = 5.0
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force[0])
    assert forces == [1.0, 45.0]


PAIR = ('<position name="kp" joint="hip_left" kp="5"/>', '<velocity name="kv" joint="hip_left" kv="0.5"/>')


def test_several_actuators_of_one_joint_are_several_motors_only_if_one_says_so():
    with pytest.raises(
        ValueError, match=r"'.*' matches both actuator kp of hip_left and actuator kv of hip_left: each"
    ):
        codrl_mj.motorise(_spec(*PAIR), {".*": "lag"})
    plain, ours = _spec(*PAIR).compile(), codrl_mj.motorise(_spec(*PAIR), {"kp": "ideal", "kv": "ideal"}).compile()
    inputs = controls(100, 2)
    np.testing.assert_array_equal(trajectory(ours, inputs), trajectory(plain, inputs))


def test_two_motors_of_one_joint_are_together_one_twice_as_strong():
    """A lag is linear, and halves and doubles are exact."""
    lag = Lag(time_constant=0.05)
    two = _spec('<motor name="a" joint="hip_left" gear="2"/>', '<motor name="b" joint="hip_left" gear="2"/>')
    one = _spec('<motor name="a" joint="hip_left" gear="4"/>')
    inputs = controls(100, 1)
    together = trajectory(codrl_mj.motorise(two, {"a": lag, "b": lag}).compile(), np.tile(inputs, 2))
    alone = trajectory(codrl_mj.motorise(one, {"a": lag}).compile(), inputs)
    count = one.compile().nq + one.compile().nv
    np.testing.assert_array_equal(together[:, :count], alone[:, :count])


def test_an_unstable_actuator_is_refused_unless_asked_for():
    unstable = Actuator(controller=CurrentLoop(kp=500.0))
    with pytest.raises(ValueError, match=r"'one': actuator: the current loop is unstable at a step of 0.005 s"):
        codrl_mj.motorise(arm(), {"one": unstable})
    assert codrl_mj.engine.motors(codrl_mj.motorise(arm(), {"one": unstable}, allow_unstable=True).compile()) == {
        0: unstable
    }


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicitfast"])
def test_inertia_and_friction_are_added_to_the_joint_through_the_gear(integrator):
    """Torques pass a gear once, inertia and damping twice; what the joint and the actuator have stays."""

    def spec():
        made = arm(integrator)
        made.actuator("one").gear = [3.0, 0, 0, 0, 0, 0]
        made.actuator("one").armature = 0.01
        made.joint("upper").armature, made.joint("upper").frictionloss = 0.02, 0.03
        return made

    by_hand = spec()
    by_hand.joint("upper").armature += 9 * 0.004
    by_hand.joint("upper").damping[0] += 9 * 2 * 0.004
    by_hand.joint("upper").frictionloss += 3 * 3 * 0.004
    added = codrl_mj.motorise(spec(), {"one": Worn(rotor=0.004)})
    expected = codrl_mj.motorise(by_hand, {"one": Worn()})
    inputs = controls(200, 2)
    np.testing.assert_allclose(trajectory(added.compile(), inputs), trajectory(expected.compile(), inputs), atol=1e-11)
    plain = trajectory(codrl_mj.motorise(spec(), {"one": Worn()}).compile(), inputs)
    assert not np.allclose(trajectory(added.compile(), inputs), plain, atol=1e-3)


def test_friction_goes_to_a_tendon_that_is_driven():
    model = codrl_mj.motorise(_spec('<motor name="m" tendon="rope" gear="-2"/>'), {"m": Worn(rotor=0.1)}).compile()
    assert model.tendon_frictionloss[0] == pytest.approx(2 * 3 * 0.1)
    assert model.actuator_armature[0] == 0.1


def test_motorised_models_are_attached_to_others():
    child = codrl_mj.motorise(arm(), {"one": LOOP, "two": "lag"})
    scene = mujoco.MjSpec()
    scene.option.timestep = child.option.timestep
    for name in ("a", "b"):
        scene.attach(child.copy(), prefix=f"{name}/", frame=scene.worldbody.add_frame())
    model = scene.compile()
    assert list(codrl_mj.engine.motors(model).values()) == [LOOP, Lag(), LOOP, Lag()]
    alone = child.compile()
    inputs = own_controls(alone, 100)
    both, one = trajectory(model, np.tile(inputs, 2)), trajectory(alone, inputs)
    np.testing.assert_allclose(both[:, :2], one[:, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(both[:, 2:4], one[:, :2], rtol=0, atol=1e-12)


RUBBING = codrl_mj.actuators.Drive(codrl_mj.actuators.GearMotor(coulomb_friction=1e-3))


def test_friction_needs_a_joint_or_a_tendon():
    with pytest.raises(ValueError, match="it drives neither a joint nor a tendon, which the friction"):
        codrl_mj.motorise(_spec('<general name="push" site="here" gear="1 0 0 0 0 0"/>'), {"push": RUBBING})


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        ({"*": "lag"}, r"'\*': must be a regular expression \(nothing to repeat"),
        ({3: "lag"}, "3: must be a regular expression"),
        ([".*"], r"actuators = \['\.\*'\]: must be a mapping of patterns"),
    ],
)
def test_patterns_that_are_none_are_refused(patterns, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.motorise(arm(), patterns)


def test_what_cannot_be_simulated_is_not_allowed_with_what_is_unstable():
    with pytest.raises(ValueError, match=r"'one': Lag\.delay = 5: must be <= 0\.04 s"):
        codrl_mj.motorise(arm(), {"one": Lag(delay=5.0)}, allow_unstable=True)
