"""Noise and bias of the current sensor, and the supply's resistance."""

import copy

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy import stats

from codrl_mj.actuators.noise import LOAD_STREAM, SENSOR_STREAM, philox, standard_normal
from tests.engine.models import VOLTAGE


def _still(**controller):
    """Return a motor without back-EMF under a proportional loop with additional settings."""
    return {
        "motor": {"back_emf_constant": 0.0},
        "controller": {"kp": 1.0, "max_voltage": float("inf"), **controller},
    }


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [  # the authors' reference values (Random123, kat_vectors, philox4x32 10)
        ([0] * 4, 0, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([0xFFFFFFFF] * 4, 2**64 - 1, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            0x299F31D0A4093822,
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_philox_equals_the_reference_values(counter, key, expected):
    assert list(philox(*counter, key)) == expected


def test_the_noise_is_standard_normal_and_white():
    numbers = np.array([standard_normal(12345.0, step, 0) for step in range(6000)])
    assert stats.kstest(numbers, "norm").pvalue > 1e-3
    for lag in (1, 2, 7):
        assert abs(np.corrcoef(numbers[lag:], numbers[:-lag])[0, 1]) < 4 / np.sqrt(len(numbers))
    others = [
        np.array([standard_normal(12346.0, step, 0) for step in range(2000)]),
        np.array([standard_normal(12345.0, step, 1) for step in range(2000)]),
    ]
    for other_noise in others:
        assert abs(np.corrcoef(numbers[:2000], other_noise)[0, 1]) < 4 / np.sqrt(2000)
    assert SENSOR_STREAM != LOAD_STREAM


def test_every_environment_has_its_own_white_noise():
    envs, steps, deviation = 100, 100, 0.25
    actuator = _still(current_noise=deviation, current_bias=0.125)
    env = gymnasium.make_vec("codrl_mj/Pendulum-v0", envs, "vector_entry_point", actuator=actuator)
    env.reset(seed=0)
    current, noise = np.zeros(envs), []
    for _ in range(steps):
        infos = env.step(np.full((envs, 1), 1.5, np.float32))[4]
        # The voltage is u = kp*(i_ref - (i + error)) with kp = 1.
        noise.append(1.5 - current - infos["voltage"])
        current = infos["current"]
    noise = np.array(noise)
    assert noise.mean() == pytest.approx(0.125, abs=4 * deviation / np.sqrt(noise.size))
    assert noise.std() == pytest.approx(deviation, rel=4 / np.sqrt(2 * noise.size))
    assert stats.kstest((noise.ravel() - 0.125) / deviation, "norm").pvalue > 1e-3
    assert np.abs(np.corrcoef(noise.T)[np.triu_indices(envs, 1)]).max() < 6 / np.sqrt(steps)
    assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 4 / np.sqrt(noise.size)


@pytest.mark.parametrize("task", ["Pendulum", "Acrobot"])
def test_the_noise_of_a_step_is_always_the_same(task):
    env = gymnasium.make(
        f"codrl_mj/{task}-v0", actuator={"controller": {"current_noise": 0.5}}
    ).unwrapped
    env.reset(seed=4)
    env.action_space.seed(0)
    env.step(env.action_space.sample())
    model, data = env.model, env.data
    mujoco.mj_forward(model, data)
    act = data.act.copy()
    data_copy = copy.copy(data)
    for data_ in (data, data_copy):
        mujoco.mj_forward(model, data_)
        np.testing.assert_array_equal(data_.act, act)
    full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    saved = np.empty(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, saved, full)
    mujoco.mj_step(model, data)
    fresh = mujoco.MjData(model)
    mujoco.mj_setState(model, fresh, saved, full)
    fresh.ctrl[:] = data.ctrl
    mujoco.mj_step(model, fresh)
    np.testing.assert_array_equal(fresh.act, data.act)
    mujoco.mj_forward(model, data)
    assert data.act[VOLTAGE] != act[VOLTAGE]


def test_noise_differs_by_episode_and_seed_and_repeats_with_the_seed():
    def voltages(*seeds):
        env = gymnasium.make(
            "codrl_mj/Pendulum-v0", actuator={"controller": {"current_noise": 0.5}}
        )
        voltages_of_episodes = []
        for seed in seeds:
            env.reset(seed=seed)
            voltages_of_episodes.append(
                [env.step(np.zeros(1, np.float32))[4]["voltage"] for _ in range(3)]
            )
        return voltages_of_episodes

    first, second, third = voltages(0, None, 1)
    assert voltages(0, None)[0] == first
    assert len({*first, *second, *third}) == 9


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_a_bias_shifts_the_steady_current_as_computed(physics):
    kp, bias = 1.0, 0.3
    arguments = {"physics": physics, "observe_actuator": True}
    env = gymnasium.make("codrl_mj/Pendulum-v0", actuator=_still(current_bias=bias), **arguments)
    start = env.reset(seed=0)[0]
    # In the steady state kp*(i_ref - i - b) = R*i.
    for _ in range(60):
        observation, *_, info = env.step(np.array([1.5], np.float32))
    assert info["current"] == pytest.approx(kp * (1.5 - bias) / (1.0 + kp), rel=1e-9)
    assert start[-2] == np.float32(bias)
    assert observation[-2] == pytest.approx(info["current"] + bias, rel=1e-6)

    integral = _still(ki=5.0, max_voltage=24.0, current_bias=bias)
    env = gymnasium.make("codrl_mj/Pendulum-v0", actuator=integral, **arguments)
    env.reset(seed=0)
    # The integral corrects the *measured* current.
    for _ in range(150):
        info = env.step(np.array([1.5], np.float32))[4]
    assert info["current"] == pytest.approx(1.5 - bias, rel=1e-9)


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_a_noisy_observation_is_the_controllers_next_measurement(physics):
    actuator = _still(current_noise=0.2, current_bias=0.1)
    arguments = {"physics": physics, "actuator": actuator, "observe_actuator": True}
    env = gymnasium.make("codrl_mj/Pendulum-v0", **arguments)
    measured = env.reset(seed=0)[0][-2]
    for _ in range(20):
        observation, *_, info = env.step(np.array([1.5], np.float32))
        # The gain kp is 1.
        assert info["voltage"] == pytest.approx(1.5 - measured, abs=1e-6)
        measured = observation[-2]


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
@pytest.mark.parametrize(("supply", "substeps"), [(0.0, 1), (0.5, 1), (8.0, 4)])
def test_a_supply_with_a_resistance_stalls_the_motor_as_computed(physics, supply, substeps):
    motor = {"resistance": 1.5, "torque_constant": 0.1, "back_emf_constant": 0.0}
    actuator = {"motor": motor, "controller": {"kp": 1.0, "max_voltage": 5.0, "substeps": substeps}}
    actuator["supply"] = {"resistance": supply}
    env = gymnasium.make("codrl_mj/Pendulum-v0", physics=physics, actuator=actuator)
    env.reset(seed=0)
    for _ in range(80):
        info = env.step(np.array([-2.0], np.float32))[4]
    assert info["current"] == pytest.approx(-5.0 / (1.5 + supply), rel=1e-9)
    assert info["voltage"] == pytest.approx(-5.0 * 1.5 / (1.5 + supply), rel=1e-9)
    assert info["saturated"]


def test_the_voltage_of_an_overloaded_supply_is_zero_and_never_reversed():
    env = gymnasium.make(
        "codrl_mj/Pendulum-v0",
        actuator={"controller": {"max_voltage": 1.0}, "supply": {"resistance": 100.0}},
        allow_unstable=True,
    )
    env.reset(seed=0)
    voltages = [env.step(np.array([2.0], np.float32))[4]["voltage"] for _ in range(20)]
    assert max(np.abs(voltages)) <= 1.0
    assert 0.0 in voltages
