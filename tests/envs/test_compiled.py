"""The compiled step and reset: equal to their parts, in custom loops, and in threads."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import mujoco
import numba
import numpy as np
import pytest

from codrl_mj import Uniform
from codrl_mj.actuators import IDEAL, DCMotorActuator, override_actuator
from codrl_mj.engine.families import signals_offset
from codrl_mj.envs import ActuatedEnv
from codrl_mj.envs.compiled import compiled_env
from codrl_mj.tasks import TASKS, named_actuator
from tests.matrix import matrix_params
from tests.tasks.faces import REBUILT, actions, desired_force, every_rebuilt, random_states

every_task = pytest.mark.parametrize("task", TASKS)
NOISY = {"controller": {"current_noise": 0.05, "current_bias": 0.1}, "supply": {"resistance": 0.01}}
PULSES = {"pulse_force": 0.3, "pulse_duration": 0.1, "pulse_interval": 0.5}
SETUPS = {
    "ideal": {"actuator": "ideal"},
    "motor": {"observe_actuator": True},
    "disturbed": {
        "disturbances": {
            "command_delay": 0.03,
            "command_quantum": 0.1,
            "command_rate": 50.0,
            **PULSES,
        }
    },
    "sensing": {"observe_actuator": True, "actuator": NOISY},
    "voltage": {"observe_actuator": True, "action": "voltage", "actuator": NOISY},
}
QUICK_CASES = [("pendulum", "motor"), ("cartpole", "disturbed")]
every_setup = pytest.mark.parametrize(
    ("task", "setup"), matrix_params(QUICK_CASES, itertools.product(REBUILT, SETUPS))
)


def _env(task, setup="motor", **options):
    arguments = SETUPS[setup] | options
    if arguments.get("action") == "voltage" and isinstance(
        TASKS[task].action_space, gymnasium.spaces.Discrete
    ):
        arguments |= {"levels": (-3.0, 0.0, 3.0)}
    if arguments.get("actuator") is NOISY:
        arguments |= {"actuator": override_actuator(named_actuator("paper", task), NOISY)}
    return ActuatedEnv(task, **arguments)


def _plain_step(env, task, state, force):
    """Take a step by MuJoCo's bindings and the task's Python functions; return state and force."""
    definition, model, data = TASKS[task], env.model, mujoco.MjData(env.model)
    positions, velocities = list(definition.qpos), list(definition.qvel)
    data.qpos[:], data.qvel[:] = state[positions], state[velocities]
    arm = env.actuator.arm_radius
    data.ctrl[0] = force * arm
    for _ in range(env.setup.inner_steps):
        explicit_positions = data.qpos + model.opt.timestep * data.qvel
        mujoco.mj_step(model, data)
        if env.setup.simulation.integrator == "euler":
            data.qpos[:] = explicit_positions
        state = np.empty_like(state)
        state[positions], state[velocities] = data.qpos, data.qvel
        if definition.constrain is not None:
            state = np.array(definition.constrain(state, model.opt.timestep))
            data.qpos[:], data.qvel[:] = state[positions], state[velocities]
    if env.actuator == IDEAL:
        return state, force
    return state, env.actuator.motor.torque_constant * data.act[
        signals_offset(DCMotorActuator)
    ] / arm


@every_rebuilt
@pytest.mark.parametrize("setup", ["ideal", "motor"])
def test_a_step_is_the_composition_of_engine_bounds_and_task(task, setup):
    definition = TASKS[task]
    for integrator in definition.integrators:
        env = _env(task, setup, integrator=integrator)
        env.reset(seed=0)
        for before, action in zip(random_states(task, 7, 100), actions(task, 8, 100), strict=True):
            env.physics.reset(before)
            after, actual = _plain_step(env, task, before, desired_force(task, action))
            observation, reward, terminated, truncated, info = env.step(action)
            np.testing.assert_array_equal(env.state, after)
            assert info["actual_force"] == pytest.approx(actual, rel=1e-15)
            size = len(definition.observation_names)
            expected = np.array(definition.observation(after), np.float32)
            np.testing.assert_allclose(observation[:size], expected, rtol=2e-7, atol=0)
            np.testing.assert_array_equal(
                observation[size:],
                np.float32([info["current"], info["reference_current"]])[: len(observation) - size],
            )
            expected_reward = definition.reward(
                before, info["actual_force"], after, definition.options()
            )
            assert reward == pytest.approx(float(expected_reward), rel=1e-14, abs=1e-14)
            assert terminated == bool(definition.terminated(after))
            assert not truncated


@numba.njit
def _episode(
    step, reset, forces, indices, generator, low, high, rows, rewards, observation, pointers
):
    reset(generator, low, high, pointers)
    rows[0] = observation
    for index in range(len(indices)):
        force = forces[indices[index]]
        reward, terminated, is_finite = step(force, pointers)
        rows[index + 1] = observation
        rewards[index] = reward
        if terminated or not is_finite:
            return index + 1
    return len(indices)


@every_setup
def test_a_compiled_loop_is_the_loop_over_the_environment_bit_for_bit(task, setup):
    ours, theirs = _env(task, setup), _env(task, setup)
    parts = compiled_env(ours)
    ours.reset(seed=3)
    theirs.reset(seed=3)
    generator = np.random.default_rng(0)
    forces = parts.forces
    if forces is None:
        table = generator.uniform(-1, 1, (50, 1)).astype(np.float32) * ours.action_space.high
        forces, indices = (
            np.array([theirs.setup.commands.force(action) for action in table]),
            np.arange(50),
        )
        env_actions = list(table)
    else:
        indices = generator.integers(len(forces), size=50)
        env_actions = list(indices)
    rows, rewards = np.zeros((51, *ours.observation_space.shape), np.float32), np.zeros(50)
    loop = (forces, indices, ours.np_random, parts.low, parts.high, rows, rewards)
    num_steps = _episode(parts.step, parts.reset, *loop, parts.observation, parts.pointers)
    observation, _ = theirs.reset()
    np.testing.assert_array_equal(rows[0], observation)
    for index in range(num_steps):
        observation, reward, terminated, _, _ = theirs.step(env_actions[index])
        np.testing.assert_array_equal(rows[index + 1], observation)
        assert rewards[index] == reward
    assert terminated or num_steps == 50
    np.testing.assert_array_equal(ours.state, theirs.state)
    np.testing.assert_array_equal(ours.physics.trace, theirs.physics.trace)
    assert ours.np_random.random() == theirs.np_random.random()


def test_environments_that_need_python_are_not_compiled():
    assert compiled_env(ActuatedEnv("pendulum", physics="analytic")) is None
    assert (
        compiled_env(ActuatedEnv("pendulum", randomize={"motor.inductance": Uniform(0.08, 0.12)}))
        is None
    )


def test_a_step_starts_from_data_that_the_user_has_written():
    env = _env("pendulum", "ideal")
    env.reset(seed=0)
    env.step(np.zeros(1))
    env.data.qpos[0], env.data.qvel[0] = np.pi / 2, 1.0
    _, reward, _, _, _ = env.step(np.zeros(1))
    assert reward == pytest.approx(-((np.pi / 2) ** 2 + 0.1), rel=1e-12)
    # The acceleration is 3 g / (2 l) sin(theta) = 15.
    assert env.state[1] == pytest.approx(1.0 + 0.05 * 15.0, rel=1e-12)


def test_threads_do_not_disturb_each_other():
    def run(seed):
        env = _env("cartpole")
        env.reset(seed=seed)
        for index in range(300):
            env.step((index * seed) % 2)
        return env.state

    sequential = [run(seed) for seed in range(1, 9)]
    with ThreadPoolExecutor(4) as pool:
        concurrent = list(pool.map(run, range(1, 9)))
    np.testing.assert_array_equal(sequential, concurrent)
