"""The vector environment is Gymnasium's loop over single environments, bit for bit."""

import copy
import itertools
import math
import pickle
import re

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from codrl_mj.envs import ActuatedEnv, ActuatedVectorEnv
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.sb3 import make_sb3_vec_env
from codrl_mj.tasks import TASKS
from tests.engine.models import FULL, changed
from tests.envs.vectors import MODES, assert_equal_episodes, assert_same, batched, looped, random_actions
from tests.matrix import but
from tests.tasks.faces import REBUILT, every_rebuilt

every_task = pytest.mark.parametrize("task", TASKS)
every_mode = pytest.mark.parametrize("mode", MODES)
DISCRETE = ("cartpole", "acrobot", "mountain_car")
COMMANDED = [("pendulum", "force"), ("pendulum", "current"), ("cartpole", "voltage")]
DIFFERENT = [
    changed(
        FULL, inductance=inductance, resistance=resistance, arm_radius=arm, torque_constant=constant, max_voltage=top
    )
    for inductance, resistance, arm, constant, top in np.random.default_rng(0).uniform(0.5, 1.0, (7, 5))
    * (1, 1, 1, 1, 4)
]


# -- the same episodes --------------------------------------------------------------------------------------


@every_rebuilt
@every_mode
@pytest.mark.parametrize("actuator", ["ideal", "paper", "weaker"])
def test_episodes_are_those_of_single_environments(task, mode, actuator):
    arguments = {"actuator": actuator, "max_episode_steps": 13}
    ours = batched(task, 5, mode, num_threads=1 if actuator == "weaker" else 2, **arguments)
    ends = assert_equal_episodes(ours, looped(task, 5, mode, **arguments), 45)
    assert (ends.sum(axis=1) > 0).all()


@every_rebuilt
def test_episodes_are_equal_over_the_registered_time_limit_and_end_both_ways(task):
    steps = min(TASKS[task].max_episode_steps + 20, 230)
    arguments = {"max_episode_steps": 60} if task == "acrobot" else {}
    ends = assert_equal_episodes(batched(task, 3, **arguments), looped(task, 3, **arguments), steps, masks=False)
    if task == "cartpole":
        assert (ends[:, 0] > 1).all()
    elif task != "mountain_car_continuous":
        assert (ends[:, 1] > 0).all()


@pytest.mark.parametrize(
    ("task", "options"), [("mountain_car", {"low": 0.4, "high": 0.49}), ("acrobot", {"low": -3.0, "high": 3.0})]
)
def test_goals_are_reached_by_some_environments_before_others(task, options):
    """Starts near the goal, so that these tasks terminate too."""
    ours, theirs = batched(task, 9, "SameStep"), looped(task, 9, "SameStep")
    resets = [env.reset(seed=0, options=dict(options)) for env in (ours, theirs)]
    assert_same(*resets)
    terminated = np.zeros(9, dtype=int)
    for step in range(25):
        actions = np.full(9, 2)
        one, other = ours.step(actions), theirs.step(actions)
        assert_same(one, other, f"step {step}")
        terminated += one[2]
        if one[2].any():
            assert not np.array_equal(one[4]["final_obs"][np.argmax(one[2])], one[0][np.argmax(one[2])])
    assert 0 < terminated.sum() < 25 * 9
    assert len(np.unique(terminated)) > 1


@every_task
@every_mode
def test_each_environment_may_have_its_own_actuator(task, mode):
    arguments = {"actuator": DIFFERENT, "max_episode_steps": 11}
    ours = batched(task, 7, mode, num_threads=1 if mode == "SameStep" else 2, **arguments)
    assert_equal_episodes(ours, looped(task, 7, mode, **arguments), 30)
    currents = ours.unwrapped.signals["current"]
    assert len(np.unique(currents)) == 7  # the parameters arrive


