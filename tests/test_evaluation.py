"""Evaluation: episodes are those of single stepping, and their numbers are those of a direct calculation."""

import functools
import math
import pickle

import gymnasium
import numpy as np
import pytest

from codrl_mj import TASKS, Actuator, CurrentLoop, Motor, named_actuator
from codrl_mj.evaluation import (
    Episode,
    RandomPolicy,
    bootstrap_mean,
    load_episode,
    make_env,
    run_episodes,
    save_episode,
    summarize,
)

SIGNALS = ("desired_force", "actual_force", "current", "reference_current", "voltage", "saturated")


class Leaner:
    """Pushes the cart to the side to which the pole leans, which balances it for a while only."""

    def __init__(self):
        """Nothing was asked yet."""
        self.asked = []

    def predict(self, observation, *, deterministic=False):
        self.asked.append((len(observation), deterministic))
        return np.where(observation[:, 2] > 0, 1, 0), None


def cartpole(actuator="weaker", **options):
    return lambda: make_env("cartpole", actuator, **options)


def assert_same(first, second):
    """Two episodes are equal in every number."""
    for name in ("time", "state", "observation", "action", "reward"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for name in SIGNALS:
        np.testing.assert_array_equal(first.signals[name], second.signals[name], err_msg=name)
    assert first.terminated == second.terminated


# -- bootstrap ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [0.1, 1.0, 30.0])
def test_the_interval_of_many_values_is_the_normal_one(spread):
    values = np.random.default_rng(1).gamma(4.0, spread, 1000)
    mean, low, high = bootstrap_mean(values)
    half = 1.959964 * values.std(ddof=1) / math.sqrt(len(values))
    assert mean == pytest.approx(math.fsum(values) / 1000, rel=1e-12)
    assert (high - low) / 2 == pytest.approx(half, rel=0.05)
    assert (high + low) / 2 == pytest.approx(mean, abs=0.1 * half)


def test_the_interval_of_few_values_is_that_of_all_their_resamples():
    values = np.array([0.0, 1.0, 2.5, 7.0, 20.0])
    choices = np.stack(np.meshgrid(*[np.arange(5)] * 5), axis=-1).reshape(-1, 5)
    every_mean = values[choices].mean(axis=1)  # all 5^5 resamples, each equally likely
    _, low, high = bootstrap_mean(values)
    # 9999 of them are drawn: the shares below the ends are 2.5 % and 97.5 % within sampling error and ties
    assert np.mean(every_mean < low) <= 0.030
    assert np.mean(every_mean <= low) >= 0.020
    assert np.mean(every_mean < high) <= 0.980
    assert np.mean(every_mean <= high) >= 0.970


@pytest.mark.parametrize("values", [[500.0] * 100, [-3.25], [0.1] * 3], ids=["many", "one", "three"])
def test_values_without_spread_have_an_interval_without_width(values):
    mean, low, high = bootstrap_mean(np.array(values))
    assert low == mean == high == pytest.approx(values[0], rel=1e-15)


def test_the_interval_is_the_same_every_time():
    values = np.random.default_rng(2).normal(size=20)
    assert bootstrap_mean(values) == bootstrap_mean(values)


# -- episodes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("actuator", ["ideal", "weaker"])
def test_episodes_are_those_of_stepping_one_environment_at_a_time(actuator):
    together = run_episodes(Leaner(), cartpole(actuator), episodes=4, seed=10)
    env = gymnasium.make("codrl_mj/CartPole-v0", actuator=actuator)
    for index, episode in enumerate(together):
        policy, rewards, infos = Leaner(), [], []
        observation, _ = env.reset(seed=10 + index)
        seen, states, ended = [observation], [env.unwrapped.state], (False, False)
        while not any(ended):
            action = int(policy.predict(observation[None])[0][0])
            observation, reward, *ended, info = env.step(action)
            seen.append(observation)
            states.append(env.unwrapped.state)
            rewards.append(reward)
            infos.append(info)
        np.testing.assert_array_equal(episode.observation, seen)
        np.testing.assert_array_equal(episode.state, states)
        np.testing.assert_array_equal(episode.reward, rewards)
        assert episode.terminated is ended[0]
        assert episode.total == sum(rewards)
        for name in SIGNALS:
            np.testing.assert_array_equal(episode.signals[name], [info[name] for info in infos], err_msg=name)
    assert len({len(episode.reward) for episode in together}) > 1  # they end at different times


def test_an_episode_does_not_depend_on_how_many_run_beside_it():
    five = run_episodes(Leaner(), cartpole(), episodes=5, seed=3)
    two = run_episodes(Leaner(), cartpole(), episodes=2, seed=3)
    (last,) = run_episodes(Leaner(), cartpole(), episodes=1, seed=7)
    assert_same(five[0], two[0])
    assert_same(five[1], two[1])
    assert_same(five[4], last)
    assert not np.array_equal(five[0].state[0], five[1].state[0])


@pytest.mark.parametrize("task", list(TASKS))
@pytest.mark.parametrize("actuator", ["ideal", "paper"])
def test_an_episodes_arrays_have_the_shapes_that_it_states(task, actuator):
    definition = TASKS[task]
    make = lambda: make_env(task, actuator, max_episode_steps=6)  # noqa: E731
    for episode in run_episodes(RandomPolicy(task), make, episodes=2):
        assert episode.time.shape == episode.reward.shape == (6,)
        np.testing.assert_allclose(episode.time, [definition.step_duration * (step + 1) for step in range(6)])
        assert episode.state.shape == (7, len(definition.state_names))
        assert episode.observation.shape == (7, *definition.observation_space.shape)
        assert episode.action.shape == (6, *definition.action_space.shape)
        assert set(episode.signals) == set(SIGNALS)
        assert all(values.shape == (6,) for values in episode.signals.values())
        assert episode.signals["saturated"].dtype == bool
        assert episode.signals["current"].any() == (actuator != "ideal")
        assert not episode.terminated


def test_an_episode_ends_where_the_task_ends_it_or_the_time_limit_does():
    (fallen,) = run_episodes(RandomPolicy("cartpole"), cartpole(), episodes=1)
    assert fallen.terminated
    assert np.abs(fallen.state[-1, 2]) > 0.209
    assert np.all(np.abs(fallen.state[:-1, 2]) < 0.2095)
    (cut,) = run_episodes(Leaner(), cartpole("ideal", max_episode_steps=9), episodes=1)
    assert not cut.terminated
    assert len(cut.reward) == 9


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_policy_is_asked_once_a_step_for_the_episodes_still_running(deterministic):
    policy = Leaner()
    episodes = run_episodes(policy, cartpole(), episodes=3, deterministic=deterministic)
    lengths = [len(episode.reward) for episode in episodes]
    expected = [sum(step < length for length in lengths) for step in range(max(lengths))]
    assert policy.asked == [(running, deterministic) for running in expected]


def test_progress_counts_running_and_finished_episodes():
    reports = []
    run_episodes(Leaner(), cartpole(), episodes=3, on_step=lambda *counts: reports.append(counts))
    assert all(running + finished == 3 for running, finished in reports)
    assert [finished for _, finished in reports] == sorted(finished for _, finished in reports)
    assert reports[-1] == (0, 3)


@pytest.mark.parametrize(("options", "named"), [({"episodes": 0}, "episodes = 0"), ({"seed": -1}, "seed = -1")])
def test_bad_counts_and_seeds_are_named(options, named):
    with pytest.raises(ValueError, match=named):
        run_episodes(Leaner(), cartpole(), **({"episodes": 1} | options))


# -- summary ------------------------------------------------------------------------------------------------


def made_up(desired, actual, voltage, saturated, reward):
    count = len(desired)
    signals = dict(zip(SIGNALS, map(np.array, (desired, actual, actual, desired, voltage, saturated)), strict=True))
    return Episode(np.arange(1, count + 1) * 0.02, np.zeros((count + 1, 4)), np.zeros((count + 1, 4)),
                   np.zeros(count), np.array(reward), signals, True)  # fmt: skip


ARM = 0.25


def test_the_summary_is_the_direct_calculation_in_torques_at_the_shaft():
    episodes = [
        made_up([10.0, -10.0], [8.0, -4.0], [1.0, -3.0], [False, True], [1.0, 1.0]),
        made_up([10.0], [10.0], [2.0], [False], [0.0]),
    ]
    summary = summarize("cartpole", Actuator(Motor(arm_radius=ARM)), episodes)
    error = math.sqrt((2.0**2 + 6.0**2 + 0.0) / 3) * ARM  # N*m
    assert summary.tracking_rms == pytest.approx(error, rel=1e-12)
    assert summary.tracking_percent == pytest.approx(100 * error / (10.0 * ARM), rel=1e-12)
    assert summary.tracking_max == pytest.approx(6.0 * ARM, rel=1e-12)
    assert summary.saturated_percent == pytest.approx(100 / 3, rel=1e-12)
    assert summary.peak_voltage == 3.0
    assert summary.returns.mean == 1.0
    assert summary.length.mean == 1.5
    assert (summary.task, summary.episodes) == ("cartpole", 2)


def test_tracking_is_weighed_over_all_steps_and_not_per_episode():
    nine_bad = made_up([1.0] * 9, [0.0] * 9, [0.0] * 9, [False] * 9, [0.0] * 9)
    one_good = made_up([1.0], [1.0], [0.0], [True], [0.0])
    summary = summarize("cartpole", Actuator(), [nine_bad, one_good])
    assert summary.tracking_rms == pytest.approx(math.sqrt(0.9), rel=1e-12)
    assert summary.saturated_percent == pytest.approx(10.0, rel=1e-12)


def test_a_desired_torque_of_zero_has_no_relative_error():
    assert summarize("cartpole", Actuator(), [made_up([0.0], [0.5], [0.0], [False], [0.0])]).tracking_percent == 0.0


def test_the_ideal_actuator_tracks_perfectly_and_has_no_voltage():
    summary = summarize("cartpole", None, run_episodes(Leaner(), cartpole("ideal"), episodes=2))
    assert (summary.tracking_rms, summary.tracking_percent, summary.tracking_max) == (0.0, 0.0, 0.0)
    assert summary.saturated_percent == 0.0
    assert summary.peak_voltage is None


@pytest.mark.parametrize("max_voltage", [0.3, 0.6, 1.0, 24.0])
def test_the_saturated_share_is_that_of_voltages_at_the_limit(max_voltage):
    weaker = named_actuator("weaker", "cartpole")
    actuator = Actuator(weaker.motor, CurrentLoop(kp=0.2, ki=0.2, kff=0.5, max_voltage=max_voltage))
    episodes = run_episodes(Leaner(), cartpole(actuator), episodes=3)
    voltages = np.concatenate([episode.signals["voltage"] for episode in episodes])
    summary = summarize("cartpole", actuator, episodes)
    assert summary.saturated_percent == pytest.approx(100 * np.mean(np.abs(voltages) == max_voltage), rel=1e-12)
    assert summary.peak_voltage <= max_voltage
    assert (summary.saturated_percent > 0) == (max_voltage <= 1.0)


# -- random policy ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", list(TASKS))
def test_the_random_policy_draws_from_the_whole_action_space_and_repeats_with_its_seed(task):
    space = TASKS[task].action_space
    draw = lambda seed: RandomPolicy(task, seed).predict(np.zeros((300, 4)))[0]  # noqa: E731
    actions = draw(0)
    assert actions.shape == (300, *space.shape)
    assert all(space.contains(action) for action in actions)
    np.testing.assert_array_equal(actions, draw(0))
    assert not np.array_equal(actions, draw(1))
    if isinstance(space, gymnasium.spaces.Discrete):
        assert set(actions) == set(range(space.n))
    else:
        assert actions.min() < 0.9 * space.low.min()
        assert actions.max() > 0.9 * space.high.max()


def test_the_random_policy_leaves_the_tasks_own_space_alone():
    space = TASKS["cartpole"].action_space
    space.seed(4)
    expected = [space.sample() for _ in range(10)]
    space.seed(4)
    RandomPolicy("cartpole", 9).predict(np.zeros((10, 4)))
    assert [space.sample() for _ in range(10)] == expected


def test_a_random_policy_needs_a_known_task_and_a_seed():
    with pytest.raises(ValueError, match="did you mean 'cartpole'"):
        RandomPolicy("cartpol")
    with pytest.raises(ValueError, match="seed = -1"):
        RandomPolicy("cartpole", -1)


# -- trajectories -------------------------------------------------------------------------------------------


def test_a_saved_episode_is_read_back_exactly(tmp_path):
    make = functools.partial(make_env, "pendulum", "weaker", max_episode_steps=7)
    (episode,) = run_episodes(RandomPolicy("pendulum"), make, 1)
    save_episode(episode, tmp_path / "new" / "swing.npz")
    again = load_episode(tmp_path / "new" / "swing.npz")
    for field in ("time", "state", "observation", "action", "reward"):
        np.testing.assert_array_equal(getattr(again, field), getattr(episode, field))
        assert getattr(again, field).dtype == getattr(episode, field).dtype
    assert again.signals.keys() == episode.signals.keys()
    for name, values in episode.signals.items():
        np.testing.assert_array_equal(again.signals[name], values)
    assert again.terminated is episode.terminated is False


def test_what_is_no_trajectory_is_refused(tmp_path):
    make = functools.partial(make_env, "pendulum", "ideal", max_episode_steps=2)
    (episode,) = run_episodes(RandomPolicy("pendulum"), make, 1)
    with pytest.raises(ValueError, match=r"swing\.csv: the suffix must be \.npz"):
        save_episode(episode, tmp_path / "swing.csv")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError, match=r"swing\.npz"):
        load_episode(tmp_path / "swing.npz")
    save_episode(episode, tmp_path / "swing.npz")
    whole = (tmp_path / "swing.npz").read_bytes()
    np.savez(tmp_path / "other.npz", time=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps({"time": 1}))
    for name in ("other.npz", "cut.npz", "pickle.npz"):
        with pytest.raises(ValueError, match=name):
            load_episode(tmp_path / name)
