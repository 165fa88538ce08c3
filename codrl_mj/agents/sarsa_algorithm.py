"""Episodic semi-gradient SARSA with tile coding: compiled learning, and the algorithm.

Sutton and Barto, *Reinforcement Learning: An Introduction* (2018), section 10.1; with traces,
section 12.7.
"""

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, TypeGuard, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean

from codrl_mj.agents.tile_coding import (
    TileCoder,
    action_value,
    choose_action,
    choose_actions,
    find_tiles,
    make_coder,
)
from codrl_mj.boundary import Info
from codrl_mj.compile_cache import njit
from codrl_mj.envs import ActuatedVectorEnv
from codrl_mj.envs.compiled import bind_observation, compiled_kernels
from codrl_mj.envs.config import Space
from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.physics import MujocoPhysics, Signals
from codrl_mj.physics.streams import generator_words, set_generator_words

# The module of `SARSAConfig` imports this one where it creates an agent, so its class cannot be
# imported here.
Settings = Any
"""A `SARSAConfig`; None in a saved model, until its own is loaded."""
MIN_ELIGIBILITY = 1e-3
"""Eligibility below which a trace is removed."""


class Traces(NamedTuple):
    """Eligibility traces of the weights; created by `empty_traces`."""

    eligibility: np.ndarray
    """Eligibility of each weight, by its flat index; mostly 0."""
    eligible: np.ndarray
    """Flat indices of the weights with an eligibility > 0; only the first `used[0]` are valid."""
    used: np.ndarray
    """Number of valid entries of `eligible`, shape (1,)."""


class Learner(NamedTuple):
    """State and settings of an agent in an episode; its arrays change.

    The random generator is a separate argument: with a generator in a tuple, numba needs 0.1 ms to
    determine the types of a call's arguments.
    """

    coder: TileCoder
    """Tile coder of the observations."""
    weights: np.ndarray
    """Weights of the action values, shape (tiles, actions)."""
    traces: Traces
    """Eligibility traces of the weights."""
    tiles: np.ndarray
    """Indices of the active tiles, which contain the current observation, shape (n,)."""
    step_size: float
    """Step size of each weight."""
    gamma: float
    """Discount factor."""
    trace_decay: float
    """Decay lambda of the traces."""
    epsilon: float
    """Probability of a random action."""


def empty_traces(size: int) -> Traces:
    """Return empty traces for `size` weights."""
    return Traces(np.zeros(size), np.zeros(size, dtype=np.int64), np.zeros(1, dtype=np.int64))


