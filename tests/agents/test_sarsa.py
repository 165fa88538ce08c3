"""SARSA equals Sutton and Barto's algorithm, and works as an algorithm of Stable-Baselines3."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.logger import configure

import codrl_mj
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.agents.sarsa import SARSAConfig
from codrl_mj.agents.sarsa_algorithm import MIN_ELIGIBILITY, SARSA
from codrl_mj.physics.base import SimulationDivergedError
from codrl_mj.tasks import find_task

# One tile for each of the chain's 3 states.
TABLE = {"tilings": 1, "intervals": (2,)}


class Chain(gymnasium.Env):
    """Chain of states 0, 1, 2: action 1 moves on and out of the last, action 0 stays; -1 a step."""

    observation_space = spaces.Box(0.0, 2.0, (1,))

    def __init__(self, actions=2):  # noqa: D107
        self.action_space = spaces.Discrete(actions)
        self.history = []

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        self.state = 0
        self.history.append([])
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.history[-1].append((self.state, int(action)))
        self.state += int(action)
        return np.full(1, min(self.state, 2), np.float32), -1.0, self.state == 3, False, {}


def _table(model):
    return model.policy.state_dict()["weights"].numpy().copy()


# -- the updates -----------------------------------------------------------------------------------


@pytest.mark.parametrize("trace_decay", [0.0, 0.8])
def test_weights_equal_those_of_sutton_and_bartos_algorithm(trace_decay):
    """Compute the weights from the history by the box (10.1; 12.7 with replacing traces)."""
    step_size, gamma, env = 0.3, 0.9, Chain()
    config = SARSAConfig(
        step_size=step_size, gamma=gamma, epsilon=0.5, trace_decay=trace_decay, **TABLE
    )
    model = config.make_model(env, 3).learn(60)
    values = np.zeros((3, 2))
    # The last episode has only started.
    for episode in env.history[:-1]:
        traces = np.zeros((3, 2))
        for pair, next_pair in zip(episode, [*episode[1:], None], strict=True):
            target = -1.0 + (0.0 if next_pair is None else gamma * values[next_pair])
            error = target - values[pair]
            traces *= gamma * trace_decay
            traces[traces < MIN_ELIGIBILITY] = 0.0
            traces[pair] = 1.0
            values += step_size * error * traces
    assert len(env.history) > 5
    np.testing.assert_allclose(_table(model), values, rtol=1e-12)


@pytest.mark.parametrize("limit", [1, 3])
def test_a_time_limit_does_not_terminate_the_return(limit):
    """The value of staying forever is -1/(1 - gamma), also in short episodes."""
    env = TimeLimit(Chain(), limit)
    env.action_space = spaces.Discrete(1)
    model = SARSAConfig(step_size=0.5, gamma=0.9, **TABLE).make_model(env, 0).learn(600)
    assert _table(model)[0, 0] == pytest.approx(-10.0)


def test_weights_start_at_the_initial_value_divided_by_tilings():
    car = find_task("mountain_car")
    policy = SARSAConfig(initial_value=40.0).make_policy(car.observation_space, car.action_space)
    np.testing.assert_array_equal(policy.table, np.full((648, 3), 5.0))


def test_equally_good_actions_are_chosen_alike_and_a_greedy_policy_takes_the_first():
    env = Chain(actions=4)
    env.step = lambda action: (
        env.history[-1].append(action),
        (np.zeros(1, np.float32), 0.0, True, False, {}),
    )[1]
    model = SARSAConfig(epsilon=0.0, **TABLE).make_model(env, 0).learn(1000)
    counts = np.bincount([int(episode[0]) for episode in env.history if episode], minlength=4)
    assert counts.sum() == 1000
    assert abs(counts - 250).max() < 5 * np.sqrt(1000 * 0.25 * 0.75)
    assert model.predict(np.zeros(1, np.float32), deterministic=True)[0] == 0


def test_epsilon_is_the_share_of_random_actions():
    policy = SARSAConfig(epsilon=0.3, **TABLE).make_policy(
        Chain.observation_space, spaces.Discrete(2)
    )
    policy.table[:, 1] = 1.0
    actions, _ = policy.predict(np.zeros((20_000, 1), np.float32), deterministic=False)
    assert abs((actions == 0).mean() - 0.15) < 5 * np.sqrt(0.15 * 0.85 / 20_000)


# -- as an algorithm of Stable-Baselines3 ----------------------------------------------------------


def _car(seed_of_env=None, **arguments):
    env = codrl_mj.make_sb3_vec_env(
        "codrl_mj/MountainCar-v0", num_envs=1, **({"actuator": "ideal"} | arguments)
    )
    if seed_of_env is not None:
        env.seed(seed_of_env)
    return env


def _model(config=SARSAConfig(epsilon=0.2), compiled=True, **arguments):  # noqa: B008
    model = config.make_model(_car(**arguments), 0)
    model.compiled = compiled
    return model


class Watched(BaseCallback):
    """Callback that records steps and epsilon at starts of episodes, and each step's locals."""

    def _init_callback(self):
        self.begun, self.steps = [], []

    def _on_rollout_start(self):
        assert self.model._last_episode_starts.all()
        self.begun.append((self.num_timesteps, self.model.exploration_rate))

    def _on_step(self):
        self.steps.append({name: self.locals[name] for name in ("dones", "infos", "signals")})
        return True


