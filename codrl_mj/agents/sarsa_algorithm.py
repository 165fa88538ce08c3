"""Episodic semi-gradient SARSA with tile coding as Stable-Baselines3 knows its algorithms."""

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import safe_mean

from codrl_mj.agents.sarsa_episodes import CompiledEpisodes
from codrl_mj.agents.sarsa_kernels import Rates, begin, choose_actions, learn, no_traces
from codrl_mj.agents.tile_coding import make_coder
from codrl_mj.physics.streams import set_words, words_of


class TileCodingPolicy(BasePolicy):
    """Acts by action values that are linear in the active tiles: greedily, or epsilon-greedily.

    Of equally good actions a greedy one (`deterministic=True`) is the first. `epsilon` and `generator` are those of
    `predict(..., deterministic=False)`; training draws from the algorithm's own generator, so that no evaluation
    changes it.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        tilings: int = 8,
        intervals: Sequence[int] = (8, 8),
        angles: int = 0,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        initial_value: float = 0.0,
        epsilon: float = 0.0,
    ) -> None:
        """Make a policy that knows nothing yet.

        Args:
            observation_space: a `Box` of shape (k,).
            action_space: a `Discrete` space that starts at 0.
            tilings: as for `make_coder`, and so are the next two.
            intervals: of every axis.
            angles: leading pairs of cosine and sine.
            low: lower ends of the axes that are not angles; None takes the observation space's.
            high: their upper ends.
            initial_value: of every action everywhere.
            epsilon: probability of a random action.

        Raises:
            ValueError: a space of another kind, or an argument out of bounds; the message names it.
        """
        if not isinstance(action_space, spaces.Discrete) or action_space.start != 0:
            raise ValueError(
                f"action_space = {action_space}: SARSA has a weight for every action: must be Discrete, from 0"
            )
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise ValueError(
                f"observation_space = {observation_space}: must be a Box with one axis, to be covered by tiles"
            )
        used = slice(2 * angles, len(intervals) + angles)
        if used.stop > observation_space.shape[0]:
            raise ValueError(
                f"intervals = {tuple(intervals)}, angles = {angles}: are of {used.stop} observation entries, but there "
                f"are {observation_space.shape[0]}; give one interval for an angle or any other entry"
            )
        super().__init__(observation_space, action_space)
        self._arguments: dict[str, Any] = {
            "tilings": tilings,
            "intervals": tuple(intervals),
            "angles": angles,
            "low": tuple(observation_space.low[used].tolist() if low is None else low),
            "high": tuple(observation_space.high[used].tolist() if high is None else high),
        }
        self.coder = make_coder(**self._arguments)
        self.initial_value, self.epsilon = initial_value, epsilon
        self.generator = np.random.default_rng()
        weights = torch.full((self.coder.size, int(action_space.n)), initial_value / tilings, dtype=torch.float64)
        self.weights = torch.nn.Parameter(weights, requires_grad=False)

    @property
    def table(self) -> np.ndarray:
        """The weights, shape (tiles, actions), float64; what is written to it is written to the policy."""
        return self.weights.numpy()

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        actions = choose_actions(
            observation.numpy(), self.coder, self.table, deterministic, self.epsilon, self.generator
        )
        return torch.from_numpy(actions)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        named = {"observation_space": self.observation_space, "action_space": self.action_space}
        return named | self._arguments | {"initial_value": self.initial_value, "epsilon": self.epsilon}


class SARSA(BaseAlgorithm):
    """Episodic semi-gradient SARSA, Sutton and Barto (2018), section 10.1; with `trace_decay`, SARSA(lambda).

    A rollout is an episode: `on_rollout_start` and `on_rollout_end` of callbacks are called once for each, and `learn`
    finishes the one in which it reaches `total_timesteps`. A callback that stops it in mid-episode gives up the traces:
    what is learned next begins with the observation that was reached.

    In training, of equally good actions one is drawn at random, as in the program that the paper's agent comes from
    (marcinbogdanski/rl-sketchpad, 1001_Episodic_Semi_Gradient_Sarsa). Unlike there, an episode that a time limit cut
    off does not end: its last update is made with the value of what would have come next.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TileCodingPolicy": TileCodingPolicy}
    policy: TileCodingPolicy
    _last_obs: Any

    def __init__(
        self,
        policy: str | type[TileCodingPolicy],
        env: Any,
        step_size: float = 0.0375,
        gamma: float = 1.0,
        epsilon: float = 0.001,
        epsilon_decay: float = 1.0,
        trace_decay: float = 0.0,
        policy_kwargs: Mapping[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        compiled: bool = True,
        seed: int | None = None,
        device: Any = "cpu",
        _init_setup_model: bool = True,
    ) -> None:
        """Make the algorithm.

        Args:
            policy: `TileCodingPolicy`.
            env: a Gymnasium environment, or a `VecEnv` of one.
            step_size: of each weight: a fraction of the inverse number of tilings.
            gamma: discount factor.
            epsilon: probability of a random action in the first episode.
            epsilon_decay: factor on epsilon from one episode to the next.
            trace_decay: lambda, of replacing traces; 0 for one-step SARSA.
            policy_kwargs: arguments of the policy.
            stats_window_size: episodes over which logged means are taken.
            tensorboard_log: folder for TensorBoard; None for none.
            verbose: as in Stable-Baselines3.
            compiled: whether to run whole episodes in compiled code where the environment can; the results are the
                same.
            seed: of the environment, and of the algorithm's own generator.
            device: not used: tables are looked up on the CPU.
            _init_setup_model: as in Stable-Baselines3.

        Raises:
            ValueError: the environment is more than one, or its spaces do not go with tiles.
        """
        del device
        self.compiled = compiled
        self._episodes: CompiledEpisodes | None = None
        self.step_size, self.gamma, self.trace_decay = step_size, gamma, trace_decay
        self.epsilon, self.epsilon_decay = epsilon, epsilon_decay
        self.exploration_rate = epsilon  # in the present episode
        if getattr(env, "num_envs", 1) != 1:
            raise ValueError(f"num_envs = {env.num_envs}: SARSA learns from one environment: must be 1")
        super().__init__(
            policy,
            env,
            learning_rate=step_size,
            policy_kwargs=dict(policy_kwargs or {}),
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device="cpu",
        )
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self.set_random_seed(self.seed)
        if "_generator" not in self.__dict__:  # a loaded model has the one that was saved
            # A child's seed: seeded alike, the environment's generator would draw the same numbers.
            self._generator = np.random.default_rng(np.random.SeedSequence(self.seed).spawn(1)[0])
        self.policy = self.policy_class(self.observation_space, self.action_space, **self.policy_kwargs)  # type: ignore[assignment]
        self._traces = no_traces(self.policy.table.size if self.trace_decay else 0)

    def snapshot(self) -> dict[str, np.ndarray]:
        """What training depends on between episodes, besides the policy and Stable-Baselines3's own attributes."""
        return {"generator": words_of(self._generator)}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Continue from what `snapshot` returned, bit for bit.

        Raises:
            KeyError: it is not such a snapshot.
        """
        set_words(self._generator, snapshot["generator"])

    def learn(  # type: ignore[override]
        self,
        total_timesteps: int,
        callback: Any = None,
        log_interval: int | None = 100,
        tb_log_name: str = "SARSA",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "SARSA":
        """Learn, whole episodes until there were `total_timesteps` steps or the callback stops it.

        Args:
            total_timesteps: environment steps.
            callback: as in Stable-Baselines3.
            log_interval: episodes between two entries in the log; None for no log.
            tb_log_name: name of the run in TensorBoard.
            reset_num_timesteps: count steps and episodes anew, and begin another episode.
            progress_bar: show one.

        Returns:
            The algorithm itself.
        """
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            self.exploration_rate = self.epsilon * self.epsilon_decay**self._episode_num
            callback.on_rollout_start()
            if not self._run_episode(callback):
                break
            callback.on_rollout_end()
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            if log_interval is not None and self._episode_num % log_interval == 0:
                self.dump_logs()
        callback.on_training_end()
        return self

    def _compiled_episodes(self) -> CompiledEpisodes | None:
        """What runs the environment's episodes in compiled code, if that is wanted and possible."""
        if not self.compiled or not CompiledEpisodes.can_run(self.env):
            return None
        if self._episodes is None or self._episodes.env is not self.env:
            self._episodes = CompiledEpisodes(self.env)  # type: ignore[arg-type]
        return self._episodes

    def _run_episode(self, callback: BaseCallback) -> bool:
        """Learn from the rest of an episode.

        Returns:
            Whether the callback lets it go on.
        """
        rates = Rates(self.step_size, self.gamma, self.trace_decay, self.exploration_rate)
        learner = self.policy.coder, self.policy.table, self._traces, rates, self._generator
        episodes = self._compiled_episodes()
        ended = None if episodes is None else episodes.run(*learner)
        if ended is not None:
            rewards, dones = np.array([ended.total], dtype=np.float32), np.array([True])
            return self._count(callback, ended.steps, ended.observations, rewards, dones, ended.infos, ended.signals)
        return self._run_steps(callback, learner)

    def _run_steps(self, callback: BaseCallback, learner: tuple[Any, ...]) -> bool:
        """The same, step by step."""
        assert self.env is not None
        tiles = np.empty(len(self.policy.coder.displacements), dtype=np.int64)
        action = begin(*learner, tiles, self._last_obs[0])
        dones = np.array([False])
        while not dones[0]:
            new_obs, rewards, dones, infos = self.env.step(np.array([action]))
            info = infos[0]
            terminated = bool(dones[0]) and not info.get("TimeLimit.truncated", False)
            seen = info["terminal_observation"] if dones[0] else new_obs[0]  # type: ignore[index]
            action = learn(*learner, tiles, action, float(rewards[0]), seen, terminated)
            if not self._count(callback, 1, new_obs, rewards, dones, infos, getattr(self.env, "signals", None)):
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
                self.logger.record(f"rollout/{name}", safe_mean([episode[key] for episode in self.ep_info_buffer]))
        self.logger.record("rollout/exploration_rate", self.exploration_rate)
        self.logger.record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed))
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_traces", "_episodes"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
