"""Contracts of all environments: each test is one contract, over the table of environments."""

import copy
import json
import pickle
import subprocess
import sys
import unittest.mock
import warnings
from unittest import TestCase

import gymnasium
import numpy as np
import pytest
from dm_env import specs, test_utils
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.utils.env_checker import check_env
from safetensors.numpy import load, load_file, save, save_file
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import codrl_mj
from codrl_mj import EnvConfig
from codrl_mj.engine.reading import motor_slots
from codrl_mj.envs import ActuatedEnv, ActuatedVectorEnv
from codrl_mj.tasks import TASKS
from tests.conformance.environments import ENVIRONMENTS, SETUPS, arguments, every
from tests.conformance.episodes import (
    action_space,
    arrays,
    assert_same,
    info_of,
    observation_of,
    plain,
    random_actions,
    run,
    start_episode,
)
from tests.envs.rig import RIG, RigEnv
from tests.envs.vectors import assert_equal_episodes
from tests.tasks.faces import every_rebuilt

# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
STEPS = 22


def is_single(environment):
    return environment.interface == "single"


def is_vector(environment):
    return environment.interface in ("vector", "sb3")


def is_dm_env(environment):
    return environment.interface == "dm_env"


# -- checkers of the interfaces -------------------------------------------------------------------


class Blank(gymnasium.Env):
    """Environment with given spaces in which nothing happens; checkers only warn of its spaces."""

    def __init__(self, action_space, observation_space):  # noqa: D107
        self.action_space, self.observation_space = action_space, observation_space

    def _observation(self):
        bounds = self.observation_space.low, self.observation_space.high
        return np.clip(np.zeros(self.observation_space.shape, np.float32), *bounds)

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):  # noqa: ARG002
        return self._observation(), 0.0, False, False, {}


class WithoutNaN(gymnasium.Wrapper, RecordConstructorArgs):
    """Wrapper that replaces NaN in infos: for Gymnasium's checker, NaN differs from NaN.

    A signal that the family of a motor lacks is NaN.
    """

    def __init__(self, env):  # noqa: D107
        RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def step(self, action):
        *outcome, info = self.env.step(action)
        return *outcome, {name: np.nan_to_num(value) for name, value in info.items()}


def warnings_of(check, env):
    """Return the warnings of a checker; its errors are raised."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # Rendering in a window would need a display.
        check(env, skip_render_check=True)
    messages = {str(warning.message).split("\n")[0] for warning in caught}
    # One warning names the wrappers, which differ.
    return {text for text in messages if "is different from the unwrapped version" not in text}


@every("checkers", is_single)
@pytest.mark.parametrize("check", [check_env, check_env_sb3], ids=["gymnasium", "sb3"])
def test_checkers_warn_no_more_than_without_motors(environment, check):
    env = environment.make()
    blank = Blank(env.action_space, env.observation_space)
    original = environment.original() if environment.original else blank
    expected = warnings_of(check, original) | warnings_of(check, blank)
    checked_env = env if environment.is_task else WithoutNaN(env)
    assert warnings_of(check, checked_env) <= expected


def test_gymnasiums_checker_does_not_warn_about_rendering(monkeypatch):
    # pygame may not be installed.
    monkeypatch.setattr("codrl_mj.envs.single.DisplayWindow", unittest.mock.Mock())
    env = gymnasium.make(TASKS["pendulum"].env_id, render_mode="rgb_array", width=64, height=48)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    blank = Blank(env.action_space, env.observation_space)
    assert {str(warning.message) for warning in caught} <= warnings_of(check_env, blank)
    env.close()


@every("dm_env", is_dm_env)
def test_dm_env_s_own_tests_pass(environment):
    """Run dm_env's tests, with actions beyond the end of an episode."""

    class Contract(test_utils.EnvironmentTestMixin, TestCase):
        def make_object_under_test(self):
            return environment.make()

        def make_action_sequence(self):
            spec, generator = self.environment.action_spec(), np.random.default_rng(0)
            for _ in range(12):
                if isinstance(spec, specs.DiscreteArray):
                    yield spec.dtype.type(generator.integers(spec.num_values))
                else:
                    yield generator.uniform(spec.minimum, spec.maximum).astype(spec.dtype)

    for name in dir(Contract):
        if name.startswith("test"):
            case = Contract(name)
            case.setUp()
            getattr(case, name)()
            case.tearDown()