def test_agent_and_environment_draw_different_numbers():
    model = SARSAConfig().make_model(_car(), 0)
    model.env.reset()
    assert model.snapshot()["generator"].tolist() != model.env.snapshot()["streams"][0].tolist()


def test_a_loaded_model_acts_and_learns_like_the_saved_one(tmp_path):
    model = SARSAConfig(trace_decay=0.5).make_model(_car(), 0).learn(500)
    model.save(tmp_path / "model")
    loaded = SARSA.load(tmp_path / "model", env=_car())
    np.testing.assert_array_equal(_table(loaded), _table(model))
    for each in (model, loaded):
        each.set_env(_car(seed_of_env=7))
        each.learn(500, reset_num_timesteps=False)
    assert model.num_timesteps == loaded.num_timesteps >= 1000
    np.testing.assert_array_equal(_table(loaded), _table(model))


def test_batched_predictions_equal_single_ones():
    model = SARSAConfig().make_model(_car(), 0).learn(2000)
    space = model.observation_space
    observations = (
        np.random.default_rng(0).uniform(space.low, space.high, (200, 2)).astype(np.float32)
    )
    actions = model.predict(observations, deterministic=True)[0].tolist()
    assert set(actions) == {0, 1, 2}
    assert [model.predict(row, deterministic=True)[0].item() for row in observations] == actions


def test_evaluations_do_not_change_the_training():
    model, unevaluated = (SARSAConfig().make_model(_car(), 0) for _ in range(2))
    evaluate = EvalCallback(_car(), n_eval_episodes=2, eval_freq=2, deterministic=False, verbose=0)
    np.testing.assert_array_equal(
        _table(model.learn(1000, evaluate)), _table(unevaluated.learn(1000))
    )
    assert evaluate.last_mean_reward == -200.0


def test_callbacks_see_every_episode_and_its_epsilon_and_loggers_work(tmp_path):
    model = SARSAConfig(epsilon=0.5, epsilon_decay=0.9).make_model(_car(), 0)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    watched, every = Watched(), []
    often = EveryNTimesteps(400, ConvertCallback(lambda locals_, _: every.append(locals_) or True))
    save = CheckpointCallback(2, str(tmp_path / "checkpoints"))
    model.learn(10**9, [watched, often, save, StopTrainingOnMaxEpisodes(5)], log_interval=1)
    assert watched.begun == [
        (200 * episode, pytest.approx(0.5 * 0.9**episode)) for episode in range(5)
    ]
    assert len(every) == 2
    assert model.num_timesteps == sum(episode["l"] for episode in model.ep_info_buffer) == 1000
    assert list((tmp_path / "checkpoints").iterdir())
    assert "rollout/ep_rew_mean" in (tmp_path / "progress.csv").read_text()


def test_learning_ends_with_an_episode_and_goes_on_with_the_next():
    model = SARSAConfig().make_model(_car(max_episode_steps=30), 0).learn(100)
    assert model.num_timesteps == 120
    assert model.learn(1, reset_num_timesteps=False).num_timesteps == 150


# -- whole episodes in compiled code ---------------------------------------------------------------

NOISY = {"controller": {"ki": 1.0, "kd": 0.01, "current_noise": 0.05}}
DISTURBED = {
    "command_delay": 0.12,
    "pulse_force": 0.1,
    "pulse_duration": 1.0,
    "pulse_interval": 9.0,
}
LEVELS = {
    "actuator": "paper",
    "observe_actuator": True,
    "action": "current",
    "levels": (-1, -0.5, 0.5, 1),
}


