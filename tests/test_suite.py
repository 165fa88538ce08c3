"""The dm_control interface keeps dm_env's contract, and equals the Gymnasium environment."""

import copy
import re

import gymnasium
import mujoco
import numpy as np
import pytest
from dm_control.suite.wrappers import pixels

from codrl_mj import suite
from codrl_mj.actuators import IDEAL, CurrentLoop, DCMotorActuator, Motor
from codrl_mj.envs.config import EnvConfig
from codrl_mj.physics import SimulationDivergedError
from codrl_mj.tasks import TASKS, named_actuator
from tests.conftest import REPRESENTATIVES
from tests.engine.models import FULL, changed
from tests.matrix import matrix_params
from tests.tasks.faces import every_rebuilt

MOTOR = changed(FULL, inductance=0.2, max_voltage=20.0)

every_task = pytest.mark.parametrize("task", TASKS)


# -- loading ---------------------------------------------------------------------------------------


def test_all_tasks_are_listed():
    assert [domain for domain, _ in suite.ALL_TASKS] == list(TASKS)
    assert {name for _, name in suite.ALL_TASKS} == {"gym"}


def test_options_replace_those_of_a_configuration():
    config = EnvConfig(
        "cartpole", "weak", inner_steps=4, options={"center_radius": 0.5}, max_episode_steps=7
    )
    same = suite.load(config)
    assert (same.setup.config.actuator, same.setup.inner_steps) == (config.actuator, 4)
    assert same.setup.config.options.center_radius == 0.5
    overridden = suite.load(config, actuator="weaker", inner_steps=2, sutton_barto_reward=True)
    assert overridden.setup.config.actuator == named_actuator("weaker", "cartpole")
    assert overridden.setup.inner_steps == 2
    assert overridden.setup.config.options == (0.5, True)
    assert suite.load(config, actuator="ideal").setup.config.actuator == IDEAL
    overridden.reset(), same.reset()
    assert [sum(not env.step(0).last() for _ in range(7)) for env in (overridden, same)] == [6, 6]
    limited = suite.load("pendulum", "gym", max_episode_steps=5)
    limited.reset()
    assert [limited.step([0.0]).last() for _ in range(5)] == [False] * 4 + [True]
    with pytest.raises(
        ValueError, match="unknown option 'innersteps' of cartpole: did you mean 'inner_steps'"
    ):
        suite.load(config, innersteps=2)


@every_task
def test_observations_have_names_or_are_a_single_vector(task):
    options = {"observe_actuator": True, "task_kwargs": {"random": 5}}
    named, flat = (
        suite.load(task, environment_kwargs={"flat_observation": is_flat}, **options)
        for is_flat in (False, True)
    )
    named_step, flat_step = named.reset(), flat.reset()
    names = [*TASKS[task].observation_names, "current", "reference_current"]
    assert [*named_step.observation] == [*named.observation_spec()] == names
    assert [*flat_step.observation] == [*flat.observation_spec()] == ["observations"]
    for action in _actions(named.action_space, 3, 0):
        np.testing.assert_array_equal(flat_step.observation["observations"], _vector(named_step))
        named_step, flat_step = named.step(action), flat.step(action)


# -- the Gymnasium environment, bit for bit -------------------------------------------------------


def _actions(space, count, seed):
    space = copy.deepcopy(space)
    space.seed(seed)
    return [space.sample() for _ in range(count)]


def _vector(timestep):
    return np.concatenate(list(timestep.observation.values()))


GOALS = {
    "cartpole": [2.39, 3.0, 0.0, 0.0],
    "acrobot": [np.pi, 0.0, 0.0, 0.0],
    "mountain_car": [0.5, 0.05],
    "mountain_car_continuous": [0.45, 0.05],
    "pendulum": [0.0, 0.0],
}


@pytest.mark.parametrize("task", GOALS)
def test_reaching_the_goal_terminates_with_discount_0(task):
    """Check the discount: 0 if the task terminates; the pendulum never does."""
    env = suite.load(task)
    env.reset()
    env.env.unwrapped.physics.reset(np.array(GOALS[task]))
    timestep = env.step(env.action_spec().generate_value())
    assert (timestep.last(), timestep.discount) == (
        (False, 1.0) if task == "pendulum" else (True, 0.0)
    )


# -- the time limit -------------------------------------------------------------------------------


