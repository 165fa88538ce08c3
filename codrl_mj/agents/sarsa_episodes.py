"""Whole episodes of SARSA in compiled code, where the environment is compiled too."""

from typing import Any, NamedTuple

import numba
import numpy as np

from codrl_mj.agents.sarsa_kernels import Rates, Traces, begin, learn
from codrl_mj.agents.tile_coding import TileCoder
from codrl_mj.envs import ActuatedVectorEnv
from codrl_mj.envs.compiled import arguments, compiled_kernels
from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.physics import Signals


class Ended(NamedTuple):
    """What an episode came to."""

    steps: int
    """Their number."""
    observations: np.ndarray
    """The first of the next episode, shape (1, k)."""
    infos: list[dict[str, Any]]
    """As the environment's `step` returns them at the end of an episode."""
    total: float
    """Sum of the rewards."""
    signals: Signals
    """The actuator's signals, each an array of shape (steps,)."""


class CompiledEpisodes:
    """Runs the episodes of an `ActuatedVecEnv` of one environment on a simulation of its own, bit for bit the same.

    At the end of each the environment is where its own steps would have brought it: at the start of the next one.
    """

    def __init__(self, env: ActuatedVecEnv) -> None:
        """Make the simulation.

        Args:
            env: one that `can_run` says it can.
        """
        self.env = env
        vector: Any = env.env
        self._physics: Any = vector.setup.simulate("mujoco")
        self._step = compiled_kernels(vector.setup, self._physics).step
        self._arguments = arguments(vector.setup, self._physics)
        self._forces = vector.setup.commands.action_forces
        self._record = np.empty((vector.max_episode_steps, self._physics.trace.shape[2]))

    @staticmethod
    def can_run(env: Any) -> bool:
        """Whether the environment is ours, in MuJoCo, of one motor, not randomised, and has a time limit."""
        return (
            type(env) is ActuatedVecEnv
            and isinstance(env.env, ActuatedVectorEnv)
            and env.num_envs == 1
            and not env.env.setup.randomization.names
            and len(env.env.task.motors) == 1
            and env.env.max_episode_steps is not None
        )

    def run(
        self, coder: TileCoder, weights: np.ndarray, traces: Traces, rates: Rates, generator: np.random.Generator
    ) -> Ended | None:
        """Learn from an episode.

        Returns:
            What it came to; None, with nothing done, if the environment stands in the middle of one.

        Raises:
            SimulationDivergedError: the simulation left the finite numbers. The environment stands where it did.
        """
        start = self.env.env.snapshot()
        if start["elapsed"][0] != 0:
            return None
        vector: Any = self.env.env
        self._physics.reset(np.zeros(len(vector.task.state_names)))  # sees to the callbacks
        self._physics.restore(start["physics"][0])
        self._physics.memory[:] = start.get("disturbances", np.zeros((1, 0)))[0]
        observation = start["observations"][0].copy()
        total, length, terminated, fine = run_episode(
            self._step,
            self._forces,
            coder,
            weights,
            traces,
            rates,
            generator,
            observation,
            self._record,
            self._arguments,
        )
        if not fine:
            self._physics.check_finite()
        columns = self._record[:length].T.copy()
        signals = vector.setup.signals(columns, columns[0])
        observations, infos = self.env.conclude(observation, total, length, not terminated, signals)
        return Ended(length, observations, infos, total, signals)


@numba.njit(nogil=True, error_model="numpy")
def run_episode(
    step: Any,
    forces: np.ndarray,
    coder: TileCoder,
    weights: np.ndarray,
    traces: Traces,
    rates: Rates,
    generator: np.random.Generator,
    observation: np.ndarray,
    record: np.ndarray,
    arguments: tuple[Any, ...],
) -> tuple[float, int, bool, bool]:
    """Learn from an episode from its first observation to its end.

    Args:
        step: see `codrl_mj.envs.compiled.Kernels`.
        forces: [N or N*m] of the actions.
        coder: finds tiles.
        weights: shape (tiles, actions); changed.
        traces: changed.
        rates: how to learn.
        generator: draws.
        observation: the first, shape (k,); gets the last.
        record: gets the trace's last row, for each step; its length is the time limit.
        arguments: the last ones of `step`.

    Returns:
        Sum of the rewards, steps, whether the task ended the episode, and whether the simulation was fine throughout.
    """
    tiles = np.empty(len(coder.displacements), dtype=np.int64)
    action = begin(coder, weights, traces, rates, generator, tiles, observation)
    total, length, terminated = 0.0, 0, False
    while not terminated and length < len(record):
        force = forces[action]
        reward, terminated, fine = step(force, observation, *arguments)
        if not fine:
            return total, length, False, False
        trace = arguments[-1]
        record[length] = trace[-1, 0]
        record[length, 0] = force  # as it was asked for, before anything disturbed it
        total, length = total + reward, length + 1
        seen_reward = float(np.float32(reward))  # what Stable-Baselines3's environments hand out
        action = learn(coder, weights, traces, rates, generator, tiles, action, seen_reward, observation, terminated)
    return total, length, terminated, True
