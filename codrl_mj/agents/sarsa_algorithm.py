"""Episodic semi-gradient SARSA with tile coding: learning from a step and from an episode, compiled, and the algorithm.

Sutton and Barto, *Reinforcement Learning: An Introduction* (2018), section 10.1; with traces,
section 12.7.
"""

import sys
import time
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import safe_mean

from codrl_mj.agents.tile_coding import (
    TileCoder,
    action_value,
    choose_action,
    choose_actions,
    find_tiles,
    make_coder,
)
from codrl_mj.compile_cache import njit
from codrl_mj.envs import ActuatedVectorEnv
from codrl_mj.envs.compiled import bound, compiled_kernels
from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.physics.streams import set_generator_words, generator_words

FORGOTTEN = 1e-3
"""Eligibility below which a trace is dropped."""


class Traces(NamedTuple):
    """What the weights that were used lately are answerable for; made by `no_traces`."""

    eligibility: np.ndarray
    """Of every weight, by its flat index; 0 for most."""
    eligible: np.ndarray
    """Flat indices of the weights whose eligibility is not 0, of which only the first `used[0]` are meant."""
    used: np.ndarray
    """Their number, shape (1,)."""


class Learner(NamedTuple):
    """An agent in an episode: what it knows, where it is, and how it learns. Its arrays change.

    Its generator is no part of it: with one in a tuple, numba takes 0.1 ms to find out what a
    call's arguments are.
    """

    coder: TileCoder
    """Finds tiles."""
    weights: np.ndarray
    """Shape (tiles, actions)."""
    traces: Traces
    """Of the weights."""
    tiles: np.ndarray
    """Indices of the active ones, in which the present observation lies, shape (n,)."""
    step_size: float
    """Of each weight."""
    gamma: float
    """Discount factor."""
    trace_decay: float
    """lambda."""
    epsilon: float
    """Probability of a random action."""


def no_traces(size: int) -> Traces:
    """Empty traces, with room for `size` weights."""
    return Traces(np.zeros(size), np.zeros(size, dtype=np.int64), np.zeros(1, dtype=np.int64))


@njit(nogil=True, error_model="numpy")
def begin(learner: Learner, generator: np.random.Generator, observation: np.ndarray) -> int:
    """Begin an episode with its first observation (k,): no traces are left. The first action."""
    traces = learner.traces
    for kept in range(traces.used[0]):  # loops over slices take numba longer to compile
        traces.eligibility[traces.eligible[kept]] = 0.0
    traces.used[0] = 0
    find_tiles(observation, learner.coder, learner.tiles)
    return choose_action(learner.weights, learner.tiles, learner.epsilon, generator)


@njit(nogil=True, error_model="numpy")
def learn(
    learner: Learner,
    generator: np.random.Generator,
    action: int,
    reward: float,
    observation: np.ndarray,
    terminated: bool,
) -> int:
    """Learn from a step that led to an observation (k,), and choose the next action, without meaning at the end.

    The target is r + gamma q(s', a'), also where a time limit cuts the episode off; and r where the
    task ends it.
    """
    weights, traces, tiles = learner.weights, learner.traces, learner.tiles
    error = reward - action_value(weights, tiles, action)
    next_tiles, next_action = np.empty_like(tiles), 0
    if not terminated:
        find_tiles(observation, learner.coder, next_tiles)
        next_action = choose_action(weights, next_tiles, learner.epsilon, generator)
        error += learner.gamma * action_value(weights, next_tiles, next_action)
    change = learner.step_size * error
    if learner.trace_decay > 0.0:
        _mark(traces, tiles, action, weights.shape[1], learner.gamma * learner.trace_decay)
        for kept in range(traces.used[0]):
            index = traces.eligible[kept]
            weights[index // weights.shape[1], index % weights.shape[1]] += (
                change * traces.eligibility[index]
            )
    else:
        for tile in tiles:
            weights[tile, action] += change
    for tiling in range(len(tiles)):
        tiles[tiling] = next_tiles[tiling]
    return next_action


