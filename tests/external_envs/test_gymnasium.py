"""`make`: Gymnasium's environments with motors."""

import functools
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from stable_baselines3.common.vec_env import SubprocVecEnv

import codrl_mj
from codrl_mj.actuators import (
    Drive,
    Servo,
    TorqueSpeed,
    VoltageDrive,
)
from codrl_mj.catalogue import motor_entry
from codrl_mj.envs.config import EnvConfig
from tests.conformance.environments import NOISY
from tests.external_envs.models import ARM, V5, ArmEnv, BareEnv, actions, assert_same, run
from tests.matrix import matrix_params

# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
IDEAL, MAXON = {".*": "ideal"}, {".*": "maxon-ec45-flat-50w"}
BACK, FRONT = ("bthigh", "bshin", "bfoot"), ("fthigh", "fshin", "ffoot")
# Several motors, and RK4 with one motor and episodes that end early.
QUICK_IDS = ("HalfCheetah-v5", "InvertedPendulum-v5")
every_v5 = pytest.mark.parametrize("env_id", matrix_params(QUICK_IDS, V5))
CHEETAH, ARM_ID, BARE_ID = "HalfCheetah-v5", "ForeignArm-v0", "ForeignBare-v0"


@pytest.fixture(autouse=True)
def _registered(tmp_path):
    """Register an environment with a servo and a motor, and one that is no `MujocoEnv`."""
    (tmp_path / "arm.xml").write_text(ARM)
    gym.register(ARM_ID, functools.partial(ArmEnv, tmp_path / "arm.xml"), max_episode_steps=50)
    gym.register(BARE_ID, BareEnv, max_episode_steps=50)
    yield
    for env_id in (ARM_ID, BARE_ID):
        gym.registry.pop(env_id)


@every_v5
def test_ideal_motors_change_neither_episodes_nor_images(env_id):
    original, ours = (
        gym.make(env_id, render_mode="rgb_array"),
        codrl_mj.make(env_id, IDEAL, render_mode="rgb_array"),
    )
    assert (ours.observation_space, ours.action_space) == (
        original.observation_space,
        original.action_space,
    )
    # The steps reach the time limit, or the end of many episodes.
    inputs = actions(original, original.spec.max_episode_steps + 1)
    expected = run(original, inputs, seed=3)
    assert any(row[2] or row[3] for row in expected)
    assert_same(run(ours, inputs, seed=3), expected)
    images = [env.render() for env in (original, ours)]
    assert images[0].std() > 1.0
    np.testing.assert_array_equal(*images)


def test_torque_stays_within_the_torque_speed_line():
    """Take one integration step per environment step, so that the speed for the line is known."""
    line = TorqueSpeed(stall_torque=0.64, no_load_speed=950.0, max_torque=0.38)
    env = codrl_mj.make(CHEETAH, {".*": line}, frame_skip=1, reset_noise_scale=1.0)
    env.reset(seed=0)
    model, data, saturated = env.unwrapped.model, env.unwrapped.data, np.zeros(6)
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    for action in np.repeat(actions(env, 60), 10, axis=0):
        speed = model.actuator_gear[:, 0] * data.qvel[dofs]
        *_, info = env.step(action)
        desired = action.astype(np.float64)
        upper, lower = (np.clip(0.64 * (sign - speed / 950.0), -0.38, 0.38) for sign in (1.0, -1.0))
        expected = np.clip(desired, lower, upper)
        np.testing.assert_array_equal(info["desired_force"], desired)
        np.testing.assert_allclose(info["actual_force"], expected, rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(info["saturated"], expected != desired)
        saturated += info["saturated"]
    assert (saturated > 20).all()
    assert (saturated < 580).all()


def test_raises_for_a_snapshot_of_another_environment():
    env, other_env = codrl_mj.make(CHEETAH, IDEAL), codrl_mj.make(CHEETAH, {".*": "lag"})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"snapshot\['state'\].*must be"):
        other_env.restore(env.snapshot())
    with pytest.raises(ValueError, match="must be of 'HalfCheetah-v5'"):
        env.restore(
            env.snapshot() | {"environment": np.frombuffer(b"HalfCheetah-v4", dtype=np.uint8)}
        )


def test_setting_the_state_brings_motors_to_rest():
    """Compare with the motors' signals after a reset to that state."""
    env = codrl_mj.make(CHEETAH, {".*": "lag"})
    inputs = actions(env, 20)
    run(env, inputs, seed=0)
    base = env.unwrapped
    base.set_state(base.init_qpos, base.init_qvel)
    moved = [env.step(action)[4]["actual_force"] for action in inputs]
    fresh = codrl_mj.make(CHEETAH, {".*": "lag"}, reset_noise_scale=0.0)
    fresh.reset(seed=0)
    np.testing.assert_array_equal(
        moved, [fresh.step(action)[4]["actual_force"] for action in inputs]
    )


