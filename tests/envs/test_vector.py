"""The vector environment is Gymnasium's loop over single environments, bit for bit."""

import copy
import functools

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from codrl_mj import LogUniform, Uniform, make_sb3_vec_env, make_vec
from codrl_mj.actuators import CurrentLoop, DCMotorActuator
from codrl_mj.envs import ActuatedEnv, ActuatedVectorEnv, SerialVectorEnv
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import TASKS, named_actuator
from tests.conformance.environments import DRIVE, scales
from tests.conformance.episodes import assert_same, random_actions
from tests.engine.models import FULL, changed
from tests.envs.vectors import (
    MODES,
    assert_equal_episodes,
    batched,
    looped,
)
from tests.matrix import matrix_params
from tests.tasks.faces import REBUILT, every_rebuilt

every_task = pytest.mark.parametrize("task", TASKS)
every_mode = pytest.mark.parametrize("mode", MODES)
DIFFERENT = [
    changed(
        FULL,
        inductance=inductance,
        resistance=resistance,
        arm_radius=arm,
        torque_constant=constant,
        max_voltage=max_voltage,
    )
    for inductance, resistance, arm, constant, max_voltage in np.random.default_rng(0).uniform(
        0.5, 1.0, (7, 5)
    )
    * (1, 1, 1, 1, 4)
]


# -- the same episodes ----------------------------------------------------------------------------


CURRENT = {"action": "current", "levels": (-1.5, 1.5)}
DAMPED = {**DRIVE, **scales("cartpole"), "model.damping.slider": Uniform(0.0, 0.3)}
SPREAD = [DCMotorActuator(controller=CurrentLoop(kp=kp, substeps=2)) for kp in (0.5, 1.0, 2.0, 3.0)]


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("cartpole", {"integrator": "semi-implicit"}),
        ("cartpole", {"center_radius": 0.05, "inner_steps": 4}),
        ("cartpole", {"integrator": "euler", "timestep": 0.005, "actuator": "ideal"}),
        ("pendulum", {"inner_steps": 7}),
        ("acrobot", {"timestep": 0.1, "actuator": "ideal"}),
        ("mountain_car", {"inner_steps": 40}),
        ("cartpole", {"actuator": "ideal", "randomize": scales("cartpole")}),
        ("cartpole", {"randomize": {"controller.kp": LogUniform(0.5, 30.0)}}),
        ("cartpole", {**CURRENT, "randomize": {"motor.resistance": Uniform(0.5, 2.0)}}),
        (
            "cartpole",
            {"integrator": "semi-implicit", "randomize": DAMPED, "observe_actuator": True},
        ),
        ("cartpole", {"inner_steps": 4, "randomize": DAMPED}),
        ("pendulum", {"actuator": SPREAD, "randomize": {"motor.inductance": Uniform(0.05, 0.2)}}),
    ],
)
def test_episodes_with_options_are_those_of_single_environments(task, options):
    options = {"max_episode_steps": 12, **options}
    assert_equal_episodes(batched(task, 4, **options), looped(task, 4, **options), 40)


@every_rebuilt
def test_episodes_are_equal_beyond_the_registered_time_limit(task):
    steps = min(TASKS[task].max_episode_steps + 20, 230)
    arguments = {"max_episode_steps": 60} if task == "acrobot" else {}
    ends = assert_equal_episodes(
        batched(task, 3, **arguments), looped(task, 3, **arguments), steps, masks=False
    )
    if task == "cartpole":
        assert (ends[:, 0] > 1).all()
    elif task != "mountain_car_continuous":
        assert (ends[:, 1] > 0).all()


@pytest.mark.parametrize(
    ("task", "options"),
    [("mountain_car", {"low": 0.4, "high": 0.49}), ("acrobot", {"low": -3.0, "high": 3.0})],
)
def test_environments_reach_the_goal_at_different_times(task, options):
    """Start near the goal, so that these tasks terminate too."""
    ours, theirs = batched(task, 9, "SameStep"), looped(task, 9, "SameStep")
    resets = [env.reset(seed=0, options=dict(options)) for env in (ours, theirs)]
    assert_same(*resets)
    terminated = np.zeros(9, dtype=int)
    for step in range(25):
        actions = np.full(9, 2)
        outcome, expected = ours.step(actions), theirs.step(actions)
        assert_same(outcome, expected, f"step {step}")
        terminated += outcome[2]
        if outcome[2].any():
            assert not np.array_equal(
                outcome[4]["final_obs"][np.argmax(outcome[2])], outcome[0][np.argmax(outcome[2])]
            )
    assert 0 < terminated.sum() < 25 * 9
    assert len(np.unique(terminated)) > 1


@every_task
@every_mode
def test_each_environment_may_have_its_own_actuator(task, mode):
    arguments = {"actuator": DIFFERENT, "max_episode_steps": 11}
    ours = batched(task, 7, mode, num_threads=1 if mode == "SameStep" else 2, **arguments)
    assert_equal_episodes(ours, looped(task, 7, mode, **arguments), 30)
    currents = ours.unwrapped.signals["current"]
    # All currents differ only if each environment has its own parameters.
    assert len(np.unique(currents)) == 7