# -- spaces, infos, draws -------------------------------------------------------------------------


@every("observation", lambda environment: is_single(environment) or is_dm_env(environment))
def test_observations_are_in_the_space_and_end_with_the_sensors(environment):
    env = environment.make()
    generator = np.random.default_rng(0)
    outcomes = [start_episode(env, 3 if environment.is_seeded else None)]
    for _ in range(STEPS):
        outcome = env.step(random_actions(env, generator))
        outcomes.append(outcome)
        if is_single(environment):
            assert type(outcome[2]) is type(outcome[3]) is bool
            assert isinstance(outcome[1], float if environment.is_task else (int, float))
            if outcome[2] or outcome[3]:
                outcomes.append(env.reset())
        info = info_of(env, outcome)
        if environment.is_observed and is_single(environment):
            # A family without current has no sensors; its signals are NaN.
            count = len(env.bank.sensors)
            second = "duty" if "duty" in info else "reference_current"
            values = np.stack([np.ravel(info["current"]), np.ravel(info[second])])
            expected = values.T[~np.isnan(values[0])]
            pairs = observation_of(outcome)[-count:].reshape(-1, 2)
            np.testing.assert_allclose(pairs[:, 1], expected[:, 1], rtol=1e-6, atol=1e-6)
            # Sensors have noise, bias and resolution of less than this; a wrong entry has more.
            np.testing.assert_allclose(pairs[:, 0], expected[:, 0], rtol=1e-6, atol=0.6)
    if is_single(environment):
        assert all(observation_of(outcome) in env.observation_space for outcome in outcomes)
        original = environment.original and environment.original().observation_space
        count = len(env.bank.sensors) if environment.is_observed else 0
        assert bool(count) is environment.is_observed
        space = original or TASKS[environment.source].observation_space
        assert env.observation_space.dtype == space.dtype
        low, high = np.full(count, -np.inf), np.full(count, np.inf)
        np.testing.assert_array_equal(env.observation_space.low, np.append(space.low, low))
        np.testing.assert_array_equal(env.observation_space.high, np.append(space.high, high))
    else:
        for name, spec in env.observation_spec().items():
            for outcome in outcomes:
                spec.validate(outcome.observation[name])


@every("info")
def test_infos_have_forces_signals_and_saturation_for_each_motor(environment):
    env = environment.make()
    start_episode(env, 0 if environment.is_seeded else None)
    outcome = env.step(random_actions(env, np.random.default_rng(0)))
    count, motors = getattr(env, "num_envs", 0), environment.motors
    shape = (*([count] if count else []), *([motors] if motors > 1 else []))
    info = info_of(env, outcome)
    families = {type(motor) for motor in motors_of(env).values()}
    signals = {name for family in families for name in family.Signals._fields}
    assert info.keys() >= {"desired_force", "actual_force", "saturated"} | signals
    if environment.is_task:
        assert info.keys() == {"desired_force", "actual_force", "saturated"} | signals
    for name in {"desired_force", "actual_force", "saturated"} | signals:
        kind = np.bool_ if name == "saturated" else np.float64
        if shape:
            assert (info[name].shape, info[name].dtype) == (shape, kind), name
        else:
            assert type(info[name]) is (bool if name == "saturated" else float), name
        # A signal that the family of a motor lacks is NaN, and such a motor never saturates.
        motor_columns = np.array(info[name]).reshape(-1, motors)
        for motor, values in zip(motors_of(env).values(), motor_columns.T, strict=True):
            lacks = name in signals - {*type(motor).Signals._fields} - {"saturated"}
            np.testing.assert_array_equal(np.isnan(values), lacks, name)
            if name == "saturated" and name not in type(motor).Signals._fields:
                assert not values.any()
    if environment.options.get("actuator") == "ideal":
        np.testing.assert_array_equal(info["actual_force"], info["desired_force"])
        assert not np.any(info["saturated"])
    if environment.interface == "vector":
        # In a first step, no environment was reset.
        for name in {*info} if environment.is_task else set():
            np.testing.assert_array_equal(outcome[4][name], info[name])
            assert outcome[4][f"_{name}"].all()