@pytest.mark.parametrize(
    ("settings", "arguments"),
    [
        pytest.param({}, {"actuator": "paper"}, marks=pytest.mark.matrix),
        ({"trace_decay": 0.8, "gamma": 0.9}, {}),
        pytest.param({}, LEVELS, marks=pytest.mark.matrix),
        ({}, {"actuator": NOISY, "disturbances": DISTURBED, "max_episode_steps": 77}),
    ],
    ids=["motor", "with traces", "currents", "disturbed"],
)
def test_compiled_episodes_equal_those_taken_step_by_step(settings, arguments):
    states, recorded = [], []
    for compiled in (False, True):
        model, watched = (
            _model(SARSAConfig(epsilon=0.2, **settings), compiled, **arguments),
            Watched(),
        )
        model.learn(10**9, [StopTrainingOnMaxEpisodes(5), watched])
        signals = {f"signals.{name}": values for name, values in model.env.signals.items()}
        results = {
            "table": _table(model),
            "observation": model._last_obs,
            "steps": model.num_timesteps,
        }
        states.append({**results, **model.snapshot(), **model.env.snapshot(), **signals})
        recorded.append(watched.steps)
    assert [*states[0]] == [*states[1]]
    for name, values in states[0].items():
        np.testing.assert_array_equal(values, states[1][name], err_msg=name)
    steps, episodes = recorded
    assert len(steps) == states[0]["steps"]
    assert len(episodes) == 5
    ended = [step for step in steps if step["dones"][0]]
    for step, episode in zip(ended, episodes, strict=True):
        assert episode["dones"].tolist() == [True]
        (step_info,), (episode_info,) = step["infos"], episode["infos"]
        np.testing.assert_array_equal(
            step_info["terminal_observation"], episode_info["terminal_observation"]
        )
        assert step_info["TimeLimit.truncated"] == episode_info["TimeLimit.truncated"]
        assert step_info["episode"] | {"t": 0} == episode_info["episode"] | {"t": 0}
    for signal in (
        "desired_force",
        "actual_force",
        "current",
        "reference_current",
        "voltage",
        "saturated",
    ):
        np.testing.assert_array_equal(
            *(np.concatenate([s["signals"][signal] for s in each]) for each in recorded)
        )


def test_changed_attributes_disable_compiled_episodes():
    tables = []
    for compiled in (False, True):
        model = _model(compiled=compiled, max_episode_steps=300)
        model.env.set_attr("gravity", 1e-4)
        tables.append(_table(model.learn(10**9, StopTrainingOnMaxEpisodes(3))))
    np.testing.assert_array_equal(*tables)


def test_an_interrupted_episode_is_finished_step_by_step():
    models = [_model(compiled=False) for _ in range(2)]
    for model in models:
        model.learn(10**9, lambda locals_, _: locals_["self"].num_timesteps < 50)
        assert model.num_timesteps == 50
    models[1].compiled = True
    for model in models:
        model.learn(400, reset_num_timesteps=False)
    np.testing.assert_array_equal(_table(models[0]), _table(models[1]))
    assert [episode["l"] for episode in models[1].ep_info_buffer] == [200, 200, 200]


@pytest.mark.parametrize("compiled", [False, True])
def test_a_diverging_simulation_is_an_error(compiled):
    actuator = DCMotorActuator(Motor(), CurrentLoop(kp=1.0, kd=0.2, max_voltage=np.inf))
    with pytest.raises(SimulationDivergedError, match="mountain_car"):
        _model(compiled=compiled, actuator=actuator, allow_unstable=True).learn(10_000)


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "config", "message"),
    [
        ("Pendulum", SARSAConfig(intervals=(8, 8, 8)), "must be Discrete"),
        (
            "MountainCar",
            SARSAConfig(intervals=(8, 8, 8)),
            "need 3 observation entries, but there are 2",
        ),
        ("Acrobot", SARSAConfig(intervals=(8, 8), angles=3), "angles = 3: must be from 0"),
        ("CartPole", SARSAConfig(intervals=(4, 4, 4, 4)), "axis 1 from -inf to inf"),
        ("MountainCar", SARSAConfig(tilings=6), "tilings = 6: must be a power of 2"),
        ("MountainCar", SARSAConfig(low=(0.0,)), r"low = \(0.0,\): must have 2 numbers"),
    ],
)
def test_spaces_that_cannot_be_tiled_raise(task, config, message):
    env = codrl_mj.make_sb3_vec_env(f"codrl_mj/{task}-v0", num_envs=1)
    with pytest.raises(ValueError, match=message):
        config.make_model(env, 0)
    with pytest.raises(ValueError, match=message):
        config.make_policy(env.observation_space, env.action_space)


def test_several_environments_raise():
    env = codrl_mj.make_sb3_vec_env("codrl_mj/MountainCar-v0", num_envs=2)
    with pytest.raises(ValueError, match="num_envs = 2: SARSA learns from one environment"):
        SARSAConfig().make_model(env, 0)


# -- other observations and actions ----------------------------------------------------------------


def test_the_intervals_select_whether_currents_are_tiled():
    env = _car(actuator="paper", observe_actuator=True)
    space = env.observation_space
    assert SARSAConfig().make_model(env, 0).policy.table.shape == (648, 3)
    ends = {
        "low": (*space.low[:2].tolist(), -1.0, -1.0),
        "high": (*space.high[:2].tolist(), 1.0, 1.0),
    }
    assert SARSAConfig(intervals=(8, 8, 2, 2), **ends).make_model(env, 0).policy.table.shape == (
        648 * 9,
        3,
    )
