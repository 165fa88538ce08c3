"""Randomization, load pulses and delays in Gymnasium's environments with motors."""

import dataclasses
import functools

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, Lag, SampledLoop, Servo, ServoLoop, Supply
from codrl_mj.catalogue import motor_entry
from tests.conformance.environments import CHEETAH, MAXON, NOISY
from tests.external_envs.models import ARM, ArmEnv, actions, assert_same, run

IDEAL = {".*": "ideal"}
# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
DRAWS = {
    ".*": {"motor.resistance": "uniform(0.6, 1.2)", "motor.rotor_inertia": "uniform(1e-5, 3e-5)"}
}


def test_randomization_does_not_change_the_initial_states():
    env, original = codrl_mj.make(CHEETAH, MAXON, randomize=DRAWS), gym.make(CHEETAH)
    resistances = []
    for seed in (4, None, None, 4):
        (ours, info), (theirs, _) = env.reset(seed=seed), original.reset(seed=seed)
        np.testing.assert_array_equal(ours, theirs)
        values = info["randomization"][".*"]
        assert 0.6 <= values["motor.resistance"] <= 1.2
        assert 1e-5 <= values["motor.rotor_inertia"] <= 3e-5
        assert env.randomization == info["randomization"]
        assert {motor.motor.resistance for motor in env.motors.values()} == {
            values["motor.resistance"]
        }
        resistances.append(values["motor.resistance"])
    assert resistances[0] == resistances[3]
    assert len(set(resistances)) == 3


def test_a_drawn_motor_equals_one_with_these_values_from_the_start():
    fields = {"motor.rotor_inertia": 3e-5, "motor.coulomb_friction": 0.02, "motor.gear_ratio": 1.5}
    drawn_motor = Drive.from_motor_parameters(
        motor_entry("maxon-ec45-flat-50w").parameters
    ).replaced(fields | {"motor.resistance": 1.1})
    draws = {".*": {name: codrl_mj.Choice([value]) for name, value in fields.items()}}
    draws[".*"]["motor.resistance"] = "choice(1.1)"
    randomized_env, reference_env = (
        codrl_mj.make("Hopper-v5", MAXON, randomize=draws),
        codrl_mj.make("Hopper-v5", {".*": drawn_motor}),
    )
    inputs = actions(reference_env, 50)
    for ours, theirs in zip(
        run(randomized_env, inputs, seed=0), run(reference_env, inputs, seed=0), strict=True
    ):
        np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-9, atol=1e-9)
    for field in (
        "actuator_armature",
        "dof_frictionloss",
        "actuator_user",
        "dof_invweight0",
        "dof_M0",
    ):
        ours, theirs = (
            getattr(env.unwrapped.model, field) for env in (randomized_env, reference_env)
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=0.0, err_msg=field)


def test_motors_of_several_families_are_randomized_by_their_own_fields():
    actuators = {"b.*": MAXON[".*"], "f.*": "lag"}
    draws = {
        "b.*": {"motor.resistance": "uniform(0.6, 1.2)"},
        "f.*": {"time_constant": "uniform(0.01, 0.02)"},
    }
    env = codrl_mj.make(CHEETAH, actuators, randomize=draws)
    drawn_values = env.reset(seed=0)[1]["randomization"]
    motors = list(env.motors.values())
    assert {motor.motor.resistance for motor in motors[:3]} == {*drawn_values["b.*"].values()}
    assert {motor.time_constant for motor in motors[3:]} == {*drawn_values["f.*"].values()}
    assert list(codrl_mj.engine.motors(env.unwrapped.model).values())[3:] == motors[3:]
    # Not every motor has the field.
    with pytest.raises(ValueError, match=r"unknown field 'motor\.resistance'"):
        codrl_mj.make(CHEETAH, actuators, randomize={"motor.resistance": "uniform(0.6, 1.2)"})


def test_paths_and_nested_mappings_draw_the_same():
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
    thigh_env = codrl_mj.make(
        "Hopper-v5",
        {".*": "lag"},
        randomize={f"thigh_joint:{name}": fields[name] for name in fields},
    )
    nested_values, flat_values, thigh_values = (
        env.reset(seed=1)[1]["randomization"] for env in (nested, flat, thigh_env)
    )
    assert nested_values == {
        ".*": {"time_constant": flat_values.pop("time_constant")},
        **flat_values,
    }
    assert thigh_values["thigh_joint"] == nested_values[".*"]
    assert list(flat.motors.values()) == list(nested.motors.values())
    assert [motor.time_constant == Lag().time_constant for motor in thigh_env.motors.values()] == [
        False,
        True,
        True,
    ]


def _model_fields(mass, gravity, damping):
    return {"model.mass.pole": mass, "model.gravity": gravity, "model.damping.hinge": damping}


def test_drawing_the_nominal_values_changes_nothing():
    draws = _model_fields("choice(1.0)", "choice(1.0)", "choice(0.0)")
    original, ours = (
        gym.make("InvertedPendulum-v5"),
        codrl_mj.make("InvertedPendulum-v5", IDEAL, randomize=draws),
    )
    inputs = actions(original, 100)
    assert_same(run(ours, inputs, seed=0), run(original, inputs, seed=0))