def test_current_commands_are_in_amperes_up_to_the_motors_limits():
    drives = {
        "b.*": (
            Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters).replaced(
                {"controller.max_current": 5.0}
            )
        )
    }
    env = codrl_mj.make(CHEETAH, drives, action="current")
    np.testing.assert_array_equal(env.action_space.high, [5.0] * 3 + [1.0] * 3)
    np.testing.assert_array_equal(env.action_space.low, -env.action_space.high)
    env.reset(seed=0)
    for scale in (1.0, 2.0):
        action = scale * np.array([5.0, -5.0, 2.0, 0.1, 0.2, -0.3], np.float32)
        *_, info = env.step(action)
        np.testing.assert_allclose(
            info["reference_current"], np.clip(action[:3], -5.0, 5.0), rtol=1e-12
        )
        np.testing.assert_allclose(env.unwrapped.data.actuator_force[3:], action[3:], rtol=1e-7)


def test_a_current_command_does_not_depend_on_gain_arm_and_limit():
    fields = {"controller.max_current": 5.0, "motor.gear_ratio": 3.0, "motor.arm_radius": 0.5}
    drive = Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters).replaced(
        fields
    )
    env = codrl_mj.make(ARM_ID, {"motor": drive}, action="current", allow_unstable=True)
    assert env.action_space.high[1] == 5.0
    env.reset(seed=0)
    *_, info = env.step(np.array([0.0, -0.4], np.float32))
    assert info["reference_current"] == pytest.approx(-0.4, rel=1e-6)
    assert info["desired_force"] == pytest.approx(
        -0.4 * drive.motor.torque_constant * 3.0 / 0.5, rel=1e-6
    )
    unlimited_env = codrl_mj.make(
        "InvertedPendulum-v5", {".*": NOISY}, action="current", allow_unstable=True
    )
    max_current = (
        3.0 * unlimited_env.unwrapped.model.actuator_gainprm[0, 0] / NOISY.motor.torque_constant
    )
    np.testing.assert_allclose(unlimited_env.action_space.high, [max_current], rtol=1e-6)


def test_voltage_commands_bypass_the_current_loop():
    env = codrl_mj.make(CHEETAH, MAXON, action="voltage")
    np.testing.assert_array_equal(env.action_space.high, [24.0] * 6)
    assert set(map(type, env.motors.values())) == {VoltageDrive}
    env.reset(seed=0)
    for action in actions(env, 5):
        *_, info = env.step(action)
        np.testing.assert_allclose(info["voltage"], action, rtol=1e-6)
        np.testing.assert_array_equal(info["desired_force"], info["actual_force"])


def test_a_servo_takes_position_commands():
    env = codrl_mj.make(
        "InvertedPendulum-v5", {".*": Servo()}, action="position", allow_unstable=True
    )
    np.testing.assert_allclose(env.action_space.high, [math.pi], rtol=1e-6)
    env.reset(seed=0)
    *_, info = env.step(np.array([0.5], np.float32))
    model, data = env.unwrapped.model, env.unwrapped.data
    assert abs(info["error"] - 0.5) < 0.2 * 0.5 + abs(model.actuator_gear[0, 0] * data.qpos[0])


def test_raises_if_a_servo_gets_force_commands():
    """Raise, because 1 N would be taken for 1 m."""
    message = (
        "action = 'force': '.*': the environment's actions are forces, but a Servo takes motions;"
        " must be position"
    )
    with pytest.raises(ValueError, match=message):
        codrl_mj.make("InvertedPendulum-v5", {".*": Servo()}, allow_unstable=True)


def test_a_position_servo_of_the_model_stays_one():
    """Check that the desired torque is kp*(target - q) - kv*w."""
    env = codrl_mj.make(
        ARM_ID, {"servo": TorqueSpeed(stall_torque=5.0, no_load_speed=10.0, max_torque=5.0)}
    )
    (q, _, w, _), _ = env.reset(seed=0)
    (*_,), *_, info = env.step(np.array([0.5, 0.0], np.float32))
    assert info["desired_force"] == pytest.approx(20.0 * (0.5 - q) - w, rel=1e-12)
    assert info["actual_force"] == pytest.approx(5.0 * (1.0 - w / 10.0), rel=1e-12)
    assert info["saturated"] is True


def gymnasium_steps(env_functions, context):
    """Yield observations and currents of Gymnasium's processes, from seeds 3 and 4."""
    vector = AsyncVectorEnv(env_functions, context=context)
    vector.reset(seed=[3, 4])
    for action in (yield):
        observations, *_, infos = vector.step(action)
        yield observations, infos["current"]
    vector.close()


