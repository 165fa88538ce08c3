"""The whole state of environments as plain arrays: what is restored goes on as the original would have, bit for bit."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from safetensors.numpy import load, load_file, save, save_file

import codrl_mj
from codrl_mj import Uniform
from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import TASKS
from tests.envs.snapshots import PHYSICS, STEPS, everything, run_several, run_single, several, single
from tests.envs.vectors import assert_same
from tests.tasks.faces import actions, every_rebuilt

both_physics = pytest.mark.parametrize("physics", PHYSICS)


def _stored(snapshot):
    """What is left of a snapshot after a way through a safetensors file."""
    return load(save(snapshot))


def _assert_same_model(env, other):
    for name in dir(env.model):
        value = getattr(env.model, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(other.model, name), value, err_msg=name)
    np.testing.assert_array_equal(other.model.opt.gravity, env.model.opt.gravity)


# -- one environment ----------------------------------------------------------------------------------------


@both_physics
@every_rebuilt
@pytest.mark.parametrize("before", [None, 0, 57], ids=["before the first reset", "at a start", "in an episode"])
def test_a_fresh_environment_goes_on_as_the_original(task, physics, before):
    env = single(task, physics)
    if before is not None:
        env.reset(seed=5)
        run_single(env, before, seed=0)
    snapshot = env.snapshot()
    kept = {name: value.copy() for name, value in snapshot.items()}
    fresh, used = single(task, physics), single(task, physics)
    used.reset(seed=99)
    for other in (fresh, used):
        other.restore(_stored(snapshot))
        assert_same(other.snapshot(), kept)
        assert other.actuator == env.actuator
        assert other.randomization == env.randomization
        np.testing.assert_array_equal(other.state, env.state)
        if physics == "mujoco":
            _assert_same_model(env, other)
    steps = STEPS if before else 60
    expected = run_single(env, steps, seed=1)
    assert len(expected["drawn"]) == steps // 40
    for other in (fresh, used):
        assert_same(run_single(other, steps, seed=1), expected)
    assert_same(snapshot, kept)  # it does not move with any of them


@both_physics
def test_a_snapshot_is_as_small_as_can_be_without_motor_draws_and_disturbances(physics):
    env = ActuatedEnv("cartpole", "ideal", physics)
    env.reset(seed=0)
    assert env.snapshot().keys() == {"task", "physics", "generator"}
    other = ActuatedEnv("cartpole", "ideal", physics)
    other.restore(env.snapshot())
    for action in (1, 1, 0):
        np.testing.assert_array_equal(other.step(action)[0], env.step(action)[0])


@both_physics
def test_a_wrong_bit_is_seen(physics):
    """The oracle itself: each entry of a snapshot has an effect on what follows."""
    env = single("pendulum", physics)
    env.reset(seed=0)
    run_single(env, 57, seed=0)
    snapshot = env.snapshot()
    expected = run_single(env, STEPS, seed=1)
    env.reset(seed=1)
    run_single(env, 5, seed=2)
    other = env.snapshot()
    for name in snapshot.keys() - {"task"}:
        env.restore(snapshot | {name: other[name]})
        if name == "rejected":
            assert env.randomization["rejected"] == other["rejected"]
            continue
        found = run_single(env, STEPS, seed=1)
        assert any(not np.array_equal(found[key], expected[key]) for key in expected), name


@both_physics
@every_rebuilt
def test_the_voltage_that_an_agent_commands_is_restored_too(task, physics):
    discrete = isinstance(TASKS[task].action_space, gymnasium.spaces.Discrete)
    levels = {"levels": (-3.0, 0.0, 3.0)} if discrete else {}
    drawn = {"motor.inductance": Uniform(0.05, 0.2)}
    arguments = {"physics": physics, "action": "voltage", "randomize": drawn, **levels}
    env, other = ActuatedEnv(task, **arguments), ActuatedEnv(task, **arguments)
    env.reset(seed=0)
    batch = [action if not discrete else action % 2 for action in actions(task, 0, 40)]
    for action in batch[:9]:
        env.step(action)
    other.restore(env.snapshot())
    assert other.actuator == env.actuator
    for action in batch[9:]:
        assert other.step(action)[4] == env.step(action)[4]


# -- several, and other processes ---------------------------------------------------------------------------


@both_physics
@every_rebuilt
def test_a_training_s_environments_go_on_as_the_original(task, physics):
    envs = several(task, physics)
    envs.seed(7)
    pending = _stored(envs.snapshot())  # seeds that no reset has used yet
    first = envs.reset()
    run_several(envs, 30, seed=0)
    snapshot = _stored(envs.snapshot())
    expected = run_several(envs, STEPS, seed=1)
    assert len(expected["ended"]) > 12
    fresh = several(task, physics)
    fresh.restore(snapshot)
    assert fresh.signals is None
    assert_same(run_several(fresh, STEPS, seed=1), expected)
    fresh.restore(pending)
    np.testing.assert_array_equal(fresh.reset(), first)


@pytest.mark.matrix
def test_another_process_goes_on_as_the_original(tmp_path):
    expected = {}
    for task in ("cartpole", "mountain_car"):
        for physics in PHYSICS:
            name, envs = f"{task}-{physics}", several(task, physics)
            envs.seed(3)
            envs.reset()
            run_several(envs, 30, 0)
            save_file(envs.snapshot(), tmp_path / f"{name}.before")
            expected[name] = run_several(envs, STEPS, 1)
    subprocess.run([sys.executable, "-m", "tests.envs.snapshots", str(tmp_path)], check=True)
    for name, values in expected.items():
        assert_same(load_file(tmp_path / f"{name}.after"), values, name)


# -- refusals -----------------------------------------------------------------------------------------------


def _plain(task="cartpole", **arguments):
    env = ActuatedEnv(task, **arguments)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"task": "acrobot"}, r"snapshot\['task'\] is of shape \(7,\) and type uint8: must be of shape \(8,\)"),
        (
            {"task": "pendulum"},
            r"snapshot\['physics'\] is of shape \(\d+,\) and type float64: must be of shape \(\d+,\)",
        ),
        ({"actuator": "ideal"}, r"snapshot\['physics'\] is of shape "),
        ({"physics": "analytic"}, r"snapshot\['physics'\] is of shape \(9,\) "),
        ({"disturbances": {"command_delay": 0.1}}, r"snapshot\['disturbances'\] is of shape .*: must be missing"),
        ({"randomize": {"motor.inductance": Uniform(0.1, 0.2)}}, r"snapshot\['drawn'\] is of shape \(1,\)"),
    ],
)
def test_a_snapshot_of_others_is_refused_and_nothing_changes(other, message):
    env = _plain()
    before = env.snapshot()
    with pytest.raises(ValueError, match=f"^{message}"):
        env.restore(_plain(**other).snapshot())
    assert_same(env.snapshot(), before)


def test_a_task_of_the_same_shapes_is_refused_by_name():
    env = _plain()
    before = env.snapshot()
    wrong = before | {"task": np.frombuffer(b"pendulum", dtype=np.uint8)}
    with pytest.raises(ValueError, match=r"^snapshot\['task'\] is of b'pendulum': must be of 'cartpole'"):
        env.restore(wrong)
    with pytest.raises(
        ValueError, match=r"^snapshot\['generator'\] is missing: must be of shape \(6,\) and type uint64"
    ):
        env.restore({name: value for name, value in before.items() if name != "generator"})
    with pytest.raises(ValueError, match=r"^snapshot\['physics'\] is of shape .* and type float32"):
        env.restore(before | {"physics": before["physics"].astype(np.float32)})
    assert_same(env.snapshot(), before)


def test_a_foreign_generator_is_refused():
    env = _plain()
    env.np_random = np.random.Generator(np.random.MT19937(0))
    with pytest.raises(ValueError, match="np_random is a MT19937: must be a PCG64"):
        env.snapshot()


@both_physics
def test_other_numbers_of_environments_are_refused(physics):
    make = TASKS["cartpole"].env_id
    arguments = everything("cartpole", physics)
    three, four = (codrl_mj.make_sb3_vec_env(make, count, **arguments) for count in (3, 4))
    before = three.snapshot()
    for wrong in (four.snapshot(), {name: value for name, value in before.items() if name != "lengths"}):
        with pytest.raises(ValueError, match=r"^snapshot\['\w+'\] is "):
            three.restore(wrong)
    assert_same(three.snapshot(), before)


def test_before_the_first_reset_the_motors_are_the_nominal_ones_again():
    arguments = {"actuator": "paper", "randomize": {"motor.inductance": Uniform(0.15, 0.3)}}
    envs = gymnasium.make_vec("codrl_mj/Pendulum-v0", 2, "vector_entry_point", **arguments).unwrapped
    before, nominal = envs.snapshot(), envs.physics.field("actuator_user").copy()
    envs.reset(seed=0)
    assert (envs.physics.field("actuator_user") != nominal).any()
    envs.restore(before)
    np.testing.assert_array_equal(envs.physics.field("actuator_user"), nominal)
    assert np.isnan(envs.randomization["motor.inductance"]).all()
