"""The dm_control face: dm_env's contract, and the Gymnasium environment bit for bit."""

import copy
import dataclasses
import importlib.util
import pickle
import re
from unittest import TestCase

import dm_env
import gymnasium
import mujoco
import numpy as np
import pytest
from dm_control.rl.control import PhysicsError
from dm_control.suite.wrappers import pixels
from dm_env import specs, test_utils

from codrl_mj import suite
from codrl_mj.actuators import IDEAL, NAMED, Actuator, CurrentLoop, Motor
from codrl_mj.engine.families import slot_size
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.views import View
from codrl_mj.physics import SimulationDivergedError
from codrl_mj.tasks import TASKS, named_actuator
from tests.engine.models import FULL, changed
from tests.tasks.faces import every_rebuilt

VOLTAGES = (-12.0, -1.0, 0.0, 12.0)
MOTOR = changed(FULL, inductance=0.2, max_voltage=20.0)

every_task = pytest.mark.parametrize("task", TASKS)


def _voltage(task):
    discrete = isinstance(TASKS[task].action_space, gymnasium.spaces.Discrete)
    return {"action": "voltage"} | ({"levels": VOLTAGES} if discrete else {})


# -- dm_env's own contract ----------------------------------------------------------------------------------


def _contract(domain, task_name, options):
    """A test case of dm_env's contract, with random actions to the end of an episode and beyond."""

    class Contract(test_utils.EnvironmentTestMixin, TestCase):
        def make_object_under_test(self):
            return suite.load(domain, task_name, task_kwargs={"random": 0}, **options)

        def make_action_sequence(self):
            spec, generator = self.environment.action_spec(), np.random.default_rng(0)
            for _ in range(TASKS[domain].max_episode_steps + 5):
                if isinstance(spec, specs.DiscreteArray):
                    yield spec.dtype.type(generator.integers(spec.num_values))
                else:
                    yield generator.uniform(spec.minimum, spec.maximum).astype(spec.dtype)

    return Contract


for _domain, _task_name in suite.ALL_TASKS:
    _kinds = {name: {"actuator": name} for name in (NAMED if TASKS[_domain].paper else ("ideal", "default"))}
    _kinds["observed"] = {"observe_actuator": True}
    _kinds["voltage"] = _voltage(_domain)
    _kinds["flat"] = {"environment_kwargs": {"flat_observation": True}}
    for _kind, _options in _kinds.items():
        _name = f"Test{_domain.title().replace('_', '')}{_kind.title().replace('_', '')}"
        globals()[_name] = type(_name, (_contract(_domain, _task_name, _options),), {})


def test_every_task_is_offered():
    assert [domain for domain, _ in suite.ALL_TASKS] == list(TASKS)
    assert {name for _, name in suite.ALL_TASKS} == {"gym"}


def test_options_are_set_over_a_configuration():
    config = EnvConfig("cartpole", "weak", inner_steps=4, options={"center_radius": 0.5}, max_episode_steps=7)
    same = suite.load(config)
    assert (same.task.setup.actuator, same.task.setup.inner_steps) == (config.actuator, 4)
    assert same.task.setup.view.options.center_radius == 0.5
    over = suite.load(config, actuator="weaker", inner_steps=2, sutton_barto_reward=True)
    assert over.task.setup.actuator == named_actuator("weaker", "cartpole")
    assert over.task.setup.inner_steps == 2
    assert over.task.setup.view.options == (0.5, True)
    assert suite.load(config, actuator=None).task.setup.actuator == IDEAL
    over.reset(), same.reset()
    assert [sum(not env.step(0).last() for _ in range(7)) for env in (over, same)] == [6, 6]
    with pytest.raises(ValueError, match=r"unknown key env\.innersteps; did you mean env\.inner_steps"):
        suite.load(config, innersteps=2)


# -- the Gymnasium environment, bit for bit -----------------------------------------------------------------