def motors_of(env):
    """Return the motors of an environment, or of the first of a vector."""
    env = getattr(env, "env", env) if hasattr(env, "num_envs") else env
    if isinstance(env, ActuatedVectorEnv):
        return env.bank.motors
    return env.get_attr("motors")[0] if hasattr(env, "num_envs") else env.motors


@every("draws", lambda environment: "randomize" in environment.options and is_single(environment))
def test_resets_report_the_drawn_values_which_the_motors_have(environment):
    env, reports = environment.make(), []
    for seed in (1, None, 1):
        _, info = env.reset(seed=seed)
        assert info.keys() == {"randomization"} or not environment.is_task
        drawn = info["randomization"]
        assert_same(plain(env.randomization), plain(drawn))
        fields = {}
        for path, value in drawn.items():
            fields |= value if isinstance(value, dict) else {path: value}
        for path, value in fields.items():
            if path == "rejected" or path.startswith("model."):
                continue
            for motor in env.motors.values():
                present = motor
                for name in path.split("."):
                    present = getattr(present, name)
                assert present == value, path
        reports.append(plain({name: fields[name] for name in fields if name != "rejected"}))
        env.step(random_actions(env, np.random.default_rng(0)))
        # A step changes nothing.
        assert_same(plain(env.randomization), plain(drawn))
    assert_same(reports[2], reports[0])
    with pytest.raises(AssertionError):
        assert_same(reports[1], reports[0])


@every("no_draws", lambda environment: "randomize" not in environment.options)
def test_without_randomization_nothing_is_reported(environment):
    env = environment.make()
    outcome = start_episode(env, 1)
    assert env.randomization == {}
    if is_single(environment):
        assert "randomization" not in outcome[1]


def signed(space, factor):
    """Return actions at the bounds of a continuous space, times a factor."""
    return [(sign * factor * space.high).astype(space.dtype) for sign in (1, -1, 1)]


@every("saturation", lambda environment: is_single(environment) and environment.saturates)
def test_actions_outside_the_space_saturate_or_are_refused(environment):
    env, expected_env = environment.make(), environment.make()
    for each_env in (env, expected_env):
        each_env.reset(seed=2)
    space = action_space(env)
    refused = [np.nan * np.ones(space.shape)] if environment.is_task else []
    if isinstance(space, spaces.Discrete):
        refused = [-1, int(space.n), 0.5, np.nan]
    else:
        for action, bound in zip(signed(space, 3.0), signed(space, 1.0), strict=True):
            outcome, expected = env.step(action), expected_env.step(bound)
            # In float32 a bound of the space is rounded, the limit of the command is not.
            np.testing.assert_allclose(outcome[0], expected[0], rtol=1e-6, atol=1e-7)
            for name in expected[4] if environment.is_task else ():
                np.testing.assert_allclose(outcome[4][name], expected[4][name], rtol=1e-5)
    before = env.snapshot()
    for action in refused:
        with pytest.raises(ValueError, match=r"action"):
            env.step(action)
        assert_same(env.snapshot(), before)


# -- episodes -------------------------------------------------------------------------------------


@every("seed")
def test_a_seed_repeats_and_another_seed_differs(environment):
    def episode(env, seed):
        """Return a start and some steps."""
        first = plain(start_episode(env, seed if environment.is_seeded else None))
        return first, run(env, STEPS, seed=0)

    if environment.is_seeded:
        # An environment that was used before begins like a new one.
        env = environment.make()
        first, second, third = (
            episode(env, 3),
            episode(env, 4),
            episode(environment.make(), 3),
        )
        assert_same(episode(env, 3), first)
    else:
        first, third, second = (episode(environment.make(*seed), 0) for seed in ((), (), (2,)))
    assert_same(third, first)
    with pytest.raises(AssertionError):
        assert_same(second, first)