def test_actuators_of_the_environments_may_be_written_as_that_of_one(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("name: weak\ncontroller: {kp: 0.5}\n")
    written = ["paper", file, {"name": "weaker", "motor": {"resistance": 2.0}}, str(file)]
    each = [EnvConfig("pendulum", one).actuator for one in written]
    assert len(set(each)) == 3
    assert_equal_episodes(batched("pendulum", 4, actuator=written), looped("pendulum", 4, actuator=each), 20)
    serial = make_sb3_vec_env(TASKS["pendulum"].env_id, 4, physics="analytic", actuator=written).env
    assert [one.unwrapped.actuator for one in serial.envs] == each


@every_rebuilt
def test_many_environments_are_as_equal_as_few(task):
    """Compiled array functions take other paths for long arrays than for single numbers."""
    arguments = {"actuator": "weaker", "max_episode_steps": 9}
    assert_equal_episodes(batched(task, 67, num_threads=2, **arguments), looped(task, 67, **arguments), 12)


@pytest.mark.parametrize(("task", "command"), but(COMMANDED, itertools.product(TASKS, ["force", "current", "voltage"])))
def test_other_commands_and_observed_currents(task, command):
    actuator = FULL if command == "force" else changed(FULL, inductance=0.2, substeps=3)
    arguments = {"actuator": actuator, "action": command, "observe_actuator": True, "max_episode_steps": 10}
    if command != "force" and task in DISCRETE:
        limit = 4.0 if command == "voltage" else TASKS[task].max_force * 0.5 / 0.8
        arguments["levels"] = (-limit, -limit / 3, limit / 7, limit)
    ours, theirs = batched(task, 5, "SameStep", **arguments), looped(task, 5, "SameStep", **arguments)
    assert ours.single_action_space == theirs.single_action_space
    assert ours.single_observation_space == theirs.single_observation_space
    assert_equal_episodes(ours, theirs, 25)
    assert np.any(ours.step(random_actions(ours, np.random.default_rng(0)))[0][:, -2:] != 0.0)


@pytest.mark.parametrize(
    ("task", "arguments"),
    [
        ("cartpole", {"integrator": "semi-implicit"}),
        ("cartpole", {"center_radius": 0.05, "inner_steps": 4}),
        ("cartpole", {"integrator": "euler", "timestep": 0.005, "actuator": "ideal"}),
        ("pendulum", {"inner_steps": 7}),
        ("acrobot", {"timestep": 0.1, "actuator": "ideal"}),
        ("mountain_car", {"inner_steps": 40}),
    ],
)
def test_every_option_of_the_single_environment(task, arguments):
    arguments = {"max_episode_steps": 15, **arguments}
    assert_equal_episodes(batched(task, 4, **arguments), looped(task, 4, **arguments), 40)


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_reset_options_out_of_order_are_refused(value):
    for env in (ActuatedEnv("pendulum"), batched("pendulum", 2)):
        with pytest.raises(ValueError, match=re.escape(f"reset options = {{'x_init': {value}}}: ask for [")):
            env.reset(seed=0, options={"x_init": value})


@pytest.mark.parametrize("task", but(["pendulum", "cartpole", "mountain_car"], TASKS))
def test_resets_take_gymnasiums_options_and_a_mask_leaves_the_others(task):
    low, high = (-0.02, 0.03) if task == "cartpole" else (-0.55, -0.45)
    options = {"x_init": 0.3, "y_init": 0.2} if task == "pendulum" else {"low": low, "high": high}
    ours, theirs = batched(task, 6, "Disabled"), looped(task, 6, "Disabled")
    assert_same(*(env.reset(seed=3, options=dict(options)) for env in (ours, theirs)))
    generator = np.random.default_rng(0)
    for index in range(8):
        actions = random_actions(ours, generator)
        assert_same(ours.step(actions), theirs.step(actions))
        mask = np.arange(6) % 4 == index % 4
        kept = ours.unwrapped.state[~mask]
        given = {"reset_mask": mask, **options}
        assert_same(*(env.reset(options=dict(given)) for env in (ours, theirs)))
        np.testing.assert_array_equal(ours.unwrapped.state[~mask], kept)
        assert given.keys() == {"reset_mask", *options}  # ours changes nobody's dictionary


@pytest.mark.parametrize("seed", [5, np.int64(5), [9, 3, 9, None], [None] * 4])
def test_seeds_in_every_form(seed):
    ours, theirs = batched("cartpole", 4), looped("cartpole", 4)
    for env in (ours, theirs):
        env.reset(seed=[1, 2, 3, 4])
    assert_same(*(env.reset(seed=int(seed) if isinstance(seed, np.integer) else seed) for env in (ours, theirs)))
    for mine, his in zip(ours.np_random, theirs.np_random, strict=True):
        assert mine.bit_generator.state == his.bit_generator.state
    if isinstance(seed, np.integer):
        np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=5)[0])


def test_unseeded_environments_differ():
    observations, _ = batched("cartpole", 8).reset()
    assert len(np.unique(observations[:, 0])) == 8


def test_one_environment_is_a_batch_too():
    assert_equal_episodes(batched("pendulum", 1, max_episode_steps=5), looped("pendulum", 1, max_episode_steps=5), 20)