def _pair(task, seed, environment_kwargs=None, **options):
    return (
        suite.load(task, task_kwargs={"random": seed}, environment_kwargs=environment_kwargs, **options),
        gymnasium.make(TASKS[task].env_id, disable_env_checker=True, **options),
    )


def _actions(space, count, seed):
    space = copy.deepcopy(space)
    space.seed(seed)
    return [space.sample() for _ in range(count)]


def _vector(timestep):
    return np.concatenate(list(timestep.observation.values()))


OPTIONS = {
    "default": {},
    "ideal": {"actuator": "ideal"},
    "weak": {"actuator": "weak"},
    "an actuator": {"actuator": MOTOR},
    "a mapping": {"actuator": {"motor": {"inductance": 0.3}}},
    "inner_steps": {"inner_steps": 20},
    "timestep": {"timestep": 0.005},
    "observed": {"observe_actuator": True},
    "voltage": {"action": "voltage"},
    "all": {"action": "voltage", "observe_actuator": True, "inner_steps": 25, "actuator": MOTOR},
}


@every_rebuilt
@pytest.mark.parametrize("case", OPTIONS)
def test_episodes_are_those_of_the_gymnasium_environment(task, case):
    options = dict(OPTIONS[case])
    if "action" in options:
        options |= _voltage(task)
    ours, theirs = _pair(task, 5, **options)
    first, (observation, _) = ours.reset(), theirs.reset(seed=5)
    assert first.step_type is dm_env.StepType.FIRST
    names = list(TASKS[task].observation_names)
    names += ["current", "reference_current"] if options.get("observe_actuator") else []
    assert list(first.observation) == names
    np.testing.assert_array_equal(_vector(first), observation)
    for action in _actions(theirs.action_space, 150, 0):
        timestep = ours.step(action)
        observation, reward, terminated, truncated, info = theirs.step(action)
        np.testing.assert_array_equal(_vector(timestep), observation)
        np.testing.assert_array_equal(ours.physics.data.qpos, theirs.unwrapped.data.qpos)
        np.testing.assert_array_equal(ours.physics.data.act, theirs.unwrapped.data.act)
        assert timestep.reward == reward
        assert ours.physics.signals == info
        assert timestep.last() == (terminated or truncated)
        assert timestep.discount == (0.0 if terminated else 1.0)
        if timestep.last():  # the next episode continues the random stream
            np.testing.assert_array_equal(_vector(ours.step(action)), theirs.reset()[0])


@pytest.mark.parametrize("integrator", ["euler", "semi-implicit"])
def test_the_integrator_is_chosen(integrator):
    ours, theirs = _pair("cartpole", 0, integrator=integrator)
    ours.reset()
    theirs.reset(seed=0)
    for action in (0, 1, 1, 0):
        np.testing.assert_array_equal(_vector(ours.step(action)), theirs.step(action)[0])


def test_the_tasks_own_options_are_given():
    ours, theirs = _pair("cartpole", 1, center_radius=0.03, actuator="ideal")
    ours.reset()
    theirs.reset(seed=1)
    for env in (ours.physics.simulation, theirs.unwrapped.physics):
        env.reset(np.zeros(4))
    rewards = [(ours.step(1).reward, theirs.step(1)[1]) for _ in range(8)]
    assert {0.0, 1.0} == {reward for reward, _ in rewards}
    assert all(one == other for one, other in rewards)


@every_task
def test_a_flat_observation_is_gymnasiums_vector(task):
    ours, theirs = _pair(task, 2, {"flat_observation": True}, observe_actuator=True)
    first = ours.reset()
    np.testing.assert_array_equal(first.observation["observations"], theirs.reset(seed=2)[0])
    assert ours.observation_spec()["observations"].shape == theirs.observation_space.shape
    for action in _actions(theirs.action_space, 5, 0):
        np.testing.assert_array_equal(ours.step(action).observation["observations"], theirs.step(action)[0])