def test_actuators_can_be_given_in_any_form_for_all_or_for_each_environment(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("name: weak\ncontroller: {kp: 0.5}\n")
    forms = ["paper", file, {"name": "weaker", "motor": {"resistance": 2.0}}, str(file)]
    actuators = [EnvConfig("pendulum", actuator).actuator for actuator in forms]
    assert len(set(actuators)) == 3
    assert_equal_episodes(
        batched("pendulum", 4, actuator=forms), looped("pendulum", 4, actuator=actuators), 20
    )
    for form, actuator in zip(forms, actuators, strict=True):
        assert_equal_episodes(
            batched("pendulum", 2, actuator=form), looped("pendulum", 2, actuator=[actuator] * 2), 3
        )
    serial = make_sb3_vec_env("pendulum", 4, physics="analytic", actuator=forms).env
    assert [actuator.unwrapped.actuator for actuator in serial.envs] == actuators


@every_rebuilt
@pytest.mark.parametrize("num_envs", [1, 67])
def test_episodes_do_not_depend_on_the_size_of_a_batch(task, num_envs):
    """Check sizes for which compiled array functions take other paths than for single numbers."""
    options = {"actuator": "weaker", "max_episode_steps": 9}
    assert_equal_episodes(
        batched(task, num_envs, num_threads=2, **options), looped(task, num_envs, **options), 12
    )


@pytest.mark.parametrize("task", ["pendulum", "mountain_car_continuous"])
def test_infinite_and_float64_actions_saturate_as_in_a_single_environment(task):
    ours, theirs = batched(task, 4), looped(task, 4, disable_env_checker=True)
    for env in (ours, theirs):
        env.reset(seed=0)
    for values in ([np.inf, -np.inf, 1e300, -3.0], [0.1, 0.2, 0.3, -0.4]):
        actions = np.array(values).reshape(4, 1)
        assert_same(ours.step(actions), theirs.step(actions))


@pytest.mark.parametrize("task", matrix_params(["pendulum", "cartpole", "mountain_car"], TASKS))
def test_resets_accept_gymnasiums_options_and_a_mask_leaves_other_environments(task):
    low, high = (-0.02, 0.03) if task == "cartpole" else (-0.55, -0.45)
    options = {"x_init": 0.3, "y_init": 0.2} if task == "pendulum" else {"low": low, "high": high}
    ours, theirs = batched(task, 6, "Disabled"), looped(task, 6, "Disabled")
    assert_same(*(env.reset(seed=3, options=dict(options)) for env in (ours, theirs)))
    generator = np.random.default_rng(0)
    for index in range(8):
        actions = random_actions(ours, generator)
        assert_same(ours.step(actions), theirs.step(actions))
        mask = np.arange(6) % 4 == index % 4
        kept_states = ours.unwrapped.state[~mask]
        reset_options = {"reset_mask": mask, **options}
        assert_same(ours.reset(options=reset_options), theirs.reset(options=dict(reset_options)))
        np.testing.assert_array_equal(ours.unwrapped.state[~mask], kept_states)
        # The reset must not change the caller's dictionary.
        assert reset_options.keys() == {"reset_mask", *options}


@pytest.mark.parametrize("seed", [5, np.int64(5), [9, 3, 9, None], [None] * 4])
def test_seeds_are_accepted_in_every_form(seed):
    ours, theirs = batched("cartpole", 4), looped("cartpole", 4)
    for env in (ours, theirs):
        env.reset(seed=[1, 2, 3, 4])
    assert_same(
        *(
            env.reset(seed=int(seed) if isinstance(seed, np.integer) else seed)
            for env in (ours, theirs)
        )
    )
    for generator, reference_generator in zip(ours.np_random, theirs.np_random, strict=True):
        assert generator.bit_generator.state == reference_generator.bit_generator.state
    if isinstance(seed, np.integer):
        np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=5)[0])


# -- the contract ---------------------------------------------------------------------------------


@pytest.mark.parametrize("task", matrix_params(REBUILT, TASKS))
def test_spaces_spec_and_metadata_are_those_of_gymnasiums_loop(task):
    ours, theirs = batched(task, 3), looped(task, 3)
    assert ours.num_envs == 3
    for name in (
        "action_space",
        "observation_space",
        "single_action_space",
        "single_observation_space",
    ):
        assert getattr(ours, name) == getattr(theirs, name), name
    assert ours.spec.id == theirs.spec.id == TASKS[task].env_id
    assert ours.spec.kwargs["vectorization_mode"] == "vector_entry_point"
    # There is no window: Gymnasium has a wrapper that makes one for many environments.
    modes = ["rgb_array", "rgb_array_list"]
    assert ours.metadata == theirs.metadata | {"render_modes": modes}
    assert ours.unwrapped.max_episode_steps == TASKS[task].max_episode_steps
    assert gymnasium.make_vec(ours.spec).num_envs == 3
    # Without a mode, Gymnasium selects the vector entry point.
    assert gymnasium.make_vec(TASKS[task].env_id, 2).unwrapped.num_envs == 2
    assert ActuatedVectorEnv.metadata["render_modes"] == modes