@njit(nogil=True, error_model="numpy")
def _mark(traces: Traces, tiles: np.ndarray, action: int, actions: int, decay: float) -> None:
    """Fade the traces, drop the faintest, and set those of the weights in use to 1 (replacing traces)."""
    kept = 0
    for position in range(traces.used[0]):
        index = traces.eligible[position]
        faded = traces.eligibility[index] * decay
        if faded < FORGOTTEN:
            traces.eligibility[index] = 0.0
        else:
            traces.eligibility[index] = faded
            traces.eligible[kept] = index
            kept += 1
    for tile in tiles:
        index = tile * actions + action
        if traces.eligibility[index] == 0.0:
            traces.eligible[kept] = index
            kept += 1
        traces.eligibility[index] = 1.0
    traces.used[0] = kept


@njit(nogil=True, error_model="numpy")
def run_episode(
    learner: Learner,
    generator: np.random.Generator,
    step: Any,
    forces: np.ndarray,
    observation: np.ndarray,
    record: np.ndarray,
    row: np.ndarray,
    where: int,
) -> tuple[float, int, bool, bool]:
    """Learn from an episode of an environment's compiled `step`, from its first observation (k,), which gets the last.

    `record`, as long as the time limit, gets the trace's last `row` of each step. Sum of the
    rewards, steps, whether the task ended the episode, and whether the simulation was fine
    throughout.
    """
    action = begin(learner, generator, observation)
    total, length, terminated = 0.0, 0, False
    while not terminated and length < len(record):
        force = forces[action]
        reward, terminated, fine = step(force, where)
        if not fine:
            return total, length, False, False
        record[length] = row
        record[length, 0] = force  # as it was asked for, before anything disturbed it
        total, length = total + reward, length + 1
        seen_reward = float(np.float32(reward))  # what Stable-Baselines3's environments hand out
        action = learn(learner, generator, action, seen_reward, observation, terminated)
    return total, length, terminated, True


class TileCodingPolicy(BasePolicy):
    """Acts by action values that are linear in the active tiles: greedily, or epsilon-greedily.

    Of equally good actions a greedy one (`deterministic=True`) is the first. `predict(...,
    deterministic=False)` draws from the policy's `generator`; training draws from the algorithm's
    own generator, so that no evaluation changes it.
    """

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], config: Any
    ) -> None:
        """Make a policy that knows nothing yet."""
        if not isinstance(action_space, spaces.Discrete) or action_space.start != 0:
            raise ValueError(
                f"action_space = {action_space}: SARSA has a weight for every action: must be"
                " Discrete, from 0"
            )
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise ValueError(
                f"observation_space = {observation_space}: must be a Box with one axis, to be"
                " covered by tiles"
            )
        tilings, intervals, angles = config.tilings, config.intervals, config.angles
        used = slice(2 * angles, len(intervals) + angles)
        if used.stop > observation_space.shape[0]:
            raise ValueError(
                f"intervals = {intervals}, angles = {angles}: are of {used.stop} observation"
                f" entries, but there are {observation_space.shape[0]}; give one interval for an"
                " angle or any other entry"
            )
        super().__init__(observation_space, action_space)
        low = observation_space.low[used].tolist() if config.low is None else config.low
        high = observation_space.high[used].tolist() if config.high is None else config.high
        self.config, self.coder = config, make_coder(low, high, tilings, intervals, angles)
        self.generator = np.random.default_rng()
        size = self.coder.size, int(action_space.n)
        weights = torch.full(size, config.initial_value / tilings, dtype=torch.float64)
        self.weights = torch.nn.Parameter(weights, requires_grad=False)

    @property
    def table(self) -> np.ndarray:
        """The weights, shape (tiles, actions), float64; what is written to it is written to the policy."""
        return self.weights.numpy()

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        epsilon, generator = self.config.epsilon, self.generator
        return torch.from_numpy(
            choose_actions(
                observation.numpy(), self.coder, self.table, deterministic, epsilon, generator
            )
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "config": self.config,
        }