@every_rebuilt
def test_a_goal_is_an_end_without_a_future(task):
    """Discount 0 where the task ends the episode; the pendulum's never does."""
    start = {
        "cartpole": [2.39, 3.0, 0.0, 0.0],
        "acrobot": [np.pi, 0.0, 0.0, 0.0],
        "mountain_car": [0.5, 0.05],
        "mountain_car_continuous": [0.45, 0.05],
        "pendulum": [0.0, 0.0],
    }[task]
    env = suite.load(task)
    env.reset()
    env.physics.simulation.reset(np.array(start))
    timestep = env.step(env.action_spec().generate_value())
    assert timestep.last() == (task != "pendulum")
    assert timestep.discount == (1.0 if task == "pendulum" else 0.0)


# -- the time limit -----------------------------------------------------------------------------------------


class _Endless(View):
    """A view of a task that never ends an episode."""

    def terminated(self, state):  # noqa: ARG002
        return False


def _endless(setup):
    view = setup.view
    return dataclasses.replace(setup, view=_Endless(view.task, view.options, view.sensors))


@every_rebuilt
@pytest.mark.parametrize("inner_steps", [None, 19, 49, 73])  # quotients that rounding lifts over the limit
def test_an_episode_has_exactly_the_steps_of_gymnasiums(task, inner_steps):
    env = suite.load(task, actuator="ideal", inner_steps=inner_steps)
    env.task.setup = _endless(env.task.setup)
    env.physics.simulation.step = env.task.after_step = env.task.get_reward = lambda _: None  # only the count matters
    action = env.action_spec().generate_value()
    for _ in range(2):
        timestep, count = env.reset(), 0
        while not timestep.last():
            timestep, count = env.step(action), count + 1
        assert count == gymnasium.spec(TASKS[task].gymnasium_id).max_episode_steps
        assert timestep.discount == 1.0


# -- the physics --------------------------------------------------------------------------------------------


@every_task
def test_the_physics_shows_the_simulation_that_is_run(task):
    env = suite.load(task)
    env.reset()
    assert env.physics.legacy_step is False
    assert env.physics.data.ptr is env.physics.simulation.data
    assert env.physics.model.ptr is env.physics.simulation.model
    assert env.control_timestep() == pytest.approx(TASKS[task].step_duration, rel=1e-15)
    env.step(env.action_spec().generate_value())
    assert env.physics.time() == pytest.approx(TASKS[task].step_duration)
    assert env.physics.named.data.qpos.shape == (len(TASKS[task].qpos),)


@every_task
@pytest.mark.parametrize("offset", [-1, 1])
def test_a_wrong_number_of_integration_steps_is_refused(task, offset):
    env = suite.load(task)
    env.reset()
    count = TASKS[task].motor_inner_steps
    with pytest.raises(ValueError, match=f"nstep = {count + offset}: must be the task's {count} integration steps"):
        env.physics.step(count + offset)
    assert env.physics.time() == 0.0


def _continued(env, actions):
    return np.array([np.concatenate([_vector(t), [t.reward, t.discount]]) for t in map(env.step, actions)])


DUPLICATES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
}


@every_task
@pytest.mark.parametrize("duplicate", DUPLICATES)
@pytest.mark.parametrize("options", [{}, {"actuator": MOTOR, "observe_actuator": True, "inner_steps": 20}])
def test_a_copy_of_the_environment_continues_bit_for_bit(task, duplicate, options):
    env = suite.load(task, task_kwargs={"random": 0}, **options)
    env.reset()
    actions = _actions(env.task.setup.commands.action_space, 24, 1)
    env.step(actions[0])
    before = _whole(env.physics)
    if duplicate == "pickle":  # an environment of dm_control's is not made to be pickled, its physics is
        twin = copy.copy(env)
        twin._physics, twin._task = DUPLICATES["pickle"]((env.physics, env.task))
    else:
        twin = DUPLICATES[duplicate](env)
    np.testing.assert_array_equal(_whole(env.physics), before)
    np.testing.assert_array_equal(_whole(twin.physics), before)
    np.testing.assert_array_equal(_continued(twin, actions[1:]), _continued(env, actions[1:]))
    np.testing.assert_array_equal(_whole(twin.physics), _whole(env.physics))


