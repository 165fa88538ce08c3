"""Load pulses: their times, their size, and their effect."""

import gymnasium
import numpy as np
import pytest
from scipy import stats

from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.disturbances import START, Disturbances
from codrl_mj.physics.disturber import Disturber

FORCE, DURATION, INTERVAL = 2.0, 0.33, 0.8
PULSES = Disturbances(pulse_force=FORCE, pulse_duration=DURATION, pulse_interval=INTERVAL)


def _loads(timestep, steps, simulations, seed=0):
    """Return loads (steps, simulations), and the next start of a pulse before each step."""
    disturber = Disturber(PULSES, timestep, np.array([10.0]), simulations)
    keys = np.floor(np.random.default_rng(seed).random(simulations) * MAX_KEY)
    disturber.reset(np.arange(simulations), keys)
    loads, starts = [], []
    for _ in range(steps):
        loads.append(disturber.disturb_commands(np.zeros((simulations, 1)))[1][:, 0])
        starts.append(disturber.memory[:, -4 + START].copy())
    return np.array(loads), np.array(starts)


def test_pulses_cover_their_share_of_time_with_both_signs():
    simulations, duration = 200, 100.0
    loads, _ = _loads(0.05, round(duration / 0.05), simulations)
    assert np.abs(loads).max() == FORCE
    busy = np.abs(loads).mean() / FORCE
    cycles = simulations * duration / (DURATION + INTERVAL)
    assert busy == pytest.approx(DURATION / (DURATION + INTERVAL), rel=5 / np.sqrt(cycles))
    assert abs(loads.mean()) < 5 * FORCE * DURATION / (DURATION + INTERVAL) / np.sqrt(cycles)


def test_the_time_between_pulses_is_exponentially_distributed():
    _, starts = _loads(0.05, 2000, 50)
    waits = [starts[0]]
    for row in starts.T:
        distinct = np.unique(row)
        waits.append(np.diff(distinct) - DURATION)
    waits = np.concatenate(waits)
    assert stats.kstest(waits, "expon", args=(0, INTERVAL)).pvalue > 1e-3


def test_environments_and_keys_have_different_pulses():
    loads, _ = _loads(0.05, 400, 40)
    loads_with_other_seed, _ = _loads(0.05, 400, 40, seed=1)
    assert len(np.unique(loads, axis=1).T) == 40
    assert not (loads == loads_with_other_seed).all(axis=0).any()


def test_the_impulse_does_not_depend_on_the_integration_step():
    # A step is longer than a pulse and contains several pulses.
    coarse_loads, _ = _loads(0.5, 100, 10)
    fine_loads, _ = _loads(0.01, 5000, 10)
    np.testing.assert_allclose(
        coarse_loads, fine_loads.reshape(100, 50, 10).mean(axis=1), atol=1e-10
    )


def test_the_impulse_of_a_pulse_is_its_force_times_its_duration():
    disturber = Disturber(
        Disturbances(pulse_force=3.0, pulse_duration=0.07, pulse_interval=40.0), 0.02, np.ones(1), 1
    )
    disturber.reset(np.zeros(1, np.int64), 5.0)
    loads = np.array([disturber.disturb_commands(np.zeros((1, 1)))[1][0, 0] for _ in range(4000)])
    (first,) = np.flatnonzero(np.diff((loads != 0).astype(int)) == 1)[:1]
    assert abs(loads[first : first + 8].sum() * 0.02) == pytest.approx(3.0 * 0.07, rel=1e-9)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
@pytest.mark.parametrize(
    "task", ["Pendulum", "CartPole", "Acrobot", "MountainCar", "MountainCarContinuous"]
)
def test_an_endless_pulse_equals_a_constant_actuator_force(task, physics):
    force = {"Pendulum": 1.5, "CartPole": 10.0, "Acrobot": 1.0}.get(task, 0.5)
    endless = {"pulse_force": force, "pulse_duration": 1e9, "pulse_interval": 1e-12}

    def run(actual, disturbances=None):
        env = gymnasium.make(
            f"codrl_mj/{task}-v0", actuator="ideal", physics=physics, disturbances=disturbances
        )
        env.reset(seed=3)
        for _ in range(10):
            env.unwrapped.physics.step(actual)
        return env.unwrapped.state

    loaded = run(0.0, endless)
    forward, backward = run(force), run(-force)
    errors = [np.abs(loaded - unloaded).max() for unloaded in (forward, backward)]
    assert min(errors) < 1e-9
    assert max(errors) > 1e-3
