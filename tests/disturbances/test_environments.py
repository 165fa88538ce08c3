"""Disturbances in environments: each changes the result, and defaults change nothing."""

import gymnasium
import numpy as np
import pytest

from codrl_mj.tasks import TASKS
from tests.conformance.episodes import assert_same, plain, run
from tests.disturbances.everything import MOST, RUBBED, imperfect
from tests.matrix import matrix_params

WEAK = {"controller": {"kp": 1.0, "ki": 0.5, "max_voltage": 3.0}}
EACH = {
    **{name: {"disturbances": {name: MOST[name]}} for name in MOST if "pulse" not in name},
    "pulses": {"disturbances": {name: MOST[name] for name in MOST if "pulse" in name}},
    **{f"joint {name}": {"joint": {name: 0.1}} for name in RUBBED},
    "current_noise": {"actuator": {"controller": {**WEAK["controller"], "current_noise": 0.05}}},
    "current_bias": {"actuator": {"controller": {**WEAK["controller"], "current_bias": -0.02}}},
    "supply": {"actuator": {**WEAK, "supply": {"resistance": 0.7}}},
}
two_tasks = pytest.mark.parametrize("task", matrix_params(["pendulum", "cartpole"], TASKS))


def _env(task, **arguments):
    """Return an environment in its first episode."""
    env = gymnasium.make(
        TASKS[task].env_id, disable_env_checker=True, **{"actuator": WEAK} | arguments
    ).unwrapped
    env.reset(seed=1)
    return env


@pytest.mark.parametrize("disturbance", EACH)
def test_each_disturbance_alone_changes_the_result(disturbance):
    disturbed, undisturbed = _env("pendulum", **EACH[disturbance]), _env("pendulum")
    for value in np.linspace(-1.7, 1.9, 12, dtype=np.float32):
        disturbed.step(np.array([value]))
        undisturbed.step(np.array([value]))
    assert np.abs(disturbed.state - undisturbed.state).max() > 1e-6


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
@two_tasks
def test_disabled_disturbances_change_nothing(task, physics):
    off = {
        **WEAK,
        "controller": {**WEAK["controller"], "current_noise": 0.0, "current_bias": 0.0},
        "supply": {},
    }
    env = _env(task, disturbances={}, joint={}, actuator=off, physics=physics)
    # Later episodes are equal, too: no random key was drawn between episodes.
    assert_same(run(env, 60, seed=0), run(_env(task, physics=physics), 60, seed=0))
    if physics == "mujoco":
        assert env.physics._disturber.enabled is False


@two_tasks
def test_initial_states_are_the_same_with_and_without_disturbances(task):
    disturbed = _env(task, disturbances=MOST, joint=RUBBED, actuator=imperfect(WEAK))
    assert_same(plain(disturbed.state), plain(_env(task).state))