def _whole(physics):
    """Everything that a simulation is continued from: time, positions, velocities, motors, controls."""
    sig = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(physics.model.ptr, sig))
    mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, sig)
    return state


@every_task
@pytest.mark.parametrize(
    "duplicate",
    [copy.deepcopy, DUPLICATES["pickle"], lambda physics: physics.copy(), lambda physics: physics.copy(True)],
    ids=["deepcopy", "pickle", "physics.copy", "physics.copy sharing"],
)
def test_a_copy_of_the_physics_keeps_controls_and_motor_and_is_apart(task, duplicate):
    env = suite.load(task, actuator=MOTOR)
    env.reset()
    physics = env.physics
    physics.desired_force = 0.7 * TASKS[task].max_force
    for _ in range(3):
        physics.step(TASKS[task].motor_inner_steps)
    before = _whole(physics)
    assert np.abs(physics.data.ctrl).max() > 0.0
    assert np.abs(physics.data.act).max() > 0.0
    twin = duplicate(physics)
    np.testing.assert_array_equal(_whole(physics), before)
    np.testing.assert_array_equal(_whole(twin), before)
    assert twin.signals == physics.signals
    assert twin.desired_force == physics.desired_force
    assert twin.legacy_step is False
    assert twin.model.ptr is twin.simulation.model
    assert twin.data.ptr is twin.simulation.data
    twin.step(TASKS[task].motor_inner_steps)
    np.testing.assert_array_equal(_whole(physics), before)  # the original stands still
    physics.step(TASKS[task].motor_inner_steps)
    np.testing.assert_array_equal(_whole(twin), _whole(physics))


def test_a_copys_model_is_the_one_that_it_simulates():
    env = suite.load("pendulum")
    env.reset()
    for duplicate in (copy.deepcopy, DUPLICATES["pickle"]):
        twin = duplicate(env.physics)
        twin.model.opt.gravity[:] = 0.0
        twin.data.qvel[:] = 0.0
        twin.step()
        assert twin.velocity() == 0.0
        assert env.physics.model.opt.gravity[2] == -10.0


@every_task
@pytest.mark.parametrize("ahead", range(-3, 4))
def test_a_restored_state_continues_as_it_did_at_whatever_time_it_is_restored(task, ahead):
    """Into a simulation whose own clock is behind, equal or ahead: the motor's tick depends on the time."""
    env = suite.load(task, actuator=MOTOR, task_kwargs={"random": 0}, inner_steps=20)
    actions = _actions(env.task.setup.commands.action_space, 12, 2)
    env.reset()
    for action in actions[:5]:
        env.step(action)
    physics = env.physics
    saved, whole = physics.get_state(), _whole(physics)
    np.testing.assert_array_equal(physics.state(), saved)
    rest = [(env.step(action), _whole(physics))[1] for action in actions[5:]]
    env.reset()
    for action in actions[: 5 + ahead]:
        env.step(action)
    # one integration step off a whole number of them, where a tick could be mistaken for another
    physics.data.time += physics.model.opt.timestep * (ahead % 2)
    physics.set_state(saved)
    assert _whole(physics)[: len(saved)].tolist() == saved.tolist() == whole[: len(saved)].tolist()
    np.testing.assert_array_equal([(env.step(action), _whole(physics))[1] for action in actions[5:]], rest)


