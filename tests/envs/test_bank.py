"""The bank of actuators: one object for tasks, batches and third-party models."""

import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.envs.bank import ActuatorBank

ARGUMENTS = {
    "observe_actuator": True,
    "randomize": {"motor.resistance": "uniform(1, 2)"},
    "disturbances": {"command_delay": 0.02},
}


def make(kind):
    """Return an environment with a motor of one kind, as one simulation or as a batch of three."""
    if kind == "batch":
        return codrl_mj.make_vec("pendulum", 3, "paper", **ARGUMENTS)
    if kind == "task":
        return codrl_mj.make("pendulum", "paper", **ARGUMENTS).unwrapped
    arguments = ARGUMENTS | {"randomize": {".*:motor.resistance": "uniform(1, 2)"}}
    actuator = codrl_mj.make("pendulum", "paper").unwrapped.actuator
    return codrl_mj.make("InvertedPendulum-v5", {".*": actuator}, **arguments)


@pytest.mark.parametrize(("kind", "count"), [("task", 1), ("batch", 3), ("model", 1)])
def test_it_says_what_the_actuators_are_take_draw_sense_and_report(kind, count):
    env = make(kind)
    bank = env.bank
    env.reset(seed=0)
    assert isinstance(bank, ActuatorBank)
    assert bank.names == {"model": ("slide",)}.get(kind, ("motor",))
    assert bank.sensors
    assert bank.action_space == (env.single_action_space if kind == "batch" else env.action_space)
    assert set(bank.signal_names) >= {"desired_force", "actual_force", "current", "saturated"}
    (values,) = (
        column for path, column in bank.randomization.drawn_values().items() if path != "rejected"
    )
    assert values.shape == (count,)
    assert len(set(values.tolist())) == count
    assert 1.0 <= values.min() <= values.max() <= 2.0
    assert bank.motors[0].motor.resistance == values[0]
    assert bank.memory.size > 0


@pytest.mark.parametrize("kind", ["task", "batch", "model"])
def test_a_restored_bank_has_the_drawn_motors_and_the_delayed_commands(kind):
    env = make(kind)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    before, resistance = env.bank.snapshot(), env.bank.motors[0].motor.resistance
    env.reset(seed=1)
    assert env.bank.motors[0].motor.resistance != resistance
    assert (env.bank.snapshot()["disturbances"] != before["disturbances"]).any()
    env.bank.restore(before)
    assert env.bank.motors[0].motor.resistance == resistance
    for name, values in before.items():
        np.testing.assert_array_equal(env.bank.snapshot()[name], values, err_msg=name)


@pytest.mark.parametrize("actuator", ["ideal", "paper"])
def test_a_key_is_drawn_only_if_something_random_needs_one(actuator):
    bank, generator = codrl_mj.make("cartpole", actuator).unwrapped.bank, np.random.default_rng(0)
    assert bank.key(generator) == 0.0
    assert generator.random() == np.random.default_rng(0).random()


def test_a_key_is_an_integer_that_float64_holds():
    disturbances = {"pulse_force": 1.0, "pulse_duration": 0.1, "pulse_interval": 1.0}
    bank = codrl_mj.make("cartpole", "ideal", disturbances=disturbances).unwrapped.bank
    key = bank.key(np.random.default_rng(0))
    assert key == np.random.default_rng(0).random() * MAX_KEY
    assert key == int(key)
