"""`make`: Gymnasium's environments with motors."""

import copy
import functools
import math
import pickle
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.vec_env import SubprocVecEnv

import codrl_mj
from codrl_mj.actuators import Actuator, CurrentLoop, Drive, Lag, Motor, Servo, TorqueSpeed, VoltageDrive
from codrl_mj.catalogue import motor_entry
from codrl_mj.engine.reading import slots
from tests.foreign.models import ARM, V5, ArmEnv, BareEnv, actions, assert_same, run
from tests.matrix import but
from tests.motorised.models import full_state

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # deprecated attributes in other people's models
IDEAL, MAXON = {".*": "ideal"}, {".*": "maxon-ec45-flat-50w"}
BACK, FRONT = ("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot")
KEPT = ("HalfCheetah-v5", "InvertedPendulum-v5")  # several motors and RK4 with an early end: one
every_v5 = pytest.mark.parametrize("env_id", but(KEPT, V5))
NOISY = Actuator(
    Motor(resistance=1.0, inductance=0.05, torque_constant=0.8, back_emf_constant=0.01),
    CurrentLoop(kp=0.5, ki=2.0, max_voltage=4.0, substeps=2, current_noise=0.1),
)


@pytest.fixture
def arm_id(tmp_path):
    """The id of an environment of a servo and a motor."""
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    gym.register("ForeignArm-v0", functools.partial(ArmEnv, path), max_episode_steps=50)
    yield "ForeignArm-v0"
    gym.registry.pop("ForeignArm-v0")


@pytest.fixture
def bare_id():
    """The id of an environment that is no `MujocoEnv`."""
    gym.register("ForeignBare-v0", BareEnv, max_episode_steps=50)
    yield "ForeignBare-v0"
    gym.registry.pop("ForeignBare-v0")


@every_v5
def test_ideal_motors_change_no_bit_of_whole_episodes(env_id):
    plain, ours = gym.make(env_id), codrl_mj.make(env_id, IDEAL)
    assert (ours.observation_space, ours.action_space) == (plain.observation_space, plain.action_space)
    steps = plain.spec.max_episode_steps + 1  # to the time limit, or over many episodes
    inputs = actions(plain, steps)
    expected = run(plain, inputs, seed=3)
    assert any(row[2] or row[3] for row in expected)
    assert_same(run(ours, inputs, seed=3), expected)