class CompiledEpisodes:
    """Runs the episodes of an `ActuatedVecEnv` of one environment on a simulation of its own, bit for bit the same.

    At the end of each the environment is where its own steps would have brought it: at the start of
    the next one.
    """

    def __init__(self, env: ActuatedVecEnv) -> None:
        """Make the simulation for one that `can_run` says it can."""
        self.env = env
        vector: Any = env.env
        self._physics: Any = vector.setup.simulate()
        self._step = compiled_kernels(vector.setup, self._physics).step
        self._where, self._observation = bound(vector.setup, self._physics)
        self._forces = vector.setup.commands.action_forces
        self._record = np.empty((vector.max_episode_steps, self._physics.trace.shape[2]))

    @staticmethod
    def can_run(env: Any) -> bool:
        """Whether the environment is ours, in MuJoCo, of one motor, as it was configured, and has a time limit."""
        return (
            type(env) is ActuatedVecEnv
            and isinstance(env.env, ActuatedVectorEnv)
            and env.num_envs == 1
            and not env.env.setup.randomization.distributions
            and not env.env.looks
            and len(env.env.task.motors) == 1
            and env.env.max_episode_steps is not None
        )

    def run(self, learner: Learner, generator: np.random.Generator) -> tuple[Any, ...] | None:
        """Learn from an episode; None, with nothing done, if the environment stands in the middle of one.

        What `SARSA._count` takes: steps, first observation (1, k) of the next episode, sum of the
        rewards (1,), that the episode ended (1,), infos of its last step, and the actuator's
        signals, each of shape (steps,).
        """
        vector: Any = self.env.env
        setup, start = vector.setup, vector.snapshot()
        if start["elapsed"][0] != 0:
            return None
        self._physics.reset(np.zeros(len(setup.task.state_names)))  # sees to the callbacks
        self._physics.restore(start["physics"][0])
        self._physics.memory[:] = start.get("disturbances", np.zeros((1, 0)))[0]
        self._observation[:] = start["observations"][0]
        total, length, terminated, fine = run_episode(
            *(learner, generator, self._step, self._forces, self._observation, self._record),
            self._physics.trace[-1, 0],
            self._where,
        )
        if not fine:
            self._physics.check_finite()
        columns = self._record[:length].T.copy()
        signals = setup.signals(columns, columns[0])
        observations, infos = self.env.conclude(
            self._observation.copy(), total, length, not terminated, signals
        )
        return (
            length,
            observations,
            np.array([total], dtype=np.float32),
            np.array([True]),
            infos,
            signals,
        )