@njit(nogil=True, error_model="numpy")
def begin_episode(learner: Learner, generator: np.random.Generator, observation: np.ndarray) -> int:
    """Clear the traces, and return the first action for an episode's first observation (k,)."""
    traces = learner.traces
    # A loop over a slice would take numba longer to compile.
    for position in range(traces.used[0]):
        traces.eligibility[traces.eligible[position]] = 0.0
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
    """Learn from a step that led to an observation (k,), and return the next action.

    The target is r + gamma q(s', a'), also if a time limit ends the episode, and r if the task
    terminates it. After a termination the returned action has no meaning.
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
        _update_traces(traces, tiles, action, weights.shape[1], learner.gamma * learner.trace_decay)
        for position in range(traces.used[0]):
            index = traces.eligible[position]
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
def _update_traces(
    traces: Traces, tiles: np.ndarray, action: int, actions: int, decay: float
) -> None:
    """Decay the traces, remove the smallest, and set those of the active tiles to 1."""
    # These are replacing traces; the valid entries of `eligible` are compacted in place.
    num_eligible = 0
    for position in range(traces.used[0]):
        index = traces.eligible[position]
        faded = traces.eligibility[index] * decay
        if faded < MIN_ELIGIBILITY:
            traces.eligibility[index] = 0.0
        else:
            traces.eligibility[index] = faded
            traces.eligible[num_eligible] = index
            num_eligible += 1
    for tile in tiles:
        index = tile * actions + action
        if traces.eligibility[index] == 0.0:
            traces.eligible[num_eligible] = index
            num_eligible += 1
        traces.eligibility[index] = 1.0
    traces.used[0] = num_eligible


@njit(nogil=True, error_model="numpy")
def run_episode(
    learner: Learner,
    generator: np.random.Generator,
    step: Callable[[float, int], tuple[float, bool, bool]],
    forces: np.ndarray,
    observation: np.ndarray,
    record: np.ndarray,
    row: np.ndarray,
    pointers: int,
) -> tuple[float, int, bool, bool]:
    """Learn from an episode of an environment's compiled `step`.

    Args:
        learner: the agent.
        generator: source of random numbers.
        step: the compiled step.
        forces: desired forces of the actions.
        observation: first observation, shape (k,); it is overwritten by each step.
        record: array with as many rows as the time limit; each step's row is written to it.
        row: the trace's last row in each step.
        pointers: addresses that `step` takes.

    Returns:
        The sum of the rewards, the number of steps, True if the task terminated the episode, and
        True if all numbers of the simulation stayed finite.
    """
    action = begin_episode(learner, generator, observation)
    total, length, terminated = 0.0, 0, False
    while not terminated and length < len(record):
        force = forces[action]
        reward, terminated, is_finite = step(force, pointers)
        if not is_finite:
            return total, length, False, False
        record[length] = row
        # The desired force before any disturbance.
        record[length, 0] = force
        total, length = total + reward, length + 1
        # Stable-Baselines3's environments return rewards in float32, and results must be the same.
        rounded_reward = float(np.float32(reward))
        action = learn(learner, generator, action, rounded_reward, observation, terminated)
    return total, length, terminated, True


class TileCodingPolicy(BasePolicy):
    """Greedy or epsilon-greedy policy by action values that are linear in the active tiles.

    With `deterministic=True` the first of equally good actions is chosen. `predict(...,
    deterministic=False)` draws from the policy's `generator`. Training draws from the generator of
    the algorithm, so that evaluations do not change it.
    """

    def __init__(self, observation_space: Space, action_space: Space, config: Settings) -> None:
        """Create a policy with initial weights."""
        if not isinstance(action_space, spaces.Discrete) or action_space.start != 0:
            raise ValueError(
                f"action_space = {action_space}: must be Discrete, from 0, because SARSA has a"
                " weight for every action"
            )
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise ValueError(
                f"observation_space = {observation_space}: must be a Box with one axis, which tiles"
                " can cover"
            )
        tilings, intervals, angles = config.tilings, config.intervals, config.angles
        used = slice(2 * angles, len(intervals) + angles)
        if used.stop > observation_space.shape[0]:
            raise ValueError(
                f"intervals = {intervals}, angles = {angles}: need {used.stop} observation entries,"
                f" but there are {observation_space.shape[0]}; give one interval for each angle and"
                " for each other entry"
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
        """Weights of the policy as a writable array, shape (tiles, actions), float64."""
        table: np.ndarray = self.weights.numpy()
        return table

    def _predict(self, observation: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        epsilon, generator = self.config.epsilon, self.generator
        return torch.from_numpy(
            choose_actions(
                observation.numpy(), self.coder, self.table, deterministic, epsilon, generator
            )
        )

    def _get_constructor_parameters(self) -> dict[str, object]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "config": self.config,
        }


class LearnedSteps(NamedTuple):
    """Steps of one environment from which an agent has learned."""

    steps: int
    """Number of steps."""
    new_obs: np.ndarray
    """Observation after them, shape (1, k); after an episode the first one of the next."""
    rewards: np.ndarray
    """Sum of their rewards, shape (1,)."""
    dones: np.ndarray
    """True if an episode ended, shape (1,)."""
    infos: list[Info]
    """Info of the last step."""
    signals: Signals | None
    """Actuator's signals in the steps, each of shape (steps,); None if they are unknown."""


