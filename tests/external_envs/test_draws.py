"""`make`: motors and models that are drawn at resets, loads and delays, in Gymnasium's environments."""

import dataclasses
import functools

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, Lag, SampledLoop, Servo, ServoLoop, Supply
from codrl_mj.catalogue import motor_entry
from tests.external_envs.models import ARM, ArmEnv, actions, assert_same, run
from tests.external_envs.test_gymnasium import CHEETAH, IDEAL, MAXON, NOISY

pytestmark = pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # deprecated attributes in other people's models
DRAWS = {
    ".*": {"motor.resistance": "uniform(0.6, 1.2)", "motor.rotor_inertia": "uniform(1e-5, 3e-5)"}
}


def test_motors_are_drawn_at_every_reset_and_initial_states_are_not_touched():
    env, plain = codrl_mj.make(CHEETAH, MAXON, randomize=DRAWS), gym.make(CHEETAH)
    found = []
    for seed in (4, None, None, 4):
        (ours, info), (theirs, _) = env.reset(seed=seed), plain.reset(seed=seed)
        np.testing.assert_array_equal(ours, theirs)
        drawn = info["randomization"][".*"]
        assert 0.6 <= drawn["motor.resistance"] <= 1.2
        assert 1e-5 <= drawn["motor.rotor_inertia"] <= 3e-5
        assert env.randomization == info["randomization"]
        assert {motor.motor.resistance for motor in env.motors.values()} == {
            drawn["motor.resistance"]
        }
        found.append(drawn["motor.resistance"])
    assert found[0] == found[3]
    assert len(set(found)) == 3


def test_a_drawn_motor_is_the_motor_that_it_would_be_from_the_first():
    fields = {"motor.rotor_inertia": 3e-5, "motor.coulomb_friction": 0.02, "motor.gear_ratio": 1.5}
    made = Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters).replaced(
        fields | {"motor.resistance": 1.1}
    )
    draws = {".*": {name: codrl_mj.Choice([value]) for name, value in fields.items()}}
    draws[".*"]["motor.resistance"] = "choice(1.1)"
    drawn, first = (
        codrl_mj.make("Hopper-v5", MAXON, randomize=draws),
        codrl_mj.make("Hopper-v5", {".*": made}),
    )
    inputs = actions(first, 50)
    for ours, theirs in zip(run(drawn, inputs, seed=0), run(first, inputs, seed=0), strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-9, atol=1e-9)
    for field in (
        "actuator_armature",
        "dof_frictionloss",
        "actuator_user",
        "dof_invweight0",
        "dof_M0",
    ):
        ours, theirs = (getattr(env.unwrapped.model, field) for env in (drawn, first))
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=0.0, err_msg=field)


def test_motors_of_several_families_are_drawn_each_by_its_fields():
    actuators = {"b.*": MAXON[".*"], "f.*": "lag"}
    draws = {
        "b.*": {"motor.resistance": "uniform(0.6, 1.2)"},
        "f.*": {"time_constant": "uniform(0.01, 0.02)"},
    }
    env = codrl_mj.make(CHEETAH, actuators, randomize=draws)
    drawn = env.reset(seed=0)[1]["randomization"]
    motors = list(env.motors.values())
    assert {one.motor.resistance for one in motors[:3]} == {*drawn["b.*"].values()}
    assert {one.time_constant for one in motors[3:]} == {*drawn["f.*"].values()}
    assert list(codrl_mj.engine.motors(env.unwrapped.model).values())[3:] == motors[3:]
    with pytest.raises(
        ValueError, match=r"unknown field 'motor\.resistance'"
    ):  # not of every motor
        codrl_mj.make(CHEETAH, actuators, randomize={"motor.resistance": "uniform(0.6, 1.2)"})


def test_paths_draw_what_patterns_with_their_fields_do():
    fields = {"time_constant": "uniform(0.01, 0.02)"}
    nested = codrl_mj.make(
        "Hopper-v5", {".*": "lag"}, randomize={".*": fields, "model.gravity": "uniform(0.9, 1.1)"}
    )
    flat = codrl_mj.make(
        "Hopper-v5",
        {".*": "lag"},
        randomize={
            "time_constant": codrl_mj.Uniform(0.01, 0.02),
            "model.gravity": "uniform(0.9, 1.1)",
        },
    )
    one = codrl_mj.make(
        "Hopper-v5",
        {".*": "lag"},
        randomize={f"thigh_joint:{name}": fields[name] for name in fields},
    )
    drawn, same, alone = (env.reset(seed=1)[1]["randomization"] for env in (nested, flat, one))
    assert drawn == {".*": {"time_constant": same.pop("time_constant")}, **same}
    assert alone["thigh_joint"] == drawn[".*"]
    assert list(flat.motors.values()) == list(nested.motors.values())
    assert [motor.time_constant == Lag().time_constant for motor in one.motors.values()] == [
        False,
        True,
        True,
    ]


def _of_the_model(mass, gravity, damping):
    return {"model.mass.pole": mass, "model.gravity": gravity, "model.damping.hinge": damping}


def test_a_model_that_is_drawn_as_it_is_is_as_before():
    draws = _of_the_model("choice(1.0)", "choice(1.0)", "choice(0.0)")
    plain, ours = (
        gym.make("InvertedPendulum-v5"),
        codrl_mj.make("InvertedPendulum-v5", IDEAL, randomize=draws),
    )
    inputs = actions(plain, 100)
    assert_same(run(ours, inputs, seed=0), run(plain, inputs, seed=0))