def test_a_drawn_model_equals_one_compiled_with_these_values():
    """Compare with a model that MuJoCo compiles, including what it derives from the masses."""
    draws = _model_fields("uniform(0.5, 2.0)", "uniform(0.5, 2.0)", "uniform(0.0, 0.3)")
    env = codrl_mj.make("InvertedPendulum-v5", IDEAL, randomize=draws)
    original = gym.make("InvertedPendulum-v5").unwrapped
    for seed in (1, 2):
        factors = env.reset(seed=seed)[1]["randomization"]
        spec = mujoco.MjSpec.from_file(original.fullpath)
        (geom,) = spec.body("pole").geoms
        geom.mass = factors["model.mass.pole"] * original.model.body("pole").mass[0]
        spec.option.gravity = factors["model.gravity"] * original.model.opt.gravity
        spec.joint("hinge").damping[0] += factors["model.damping.hinge"]
        expected, model = spec.compile(), env.unwrapped.model
        np.testing.assert_allclose(model.opt.gravity, expected.opt.gravity, rtol=1e-12)
        for field in (
            "body_mass",
            "body_inertia",
            "body_subtreemass",
            "body_invweight0",
            "dof_M0",
            "dof_damping",
        ):
            ours, theirs = getattr(model, field), getattr(expected, field)
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-15, err_msg=field)
    assert env.reset(seed=1)[1]["randomization"]["model.gravity"] != factors["model.gravity"]


def test_load_pulses_act_on_the_joints_of_the_motors():
    """Compare a permanent pulse with a constant load on the environment without motors."""
    pulses = {"pulse_force": 2.0, "pulse_duration": 1e6, "pulse_interval": 1e-9}
    env, original = codrl_mj.make(CHEETAH, IDEAL, disturbances=pulses), gym.make(CHEETAH)
    dofs = original.unwrapped.model.jnt_dofadr[original.unwrapped.model.actuator_trnid[:, 0]]
    inputs, signs = actions(original, 5), []
    for seed in (0, 1, 0):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], original.reset(seed=seed)[0])
        for index, action in enumerate(inputs):
            row = env.step(action)
            load = env.unwrapped.data.qfrc_applied.copy()
            if index:
                np.testing.assert_allclose(np.abs(load[dofs]), 2.0, rtol=1e-12)
            assert np.count_nonzero(load) == len(dofs)
            original.unwrapped.data.qfrc_applied[:] = load
            np.testing.assert_array_equal(row[0], original.step(action)[0])
        signs.append(tuple(np.sign(load[dofs])))
    assert signs[0] == signs[2] != signs[1]


def test_unstable_draws_are_repeated():
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
    # A reset must delete delayed commands.
    for _ in range(2):
        rows = run(env, inputs, seed=0)[1:]
        for index, row in enumerate(rows):
            # The delay is three steps of 0.05 s.
            expected = inputs[index - 3] if index >= 3 else np.zeros(6)
            np.testing.assert_allclose(row[4]["desired_force"], expected, rtol=0, atol=1e-7)


SERVO = Servo(
    GearMotor(gear_ratio=20.0),
    SampledLoop(20e3),
    Supply(48.0),
    ServoLoop(servo_rate=100.0, velocity_gain=1.0),
)
WEAK = dataclasses.replace(SERVO, loop=ServoLoop(servo_rate=100.0, velocity_gain=0.05))


@pytest.mark.parametrize("kind", ["gymnasium", "stale"])
@pytest.mark.parametrize(
    ("motors", "command"),
    [
        ({"servo": "ideal", "motor": "ideal"}, "force"),  # the model's own position servo
        ({"servo": SERVO, "motor": WEAK}, "position"),
        ({"servo": SERVO, "motor": "ideal"}, "force"),
    ],
)
def test_delayed_positions_start_at_the_initial_state_and_delayed_forces_at_0(
    tmp_path, motors, command, kind
):
    """Compare with an environment without delay that starts with commands to hold its state."""

    class Stale(ArmEnv):
        """Environment that does not update the data at a reset."""

        def reset_model(self):
            self.data.qpos[:] = self.np_random.uniform(-0.5, 0.5, 2)
            return self.state_vector()

    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    creator = functools.partial(Stale if kind == "stale" else ArmEnv, path)
    delayed_env = codrl_mj.make(
        creator, motors, action=command, disturbances={"command_delay": 0.02}, max_episode_steps=99
    )
    undelayed_env = codrl_mj.make(creator, motors, action=command, max_episode_steps=99)
    for seed in (3, 4):
        observation = delayed_env.reset(seed=seed)[0]
        np.testing.assert_array_equal(undelayed_env.reset(seed=seed)[0], observation)
        is_force = np.array([False, command == "force"])
        # The second actuator has a gear of 5.
        lengths = observation[:2] * [1.0, 5.0]
        start = np.where(is_force, 0.0, lengths)
        rows = [start, start, *(start + 0.1 * np.sin(step) for step in range(6))]
        for action, earlier_action in zip(rows[2:], rows, strict=False):
            ours, theirs = delayed_env.step(action), undelayed_env.step(earlier_action)
            np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=1e-12)