@every("rest", lambda environment: is_single(environment) and "analytic" not in environment.name)
def test_resets_bring_motors_to_rest(environment):
    env, fresh_env = environment.make(), environment.make()
    env.reset(seed=1)
    run(env, STEPS, seed=0)
    keys = []
    for seed in (7, None):
        env.reset(seed=seed)
        slots = motor_slots(env.unwrapped.data, env.motors)
        for slot in slots.values():
            # The first two numbers are the time and the key of the sensors' noise.
            np.testing.assert_array_equal(slot[2:], 0.0)
        # An ideal motor of a task has no state.
        keys.append([slot[1] for slot in slots.values() if slot.size])
        for motor, slot in zip(env.motors.values(), slots.values(), strict=True):
            # Load pulses need a key too.
            is_keyless = not motor.random and "disturbances" not in environment.options
            assert not is_keyless or not slot[:2].any()
    fresh_env.reset(seed=7)
    fresh_slots = motor_slots(fresh_env.unwrapped.data, fresh_env.motors)
    assert [slot[1] for slot in fresh_slots.values() if slot.size] == keys[0]
    # Each motor has a noise of its own in each episode.
    if any(motor.random for motor in env.motors.values()):
        assert len({*keys[0], *keys[1]}) == 2 * len(env.motors)


@every("snapshot", lambda environment: environment.copies)
def test_snapshots_continue_bit_for_bit(environment):
    env, fresh_env, used_env = (environment.make() for _ in range(3))
    start_episode(used_env, 99)
    # First before any reset, then in the middle of an episode.
    for steps in (None, 23) if environment.is_task else (23,):
        if steps:
            start_episode(env, 5)
            run(env, steps, seed=0)
        snapshot = env.snapshot()
        assert all(isinstance(array, np.ndarray) for array in snapshot.values())
        # Without the whole state, a restored environment can only start an episode.
        runs = [(None, run(env, 22, seed=1))] if steps and environment.has_snapshots else []
        for resumed in (fresh_env, used_env):
            restored = resumed.restore(load(save(snapshot)))
            if environment.has_snapshots:
                assert_same(resumed.snapshot(), snapshot)
            if steps is None:
                start_episode(resumed)
            runs.append((plain(restored), run(resumed, 22, seed=1)))
        for run_of_resumed in runs[1:]:
            assert_same(run_of_resumed, runs[0])


@every("copy", lambda environment: environment.copies)
def test_copies_continue_like_the_original_and_share_nothing(environment):
    env = environment.make()
    start_episode(env, 5)
    run(env, 23, seed=0)
    runs = []
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env)), env):
        if environment.copies == "reset":
            start_episode(twin, 6)
        elif twin is not env:
            assert_same(twin.snapshot(), env.snapshot())
        runs.append(run(twin, 22, seed=1))
        # Each twin has a model of its own: changing it changes only the twin.
        if is_single(environment) and "analytic" not in environment.name:
            base = twin.unwrapped
            assert base.model is base.data.model
            assert (base.model is env.unwrapped.model) is (twin is env)
    for run_of_twin in runs[:-1]:
        assert_same(run_of_twin, runs[-1])


@every("arrays")
def test_returned_arrays_and_actions_belong_to_the_caller(environment):
    env, control_env = environment.make(), environment.make()
    for each_env in (env, control_env):
        start_episode(each_env, 2 if environment.is_seeded else None)
    assert_same(run(env, 22, seed=0, vandal=True), run(control_env, 22, seed=0))