def test_a_drawn_model_is_the_model_that_it_would_be_from_the_first():
    """Built anew by MuJoCo's compiler, which computes all that follows from masses."""
    draws = _of_the_model("uniform(0.5, 2.0)", "uniform(0.5, 2.0)", "uniform(0.0, 0.3)")
    env = codrl_mj.make("InvertedPendulum-v5", IDEAL, randomize=draws)
    plain = gym.make("InvertedPendulum-v5").unwrapped
    for seed in (1, 2):
        drawn = env.reset(seed=seed)[1]["randomization"]
        spec = mujoco.MjSpec.from_file(plain.fullpath)
        (geom,) = spec.body("pole").geoms
        geom.mass = drawn["model.mass.pole"] * plain.model.body("pole").mass[0]
        spec.option.gravity = drawn["model.gravity"] * plain.model.opt.gravity
        spec.joint("hinge").damping[0] += drawn["model.damping.hinge"]
        expected, found = spec.compile(), env.unwrapped.model
        np.testing.assert_allclose(found.opt.gravity, expected.opt.gravity, rtol=1e-12)
        for field in (
            "body_mass",
            "body_inertia",
            "body_subtreemass",
            "body_invweight0",
            "dof_M0",
            "dof_damping",
        ):
            ours, theirs = getattr(found, field), getattr(expected, field)
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-15, err_msg=field)
    assert env.reset(seed=1)[1]["randomization"]["model.gravity"] != drawn["model.gravity"]


def test_load_pulses_act_on_the_motors_joints():
    """One that lasts for good begins at once: the environment without motors under the same load, bit for bit."""
    pulses = {"pulse_force": 2.0, "pulse_duration": 1e6, "pulse_interval": 1e-9}
    env, plain = codrl_mj.make(CHEETAH, IDEAL, disturbances=pulses), gym.make(CHEETAH)
    dofs = plain.unwrapped.model.jnt_dofadr[plain.unwrapped.model.actuator_trnid[:, 0]]
    inputs, signs = actions(plain, 5), []
    for seed in (0, 1, 0):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], plain.reset(seed=seed)[0])
        for index, action in enumerate(inputs):
            row = env.step(action)
            load = env.unwrapped.data.qfrc_applied.copy()
            if index:
                np.testing.assert_allclose(np.abs(load[dofs]), 2.0, rtol=1e-12)
            assert np.count_nonzero(load) == len(dofs)
            plain.unwrapped.data.qfrc_applied[:] = load
            np.testing.assert_array_equal(row[0], plain.step(action)[0])
        signs.append(tuple(np.sign(load[dofs])))
    assert signs[0] == signs[2] != signs[1]


def test_unstable_draws_are_drawn_again():
    loop = dict.fromkeys(("kp",), "uniform(0.1, 20.0)")
    draws = {".*": {f"controller.{name}": text for name, text in loop.items()}}
    stiff = NOISY.replaced({"controller.current_noise": 0.0})
    env = codrl_mj.make(CHEETAH, {".*": stiff}, randomize=draws)
    rejected = []
    for seed in range(20):
        info = env.reset(seed=seed)[1]["randomization"]
        rejected.append(info["rejected"])
        stiff.replaced({"controller.kp": info[".*"]["controller.kp"]}).check(
            env.unwrapped.model.opt.timestep
        )
    assert any(rejected)


def test_commands_are_delayed_by_whole_environment_steps():
    env = codrl_mj.make(CHEETAH, IDEAL, disturbances={"command_delay": 0.15})
    inputs = actions(env, 20)
    for _ in range(2):  # a reset forgets what is on its way
        rows = run(env, inputs, seed=0)[1:]
        for index, row in enumerate(rows):
            expected = inputs[index - 3] if index >= 3 else np.zeros(6)  # three steps of 0.05 s
            np.testing.assert_allclose(row[4]["desired_force"], expected, rtol=0, atol=1e-7)


SERVO = Servo(
    GearMotor(gear_ratio=20.0),
    SampledLoop(20e3),
    Supply(48.0),
    ServoLoop(servo_rate=100.0, velocity_gain=1.0),
)
WEAK = dataclasses.replace(SERVO, loop=ServoLoop(servo_rate=100.0, velocity_gain=0.05))


@pytest.mark.parametrize("face", ["gymnasium", "stale"])
@pytest.mark.parametrize(
    ("motors", "action"),
    [
        ({"servo": "ideal", "motor": "ideal"}, "force"),  # the model's own position servo
        ({"servo": SERVO, "motor": WEAK}, "position"),
        ({"servo": SERVO, "motor": "ideal"}, "force"),
    ],
)
def test_late_positions_are_held_where_the_episode_starts_and_late_forces_are_zero(
    tmp_path, motors, action, face
):
    """As in the environment without delay, whose first actions are the positions at which it starts."""

    class Stale(ArmEnv):
        """Does not bring the data up to date at a reset."""

        def reset_model(self):
            self.data.qpos[:] = self.np_random.uniform(-0.5, 0.5, 2)
            return self.state_vector()

    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    creator = functools.partial(Stale if face == "stale" else ArmEnv, path)
    late = codrl_mj.make(
        creator, motors, action=action, disturbances={"command_delay": 0.02}, max_episode_steps=99
    )
    plain = codrl_mj.make(creator, motors, action=action, max_episode_steps=99)
    for seed in (3, 4):
        observation = late.reset(seed=seed)[0]
        np.testing.assert_array_equal(plain.reset(seed=seed)[0], observation)
        forced = np.array([False, action == "force"])
        lengths = observation[:2] * [1.0, 5.0]  # the gear of the second
        start = np.where(forced, 0.0, lengths)
        rows = [start, start, *(start + 0.1 * np.sin(step) for step in range(6))]
        for wanted, earlier in zip(rows[2:], rows, strict=False):
            ours, theirs = late.step(wanted), plain.step(earlier)
            np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=1e-12)
