"""The whole state of environments as plain arrays: what it is made of, and whose is refused."""

import numpy as np
import pytest

from codrl_mj import Uniform
from codrl_mj.envs import ActuatedEnv
from tests.envs.faces import FACES, PHYSICS, arguments, begun, run
from tests.envs.vectors import assert_same
from tests.tasks.faces import every_rebuilt

both_physics = pytest.mark.parametrize("physics", PHYSICS)


def _begun(face="one", task="cartpole", **given):
    env = FACES[face](task, **given)
    begun(env, 0)
    return env


@both_physics
def test_a_snapshot_is_as_small_as_can_be_without_motor_draws_and_disturbances(physics):
    assert _begun(actuator="ideal", physics=physics).snapshot().keys() == {
        "task",
        "physics",
        "generator",
    }


@both_physics
def test_a_wrong_bit_is_seen(physics):
    """Each entry of a snapshot has an effect on what follows."""
    env = ActuatedEnv("pendulum", physics=physics, **arguments("pendulum", "everything", physics))
    snapshots = []
    for seed in (0, 1):
        begun(env, seed)
        run(env, 57 - seed, seed)
        snapshots.append(env.snapshot())
    snapshot, other = snapshots
    env.restore(snapshot)
    expected = run(env, 60, seed=1)
    for name in snapshot.keys() - {"task"}:
        env.restore(snapshot | {name: other[name]})
        if name == "rejected":
            assert env.randomization["rejected"] == other["rejected"]
            continue
        with pytest.raises(AssertionError):
            assert_same(run(env, 60, seed=1), expected)


@every_rebuilt
def test_the_model_is_restored_to_its_last_number(task):
    env, other = (ActuatedEnv(task, **arguments(task, "everything")) for _ in range(2))
    begun(env, 5)
    begun(other, 99)
    other.restore(env.snapshot())
    assert other.actuator == env.actuator
    for name in dir(env.model):
        if isinstance(value := getattr(env.model, name), np.ndarray):
            np.testing.assert_array_equal(getattr(other.model, name), value, err_msg=name)
    np.testing.assert_array_equal(other.model.opt.gravity, env.model.opt.gravity)


@pytest.mark.parametrize(
    ("face", "given", "message"),
    [
        (
            "one",
            {"task": "acrobot"},
            r"\['task'\] is of shape \(7,\) and type uint8: must be of shape \(8,\)",
        ),
        (
            "one",
            {"task": "pendulum"},
            r"\['physics'\] is of shape \(\d+,\) and type float64: must be of shape \(\d+,",
        ),
        ("one", {"actuator": "ideal"}, r"\['physics'\] is of shape "),
        ("one", {"physics": "analytic"}, r"\['physics'\] is of shape \(9,\) "),
        (
            "one",
            {"disturbances": {"command_delay": 0.1}},
            r"\['disturbances'\] is of shape .*: must be missing",
        ),
        (
            "one",
            {"randomize": {"motor.inductance": Uniform(0.1, 0.2)}},
            r"\['drawn'\] is of shape \(1,\)",
        ),
        ("many, NextStep", {"task": "pendulum"}, r"\['physics'\] is of shape "),
    ],
)
def test_a_snapshot_of_others_is_refused_and_nothing_changes(face, given, message):
    env = _begun(face)
    before = env.snapshot()
    with pytest.raises(ValueError, match=rf"^snapshot{message}"):
        env.restore(_begun(face, **given).snapshot())
    assert_same(env.snapshot(), before)


@pytest.mark.parametrize(
    ("face", "entry", "changed", "message"),
    [
        (
            "one",
            "task",
            lambda _: np.frombuffer(b"pendulum", np.uint8),
            "of b'pendulum': must be of 'cartpole'",
        ),
        ("one", "physics", np.float32, "of shape .* and type float32"),
        ("one", "generator", None, r"missing: must be of shape \(6,\) and type uint64"),
        ("many, NextStep", "physics", lambda rows: rows[:2], r"of shape \(2, \d+\)"),
        ("many, NextStep", "elapsed", lambda rows: rows[:2], r"of shape \(2,\)"),
        ("many, NextStep", "streams", None, "missing"),
        ("serial, analytic", "physics", lambda rows: rows[:2], r"of shape \(2, \d+\)"),
        ("Stable-Baselines3", "physics", lambda rows: rows[:2], r"of shape \(2, \d+\)"),
        ("Stable-Baselines3", "lengths", None, "missing"),
        ("dm_control", "physics", lambda row: row[:-1], "of shape"),
        ("dm_control", "elapsed", None, "missing"),
    ],
)
def test_a_snapshot_with_a_wrong_entry_is_refused_and_nothing_changes(
    face, entry, changed, message
):
    env = _begun(face)
    before = env.snapshot()
    wrong = {name: value for name, value in before.items() if name != entry}
    with pytest.raises(ValueError, match=rf"^snapshot\['{entry}'\] is {message}"):
        env.restore(wrong if changed is None else before | {entry: changed(before[entry])})
    assert_same(env.snapshot(), before)


def test_a_foreign_generator_is_refused():
    env = ActuatedEnv("cartpole")
    env.np_random = np.random.Generator(np.random.MT19937(0))
    with pytest.raises(ValueError, match="np_random is a MT19937: must be a PCG64"):
        env.snapshot()