@every_rebuilt
# The quotients of these numbers are rounded to more than the limit.
@pytest.mark.parametrize("inner_steps", [None, 19, 49, 73])
def test_an_episode_has_as_many_steps_as_in_gymnasium(task, inner_steps):
    env = suite.load(task, actuator="ideal", inner_steps=inner_steps)
    env.env.unwrapped.step = lambda _: (
        np.zeros(len(TASKS[task].observation_names)),
        0.0,
        False,
        False,
        {},
    )
    action = env.action_spec().generate_value()
    for _ in range(2):
        timestep, count = env.reset(), 0
        while not timestep.last():
            timestep, count = env.step(action), count + 1
        assert count == gymnasium.spec(TASKS[task].gymnasium_id).max_episode_steps
        assert timestep.discount == 1.0


# -- the physics ----------------------------------------------------------------------------------


@every_task
def test_the_physics_is_a_view_of_the_simulation(task):
    env = suite.load(task)
    env.reset()
    assert env.physics.data.ptr is env.data is env.env.unwrapped.data
    assert env.physics.model.ptr is env.model
    assert env.physics is env.physics
    assert env.control_timestep() == pytest.approx(TASKS[task].step_duration, rel=1e-15)
    env.step(env.action_spec().generate_value())
    assert env.physics.time() == pytest.approx(TASKS[task].step_duration)
    assert env.physics.named.data.qpos.shape == (len(TASKS[task].qpos),)


def _complete_state(physics):
    """Return the state to continue from: time, positions, velocities, motors, controls."""
    sig = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(physics.model.ptr, sig))
    mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, sig)
    return state


def _run_actions(env, actions):
    steps = [(env.step(action), _complete_state(env.physics)) for action in actions]
    return np.array(
        [
            [*_vector(timestep), timestep.reward, timestep.discount, *complete_state]
            for timestep, complete_state in steps
        ],
        float,
    )


@every_task
@pytest.mark.parametrize("ahead", range(-3, 4))
def test_a_snapshot_continues_the_same_at_any_time_of_restoring(task, ahead):
    """Restore when the clock is behind, equal or ahead, because the motor's tick depends on it."""
    env = suite.load(task, actuator=MOTOR, task_kwargs={"random": 0}, inner_steps=20)
    actions = _actions(env.action_space, 12, 2)
    env.reset()
    _run_actions(env, actions[:5])
    saved, complete_state = env.snapshot(), _complete_state(env.physics)
    rest = _run_actions(env, actions[5:])
    env.reset()
    _run_actions(env, actions[: 5 + ahead])
    # Half of the cases are one integration step off, where a tick could be mistaken for another.
    env.data.time += env.model.opt.timestep * (ahead % 2)
    env.restore(saved)
    np.testing.assert_array_equal(_complete_state(env.physics), complete_state)
    np.testing.assert_array_equal(_run_actions(env, actions[5:]), rest)


@every_task
def test_dm_controls_reset_context_keeps_the_user_s_state(task):
    """Check that dm_control's forward passes keep the user's state, and the motor at rest."""
    env = suite.load(task, actuator=MOTOR)
    env.reset()
    env.step(env.action_spec().generate_value())
    with env.physics.reset_context() as physics:
        physics.data.qpos[:] = 0.1
        physics.data.qvel[:] = 0.02
    assert env.physics.time() == 0.0
    np.testing.assert_array_equal(env.physics.position(), 0.1)
    np.testing.assert_array_equal(env.physics.velocity(), 0.02)
    np.testing.assert_array_equal(env.data.act, 0.0)
    reference = suite.load(task, actuator=MOTOR)
    reference.reset()
    reference.env.unwrapped.physics.reset(env.state)
    for action in _actions(env.action_space, 3, 0):
        env.step(action), reference.step(action)
    np.testing.assert_array_equal(_complete_state(env.physics), _complete_state(reference.physics))


def test_a_diverging_simulation_raises_and_works_again_after_reset(tmp_path, monkeypatch):
    # The engine writes a log into the present folder.
    monkeypatch.chdir(tmp_path)
    wild = DCMotorActuator(Motor(), CurrentLoop(kp=1000.0, max_voltage=float("inf")))
    env = suite.load("pendulum", actuator=wild, allow_unstable=True)
    env.reset()
    with pytest.raises(SimulationDivergedError):
        _run_actions(env, [np.ones(1)] * 200)
    assert np.isfinite(_vector(env.reset())).all()