def _complaints(check, env, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(env, **options)
    said = {str(warning.message).split("\n")[0] for warning in caught}
    return {text for text in said if "is different from the unwrapped version" not in text}  # names the wrappers


@every_v5
@pytest.mark.parametrize("check", [check_env, check_env_sb3], ids=["gymnasium", "stable_baselines3"])
def test_the_checkers_say_no_more_than_of_the_environment_without_motors(env_id, check):
    expected = _complaints(check, gym.make(env_id), skip_render_check=True)  # a window needs a display
    for actuators, options in ((IDEAL, {}), ({".*": NOISY}, {"observe_actuator": True, "allow_unstable": True})):
        ours = codrl_mj.make(env_id, actuators, **options)
        assert _complaints(check, ours, skip_render_check=True) <= expected


@every_v5
def test_images_are_the_same(env_id):
    envs = [gym.make(env_id, render_mode="rgb_array"), codrl_mj.make(env_id, IDEAL, render_mode="rgb_array")]
    inputs = actions(envs[0], 3)
    images = []
    for env in envs:
        run(env, inputs, seed=1)
        images.append(env.render())
        env.close()
    assert images[0].std() > 1.0
    np.testing.assert_array_equal(*images)


def _shafts(env):
    """Speeds [rad/s] of the motors' shafts: the gears' times the joints'."""
    model, data = env.unwrapped.model, env.unwrapped.data
    return model.actuator_gear[:, 0] * data.qvel[model.jnt_dofadr[model.actuator_trnid[:, 0]]]


def test_torque_stays_within_the_torque_speed_line_on_every_joint_at_every_step():
    """One integration step in each environment step: then the speed that the line is of is known."""
    motor = motor_entry("maxon-ec45-flat-50w").numbers
    stall = motor.torque_constant * 24.0 / motor.resistance
    free, most = 24.0 / motor.back_emf_constant, 0.6 * stall
    line = TorqueSpeed(stall_torque=stall, no_load_speed=free, max_torque=most)
    env = codrl_mj.make("HalfCheetah-v5", {".*": line}, frame_skip=1, reset_noise_scale=1.0)
    env.reset(seed=0)
    saturated = np.zeros(6)
    for action in np.repeat(actions(env, 60), 10, axis=0):
        speed = _shafts(env)
        *_, info = env.step(action)
        desired = action.astype(np.float64)
        upper, lower = (np.clip(stall * (sign - speed / free), -most, most) for sign in (1.0, -1.0))
        expected = np.clip(desired, lower, upper)
        np.testing.assert_array_equal(info["desired_force"], desired)
        np.testing.assert_allclose(info["actual_force"], expected, rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(info["saturated"], expected != desired)
        saturated += info["saturated"]
    assert (saturated > 20).all()
    assert (saturated < 580).all()


def test_a_motor_of_the_catalogue_saturates_where_its_datasheet_says():
    """By the line kT*(±V - kE*w)/R at the speeds between which a step lies, 10 V to either side for what is between.

    On every joint: never more torque than the line allows, saturated wherever more is asked for, and wherever less is
    asked for, for longer than the winding takes, that is delivered; but where a contact changes the speed meanwhile.
    """
    entry = motor_entry("maxon-ec45-flat-50w").numbers
    warming = ("thermal_resistance_winding", "thermal_resistance_housing")
    fields = dict.fromkeys((f"motor.{name}" for name in warming), 0.0) | {"motor.max_temperature": math.inf}
    cold = Drive.of(entry).replaced(fields)
    env = codrl_mj.make("HalfCheetah-v5", {".*": cold}, frame_skip=1, reset_noise_scale=0.5)
    env.reset(seed=0)
    kt, ke, resistance, slack = entry.torque_constant, entry.back_emf_constant, entry.resistance, 0.05
    asked_too_much, possible, kept = np.zeros(6), np.zeros(6), np.zeros(6)
    for index, action in enumerate(np.repeat(actions(env, 100), 10, axis=0)):
        before = _shafts(env)
        *_, info = env.step(action)
        speeds, desired, actual = np.array([before, _shafts(env)]), action.astype(np.float64), info["actual_force"]
        low, high = (kt * (volts - ke * speeds) / resistance for volts in (-24.0, 24.0))
        beyond = (desired < low.min(0) - slack) | (desired > high.max(0) + slack)
        assert info["saturated"][beyond].all()
        assert (actual <= high.max(0) + slack).all()
        assert (actual >= low.min(0) - slack).all()
        asked_too_much += beyond
        if index % 10:
            within = (desired > low.max(0) + slack) & (desired < high.min(0) - slack)
            possible += within
            kept += within & ~info["saturated"] & (np.abs(actual - desired) < 1e-3)
    assert (asked_too_much > 100).all()
    assert (possible > 200).all()
    assert (kept >= 0.98 * possible).all()


PULSES = {"pulse_force": 0.5, "pulse_duration": 0.03, "pulse_interval": 0.1}


def _everything(env_id):
    """An environment with all that a snapshot has to remember: noise, draws, delays, a limit of time."""
    draws = {".*": {"motor.resistance": "uniform(0.5, 1.5)", "motor.back_emf_constant": codrl_mj.Uniform(0.0, 0.02)}}
    draws["model.gravity"] = "uniform(0.8, 1.2)"
    return codrl_mj.make(
        env_id,
        {".*": NOISY},
        observe_actuator=True,
        randomize=draws,
        disturbances={"command_delay": 0.07, "command_rate": 20.0} | PULSES,
        allow_unstable=True,
        max_episode_steps=40,
    )


@pytest.mark.parametrize("env_id", but((*KEPT, "Ant-v5"), V5))  # Ant's rewards come from poses that lag a step
def test_a_snapshot_continues_bit_for_bit_in_a_fresh_environment(env_id):
    env, other = _everything(env_id), _everything(env_id)
    inputs = actions(env, 120)
    run(env, inputs[:15], seed=5)
    snapshot = env.snapshot()
    expected = run(env, inputs[15:])
    other.restore(snapshot)
    found = run(other, inputs[15:])
    assert_same(found, expected)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours[4].keys() == theirs[4].keys()
    assert sum(row[3] or row[2] for row in expected) >= 2  # resets were drawn alike too
    env.restore(snapshot)
    assert_same(run(env, inputs[15:]), expected)
    assert all(isinstance(array, np.ndarray) for array in snapshot.values())


def test_a_snapshot_of_something_else_is_refused():
    env, other = codrl_mj.make("HalfCheetah-v5", IDEAL), codrl_mj.make("HalfCheetah-v5", {".*": "lag"})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"snapshot\['state'\].*must be"):
        other.restore(env.snapshot())
    with pytest.raises(ValueError, match="must be of 'HalfCheetah-v5'"):
        env.restore(env.snapshot() | {"environment": np.frombuffer(b"HalfCheetah-v4", dtype=np.uint8)})


def test_setting_the_state_brings_motors_to_rest():
    """Each of them then does what it does after a reset to that state."""
    env = codrl_mj.make("HalfCheetah-v5", {".*": "lag"})
    inputs = actions(env, 20)
    run(env, inputs, seed=0)
    base = env.unwrapped
    base.set_state(base.init_qpos, base.init_qvel)
    moved = [env.step(action)[4]["actual_force"] for action in inputs]
    fresh = codrl_mj.make("HalfCheetah-v5", {".*": "lag"}, reset_noise_scale=0.0)
    fresh.reset(seed=0)
    np.testing.assert_array_equal(moved, [fresh.step(action)[4]["actual_force"] for action in inputs])


def test_resets_bring_motors_to_rest():
    env = codrl_mj.make("HalfCheetah-v5", {".*": NOISY}, allow_unstable=True)
    inputs = actions(env, 30)
    first = run(env, inputs, seed=2)
    assert_same(run(env, inputs, seed=2), first)


def test_every_motor_has_noise_of_its_own_in_every_episode():
    env = codrl_mj.make("HalfCheetah-v5", {"b.*": NOISY, "f.*": "lag"}, allow_unstable=True)
    views, keys = slots(env.unwrapped.data, env.motors), []
    for seed in (7, None, 7):
        env.reset(seed=seed)
        keys.append([view[1] for view in views.values()])
    assert keys[0] == keys[2]
    assert len({*keys[0][:3], *keys[1][:3]}) == 6
    assert keys[0][3:] == [0.0] * 3  # which need none


def test_environments_that_do_not_reset_all_data_have_motors_at_rest_too(bare_id):
    env = codrl_mj.make(bare_id, {".*": "lag"})
    inputs = actions(env, 10)
    first = run(env, inputs, seed=0)
    assert_same(run(env, inputs, seed=0), first)
    with pytest.raises(ValueError, match="has no dt"):
        codrl_mj.make(bare_id, {".*": "lag"}, disturbances={"command_rate": 1.0})
    delayed = codrl_mj.make("HalfCheetah-v5", {".*": "lag"}, disturbances={"command_delay": 0.05})
    delayed.reset()
    with pytest.raises(ValueError, match=r"action has shape \(1,\): must be \(6,\)"):
        delayed.step(np.zeros(1))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_have_the_motors(copied):
    """Gymnasium's copies are environments made again."""
    env = codrl_mj.make("HalfCheetah-v5", MAXON, action="current", observe_actuator=True)
    other = copied(env)
    inputs = actions(env, 10)
    assert_same(run(other, inputs, seed=1), run(env, inputs, seed=1))
    assert copied(env.unwrapped).model.nplugin == 6


def cheetah(**options):
    """Somebody's function."""
    return gym.wrappers.TimeLimit(HalfCheetahEnv(**options), 500)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("creator", [cheetah, HalfCheetahEnv, BareEnv])
def test_copies_of_what_a_function_makes_have_the_motors_and_their_draws(creator, copied):
    env = codrl_mj.make(creator, {".*": "lag"}, randomize={"time_constant": "loguniform(0.01, 1)"})
    other = copied(env)
    inputs = actions(env, 10)
    both = [np.array([row[0] for seed in (1, 2) for row in run(one, inputs, seed)]) for one in (env, other)]
    np.testing.assert_array_equal(*both)
    assert not np.array_equal(both[0][:11], both[0][11:])
    assert other.step(inputs[0])[4]["desired_force"].shape == inputs[0].shape


def test_a_spec_makes_the_environment_again():
    env = codrl_mj.make("HalfCheetah-v5", {".*": "lag"}, disturbances={"command_rate": 5.0}, max_episode_steps=7)
    other = gym.make(env.spec)
    inputs = actions(env, 10)
    assert_same(run(other, inputs, seed=1), run(env, inputs, seed=1))
    assert "actual_force" in other.step(inputs[0])[4]


@pytest.mark.parametrize(("env_id", "count"), [("HalfCheetah-v5", 6), ("InvertedPendulum-v5", 1)])
def test_info_has_arrays_for_several_motors_and_numbers_for_one(env_id, count):
    env = codrl_mj.make(env_id, MAXON)
    run(env, actions(env, 1), seed=0)
    info = env.step(actions(env, 1)[0])[4]
    for name in ("desired_force", "actual_force", *Drive.Signals._fields):
        kind = (bool if count == 1 else np.bool_) if name == "saturated" else float
        if count == 1:
            assert type(info[name]) is kind
        else:
            assert (info[name].shape, info[name].dtype) == ((count,), kind)


def test_motors_of_several_families_have_nan_for_what_the_others_have():
    env = codrl_mj.make("HalfCheetah-v5", {"b.*": MAXON[".*"], "f.*": "lag"}, observe_actuator=True)
    run(env, actions(env, 5), seed=0)
    observation, *_, info = env.step(actions(env, 1)[0])
    np.testing.assert_array_equal(np.isnan(info["current"]), [False] * 3 + [True] * 3)
    assert not info["saturated"][3:].any()
    assert observation.shape == (17 + 3 * 2,)


def test_observations_end_with_what_the_sensors_say():
    env, plain = codrl_mj.make("HalfCheetah-v5", MAXON, observe_actuator=True), gym.make("HalfCheetah-v5")
    space = plain.observation_space
    assert env.observation_space.dtype == space.dtype
    np.testing.assert_array_equal(env.observation_space.low, np.append(space.low, [-np.inf] * 12))
    np.testing.assert_array_equal(env.observation_space.high, np.append(space.high, [np.inf] * 12))
    assert env.sensor_names == tuple(f"{motor}.{name}" for motor in BACK + FRONT for name in Drive.OBSERVED)
    assert not env.reset(seed=0)[0][17:].any()
    for action in actions(env, 5):
        observation, *_, info = env.step(action)
        np.testing.assert_array_equal(observation[17::2], info["current"])
        np.testing.assert_array_equal(observation[18::2], info["reference_current"])


def test_currents_are_commanded_in_amperes_up_to_the_motors_limits():
    drives = {"b.*": Drive.of(motor_entry("maxon-ec45-flat-50w").numbers).replaced({"controller.max_current": 5.0})}
    env = codrl_mj.make("HalfCheetah-v5", drives, action="current")
    np.testing.assert_array_equal(env.action_space.high, [5.0] * 3 + [1.0] * 3)
    np.testing.assert_array_equal(env.action_space.low, -env.action_space.high)
    env.reset(seed=0)
    for scale in (1.0, 2.0):
        action = scale * np.array([5.0, -5.0, 2.0, 0.1, 0.2, -0.3], np.float32)
        *_, info = env.step(action)
        np.testing.assert_allclose(info["reference_current"], np.clip(action[:3], -5.0, 5.0), rtol=1e-12)
        np.testing.assert_allclose(env.unwrapped.data.actuator_force[3:], action[3:], rtol=1e-7)


def test_a_current_is_one_whatever_gain_and_arm_stand_before_it(arm_id):
    drive = Drive.of(motor_entry("maxon-ec45-flat-50w").numbers).replaced(
        {"controller.max_current": 5.0, "motor.gear_ratio": 3.0, "motor.arm_radius": 0.5}
    )
    env = codrl_mj.make(arm_id, {"motor": drive}, action="current", allow_unstable=True)
    assert env.action_space.high[1] == 5.0
    env.reset(seed=0)
    *_, info = env.step(np.array([0.0, -0.4], np.float32))
    assert info["reference_current"] == pytest.approx(-0.4, rel=1e-6)
    assert info["desired_force"] == pytest.approx(-0.4 * drive.motor.torque_constant * 3.0 / 0.5, rel=1e-6)


def test_without_a_limit_of_its_own_a_current_goes_as_far_as_the_environments_force():
    motor = NOISY.motor
    env = codrl_mj.make("InvertedPendulum-v5", {".*": NOISY}, action="current", allow_unstable=True)
    gain = env.unwrapped.model.actuator_gainprm[0, 0]
    np.testing.assert_allclose(env.action_space.high, [3.0 * gain / motor.torque_constant], rtol=1e-6)


def test_voltages_are_commanded_past_the_loop():
    env = codrl_mj.make("HalfCheetah-v5", MAXON, action="voltage")
    np.testing.assert_array_equal(env.action_space.high, [24.0] * 6)
    assert set(map(type, env.motors.values())) == {VoltageDrive}
    env.reset(seed=0)
    for action in actions(env, 5):
        *_, info = env.step(action)
        np.testing.assert_allclose(info["voltage"], action, rtol=1e-6)
        np.testing.assert_array_equal(info["desired_force"], info["actual_force"])


def test_a_servo_of_ours_is_asked_for_positions():
    env = codrl_mj.make("InvertedPendulum-v5", {".*": Servo()}, action="position", allow_unstable=True)
    np.testing.assert_allclose(env.action_space.high, [math.pi], rtol=1e-6)
    env.reset(seed=0)
    *_, info = env.step(np.array([0.5], np.float32))
    model, data = env.unwrapped.model, env.unwrapped.data
    assert abs(info["error"] - 0.5) < 0.2 * 0.5 + abs(model.actuator_gear[0, 0] * data.qpos[0])


def test_a_servo_of_the_models_stays_one(arm_id):
    """What it asks for, kp*(target - q) - kv*w, is the desired torque."""
    env = codrl_mj.make(arm_id, {"servo": TorqueSpeed(stall_torque=5.0, no_load_speed=10.0, max_torque=5.0)})
    (q, _, w, _), _ = env.reset(seed=0)
    (*_,), *_, info = env.step(np.array([0.5, 0.0], np.float32))
    assert info["desired_force"] == pytest.approx(20.0 * (0.5 - q) - w, rel=1e-12)
    assert info["actual_force"] == pytest.approx(5.0 * (1.0 - w / 10.0), rel=1e-12)
    assert info["saturated"] is True


DRAWS = {".*": {"motor.resistance": "uniform(0.6, 1.2)", "motor.rotor_inertia": "uniform(1e-5, 3e-5)"}}


def test_motors_are_drawn_at_every_reset_and_initial_states_are_not_touched():
    env, plain = codrl_mj.make("HalfCheetah-v5", MAXON, randomize=DRAWS), gym.make("HalfCheetah-v5")
    found = []
    for seed in (4, None, None, 4):
        (ours, info), (theirs, _) = env.reset(seed=seed), plain.reset(seed=seed)
        np.testing.assert_array_equal(ours, theirs)
        drawn = info["randomization"][".*"]
        assert 0.6 <= drawn["motor.resistance"] <= 1.2
        assert 1e-5 <= drawn["motor.rotor_inertia"] <= 3e-5
        assert env.randomization == info["randomization"]
        assert {motor.motor.resistance for motor in env.motors.values()} == {drawn["motor.resistance"]}
        found.append(drawn["motor.resistance"])
    assert found[0] == found[3]
    assert len(set(found)) == 3


def test_a_drawn_motor_is_the_motor_that_it_would_be_from_the_first():
    fields = {"motor.rotor_inertia": 3e-5, "motor.coulomb_friction": 0.02, "motor.gear_ratio": 1.5}
    made = Drive.of(motor_entry("maxon-ec45-flat-50w").numbers).replaced(fields | {"motor.resistance": 1.1})
    draws = {".*": {name: codrl_mj.Choice([value]) for name, value in fields.items()}}
    draws[".*"]["motor.resistance"] = "choice(1.1)"
    drawn, first = codrl_mj.make("Hopper-v5", MAXON, randomize=draws), codrl_mj.make("Hopper-v5", {".*": made})
    inputs = actions(first, 50)
    for ours, theirs in zip(run(drawn, inputs, seed=0), run(first, inputs, seed=0), strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-9, atol=1e-9)
    for field in ("actuator_armature", "dof_frictionloss", "actuator_user", "dof_invweight0", "dof_M0"):
        ours, theirs = (getattr(env.unwrapped.model, field) for env in (drawn, first))
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=0.0, err_msg=field)


