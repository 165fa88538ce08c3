"""Episodes: they equal single stepping, repeat with their seeds, and are saved completely."""

import collections
import io
import math
import pickle

import gymnasium
import numpy as np
import pytest
import torch

from codrl_mj import Uniform
from codrl_mj.actuators import IDEAL, DCMotorActuator, Ideal, Supply
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.episodes import RandomPolicy, load_episode, run_episodes, save_episode
from codrl_mj.physics import signal_names, trace_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.tasks.faces import every_rebuilt

ARRAYS = ("time", "state", "observation", "action", "reward")


class Leaner:
    """Policy that pushes to the side given by the second last entry, a balancing pole's angle."""

    def __init__(self, space=TASKS["cartpole"].action_space):
        """Choose from the ends of the space."""
        self.asked = []
        self.ends = (
            (space.low, space.high) if isinstance(space, gymnasium.spaces.Box) else (0, space.n - 1)
        )

    def predict(self, observation, *, deterministic=False):
        self.asked.append((len(observation), deterministic))
        return np.array([self.ends[int(lean[-2] > 0)] for lean in observation]), None


def cartpole(actuator="weaker", **options):
    return EnvConfig("cartpole", actuator, **options).build


def assert_same(first, second):
    """Assert that two episodes are equal in every number."""
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for mapping in ("trace", "signals"):
        first_values, second_values = getattr(first, mapping), getattr(second, mapping)
        assert first_values.keys() == second_values.keys()
        for name, values in first_values.items():
            np.testing.assert_array_equal(values, second_values[name], err_msg=name)
            assert values.dtype == second_values[name].dtype
    assert (first.terminated, first.actuator, first.command) == (
        second.terminated,
        second.actuator,
        second.command,
    )


def stepped(env, seed, policy):
    """Return the columns of an episode from single steps, and whether the task ended it."""
    observation, _ = env.reset(seed=seed)
    columns = collections.defaultdict(
        list, {"observation": [observation], "state": [env.unwrapped.state]}
    )
    ended = (False, False)
    while not any(ended):
        action = policy.predict(observation[None])[0][0]
        observation, reward, *ended, info = env.step(action)
        trace, state = env.unwrapped.physics.trace.copy(), env.unwrapped.state
        now = {
            "observation": observation,
            "state": state,
            "reward": reward,
            "action": action,
            "trace": trace,
        }
        for name, value in {**now, **info}.items():
            columns[name].append(value)
    return columns, ended[0]


@every_rebuilt
@pytest.mark.parametrize("actuator", ["ideal", "paper"])
def test_episodes_equal_stepping_one_environment_at_a_time(task, actuator):
    """Compare observations, states, rewards, signals and every integration step of the trace."""
    definition, family = TASKS[task], {"ideal": Ideal, "paper": DCMotorActuator}[actuator]
    count = max(3, definition.motor_inner_steps)
    make = EnvConfig(task, actuator, inner_steps=count, max_episode_steps=60).build
    for seed, episode in enumerate(
        run_episodes(Leaner(definition.action_space), make, 4, seed=10), 10
    ):
        columns, terminated = stepped(make(), seed, Leaner(definition.action_space))
        steps = len(columns["reward"])
        for name in ("observation", "state", "action", "reward"):
            np.testing.assert_array_equal(getattr(episode, name), columns[name], err_msg=name)
        np.testing.assert_allclose(episode.time, definition.step_duration * np.arange(1, steps + 1))
        assert tuple(episode.signals) == signal_names(family)
        for name, values in episode.signals.items():
            np.testing.assert_array_equal(values, columns[name], err_msg=name)
        assert tuple(episode.trace) == trace_names(family)
        whole = np.stack(list(episode.trace.values()), axis=-1)
        np.testing.assert_array_equal(whole[:, np.newaxis], np.concatenate(columns["trace"]))
        for name in episode.trace.keys() & episode.signals.keys():
            np.testing.assert_array_equal(
                episode.trace[name][count - 1 :: count], episode.signals[name]
            )
        assert episode.terminated is terminated
        assert episode.total == pytest.approx(
            math.fsum(columns["reward"]), rel=1e-12
        )  # in another order
        assert episode.inner_steps == count
        assert episode.timestep == pytest.approx(definition.step_duration / count, rel=1e-15)
        assert episode.signals["saturated"].dtype == bool
        assert actuator == "ideal" or episode.signals["current"].any()


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_policy_is_called_once_per_step_for_all_running_episodes(
    deterministic,
):
    policy, reports = Leaner(), []
    episodes = run_episodes(
        policy, cartpole(), 3, 0, deterministic, on_step=lambda *counts: reports.append(counts)
    )
    lengths = [len(episode.reward) for episode in episodes]
    assert len(set(lengths)) > 1  # The episodes end at different times.
    running = [sum(step < length for length in lengths) for step in range(max(lengths) + 1)]
    assert policy.asked == [(count, deterministic) for count in running[:-1]]
    assert reports == [(count, 3 - count) for count in running[1:]]


class Sampler:
    """Policy that samples from torch's generator unless deterministic."""

    def predict(self, observation, *, deterministic=False):
        chosen = (
            torch.zeros(len(observation))
            if deterministic
            else torch.randint(2, (len(observation),))
        )
        return chosen.numpy().astype(int), None


