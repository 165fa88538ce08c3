"""Episodes: they are those of single stepping, they repeat with their seeds, and files hold all of them."""

import pickle

import gymnasium
import numpy as np
import pytest

from codrl_mj import Uniform
from codrl_mj.actuators import IDEAL, Actuator, Ideal, Supply
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.episodes import RandomPolicy, load_episode, run_episodes, save_episode
from codrl_mj.physics import signal_names, trace_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.tasks.faces import every_rebuilt

ARRAYS = ("time", "state", "observation", "action", "reward")
FAMILY = {"ideal": Ideal, "paper": Actuator, "weaker": Actuator}


class Leaner:
    """Pushes the cart to the side to which the pole leans, which balances it for a while only."""

    def __init__(self):
        """Nothing was asked yet."""
        self.asked = []

    def predict(self, observation, *, deterministic=False):
        self.asked.append((len(observation), deterministic))
        return np.where(observation[:, 2] > 0, 1, 0), None


def cartpole(actuator="weaker", **options):
    return EnvConfig("cartpole", actuator, **options).make


def assert_same(first, second):
    """Two episodes are equal in every number."""
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    for mapping in ("trace", "signals"):
        one, other = getattr(first, mapping), getattr(second, mapping)
        assert one.keys() == other.keys()
        for name, values in one.items():
            np.testing.assert_array_equal(values, other[name], err_msg=name)
            assert values.dtype == other[name].dtype
    assert (first.terminated, first.actuator, first.command) == (second.terminated, second.actuator, second.command)


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
        for name in signal_names(FAMILY[actuator]):
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


@every_rebuilt
@pytest.mark.parametrize("actuator", ["ideal", "paper"])
def test_an_episodes_arrays_have_the_shapes_that_it_states(task, actuator):
    definition = TASKS[task]
    make = EnvConfig(task, actuator, max_episode_steps=6).make
    for episode in run_episodes(RandomPolicy(task), make, episodes=2):
        assert episode.time.shape == episode.reward.shape == (6,)
        np.testing.assert_allclose(episode.time, [definition.step_duration * (step + 1) for step in range(6)])
        assert episode.state.shape == (7, len(definition.state_names))
        assert episode.observation.shape == (7, *definition.observation_space.shape)
        assert episode.action.shape == (6, *definition.action_space.shape)
        assert tuple(episode.signals) == signal_names(FAMILY[actuator])
        assert all(values.shape == (6,) for values in episode.signals.values())
        assert tuple(episode.trace) == trace_names(FAMILY[actuator])
        assert all(values.shape == (6 * episode.inner_steps,) for values in episode.trace.values())
        assert episode.signals["saturated"].dtype == bool
        if actuator != "ideal":
            assert episode.signals["current"].any()
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


# -- sampled actions ----------------------------------------------------------------------------------------


class Sampler:
    """Draws actions from torch's generator, as Stable-Baselines3's policies do, unless it is to be deterministic."""

    def predict(self, observation, *, deterministic=False):
        import torch

        chosen = torch.zeros(len(observation)) if deterministic else torch.randint(2, (len(observation),))
        return chosen.numpy().astype(int), None


def test_sampled_actions_repeat_with_their_seed_and_disturb_no_other():
    import torch

    run = lambda seed: run_episodes(Sampler(), cartpole(), 3, seed, deterministic=False)  # noqa: E731
    torch.manual_seed(11)
    expected = torch.rand(4)
    torch.manual_seed(11)
    first = run(5)
    np.testing.assert_array_equal(torch.rand(4), expected)
    for episode, again in zip(first, run(5), strict=True):
        assert_same(episode, again)
    assert len({episode.action[:8].tobytes() for episode in (*first, *run(8))}) == 6  # all of them differ


# -- whatever the environment -------------------------------------------------------------------------------


@every_rebuilt
def test_the_trace_has_every_integration_step_and_ends_each_step_with_its_signals(task):
    count = max(3, TASKS[task].motor_inner_steps)
    make = EnvConfig(task, "paper", inner_steps=count, max_episode_steps=5).make
    (episode,) = run_episodes(RandomPolicy(task), make, 1, seed=2)
    env = make()
    env.reset(seed=2)
    expected = []
    for action in episode.action:
        env.step(action)
        expected.append(env.unwrapped.physics.trace.copy())
    whole = np.stack(list(episode.trace.values()), axis=-1)
    np.testing.assert_array_equal(whole[:, np.newaxis], np.concatenate(expected))
    assert (episode.inner_steps, episode.timestep) == (
        count,
        pytest.approx(TASKS[task].step_duration / count, rel=1e-15),
    )
    for name in ("actual_force", "current", "voltage", "saturated"):
        np.testing.assert_array_equal(episode.trace[name][count - 1 :: count], episode.signals[name])


def test_episodes_know_what_was_drawn_for_them_and_what_was_commanded():
    drawn = {"motor.resistance": Uniform(0.5, 2.0)}
    make = EnvConfig("pendulum", "paper", randomize=drawn, action="current", max_episode_steps=3).make
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


def test_analytic_physics_disturbed_runs_the_same_episodes():
    paper = named_actuator("paper", "cartpole").replaced(
        {"controller.current_bias": 0.1, "supply": Supply(resistance=0.5)}
    )
    options = {"disturbances": {"command_delay": 0.03}, "max_episode_steps": 40}
    ours, theirs = (
        run_episodes(Leaner(), cartpole(paper, physics=physics, **options), 3) for physics in ("mujoco", "analytic")
    )
    for one, other in zip(ours, theirs, strict=True):
        for name, values in one.trace.items():
            np.testing.assert_allclose(values, other.trace[name], rtol=0, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(one.state, other.state, rtol=0, atol=1e-9)


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


@pytest.mark.parametrize(
    "actuator", ["weaker", "ideal", {"motor": {"arm_radius": 0.1}, "controller": {"max_voltage": float("inf")}}]
)
def test_a_saved_episode_is_read_back_exactly(tmp_path, actuator):
    make = EnvConfig("pendulum", actuator, max_episode_steps=7).make
    (episode,) = run_episodes(RandomPolicy("pendulum"), make, 1)
    save_episode(episode, tmp_path / "new" / "swing.npz")
    again = load_episode(tmp_path / "new" / "swing.npz")
    assert_same(again, episode)
    for field in ARRAYS:
        assert getattr(again, field).dtype == getattr(episode, field).dtype
    assert again.signals.keys() == episode.signals.keys()
    assert again.terminated is episode.terminated is False


def test_what_is_no_trajectory_is_refused(tmp_path):
    make = EnvConfig("pendulum", "ideal", max_episode_steps=2).make
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
    within = whole.index(b"observation.npy") + 400  # compressed numbers
    (tmp_path / "flipped.npz").write_bytes(whole[:within] + bytes([whole[within] ^ 255]) + whole[within + 1 :])
    for name in ("other.npz", "cut.npz", "pickle.npz", "flipped.npz"):
        with pytest.raises(ValueError, match=name):
            load_episode(tmp_path / name)