def test_motors_of_several_families_are_drawn_each_by_its_fields():
    actuators = {"b.*": MAXON[".*"], "f.*": "lag"}
    draws = {"b.*": {"motor.resistance": "uniform(0.6, 1.2)"}, "f.*": {"time_constant": "uniform(0.01, 0.02)"}}
    env = codrl_mj.make("HalfCheetah-v5", actuators, randomize=draws)
    drawn = env.reset(seed=0)[1]["randomization"]
    motors = list(env.motors.values())
    assert {one.motor.resistance for one in motors[:3]} == {*drawn["b.*"].values()}
    assert {one.time_constant for one in motors[3:]} == {*drawn["f.*"].values()}
    assert list(codrl_mj.engine.motors(env.unwrapped.model).values())[3:] == motors[3:]
    with pytest.raises(ValueError, match=r"unknown field 'motor\.resistance'"):  # not of every motor
        codrl_mj.make("HalfCheetah-v5", actuators, randomize={"motor.resistance": "uniform(0.6, 1.2)"})


def test_paths_draw_what_patterns_with_their_fields_do():
    fields = {"time_constant": "uniform(0.01, 0.02)"}
    nested = codrl_mj.make("Hopper-v5", {".*": "lag"}, randomize={".*": fields, "model.gravity": "uniform(0.9, 1.1)"})
    flat = codrl_mj.make(
        "Hopper-v5",
        {".*": "lag"},
        randomize={"time_constant": codrl_mj.Uniform(0.01, 0.02), "model.gravity": "uniform(0.9, 1.1)"},
    )
    one = codrl_mj.make("Hopper-v5", {".*": "lag"}, randomize={f"thigh_joint:{name}": fields[name] for name in fields})
    drawn, same, alone = (env.reset(seed=1)[1]["randomization"] for env in (nested, flat, one))
    assert drawn == {".*": {"time_constant": same.pop("time_constant")}, **same}
    assert alone["thigh_joint"] == drawn[".*"]
    assert list(flat.motors.values()) == list(nested.motors.values())
    assert [motor.time_constant == Lag().time_constant for motor in one.motors.values()] == [False, True, True]