# -- the contract -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", but(REBUILT, TASKS))
def test_spaces_spec_and_metadata_are_those_of_gymnasiums_loop(task):
    ours, theirs = batched(task, 3), looped(task, 3)
    assert ours.num_envs == 3
    for name in ("action_space", "observation_space", "single_action_space", "single_observation_space"):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert ours.spec.id == theirs.spec.id == TASKS[task].env_id
    assert ours.spec.kwargs["vectorization_mode"] == "vector_entry_point"
    modes = ["rgb_array", "rgb_array_list"]  # no window: Gymnasium's wrapper has one for many
    assert ours.metadata == theirs.metadata | {"render_modes": modes}
    assert ours.unwrapped.max_episode_steps == TASKS[task].max_episode_steps
    assert gymnasium.make_vec(ours.spec).num_envs == 3
    assert gymnasium.make_vec(TASKS[task].env_id, 2).unwrapped.num_envs == 2  # the default mode is ours
    assert ActuatedVectorEnv.metadata["render_modes"] == modes


@every_mode
def test_the_autoreset_mode_is_in_the_metadata_and_may_be_a_name_or_gymnasiums_own(mode):
    assert batched("pendulum", 2, mode).metadata["autoreset_mode"] is AutoresetMode(mode)
    assert batched("pendulum", 2, AutoresetMode(mode)).metadata["autoreset_mode"] is AutoresetMode(mode)


def test_without_a_limit_no_episode_is_truncated():
    env = ActuatedVectorEnv(2, "pendulum", max_episode_steps=None)
    env.reset(seed=0)
    for _ in range(1100):
        _, _, terminated, truncated, _ = env.step(np.zeros((2, 1), np.float32))
        assert not terminated.any()
        assert not truncated.any()


@every_rebuilt
@every_mode
def test_nothing_returned_or_given_aliases_what_goes_on(task, mode):
    arguments = {"actuator": "weaker", "max_episode_steps": 7}
    env, control = batched(task, 4, mode, **arguments), batched(task, 4, mode, **arguments)
    generator = np.random.default_rng(0)
    first, _ = env.reset(seed=0)
    kept = [first]
    copies = [first.copy()]
    control.reset(seed=0)
    for _ in range(20):
        actions = random_actions(env, generator)
        given = actions.copy()
        found, expected = env.step(actions), control.step(given.copy())
        assert_same(found, expected)
        np.testing.assert_array_equal(actions, given)
        ended = found[2] | found[3]
        for array in _arrays(found):
            array[...] = 1  # vandalism
        actions[...] = 0
        env.unwrapped.state[:] = 5.0
        kept.append(control.unwrapped.state)
        copies.append(kept[-1].copy())
        if mode == "Disabled" and ended.any():
            for one in (env, control):
                one.reset(options={"reset_mask": ended})
    for array, expected in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, expected)


def _arrays(value):
    """Every numeric array in nested results."""
    if isinstance(value, dict):
        return [array for item in value.values() for array in _arrays(item)]
    if isinstance(value, tuple):
        return [array for item in value for array in _arrays(item)]
    if isinstance(value, np.ndarray) and value.dtype == object:
        return [array for item in value for array in _arrays(item)]
    return [value] if isinstance(value, np.ndarray) else []


def test_gymnasiums_vector_wrappers_work_on_it():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(batched("cartpole", 4))
    env.reset(seed=0)
    episodes = 0
    for _ in range(80):
        *_, infos = env.step(env.action_space.sample())
        episodes += int(infos["_episode"].sum()) if "_episode" in infos else 0
    assert episodes > 4


# -- copies and snapshots -----------------------------------------------------------------------------------


def _copy_by_snapshot(env):
    twin = batched(env.spec.kwargs["task"], env.num_envs, env.metadata["autoreset_mode"], **env.test_arguments)
    twin.reset(seed=99)
    for _ in range(5):
        twin.step(random_actions(twin, np.random.default_rng(8)))
    saved = env.unwrapped.snapshot()
    twin.unwrapped.restore({name: value.copy() for name, value in saved.items()})
    return twin


@every_task
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    "duplicate",
    [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), _copy_by_snapshot],
    ids=["copy", "pickle", "snapshot"],
)
def test_a_copy_made_mid_episode_continues_bit_for_bit(task, mode, duplicate):
    arguments = {"actuator": DIFFERENT, "max_episode_steps": 8}
    env = batched(task, 7, mode, **arguments)
    env.test_arguments = arguments
    env.reset(seed=4)
    generator = np.random.default_rng(0)
    mask = np.arange(7) < 3
    for index in range(8):  # the last step ends some episodes, which in NextStep mode are to be reset
        if index == 4:
            env.reset(options={"reset_mask": mask})
        env.step(random_actions(env, generator))
    twin = duplicate(env)
    actions = [random_actions(env, generator) for _ in range(20)]
    expected = [env.step(action) for action in actions]
    for index, (action, one) in enumerate(zip(actions, expected, strict=True)):
        assert_same(twin.step(action), one, f"step {index}")
    state = env.unwrapped.state
    twin.step(actions[0])
    np.testing.assert_array_equal(env.unwrapped.state, state)  # they are apart
    for mine, his in zip(env.np_random, twin.np_random, strict=True):
        assert mine is not his