def stable_baselines3_steps(env_functions, context):
    """Yield observations and currents of Stable-Baselines3's processes, as `gymnasium_steps`."""
    vector = SubprocVecEnv(env_functions, start_method=context)
    vector.seed(3)
    vector.reset()
    for action in (yield):
        observations, _, _, infos = vector.step(action)
        yield observations, [info["current"] for info in infos]
    vector.close()


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.matrix)])
@pytest.mark.parametrize("steps_of", [gymnasium_steps, stable_baselines3_steps])
def test_environments_in_processes_equal_single_ones(steps_of, context):
    make = functools.partial(
        codrl_mj.make, CHEETAH, {"b.*": NOISY, "f.*": "lag"}, allow_unstable=True
    )
    inputs = np.random.default_rng(0).uniform(-1, 1, (30, 2, 6)).astype(np.float32)
    singles, steps = [make(), make()], steps_of([make] * 2, context)
    for seed, single in zip((3, 4), singles, strict=True):
        single.reset(seed=seed)
    next(steps)
    results = [steps.send(inputs), *steps]
    assert len(results) == len(inputs)
    for (observations, currents), env_actions in zip(results, inputs, strict=True):
        for single, action, observation, current in zip(
            singles, env_actions, observations, currents, strict=True
        ):
            expected, *_, info = single.step(action)
            np.testing.assert_array_equal(observation, expected)
            np.testing.assert_array_equal(current, info["current"])


MOTOR = {"motor": MAXON[".*"]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"actuator": {"knee": "lag"}}, "'knee': no actuator has such a name"),
        (
            {"action": "voltage"},
            r"action = 'voltage': must be one of force, which the lag actuator of '\.\*' takes; or",
        ),
        (
            {"observe_actuator": True},
            "the lag actuator has no current and no other signal to observe; choose another",
        ),
        ({"randomize": {"knee": {}}}, "randomize: knee: {} is no distribution"),
        ({"randomize": ["time_constant"]}, "must be FIELD=DISTRIBUTION"),
        (
            {"randomize": {"knee:time_constant": "uniform(0, 1)"}},
            "'knee': no actuator has such a name",
        ),
        (
            {"randomize": {"time_constant": "uniform(0, 1)", "bfoot:time_constant": "choice(1)"}},
            "drawn by another pattern, too",
        ),
        ({"randomize": {".*": {"time_constnt": "uniform(0, 1)"}}}, "did you mean .*time_constant"),
        (
            {"randomize": {".*": {"time_constant": "uniform(-1, 1)"}}},
            r"'\.\*'\]\['time_constant'\].*must be.*>= 0",
        ),
        ({"randomize": {"model.mass.trso": "uniform(0.5, 2)"}}, "did you mean 'model.mass.torso'"),
        (
            {"randomize": {"model.mass.torso": "uniform(0, 2)"}},
            r"mass.torso'\] = uniform\(0.*= 0: must be .* > 0",
        ),
        (
            {"randomize": {"model.length.torso": "uniform(0.5, 2)"}},
            "unknown field 'model.length.torso'",
        ),
        (
            {
                "actuator": {".*": NOISY},
                "randomize": {".*": {"controller.substeps": "uniform(1, 4)"}},
            },
            "controller.substeps must be drawn from a Choice of int values",
        ),
        (
            {
                "actuator": MAXON,
                "action": "current",
                "randomize": {"motor.torque_constant": "uniform(0.01, 0.02)"},
            },
            (
                "with action='current' it would change what an action means; draw it with"
                " action='force'"
            ),
        ),
        (
            {"randomize": {"model.gravity": "uniform(0)"}},
            "randomize: model.gravity: .* has 1 values",
        ),
        ({"disturbances": {"comand_delay": 1}}, "did you mean disturbances.command_delay"),
        ({"env": BARE_ID, "disturbances": {"command_rate": 1.0}}, "has no `dt`"),
        (
            {"env": ARM_ID, "actuator": MAXON, "action": "current"},
            r"servo: is not a plain motor.*action='force'",
        ),
        (
            {"env": ARM_ID, "actuator": MOTOR, "action": "current"},
            r"motor: a command \[A\] needs a limit",
        ),
        (
            {"env": "CartPole-v1"},
            "has no MuJoCo model built from XML, and so no motors: use this package's task 'cartpole'",
        ),
    ],
)
def test_raises_for_wrong_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.make(
            **{"env": CHEETAH, "actuator": {".*": "lag"}, "allow_unstable": True, **arguments}
        )


@pytest.mark.parametrize(
    "options", [{"action": "current"}, {"disturbances": {"command_delay": 0.05}}]
)
def test_raises_for_an_action_of_the_wrong_shape(options):
    env = codrl_mj.make(CHEETAH, MAXON, **options)
    env.reset()
    with pytest.raises(ValueError, match=r"action has shape \(1,\): must be \(6,\)"):
        env.step(np.zeros(1, np.float32))


def test_a_family_s_class_selects_an_actuator_with_default_fields():
    for actuator in ({".*": TorqueSpeed}, TorqueSpeed):
        assert EnvConfig("InvertedPendulum-v5", actuator) == EnvConfig(
            "InvertedPendulum-v5", {".*": TorqueSpeed()}
        )
        codrl_mj.make("InvertedPendulum-v5", actuator).close()