def _of_the_model(mass, gravity, damping):
    return {"model.mass.pole": mass, "model.gravity": gravity, "model.damping.hinge": damping}


def test_a_model_that_is_drawn_as_it_is_is_as_before():
    draws = _of_the_model("choice(1.0)", "choice(1.0)", "choice(0.0)")
    plain, ours = gym.make("InvertedPendulum-v5"), codrl_mj.make("InvertedPendulum-v5", IDEAL, randomize=draws)
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
        for field in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_M0", "dof_damping"):
            ours, theirs = getattr(found, field), getattr(expected, field)
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-15, err_msg=field)
    assert env.reset(seed=1)[1]["randomization"]["model.gravity"] != drawn["model.gravity"]


def test_load_pulses_act_on_the_motors_joints():
    """One that lasts for good begins at once: the environment without motors under the same load, bit for bit."""
    pulses = {"pulse_force": 2.0, "pulse_duration": 1e6, "pulse_interval": 1e-9}
    env, plain = codrl_mj.make("HalfCheetah-v5", IDEAL, disturbances=pulses), gym.make("HalfCheetah-v5")
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
    env = codrl_mj.make("HalfCheetah-v5", {".*": stiff}, randomize=draws)
    rejected = []
    for seed in range(20):
        info = env.reset(seed=seed)[1]["randomization"]
        rejected.append(info["rejected"])
        stiff.replaced({"controller.kp": info[".*"]["controller.kp"]}).check(env.unwrapped.model.opt.timestep)
    assert any(rejected)