class CompiledEpisodes:
    """Runner of whole episodes of an `ActuatedVecEnv` with one environment, in compiled code.

    The runner has its own simulation, whose results are bit-identical. After an episode it leaves
    the environment in the state to which the environment's own steps would have led: at the start
    of the next episode.
    """

    def __init__(self, env: ActuatedVecEnv) -> None:
        """Create the simulation of an environment for which `can_run` is True."""
        self.env = env
        vector = cast(ActuatedVectorEnv, env.env)
        self._physics = cast(MujocoPhysics, vector.setup.simulate())
        self._step = compiled_kernels(vector.setup, self._physics).step
        self._pointers, self._observation = bind_observation(vector.setup, self._physics)
        # SARSA has discrete actions, and `can_run` requires a time limit.
        forces, limit = vector.setup.commands.action_forces, vector.max_episode_steps
        assert forces is not None
        assert limit is not None
        self._forces = forces
        self._record = np.empty((limit, self._physics.trace.shape[2]))

    @staticmethod
    def can_run(env: object) -> TypeGuard[ActuatedVecEnv]:
        """Return True if whole episodes of an environment can run in compiled code.

        It must be a single `ActuatedVectorEnv` with one motor and a time limit, and without
        randomization or changed attributes.
        """
        return (
            type(env) is ActuatedVecEnv
            and isinstance(env.env, ActuatedVectorEnv)
            and env.num_envs == 1
            and not env.env.setup.randomization.distributions
            and not env.env.model_fields
            and len(env.env.task.motors) == 1
            and env.env.max_episode_steps is not None
        )

    def run(self, learner: Learner, generator: np.random.Generator) -> LearnedSteps | None:
        """Learn from an episode; return None, without effect, if one has already started.

        Returns:
            The episode's steps, whose only reward is the sum of the rewards.
        """
        vector = cast(ActuatedVectorEnv, self.env.env)
        setup, snapshot = vector.setup, vector.snapshot()
        if snapshot["elapsed"][0] != 0:
            return None
        # `restore` alone would not install the MuJoCo callbacks.
        self._physics.reset(np.zeros(len(setup.task.state_names)))
        self._physics.restore(snapshot["physics"][0])
        self._physics.memory[:] = snapshot.get("disturbances", np.zeros((1, 0)))[0]
        self._observation[:] = snapshot["observations"][0]
        total, length, terminated, is_finite = run_episode(
            *(learner, generator, self._step, self._forces, self._observation, self._record),
            self._physics.trace[-1, 0],
            self._pointers,
        )
        if not is_finite:
            self._physics.check_finite()
        columns = self._record[:length].T.copy()
        signals = vector.bank.signals(columns, columns[0])
        observations, infos = self.env.finish_episode(
            self._observation.copy(), total, length, not terminated, signals
        )
        return LearnedSteps(
            length,
            observations,
            np.array([total], dtype=np.float32),
            np.array([True]),
            infos,
            signals,
        )