def test_a_restored_state_is_exact_one_integration_step_early():
    """The saved motor's tick is then the restored clock: without the time it would forget its last step."""
    env = suite.load("pendulum", actuator=MOTOR)
    env.reset()
    physics = env.physics
    physics.desired_force = 2.0
    for _ in range(5):
        physics.step()
    saved = physics.get_state()
    physics.step()
    expected = _whole(physics)
    physics.simulation.reset(np.zeros(2))
    for _ in range(4):
        physics.step()
    physics.set_state(saved)
    physics.step()
    np.testing.assert_array_equal(_whole(physics), expected)


def test_a_state_of_another_size_is_refused_and_parts_can_be_asked_for():
    physics = suite.load("cartpole").physics
    size = 1 + 2 + 2 + slot_size(Actuator)  # time, positions, velocities, motor
    with pytest.raises(ValueError, match=rf"physics_state has shape \(3,\), must be \({size},\)"):
        physics.set_state(np.zeros(3))
    velocities = int(mujoco.mjtState.mjSTATE_QVEL)
    physics.set_state(np.array([1.0, 2.0]), velocities)
    np.testing.assert_array_equal(physics.get_state(velocities), [1.0, 2.0])
    np.testing.assert_array_equal(physics.velocity(), [1.0, 2.0])


@every_task
def test_dm_controls_own_reset_context(task):
    """It runs forward passes around what the user sets; the motor stays at rest and the state is the user's."""
    env = suite.load(task, actuator=MOTOR)
    env.reset()
    env.step(env.action_spec().generate_value())
    with env.physics.reset_context():
        env.physics.data.qpos[:] = 0.1
        env.physics.data.qvel[:] = 0.02
    assert env.physics.time() == 0.0
    np.testing.assert_array_equal(env.physics.position(), 0.1)
    np.testing.assert_array_equal(env.physics.velocity(), 0.02)
    np.testing.assert_array_equal(env.physics.data.act, 0.0)
    twin = suite.load(task, actuator=MOTOR)
    twin.physics.simulation.reset(env.physics.simulation.state)
    for physics in (env.physics, twin.physics):
        physics.desired_force = 0.5 * TASKS[task].max_force
        for _ in range(3):
            physics.step(TASKS[task].motor_inner_steps)
    np.testing.assert_array_equal(_whole(env.physics), _whole(twin.physics))


def test_a_forward_pass_between_steps_changes_nothing():
    one, two = (suite.load("acrobot", actuator=MOTOR, task_kwargs={"random": 0}) for _ in range(2))
    one.reset()
    two.reset()
    for action in _actions(one.task.setup.commands.action_space, 20, 0):
        one.step(action)
        two.step(action)
        two.physics.forward()
        np.testing.assert_array_equal(two.physics.velocity(), one.physics.velocity())