@every("recorder", is_single)
def test_the_recorder_has_the_signals_of_each_integration_step(environment):
    env = environment.make()
    recorder = env.recorder
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(3):
        *_, info = env.step(random_actions(env, generator))
        trace, names = recorder.trace, recorder.trace_names
        assert trace.shape[1:] == (environment.motors, len(names))
        assert recorder.speeds.shape == (environment.motors,)
        assert np.isfinite(recorder.state).all()
        assert recorder.command == environment.options.get("action", "force")
        assert len(recorder.motor_names) == environment.motors
        assert {*info} >= {*recorder.signal_names}
        np.testing.assert_array_equal(trace[-1, :, -1], recorder.speeds)
        for column, name in enumerate(names[:-1]):
            # A disturbance changes the command after `desired_force`.
            if name != "desired_force":
                values, expected = trace[-1, :, column], np.ravel(info[name]).astype(float)
                # A family that cannot saturate reports False.
                lacks = np.isnan(values) & ((name == "saturated") & (expected == 0.0))
                np.testing.assert_array_equal(values[~lacks], expected[~lacks], name)
    if environment.is_task:
        assert len(trace) == env.setup.inner_steps
        assert recorder.step_duration == TASKS[environment.source].step_duration
    else:
        timestep = env.unwrapped.model.opt.timestep
        assert recorder.step_duration == pytest.approx(len(trace) * timestep)
        assert (
            len(trace) == round(env.unwrapped.dt / timestep) if hasattr(env.unwrapped, "dt") else 1
        )


@every("close")
def test_an_environment_can_be_closed_twice(environment):
    env = environment.make()
    start_episode(env, 0 if environment.is_seeded else None)
    env.close()
    env.close()


# -- one environment through several interfaces ---------------------------------------------------


@every("rows", lambda environment: environment.interface == "vector")
def test_rows_of_a_vector_equal_single_environments(environment):
    env, reference = environment.make(), environment.reference()
    assert env.single_action_space == reference.single_action_space
    assert env.single_observation_space == reference.single_observation_space
    ends = assert_equal_episodes(env, reference, 40)
    assert (ends.sum(axis=1) > 0).all()
    for generator, expected in zip(env.np_random, reference.np_random, strict=True):
        assert environment.original or generator.random() == expected.random()


@every("rows", lambda environment: environment.interface == "sb3")
def test_rows_for_stable_baselines3_equal_monitored_environments(environment):
    env, reference = environment.make(), environment.reference()
    assert env.observation_space == reference.observation_space
    assert env.action_space == reference.action_space
    for each_env in (env, reference):
        each_env.seed(3)
    generator, ends = np.random.default_rng(0), 0
    # The reset in the middle restarts the records, from other states.
    for _ in range(2):
        assert_same(env.reset(), reference.reset())
        nested = [
            {
                f"{pattern}:{name}": value
                for pattern, values in info.get("randomization", {}).items()
                for name, value in (values if isinstance(values, dict) else {"": values}).items()
            }
            for info in reference.reset_infos
        ]
        for info, values in zip(env.reset_infos, nested, strict=True):
            expected = {name.removesuffix(":"): value for name, value in values.items()}
            assert info.get("randomization", {}) == expected
        for _ in range(30):
            actions = random_actions(env, generator)
            if isinstance(env.action_space, spaces.Box):
                # The algorithms of Stable-Baselines3 clip actions.
                actions = np.clip(actions, env.action_space.low, env.action_space.high)
            *outcome, infos = env.step(actions)
            *expected_outcome, expected_infos = reference.step(actions)
            assert_same(tuple(outcome), tuple(expected_outcome))
            for row, (info, expected) in enumerate(zip(infos, expected_infos, strict=True)):
                for name in env.signals:
                    np.testing.assert_array_equal(env.signals[name][row], expected[name], name)
                if not outcome[2][row]:
                    assert info == {}
                    continue
                ends += 1
                assert info["episode"]["t"] >= 0
                assert info.keys() == {"terminal_observation", "TimeLimit.truncated", "episode"}
                assert_same(plain(info), plain({name: expected[name] for name in info}))
    assert ends >= 12


@every("rows", lambda environment: is_dm_env(environment) and environment.reference)
def test_episodes_of_dm_env_equal_those_of_the_environment_inside(environment):
    env, reference = environment.make(), environment.reference()
    generator = np.random.default_rng(0)
    for seed in (4, None):
        if seed is not None:
            env._seed = seed
        timestep, (observation, info) = env.reset(), reference.reset(seed=seed)
        assert (timestep.first(), timestep.reward, timestep.discount) == (True, None, None)
        np.testing.assert_array_equal(observation_of(timestep), observation)
        assert_same(plain(env.randomization), plain(info.get("randomization", {})))
        while not timestep.last():
            action = random_actions(env, generator)
            timestep = env.step(action)
            observation, reward, terminated, truncated, info = reference.step(action)
            np.testing.assert_array_equal(observation_of(timestep), observation)
            assert timestep.reward == reward
            assert timestep.last() == (terminated or truncated)
            assert timestep.discount == (0.0 if terminated and not truncated else 1.0)
            assert_same(plain(env.info), plain(info))
            if environment.is_task:
                np.testing.assert_array_equal(env.state, reference.unwrapped.state)