def test_a_snapshot_is_plain_arrays_and_does_not_move_with_the_environment(tmp_path):
    env = batched("acrobot", 3, "SameStep", max_episode_steps=5)
    env.reset(seed=0)
    env.step(np.array([0, 1, 2]))
    saved = env.unwrapped.snapshot()
    np.savez(tmp_path / "snapshot.npz", **saved)
    actions = np.random.default_rng(0).integers(3, size=(12, 3))
    first = [env.step(action) for action in actions]
    with np.load(tmp_path / "snapshot.npz", allow_pickle=False) as loaded:
        for again in (saved, dict(loaded)):
            env.unwrapped.restore(again)
            for action, one in zip(actions, first, strict=True):
                assert_same(env.step(action), one)


def test_a_snapshot_of_others_is_refused_and_nothing_changes():
    env = ActuatedVectorEnv(3, "pendulum")
    env.reset(seed=0)
    before = env.snapshot()
    for wrong, name in (
        (ActuatedVectorEnv(4, "pendulum").snapshot(), "physics"),
        (ActuatedVectorEnv(3, "cartpole").snapshot(), "physics"),
        ({**before, "elapsed": before["elapsed"][:2]}, "elapsed"),
        ({key: value for key, value in before.items() if key != "streams"}, "streams"),
    ):
        with pytest.raises(ValueError, match=rf"^snapshot\['{name}'\] is "):
            env.restore(wrong)
    assert_same(env.snapshot(), before)


# -- rendering ----------------------------------------------------------------------------------------------


def test_rendering_shows_every_environment_and_leaves_the_episode_alone():
    arguments = {"render_mode": "rgb_array", "width": 64, "height": 48}
    env, control = batched("pendulum", 3, **arguments), batched("pendulum", 3)
    singles = [gymnasium.make(TASKS["pendulum"].env_id, **arguments) for _ in range(3)]
    for one in (env, control):
        one.reset(seed=1)
    for row, single in enumerate(singles):
        single.reset(seed=1 + row)
    for _ in range(5):
        np.testing.assert_array_equal(env.render(), [single.render() for single in singles])
        actions = np.full((3, 1), 2.0, np.float32)
        assert_same(env.step(actions), control.step(actions))
        for single in singles:
            single.step(actions[0])
    env.set_attr("l", [1.0, 0.5, 2.0])
    singles[1].set_wrapper_attr("l", 0.5)
    twin = copy.deepcopy(env)
    np.testing.assert_array_equal(twin.render(), env.render())
    np.testing.assert_array_equal(env.image(1), singles[1].render())
    assert env.image().shape == (48, 64, 3)
    assert env.image().dtype == np.uint8
    for one in (env, twin, *singles):
        one.close()


def test_a_list_of_images_is_one_of_each_environment():
    view = {"width": 64, "height": 48}
    lists, images = (batched("cartpole", 2, render_mode=mode, **view) for mode in ("rgb_array_list", "rgb_array"))
    for env in (lists, images):
        env.reset(seed=0)
    np.testing.assert_array_equal(lists.render(), images.render())


def test_without_a_render_mode_there_is_a_warning_and_no_image():
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert batched("pendulum", 2).render() is None


# -- one environment of a batch -----------------------------------------------------------------------------


def test_an_actuator_in_any_form_is_the_same():
    motor = Actuator(Motor(), CurrentLoop(kp=2.0))
    forms = [motor, {"controller": {"kp": 2.0}}, [motor] * 3]
    runs = []
    for form in forms:
        env = ActuatedVectorEnv(3, "pendulum", form)
        env.reset(seed=0)
        runs.append([env.step(np.full((3, 1), value, np.float32)) for value in (1.0, -2.0, 0.5)])
    assert_same(tuple(runs[1]), tuple(runs[0]))
    assert_same(tuple(runs[2]), tuple(runs[0]))
    single = ActuatedEnv("pendulum", motor)
    single.reset(seed=0)
    assert single.step(np.array([1.0], np.float32))[4]["current"] == runs[0][0][4]["current"][0]


def test_threads_of_a_shallow_copy_use_its_own_arrays():
    taken = []
    for threads in (1, 2):
        one = batched("pendulum", 256, num_threads=threads)
        one.reset(seed=0)
        one.action_space.seed(0)
        other = copy.copy(one)
        other._kernels = None  # it makes its own, of what both share
        taken.append([env.step(one.action_space.sample())[1] for _ in range(100) for env in (one, other)])
    np.testing.assert_array_equal(*taken)