@every_task
def test_a_diverging_simulation_raises_and_works_again_after_reset(task, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    wild = Actuator(Motor(), CurrentLoop(kp=1000.0, max_voltage=float("inf")))
    env = suite.load(task, actuator=wild, allow_unstable=True)
    env.task.setup = _endless(env.task.setup)
    env.reset()
    action = env.action_spec().generate_value()
    last = TASKS[task].action_space.n - 1 if isinstance(action, np.integer | int) else np.ones_like(action)

    def run():
        for _ in range(TASKS[task].max_episode_steps):
            assert not env.step(last).first()

    with pytest.raises((PhysicsError, SimulationDivergedError)):
        run()
    assert np.isfinite(_vector(env.reset())).all()


# -- pixels -------------------------------------------------------------------------------------------------


@every_task
def test_pixels_show_the_present_state_and_change_nothing(task):
    env, blind = (suite.load(task, task_kwargs={"random": 3}, actuator="ideal") for _ in range(2))
    wrapped = pixels.Wrapper(env, render_kwargs={"height": 48, "width": 64, "camera_id": "fixed"})
    assert wrapped.observation_spec()["pixels"].shape == (48, 64, 3)
    images = [wrapped.reset().observation["pixels"].copy()]
    blind.reset()
    action = env.action_spec().maximum  # to the right all the time
    for _ in range(8):
        images.append(wrapped.step(action).observation["pixels"].copy())
        blind.step(action)
        np.testing.assert_array_equal(_whole(env.physics), _whole(blind.physics))
    for image in images:
        assert image.dtype == np.uint8
        assert image.std() > 5.0
    assert np.any(np.abs(images[0].astype(int) - images[-1]).max(axis=2) > 30)
    # the same picture as of a simulation that was put into this very state
    fresh = suite.load(task, actuator="ideal").physics
    with fresh.reset_context():
        fresh.data.qpos[:] = env.physics.position()
    np.testing.assert_array_equal(fresh.render(height=48, width=64, camera_id="fixed"), images[-1])


# -- refusals -----------------------------------------------------------------------------------------------

REFUSED = {
    "domain": (("pendulm",), {}, "unknown task 'pendulm': did you mean 'pendulum'?"),
    "task": (("pendulum", "swingup"), {}, "task_name = 'swingup': every domain has one task, 'gym'"),
    "task_kwargs": (("pendulum",), {"task_kwargs": {"seed": 1}}, "task_kwargs = {'seed': 1}: may only hold 'random'"),
    "actuator": (("pendulum", "gym", "papr"), {}, "unknown actuator 'papr': did you mean 'paper'"),
    "option": (("pendulum",), {"center_radius": 0.1}, "unknown option 'center_radius' of pendulum"),
    "integrator": (("pendulum",), {"integrator": "euler"}, "integrator = 'euler': pendulum has semi-implicit"),
    "inner_steps": (("pendulum",), {"inner_steps": 0}, "inner_steps = 0: must be an integer >= 1"),
    "levels": (("cartpole",), {"action": "voltage"}, "levels = None: cartpole has discrete actions"),
    "observing": (("cartpole", "gym", "ideal"), {"observe_actuator": True}, "the ideal actuator has no current"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_bad_argument_is_refused(case):
    arguments, options, message = REFUSED[case]
    with pytest.raises(ValueError, match=re.escape(message)):
        suite.load(*arguments, **options)


BAD_ACTIONS = [0.5, 1.0, np.array([0.7]), -1, 3, None, "1", np.nan, np.array([0, 1])]


@pytest.mark.parametrize("action", BAD_ACTIONS, ids=repr)
@pytest.mark.parametrize("task", ["cartpole", "pendulum"])
def test_a_bad_action_is_refused_and_changes_nothing(task, action):
    if task == "pendulum" and isinstance(action, np.ndarray) and action.dtype.kind == "f":
        action = np.array([np.nan])
    env = suite.load(task)
    env.reset()
    before = _whole(env.physics)
    with pytest.raises(ValueError, match="action = "):
        env.step(action)
    np.testing.assert_array_equal(_whole(env.physics), before)


@pytest.mark.parametrize("kind", [int, np.int32, np.int64, np.uint8, np.array])
def test_a_discrete_action_may_be_any_integer(kind):
    env, reference = (suite.load("cartpole", task_kwargs={"random": 0}) for _ in range(2))
    env.reset()
    reference.reset()
    np.testing.assert_array_equal(_vector(env.step(kind(1))), _vector(reference.step(1)))


def test_a_generator_may_be_shared():
    generator, twin = np.random.default_rng(4), np.random.default_rng(4)
    one, two = suite.load("pendulum", task_kwargs={"random": generator}), suite.load("pendulum", task_kwargs=None)
    expected = gymnasium.make(TASKS["pendulum"].env_id)
    expected.reset(seed=4)
    one.reset()
    np.testing.assert_array_equal(one.physics.simulation.state, expected.unwrapped.state)
    assert generator.random() != twin.random()
    two.reset()  # no seed: any start
    assert not np.array_equal(two.physics.simulation.state, expected.unwrapped.state)


def test_dm_control_is_installed_here():
    """These tests are no good without it, and none is skipped."""
    assert importlib.util.find_spec("dm_control")