def test_commands_are_delayed_by_whole_environment_steps():
    env = codrl_mj.make("HalfCheetah-v5", IDEAL, disturbances={"command_delay": 0.15})
    inputs = actions(env, 20)
    for _ in range(2):  # a reset forgets what is on its way
        rows = run(env, inputs, seed=0)[1:]
        for index, row in enumerate(rows):
            expected = inputs[index - 3] if index >= 3 else np.zeros(6)  # three steps of 0.05 s
            np.testing.assert_allclose(row[4]["desired_force"], expected, rtol=0, atol=1e-7)


def _vector(env_id):
    return functools.partial(codrl_mj.make, env_id, {"b.*": NOISY, "f.*": "lag"}, allow_unstable=True)


def _episodes(vector, inputs, seeds):
    rows = [vector.reset(seed=seeds)[0]]
    infos = []
    for action in inputs:
        observation, *_, info = vector.step(action)
        rows.append(observation)
        infos.append(info["current"])
    vector.close()
    return np.array(rows), np.array(infos)


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.matrix)])
def test_vectors_of_processes_are_those_of_one(context):
    makers = [_vector("HalfCheetah-v5")] * 2
    inputs = np.random.default_rng(0).uniform(-1, 1, (30, 2, 6)).astype(np.float32)
    expected = _episodes(SyncVectorEnv(makers), inputs, [3, 4])
    found = _episodes(AsyncVectorEnv(makers, context=context), inputs, [3, 4])
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    single = makers[0]()
    single.reset(seed=3)
    for action, row in zip(inputs[:, 0], expected[1], strict=True):
        np.testing.assert_array_equal(single.step(action)[4]["current"], row[0])


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.matrix)])
def test_stable_baselines3s_processes_too(context):
    makers = [_vector("HalfCheetah-v5")] * 2
    vector = SubprocVecEnv(makers, start_method=context)
    vector.seed(3)  # and 4
    vector.reset()
    inputs = np.random.default_rng(0).uniform(-1, 1, (30, 2, 6)).astype(np.float32)
    single = makers[1]()
    single.reset(seed=4)
    for action in inputs:
        observations, _, _, infos = vector.step(action)
        observation, *_, info = single.step(action[1])
        np.testing.assert_array_equal(observations[1], observation)
        np.testing.assert_array_equal(infos[1]["current"], info["current"])
    vector.close()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"actuator": {"knee": "lag"}}, "'knee': no actuator has such a name"),
        ({"actuator": {".*": "lagg"}}, "did you mean 'lag'"),
        ({"actuator": {"b.*": "lag", "bfoot": "lag"}}, "both 'b.*' and 'bfoot' match it"),
        (
            {"action": "voltage"},
            r"action = 'voltage': must be one of force, which the lag actuator of '\.\*' takes; or",
        ),
        ({"observe_actuator": True}, "the lag actuator has no current to observe, and nothing else; choose another"),
        ({"randomize": {"knee": {}}}, "randomize: knee: {} is no distribution"),
        ({"randomize": ["time_constant"]}, "must be FIELD=DISTRIBUTION"),
        ({"randomize": {"knee:time_constant": "uniform(0, 1)"}}, "'knee': no actuator has such a name"),
        (
            {"randomize": {"time_constant": "uniform(0, 1)", "bfoot:time_constant": "choice(1)"}},
            "drawn by another pattern, too",
        ),
        ({"randomize": {".*": {"time_constnt": "uniform(0, 1)"}}}, "did you mean .*time_constant"),
        ({"randomize": {".*": {"time_constant": "uniform(-1, 1)"}}}, r"'\.\*'\]\['time_constant'\].*must be.*>= 0"),
        ({"randomize": {"model.mass.trso": "uniform(0.5, 2)"}}, "did you mean 'model.mass.torso'"),
        ({"randomize": {"model.mass.torso": "uniform(0, 2)"}}, r"mass.torso'\] = uniform\(0.*= 0: must be .* > 0"),
        ({"randomize": {"model.length.torso": "uniform(0.5, 2)"}}, "unknown field 'model.length.torso'"),
        (
            {"actuator": {".*": NOISY}, "randomize": {".*": {"controller.substeps": "uniform(1, 4)"}}},
            "controller.substeps must be drawn from a Choice of int values",
        ),
        (
            {"actuator": MAXON, "action": "current", "randomize": {"motor.torque_constant": "uniform(0.01, 0.02)"}},
            "with action='current' it would change what an action means; draw it with action='force'",
        ),
        ({"randomize": {"model.gravity": "uniform(0)"}}, "randomize: model.gravity: .* has 1 values"),
        ({"disturbances": {"comand_delay": 1}}, "did you mean disturbances.command_delay"),
    ],
)
def test_what_is_wrong_is_said(arguments, text):
    with pytest.raises(ValueError, match=text):
        codrl_mj.make("HalfCheetah-v5", **{"actuator": {".*": "lag"}, "allow_unstable": True, **arguments})