def test_sampled_actions_repeat_with_their_seed_and_leave_torch_s_generator_unchanged():
    run = lambda seed: run_episodes(Sampler(), cartpole(), 3, seed, deterministic=False)  # noqa: E731
    torch.manual_seed(11)
    expected = torch.rand(4)
    torch.manual_seed(11)
    first = run(5)
    np.testing.assert_array_equal(torch.rand(4), expected)
    for episode, again in zip(first, run(5), strict=True):
        assert_same(episode, again)
    assert (
        len({episode.action[:8].tobytes() for episode in (*first, *run(8))}) == 6
    )  # All of them differ.


# -- with disturbances -----------------------------------------------------------------------------


def test_episodes_record_the_random_actuator_and_the_command():
    drawn = {"motor.resistance": Uniform(0.5, 2.0)}
    make = EnvConfig(
        "pendulum", "paper", randomize=drawn, action="current", max_episode_steps=3
    ).build
    policy = RandomPolicy(make().action_space)
    episodes = run_episodes(policy, make, 4)
    resistances = [episode.actuator.motor.resistance for episode in episodes]
    assert len(set(resistances)) == 4
    for index, resistance in enumerate(resistances):
        info = make().reset(seed=index)[1]
        assert info["randomization"]["motor.resistance"] == resistance
    assert {episode.command for episode in episodes} == {"current"}
    (ideal,) = run_episodes(Leaner(), cartpole("ideal"), 1)
    assert (ideal.actuator, ideal.command) == (IDEAL, "force")


def test_analytic_physics_with_disturbances_gives_the_same_episodes():
    paper = named_actuator("paper", "cartpole").replaced(
        {"controller.current_bias": 0.1, "supply": Supply(resistance=0.5)}
    )
    options = {"disturbances": {"command_delay": 0.03}, "max_episode_steps": 40}
    ours, theirs = (
        run_episodes(Leaner(), cartpole(paper, physics=physics, **options), 3)
        for physics in ("mujoco", "analytic")
    )
    for mujoco_episode, analytic_episode in zip(ours, theirs, strict=True):
        for name, values in mujoco_episode.trace.items():
            np.testing.assert_allclose(
                values, analytic_episode.trace[name], rtol=0, atol=1e-9, err_msg=name
            )
        np.testing.assert_allclose(mujoco_episode.state, analytic_episode.state, rtol=0, atol=1e-9)


# -- random policy ---------------------------------------------------------------------------------


@pytest.mark.parametrize("task", list(TASKS))
def test_the_random_policy_samples_the_whole_action_space_and_repeats_with_its_seed(task):
    space = TASKS[task].action_space
    draw = lambda seed: RandomPolicy(task, seed).predict(np.zeros((300, 4)))[0]  # noqa: E731
    space.seed(4)
    expected = space.sample()
    space.seed(4)
    actions = draw(0)
    np.testing.assert_array_equal(space.sample(), expected)  # The task's space is not changed.
    assert actions.shape == (300, *space.shape)
    assert all(space.contains(action) for action in actions)
    np.testing.assert_array_equal(actions, draw(0))
    assert not np.array_equal(actions, draw(1))
    if isinstance(space, gymnasium.spaces.Discrete):
        assert set(actions) == set(range(space.n))
    else:
        assert actions.min() < 0.9 * space.low.min()
        assert actions.max() > 0.9 * space.high.max()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: run_episodes(Leaner(), cartpole(), episodes=0), "episodes = 0"),
        (lambda: run_episodes(Leaner(), cartpole(), episodes=1, seed=-1), "seed = -1"),
        (lambda: RandomPolicy("cartpole", -1), "seed = -1"),
        (lambda: RandomPolicy("cartpol"), "did you mean 'cartpole'"),
    ],
)
def test_raises_if_the_count_seed_or_task_is_invalid(call, words):
    with pytest.raises(ValueError, match=words):
        call()


# -- trajectories ----------------------------------------------------------------------------------


SPECIAL = {"motor": {"arm_radius": 0.1}, "controller": {"max_voltage": float("inf")}}


def swing(actuator="ideal"):
    (episode,) = run_episodes(
        RandomPolicy("pendulum"), EnvConfig("pendulum", actuator, max_episode_steps=7).build, 1
    )
    return episode


@pytest.mark.parametrize("actuator", ["weaker", "ideal", SPECIAL], ids=str)
def test_a_saved_episode_is_loaded_exactly(tmp_path, actuator):
    episode, path = swing(actuator), tmp_path / "new" / "swing.npz"
    save_episode(episode, path)
    again = load_episode(path)
    assert_same(again, episode)
    for field in ARRAYS:
        assert getattr(again, field).dtype == getattr(episode, field).dtype
    assert again.terminated is episode.terminated is False


def test_raises_if_the_suffix_is_wrong_or_the_file_is_missing(tmp_path):
    with pytest.raises(ValueError, match=r"swing\.csv: the suffix must be \.npz"):
        save_episode(swing(), tmp_path / "swing.csv")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError, match=r"swing\.npz"):
        load_episode(tmp_path / "swing.npz")


def without_an_array(_):
    np.savez(kept_name := io.BytesIO(), time=np.zeros(3))
    return kept_name.getvalue()


def flipped(whole):
    within = whole.index(b"observation.npy") + 400  # compressed numbers
    return whole[:within] + bytes([whole[within] ^ 255]) + whole[within + 1 :]


@pytest.mark.parametrize(
    "change",
    [
        without_an_array,
        flipped,
        lambda whole: whole[: len(whole) // 2],
        lambda _: pickle.dumps({"time": 1}),
    ],
)
def test_raises_if_the_file_is_not_a_trajectory(tmp_path, change):
    path = tmp_path / "swing.npz"
    save_episode(swing("weaker"), path)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=f"{path} is not the trajectory of an episode"):
        load_episode(path)
