"""Snapshots: the whole state of an environment as plain arrays, and refused snapshots."""

import numpy as np
import pytest

from codrl_mj import Uniform, make_sb3_vec_env, make_vec, suite
from codrl_mj.envs import ActuatedEnv
from tests.conformance.environments import COUNT, LIMITED, arguments
from tests.conformance.episodes import assert_same, run, start_episode
from tests.envs.vectors import batched
from tests.tasks.faces import every_rebuilt

both_physics = pytest.mark.parametrize("physics", ["mujoco", "analytic"])
INTERFACES = {
    "single": ActuatedEnv,
    "batch": lambda task, **options: batched(task, COUNT, **LIMITED, **options).unwrapped,
    "serial": lambda task: make_vec(task, COUNT, physics="analytic", **LIMITED),
    "sb3": lambda task: make_sb3_vec_env(task, COUNT, **LIMITED),
    "dm_env": lambda task: suite.load(task, **LIMITED),
}


def _started_env(interface="single", task="cartpole", **options):
    env = INTERFACES[interface](task, **options)
    start_episode(env, 0)
    return env


@both_physics
def test_a_minimal_environment_has_a_minimal_snapshot(physics):
    assert _started_env(actuator="ideal", physics=physics).snapshot().keys() == {
        "task",
        "physics",
        "generator",
    }


@both_physics
def test_every_entry_of_a_snapshot_matters(physics):
    """Each entry of a snapshot has an effect on what follows."""
    env = ActuatedEnv("pendulum", physics=physics, **arguments("pendulum", "randomized", physics))
    snapshots = []
    for seed in (0, 1):
        start_episode(env, seed)
        run(env, 57 - seed, seed)
        snapshots.append(env.snapshot())
    snapshot, other_snapshot = snapshots
    env.restore(snapshot)
    expected = run(env, 60, seed=1)
    for name in snapshot.keys() - {"task"}:
        env.restore(snapshot | {name: other_snapshot[name]})
        if name == "rejected":
            assert env.randomization["rejected"] == other_snapshot["rejected"]
            continue
        with pytest.raises(AssertionError):
            assert_same(run(env, 60, seed=1), expected)


@every_rebuilt
def test_the_model_is_restored_to_its_last_number(task):
    env, other_env = (ActuatedEnv(task, **arguments(task, "randomized")) for _ in range(2))
    start_episode(env, 5)
    start_episode(other_env, 99)
    other_env.restore(env.snapshot())
    assert other_env.actuator == env.actuator
    for name in dir(env.model):
        if isinstance(value := getattr(env.model, name), np.ndarray):
            np.testing.assert_array_equal(getattr(other_env.model, name), value, err_msg=name)
    np.testing.assert_array_equal(other_env.model.opt.gravity, env.model.opt.gravity)


@pytest.mark.parametrize(
    ("interface", "options", "message"),
    [
        (
            "single",
            {"task": "acrobot"},
            r"\['task'\] is of shape \(7,\) and type uint8: must be of shape \(8,\)",
        ),
        (
            "single",
            {"task": "pendulum"},
            r"\['physics'\] is of shape \(\d+,\) and type float64: must be of shape \(\d+,",
        ),
        ("single", {"actuator": "ideal"}, r"\['physics'\] is of shape "),
        ("single", {"physics": "analytic"}, r"\['physics'\] is of shape \(9,\) "),
        (
            "single",
            {"disturbances": {"command_delay": 0.1}},
            r"\['disturbances'\] is of shape .*: must be missing",
        ),
        (
            "single",
            {"randomize": {"motor.inductance": Uniform(0.1, 0.2)}},
            r"\['drawn'\] is of shape \(1,\)",
        ),
        ("batch", {"task": "pendulum"}, r"\['physics'\] is of shape "),
    ],
)
def test_raises_for_a_snapshot_of_another_environment_and_changes_nothing(
    interface, options, message
):
    env = _started_env(interface)
    before = env.snapshot()
    with pytest.raises(ValueError, match=rf"^snapshot{message}"):
        env.restore(_started_env(interface, **options).snapshot())
    assert_same(env.snapshot(), before)


@pytest.mark.parametrize(
    ("interface", "entry", "change", "message"),
    [
        (
            "single",
            "task",
            lambda _: np.frombuffer(b"pendulum", np.uint8),
            "of b'pendulum': must be of 'cartpole'",
        ),
        ("single", "physics", np.float32, "of shape .* and type float32"),
        ("single", "generator", None, r"missing: must be of shape \(6,\) and type uint64"),
        ("batch", "physics", lambda rows: rows[:2], r"of shape \(2, \d+\)"),
        ("batch", "elapsed", lambda rows: rows[:2], r"of shape \(2,\)"),
        ("batch", "streams", None, "missing"),
        ("serial", "physics", lambda rows: rows[:2], r"of shape \(2, \d+\)"),
        ("sb3", "physics", lambda rows: rows[:2], r"of shape \(2, \d+\)"),
        ("sb3", "lengths", None, "missing"),
        ("dm_env", "physics", lambda row: row[:-1], "of shape"),
        ("dm_env", "elapsed", None, "missing"),
    ],
)
def test_raises_for_a_snapshot_with_a_wrong_entry_and_changes_nothing(
    interface, entry, change, message
):
    env = _started_env(interface)
    before = env.snapshot()
    incomplete = {name: value for name, value in before.items() if name != entry}
    with pytest.raises(ValueError, match=rf"^snapshot\['{entry}'\] is {message}"):
        env.restore(incomplete if change is None else before | {entry: change(before[entry])})
    assert_same(env.snapshot(), before)


def test_raises_for_a_generator_of_another_type():
    env = ActuatedEnv("cartpole")
    env.np_random = np.random.Generator(np.random.MT19937(0))
    with pytest.raises(ValueError, match="np_random is a MT19937: must be a PCG64"):
        env.snapshot()