def test_what_does_not_go_with_a_model_is_said(arm_id):
    with pytest.raises(ValueError, match=r"servo: is no plain motor.*action='force'"):
        codrl_mj.make(arm_id, MAXON, action="current", allow_unstable=True)
    with pytest.raises(ValueError, match=r"motor: a command \[A\] needs a limit"):
        codrl_mj.make(arm_id, {"motor": "maxon-ec45-flat-50w"}, action="current", allow_unstable=True)
    with pytest.raises(ValueError, match="has no MuJoCo model built from XML, and so no motors: take 'cartpole'"):
        codrl_mj.make("CartPole-v1", IDEAL)
    env = codrl_mj.make("HalfCheetah-v5", MAXON, action="current")
    env.reset()
    with pytest.raises(ValueError, match=r"action has shape \(1,\): must be \(6,\)"):
        env.step(np.zeros(1, np.float32))


def test_states_of_several_episodes_are_whole():
    """The engine's own state, motors included, is the same after the same seed, whatever came before."""
    env = codrl_mj.make("HalfCheetah-v5", {".*": "lag"})
    states = []
    for length in (5, 50):
        run(env, actions(env, length), seed=1)
        env.reset(seed=1)
        mujoco.mj_forward(env.unwrapped.model, env.unwrapped.data)
        states.append(full_state(env.unwrapped.data))
    np.testing.assert_array_equal(*states)