@every_mode
def test_the_autoreset_mode_is_in_the_metadata_and_can_be_a_name_or_an_enum(mode):
    assert batched("pendulum", 2, mode).metadata["autoreset_mode"] is AutoresetMode(mode)
    assert batched("pendulum", 2, AutoresetMode(mode)).metadata["autoreset_mode"] is AutoresetMode(
        mode
    )


def test_without_a_limit_no_episode_is_truncated():
    env = ActuatedVectorEnv(2, "pendulum", max_episode_steps=None)
    env.reset(seed=0)
    actions = np.zeros((2, 1), np.float32)
    assert not any(end.any() for _ in range(1100) for end in env.step(actions)[2:4])


def test_without_a_limit_no_serial_episode_is_truncated():
    make = functools.partial(ActuatedEnv, "pendulum", physics="analytic")
    env = SerialVectorEnv(2, make)
    assert isinstance(env, gymnasium.vector.SyncVectorEnv)
    env.reset(seed=0)
    assert not any(env.step(np.zeros((2, 1), np.float32))[3].any() for _ in range(250))
    assert env.task is TASKS["pendulum"]


def test_each_serial_environment_can_have_an_actuator_of_its_own():
    actuators = [named_actuator(name, "cartpole") for name in ("paper", "weak", "weaker")]
    options = {"physics": "analytic", "randomize": {"motor.resistance": Uniform(1, 2)}}
    env = make_vec("cartpole", 3, actuators, **options)
    # Before the first reset all values are NaN, and there are no signals.
    assert np.isnan(env.randomization["motor.resistance"]).all()
    assert env.signals is None
    env.reset(seed=3)
    env.step(np.array([1, 1, 1]))
    resistances = env.randomization["motor.resistance"]
    assert len(set(resistances)) == 3
    for row, actuator in enumerate(actuators):
        single = ActuatedEnv("cartpole", actuator, **options)
        drawn_values = single.reset(seed=3 + row)[1]["randomization"]
        assert drawn_values["motor.resistance"] == resistances[row]
        assert single.step(1)[4]["current"] == env.signals["current"][row]


def test_gymnasiums_vector_wrappers_work_on_it():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(batched("cartpole", 4))
    env.reset(seed=0)
    episodes = 0
    for _ in range(80):
        *_, infos = env.step(env.action_space.sample())
        episodes += int(infos["_episode"].sum()) if "_episode" in infos else 0
    assert episodes > 4


# -- rendering ------------------------------------------------------------------------------------


def test_rendering_shows_every_environment_and_does_not_change_the_episode():
    arguments = {"render_mode": "rgb_array", "width": 64, "height": 48}
    env, control = batched("pendulum", 3, **arguments), batched("pendulum", 3)
    singles = [gymnasium.make(TASKS["pendulum"].env_id, **arguments) for _ in range(3)]
    for each_env in (env, control):
        each_env.reset(seed=1)
    for row, single in enumerate(singles):
        single.reset(seed=1 + row)
    for _ in range(5):
        np.testing.assert_array_equal(env.render(), [single.render() for single in singles])
        actions = np.full((3, 1), 2.0, np.float32)
        assert_same(env.step(actions), control.step(actions))
        for single in singles:
            single.step(actions[0])
    lists = batched("pendulum", 3, **arguments | {"render_mode": "rgb_array_list"})
    lists.unwrapped.restore(env.unwrapped.snapshot())
    np.testing.assert_array_equal(lists.render(), env.render())
    env.set_attr("l", [1.0, 0.5, 2.0])
    singles[1].set_wrapper_attr("l", 0.5)
    twin = copy.deepcopy(env)
    np.testing.assert_array_equal(twin.render(), env.render())
    np.testing.assert_array_equal(env.image(1), singles[1].render())
    assert env.image().shape == (48, 64, 3)
    assert env.image().dtype == np.uint8
    for each_env in (env, twin, lists, *singles):
        each_env.close()


def test_without_a_render_mode_there_is_a_warning_and_no_image():
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert batched("pendulum", 2).render() is None


def test_threads_of_a_shallow_copy_use_its_own_arrays():
    rewards = []
    for threads in (1, 2):
        env_copied = batched("pendulum", 256, num_threads=threads)
        env_copied.reset(seed=0)
        env_copied.action_space.seed(0)
        shallow_copy = copy.copy(env_copied)
        # The copy makes new kernels from the arrays that both share.
        shallow_copy._kernels = None
        rewards.append(
            [
                stepped_env.step(env_copied.action_space.sample())[1]
                for _ in range(100)
                for stepped_env in (env_copied, shallow_copy)
            ]
        )
    np.testing.assert_array_equal(*rewards)