class SARSA(BaseAlgorithm):
    """Episodic semi-gradient SARSA, Sutton and Barto (2018), section 10.1; with `trace_decay`, SARSA(lambda).

    A rollout is an episode: `on_rollout_start` and `on_rollout_end` of callbacks are called once
    for each, and `learn` finishes the one in which it reaches `total_timesteps`. A callback that
    stops it in mid-episode gives up the traces: what is learned next begins with the observation
    that was reached.

    In training, of equally good actions one is drawn at random, as in the program that the paper's
    agent comes from (marcinbogdanski/rl-sketchpad, 1001_Episodic_Semi_Gradient_Sarsa). Unlike
    there, an episode that a time limit cut off does not end: its last update is made with the value
    of what would have come next.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TileCodingPolicy": TileCodingPolicy}
    policy: TileCodingPolicy
    compiled = True
    """Whether to run whole episodes in compiled code where the environment can; the results are the same."""
    _last_obs: Any

    def __init__(
        self, policy: str | type[TileCodingPolicy], env: Any, config: Any = None, **settings: Any
    ) -> None:
        """Take what `BaseAlgorithm` takes, for one environment, and a `SARSAConfig`: a saved model brings its own."""
        self.config = config
        self._episodes: CompiledEpisodes | None = None
        self.exploration_rate = getattr(config, "epsilon", 0.0)  # in the present episode
        if getattr(env, "num_envs", 1) != 1:
            raise ValueError(
                f"num_envs = {env.num_envs}: SARSA learns from one environment: must be 1"
            )
        set_up = settings.pop("_init_setup_model", True)
        given = settings | {"policy_kwargs": {"config": self.config}, "device": "cpu"}
        super().__init__(policy, env, learning_rate=getattr(config, "step_size", 0.0), **given)
        if set_up:
            self._setup_model()

    def _setup_model(self) -> None:
        self.set_random_seed(self.seed)
        if "_generator" not in self.__dict__:  # a loaded model has the one that was saved
            # A child's seed: seeded alike, the environment's generator would draw the same numbers.
            self._generator = np.random.default_rng(np.random.SeedSequence(self.seed).spawn(1)[0])
        self.policy = self.policy_class(
            self.observation_space, self.action_space, **self.policy_kwargs
        )  # type: ignore[assignment]
        coder, table = self.policy.coder, self.policy.table
        self._learner = Learner(
            coder,
            table,
            no_traces(table.size if self.config.trace_decay else 0),
            np.empty(len(coder.displacements), dtype=np.int64),
            self.config.step_size,
            self.config.gamma,
            self.config.trace_decay,
            self.config.epsilon,
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """What training depends on between episodes, besides the policy and Stable-Baselines3's own attributes."""
        return {"generator": generator_words(self._generator)}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Continue from what `snapshot` returned, bit for bit."""
        set_generator_words(self._generator, snapshot["generator"])

    def learn(  # type: ignore[override]
        self,
        total_timesteps: int,
        callback: Any = None,
        log_interval: int | None = 100,
        tb_log_name: str = "SARSA",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "SARSA":
        """Learn, whole episodes until there were `total_timesteps` steps or the callback stops it."""
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            self.exploration_rate = (
                self.config.epsilon * self.config.epsilon_decay**self._episode_num
            )
            callback.on_rollout_start()
            if not self._run_episode(callback):
                break
            callback.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            if log_interval is not None and self._episode_num % log_interval == 0:
                self.dump_logs()
        callback.on_training_end()
        return self

    def _run_episode(self, callback: BaseCallback) -> bool:
        """Learn from the rest of an episode; whether the callback lets it go on."""
        learner = self._learner._replace(epsilon=self.exploration_rate)
        if self.compiled and CompiledEpisodes.can_run(self.env):
            if self._episodes is None or self._episodes.env is not self.env:
                self._episodes = CompiledEpisodes(self.env)  # type: ignore[arg-type]
            if (episode := self._episodes.run(learner, self._generator)) is not None:
                return self._count(callback, *episode)
        return self._run_steps(callback, learner)

    def _run_steps(self, callback: BaseCallback, learner: Learner) -> bool:
        """The same, step by step."""
        assert self.env is not None
        action = begin(learner, self._generator, self._last_obs[0])
        dones = np.array([False])
        while not dones[0]:
            new_obs, rewards, dones, infos = self.env.step(np.array([action]))
            info = infos[0]
            terminated = bool(dones[0]) and not info.get("TimeLimit.truncated", False)
            seen = info["terminal_observation"] if dones[0] else new_obs[0]  # type: ignore[index]
            action = learn(learner, self._generator, action, float(rewards[0]), seen, terminated)
            if not self._count(
                callback, 1, new_obs, rewards, dones, infos, getattr(self.env, "signals", None)
            ):
                return False
        return True

    def _count(
        self,
        callback: BaseCallback,
        steps: int,
        new_obs: Any,
        rewards: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
        signals: Any,
    ) -> bool:
        """Count steps that were taken, and show the callback what they were: its `locals` are the arguments."""
        self.num_timesteps += steps
        self._last_obs, self._last_episode_starts = new_obs, dones
        self._episode_num += int(dones[0])
        self._update_info_buffer(infos, dones)
        callback.update_locals(locals())
        return callback.on_step()

    def dump_logs(self) -> None:
        """Write to the log how training goes."""
        elapsed = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        if self.ep_info_buffer:
            for name, key in (("ep_rew_mean", "r"), ("ep_len_mean", "l")):
                self.logger.record(
                    f"rollout/{name}", safe_mean([episode[key] for episode in self.ep_info_buffer])
                )
        self.logger.record("rollout/exploration_rate", self.exploration_rate)
        self.logger.record(
            "time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed)
        )
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_learner", "_episodes"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