# -- pixels ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", matrix_params(REPRESENTATIVES, TASKS))
def test_pixels_show_the_present_state_and_change_nothing(task):
    env, unrendered = (
        suite.load(task, task_kwargs={"random": 3}, actuator="ideal") for _ in range(2)
    )
    wrapped = pixels.Wrapper(env, render_kwargs={"height": 48, "width": 64, "camera_id": "fixed"})
    assert wrapped.observation_spec()["pixels"].shape == (48, 64, 3)
    images = [wrapped.reset().observation["pixels"].copy()]
    unrendered.reset()
    # The cart moves to the right all the time.
    action = env.action_spec().maximum
    for _ in range(8):
        images.append(wrapped.step(action).observation["pixels"].copy())
        unrendered.step(action)
        np.testing.assert_array_equal(
            _complete_state(env.physics), _complete_state(unrendered.physics)
        )
    for image in images:
        assert image.dtype == np.uint8
        assert image.std() > 5.0
    assert np.any(np.abs(images[0].astype(int) - images[-1]).max(axis=2) > 30)
    # The image must equal that of another simulation with the same state.
    fresh = suite.load(task, actuator="ideal")
    with fresh.physics.reset_context() as physics:
        physics.data.qpos[:] = env.physics.position()
    np.testing.assert_array_equal(
        fresh.physics.render(height=48, width=64, camera_id="fixed"), images[-1]
    )


# -- third-party environments ---------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["Taxi-v4", "Blackjack-v1"])
def test_observations_may_be_numbers_and_tuples_of_them(env_id):
    ours, theirs = (gymnasium.make(env_id, disable_env_checker=True) for _ in range(2))
    env = suite.DmEnvironment(ours, 4)
    timesteps, expected = [env.reset()], [theirs.reset(seed=4)]
    for action in _actions(theirs.action_space, 60, 0):
        timesteps.append(env.step(action))
        expected.append(theirs.step(action))
        is_last = expected[-1][2] or expected[-1][3]
        assert (timesteps[-1].reward, timesteps[-1].last()) == (expected[-1][1], is_last)
        if is_last:
            timesteps.append(env.step(action))
            expected.append(theirs.reset())
    for timestep, expected_step in zip(timesteps, expected, strict=True):
        np.testing.assert_array_equal(timestep.observation["observations"], expected_step[0])
        env.observation_spec()["observations"].validate(timestep.observation["observations"])


def test_the_physics_of_a_third_party_environment_is_a_view_too():
    env = suite.load("Hopper-v5", actuator={".*": "lag"})
    env.reset()
    assert env.physics.named.data.qpos["rootz"] == env.data.qpos[1]
    assert env.control_timestep() == env.dt == 0.008


# -- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("pendulm",), {}, "unknown task 'pendulm': did you mean 'pendulum'?"),
        (("pendulum", "swingup"), {}, "task_name = 'swingup': every domain has one task, 'gym'"),
        (
            ("pendulum",),
            {"task_kwargs": {"seed": 1}},
            "task_kwargs = {'seed': 1}: may only hold 'random'",
        ),
        (("pendulum", "gym", "papr"), {}, "unknown actuator 'papr': did you mean 'paper'"),
        (("pendulum",), {"center_radius": 0.1}, "unknown option 'center_radius' of pendulum"),
        (
            ("cartpole", "gym", "ideal"),
            {"observe_actuator": True},
            "the ideal actuator has no current",
        ),
    ],
)
def test_raises_for_bad_arguments(arguments, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        suite.load(*arguments, **options)


INVALID = [0.5, -1, 3, None, "1", np.nan, np.array([0, 1])]
BAD_ACTIONS = {
    "cartpole": [*INVALID, 1.0, np.array([0.7])],
    "pendulum": [*INVALID, 1.0, np.array([np.nan])],
}


@pytest.mark.parametrize(
    ("task", "action"),
    [(task, bad_action) for task, bad_actions in BAD_ACTIONS.items() for bad_action in bad_actions],
)
def test_raises_for_a_bad_action_and_changes_nothing(task, action):
    env = suite.load(task)
    env.reset()
    before = _complete_state(env.physics)
    with pytest.raises(ValueError, match="action = "):
        env.step(action)
    np.testing.assert_array_equal(_complete_state(env.physics), before)


@pytest.mark.parametrize("kind", [int, np.int32, np.int64, np.uint8, np.array])
def test_a_discrete_action_may_be_any_integer(kind):
    env, reference = (suite.load("cartpole", task_kwargs={"random": 0}) for _ in range(2))
    env.reset()
    reference.reset()
    np.testing.assert_array_equal(_vector(env.step(kind(1))), _vector(reference.step(1)))


def test_a_generator_can_be_shared():
    generator, same_generator = np.random.default_rng(4), np.random.default_rng(4)
    env, unseeded_env = (
        suite.load("pendulum", task_kwargs={"random": generator}),
        suite.load("pendulum", task_kwargs=None),
    )
    expected = gymnasium.make(TASKS["pendulum"].env_id)
    expected.reset(seed=4)
    env.reset()
    np.testing.assert_array_equal(env.state, expected.unwrapped.state)
    assert generator.random() != same_generator.random()
    # Without a seed, the start is arbitrary.
    unseeded_env.reset()
    assert not np.array_equal(unseeded_env.state, expected.unwrapped.state)