class SARSA(BaseAlgorithm):
    """Episodic semi-gradient SARSA (Sutton and Barto, 2018, section 10.1) or SARSA(lambda).

    `trace_decay` selects SARSA(lambda). A rollout is an episode: `on_rollout_start` and
    `on_rollout_end` of callbacks are called once for each, and `learn` finishes the episode in
    which it reaches `total_timesteps`. If a callback stops an episode, its traces are lost:
    learning continues from the observation that was reached.

    In training, one of equally good actions is drawn at random, as in the program of the paper's
    agent (marcinbogdanski/rl-sketchpad, 1001_Episodic_Semi_Gradient_Sarsa). Unlike in that program,
    a time limit does not terminate an episode: the last update uses the value of the next action.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TileCodingPolicy": TileCodingPolicy}
    policy: TileCodingPolicy
    compiled = True
    """Run whole episodes in compiled code if the environment allows it; results are the same."""
    _last_obs: np.ndarray

    def __init__(
        self,
        policy: str | type[TileCodingPolicy],
        env: GymEnv | str | None,
        config: Settings = None,
        **settings: object,
    ) -> None:
        """Take the arguments of `BaseAlgorithm`, for one environment, and a `SARSAConfig`.

        A saved model contains its config, so it is loaded without one.
        """
        self.config = config
        self._episodes: CompiledEpisodes | None = None
        # The probability of a random action in the current episode.
        self.exploration_rate = getattr(config, "epsilon", 0.0)
        if (num_envs := getattr(env, "num_envs", 1)) != 1:
            raise ValueError(f"num_envs = {num_envs}: SARSA learns from one environment: must be 1")
        should_set_up = settings.pop("_init_setup_model", True)
        arguments = settings | {"policy_kwargs": {"config": self.config}, "device": "cpu"}
        super().__init__(policy, env, learning_rate=getattr(config, "step_size", 0.0), **arguments)
        if should_set_up:
            self._setup_model()

    def _setup_model(self) -> None:
        self.set_random_seed(self.seed)
        # A loaded model has the saved generator.
        if "_generator" not in self.__dict__:
            # A child seed is used, because with the same seed the generators of agent and
            # environment would draw the same numbers.
            self._generator = np.random.default_rng(np.random.SeedSequence(self.seed).spawn(1)[0])
        self.policy = self.policy_class(
            self.observation_space, self.action_space, **self.policy_kwargs
        )
        coder, table = self.policy.coder, self.policy.table
        self._learner = Learner(
            coder,
            table,
            empty_traces(table.size if self.config.trace_decay else 0),
            np.empty(len(coder.displacements), dtype=np.int64),
            self.config.step_size,
            self.config.gamma,
            self.config.trace_decay,
            self.config.epsilon,
        )

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the state of training between episodes.

        The policy and the attributes of Stable-Baselines3 are not part of it.
        """
        return {"generator": generator_words(self._generator)}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Restore the result of `snapshot`; training then continues bit-identically."""
        set_generator_words(self._generator, snapshot["generator"])

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 100,
        tb_log_name: str = "SARSA",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "SARSA":
        """Learn from whole episodes until `total_timesteps` or until the callback stops it."""
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
        """Learn from the rest of an episode; return True unless the callback stops learning."""
        learner = self._learner._replace(epsilon=self.exploration_rate)
        if self.compiled and CompiledEpisodes.can_run(self.env):
            if self._episodes is None or self._episodes.env is not self.env:
                self._episodes = CompiledEpisodes(self.env)
            if (episode := self._episodes.run(learner, self._generator)) is not None:
                return self._count(callback, *episode)
        return self._run_steps(callback, learner)

    def _run_steps(self, callback: BaseCallback, learner: Learner) -> bool:
        """Learn from the rest of an episode step by step; see `_run_episode`."""
        assert self.env is not None
        action = begin_episode(learner, self._generator, self._last_obs[0])
        dones = np.array([False])
        while not dones[0]:
            new_obs, rewards, dones, infos = self.env.step(np.array([action]))
            info = infos[0]
            terminated = bool(dones[0]) and not info.get("TimeLimit.truncated", False)
            observation = info["terminal_observation"] if dones[0] else new_obs[0]
            action = learn(
                learner, self._generator, action, float(rewards[0]), observation, terminated
            )
            if not self._count(
                callback, 1, new_obs, rewards, dones, infos, getattr(self.env, "signals", None)
            ):
                return False
        return True

    def _count(
        self,
        callback: BaseCallback,
        steps: int,
        new_obs: np.ndarray,
        rewards: np.ndarray,
        dones: np.ndarray,
        infos: list[Info],
        signals: Signals | None,
    ) -> bool:
        """Count steps, and call the callback."""
        # The callback reads the arguments from these locals, by the names that Stable-Baselines3
        # uses.
        self.num_timesteps += steps
        self._last_obs, self._last_episode_starts = new_obs, dones
        self._episode_num += int(dones[0])
        self._update_info_buffer(infos, dones)
        callback.update_locals(locals())
        goes_on: bool = callback.on_step()
        return goes_on

    def dump_logs(self) -> None:
        """Write statistics of the training to the log."""
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