@every("ways", is_single)
def test_all_ways_to_make_an_environment_give_the_same(environment):
    options = environment.options | {"max_episode_steps": 8}
    source, actuator = environment.source, options.pop("actuator")
    config, remaining = EnvConfig.of(source, actuator, options)
    envs = {
        "make": codrl_mj.make(source, actuator, **options),
        "configuration": config.build(**remaining),
        "file": EnvConfig.from_mapping(json.loads(json.dumps(config.as_mapping()))).build(),
    }
    if environment.is_task:
        envs["id"] = gymnasium.make(TASKS[source].env_id, actuator=actuator, **options)
        envs["task"] = codrl_mj.make(TASKS[source], actuator, **options)
    elif isinstance(source, str) and ":" not in source:
        envs["spec"] = gymnasium.make(envs["make"].spec)
    if environment.name.startswith("source"):
        envs |= {
            name: codrl_mj.make(target, actuator, **options)
            for name, target in {
                "object": RIG,
                "class": RigEnv,
                "name of the class": "tests.envs.rig:RigEnv",
            }.items()
        }
    vector = codrl_mj.make_vec(source, 1, actuator, autoreset_mode="Disabled", **options)
    (expected, *_), *_ = vector.reset(seed=5)
    for name, env in envs.items():
        np.testing.assert_array_equal(env.reset(seed=5)[0], expected, name)
    generator = np.random.default_rng(1)
    for _ in range(8):
        actions = random_actions(vector, generator)
        expected = [values[0] for values in vector.step(actions)[:4]]
        for name, env in envs.items():
            for value, expected_value in zip(env.step(actions[0]), expected, strict=False):
                np.testing.assert_array_equal(value, expected_value, name)
        if expected[2] or expected[3]:
            break
    assert expected[2] or expected[3]


@every_rebuilt
@pytest.mark.parametrize("setup", SETUPS)
def test_both_physics_give_the_same_results(task, setup):
    """Compare states, rewards, ends and signals of the first steps, before chaos sets in."""
    options = arguments(task, setup, "analytic")
    pair = [ActuatedEnv(task, physics=physics, **options) for physics in ("mujoco", "analytic")]
    for values, expected in zip(
        *(arrays(plain((start_episode(env, 7), run(env, 15, seed=0)))) for env in pair), strict=True
    ):
        rounding = 1e-6 if values.dtype == np.float32 else 1e-9
        np.testing.assert_allclose(values, expected, rtol=rounding, atol=rounding)


# -- another process ------------------------------------------------------------------------------


def continue_snapshot(name, before, after):
    """Restore a snapshot from a file, run some steps, and write the next snapshot."""
    (env,) = (environment.make() for environment in ENVIRONMENTS if environment.name == name)
    env.restore(load_file(before))
    run(env, 60, seed=1)
    save_file(env.snapshot(), after)


@pytest.mark.matrix
@pytest.mark.parametrize("task", ["cartpole", "mountain_car"])
def test_another_process_continues_like_this_one(tmp_path, task):
    name, before, after = f"{task}-mujoco-randomized-sb3", tmp_path / "before", tmp_path / "after"
    (env,) = (environment.make() for environment in ENVIRONMENTS if environment.name == name)
    start_episode(env, 3)
    save_file(env.snapshot(), before)
    run(env, 60, seed=1)
    code = (
        "from tests.conformance.test_contracts import continue_snapshot\n"
        f"continue_snapshot({name!r}, {str(before)!r}, {str(after)!r})"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert_same(load_file(after), env.snapshot())
