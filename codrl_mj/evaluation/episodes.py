"""Whole episodes: running them, and keeping them in files."""

import contextlib
import copy
import dataclasses
import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import IDEAL, actuator_from_mapping, mapping_of, trusting
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import check_memory
from codrl_mj.runs.files import select_prefix, atomic_write
from codrl_mj.runs.policies import Policy

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]


@dataclasses.dataclass(frozen=True)
class Episode:
    """Everything that happened in one episode of T environment steps of n integration steps each."""

    time: np.ndarray
    """Time at the end of each step [s], shape (T,)."""
    state: np.ndarray
    """Mechanical state before the first step and after each, shape (T+1, k)."""
    observation: np.ndarray
    """What the agent saw, before the first step and after each, shape (T+1, ...)."""
    action: np.ndarray
    """What the agent did, shape (T, ...)."""
    reward: np.ndarray
    """Reward of each step, shape (T,)."""
    first_speeds: np.ndarray
    """Velocities at the motors' side of the model's gears before the first step [m/s or rad/s], shape (motors,)."""
    trace: dict[str, np.ndarray]
    """What the actuators did in each integration step, by the names of
    `codrl_mj.physics.trace_names`, each of shape (T*n,); with several motors (T*n, motors).
    """
    signals: dict[str, np.ndarray]
    """The actuators' signals at the end of each step, by their names in `info`, each of shape (T,) or (T, motors)."""
    terminated: bool
    """The task ended it; otherwise the time limit did."""
    actuator: Any
    """What it ran on: the one that was drawn for it, if actuators were; with several motors a tuple of them."""
    command: str = "force"
    """What the agent commanded: `force`, `current` or `voltage`."""
    motors: tuple[str, ...] = ()
    """Names of several motors."""
    succeeded: bool | None = None
    """What the environment said of it in the end (`is_success` or `success` in its info), if anything."""

    @property
    def actuators(self) -> tuple[Any, ...]:
        """What it ran on, always as a tuple."""
        return self.actuator if isinstance(self.actuator, tuple) else (self.actuator,)

    @property
    def is_torque_controlled(self) -> tuple[bool, ...]:
        """For each motor True if a torque was asked of it; a voltage, a position or a speed is none."""
        asked = (
            one if self.command == "force" else one.commands()[self.command].actuator
            for one in self.actuators
        )
        return tuple(one.tracks for one in asked)

    @property
    def total(self) -> float:
        """The return: the sum of the rewards."""
        return float(self.reward.sum())

    @property
    def inner_steps(self) -> int:
        """Integration steps in an environment step."""
        return len(self.trace["speed"]) // len(self.time)

    @property
    def timestep(self) -> float:
        """Duration of an integration step [s]."""
        return float(self.time[0]) / self.inner_steps


class RandomPolicy:
    """Chooses uniformly from an action space."""

    def __init__(self, actions: str | spaces.Space[Any], seed: int = 0) -> None:
        """Seed a private copy of the action space.

        Args:
            actions: the space, or the name of the task whose space it is.
            seed: of the choices.

        Raises:
            ValueError: unknown task, or a seed below 0.
        """
        if seed < 0:
            raise ValueError(f"seed = {seed}: must be >= 0")
        self._space = copy.deepcopy(
            EnvConfig(actions).action_space if isinstance(actions, str) else actions
        )
        self._space.seed(seed)

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = False,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """One random action for each observation; `deterministic` makes no difference."""
        return np.array([self._space.sample() for _ in observation]), None


_ARRAYS = ("time", "state", "observation", "action", "reward", "first_speeds")


def save_episode(episode: Episode, path: Path) -> None:
    """Write an episode as a compressed NumPy archive, whole or not at all.

    Args:
        episode: the episode.
        path: `.npz` file; its arrays are named as the fields of `Episode`, what is in `trace` and
            `signals` as `trace/NAME` and `signals/NAME`. `actuator` is text: its fields as JSON, a
            list for several motors.

    Raises:
        ValueError: another suffix.
    """
    if path.suffix != ".npz":
        raise ValueError(f"trajectory {path}: the suffix must be .npz")
    arrays: dict[str, Any] = {
        field: getattr(episode, field) for field in (*_ARRAYS, "terminated", "command")
    }
    for field in ("trace", "signals"):
        arrays |= {f"{field}/{name}": values for name, values in getattr(episode, field).items()}
    if episode.motors:
        arrays["motors"] = episode.motors
    if episode.succeeded is not None:
        arrays["succeeded"] = episode.succeeded
    several = isinstance(episode.actuator, tuple)
    described = (
        [mapping_of(one) for one in episode.actuator] if several else mapping_of(episode.actuator)
    )
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, actuator=json.dumps(described), **arrays)


def load_episode(path: Path, trust: bool = False) -> Episode:
    """Read an episode that `save_episode` wrote; nothing is unpickled.

    Args:
        path: the file.
        trust: whether to import the module of an actuator that is none of ours, which executes it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not such an archive.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        described = json.loads(str(arrays["actuator"]))
        several = isinstance(described, list)
        with trusting(trust):
            actuators = [
                IDEAL if one is None else actuator_from_mapping(one)
                for one in (described if several else [described])
            ]
        return Episode(
            **{field: arrays[field] for field in _ARRAYS},
            trace=select_prefix("trace/", arrays),
            signals=select_prefix("signals/", arrays),
            terminated=bool(arrays["terminated"]),
            actuator=tuple(actuators) if several else actuators[0],
            command=str(arrays["command"]),
            motors=tuple(arrays["motors"].tolist()) if "motors" in arrays else (),
            succeeded=bool(arrays["succeeded"]) if "succeeded" in arrays else None,
        )
    except (
        KeyError,
        TypeError,
        ValueError,
        EOFError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(f"{path} is not the trajectory of an episode: {error}") from None


# memory [bytes] of an environment that stands still; the tasks' have three to seven times that
_EPISODE_SIZE = 100_000
_STEPS_BETWEEN_CHECKS = 10_000


def check_episodes(episodes: int, name: str = "episodes") -> None:
    """Refuse a number of episodes that is below 1, or whose environments memory does not hold."""
    if episodes < 1:
        raise ValueError(f"{name} = {episodes}: must be >= 1")
    check_memory(
        _EPISODE_SIZE * episodes, f"{name} = {episodes:,}, which run side by side", "run fewer"
    )


class _Recording:
    """One environment, and what has happened in it since the reset."""

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int) -> None:
        """Reset the environment."""
        self.env = env
        self._recorder: Any = env.get_wrapper_attr("recorder")
        self.observations = [env.reset(seed=seed)[0]]
        self._states = [self._recorder.state]
        self._first_speeds = self._recorder.speeds
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._traces: list[np.ndarray] = []
        self._signals: list[dict[str, Any]] = []
        self._terminated = False

    def step(self, action: Any) -> bool:
        """Take a step, and say whether the episode has ended."""
        observation, reward, self._terminated, truncated, info = self.env.step(action)
        self.observations.append(observation)
        self._states.append(self._recorder.state)
        self._actions.append(action)
        self._rewards.append(float(reward))
        self._traces.append(self._recorder.trace)
        self._signals.append(info)
        if (
            steps := len(self._traces)
        ) % _STEPS_BETWEEN_CHECKS == 0:  # what is recorded is copied in the end
            what = f"an episode of {steps:,} steps, which does not end"
            check_memory(steps * self._traces[-1].nbytes, what, "lower max_episode_steps")
        return self._terminated or truncated

    def episode(self) -> Episode:
        """What has happened."""
        recorder = self._recorder
        said = self._signals[-1].get("is_success", self._signals[-1].get("success"))
        whole = np.concatenate(self._traces)
        columns = whole[:, 0].T if whole.shape[1] == 1 else np.moveaxis(whole, 2, 0)
        return Episode(
            time=recorder.step_duration * np.arange(1, len(self._rewards) + 1),
            state=np.array(self._states),
            observation=np.array(self.observations),
            action=np.array(self._actions),
            reward=np.array(self._rewards),
            trace=dict(zip(recorder.trace_names, columns.copy(), strict=True)),
            signals={
                name: np.array([info[name] for info in self._signals])
                for name in recorder.signal_names
            },
            terminated=self._terminated,
            actuator=recorder.actuator,
            command=recorder.command,
            motors=recorder.motor_names if len(recorder.motor_names) > 1 else (),
            first_speeds=self._first_speeds,
            succeeded=None if said is None else bool(said),
        )


def run_episodes(
    policy: Policy,
    make: MakeEnv,
    episodes: int,
    seed: int = 0,
    deterministic: bool = True,
    on_step: Callable[[int, int], None] | None = None,
) -> list[Episode]:
    """Run whole episodes side by side, the policy choosing for all of them at once.

    Args:
        policy: chooses actions for a batch of observations.
        make: makes one environment with a time limit.
        episodes: their number, >= 1; episode i starts from seed `seed + i`.
        seed: first seed; also of the actions that a policy samples from torch's generator.
        deterministic: whether the policy takes its most likely action or samples.
        on_step: called with (episodes running, episodes finished) after every step.

    Returns:
        The episodes, in the order of their seeds.

    Raises:
        ValueError: `episodes` is below 1, or `seed` below 0.
        SimulationDivergedError: a simulation left the finite numbers.
    """
    check_episodes(episodes)
    if seed < 0:
        raise ValueError(f"seed = {seed}: must be >= 0")
    recordings = [_Recording(make(), seed + index) for index in range(episodes)]
    running = recordings
    with contextlib.ExitStack() as stack:
        if (
            not deterministic
        ):  # the generator that torch's policies sample from is left as it was found
            import torch

            stack.enter_context(torch.random.fork_rng(devices=[]))
            torch.default_generator.manual_seed(seed)
        while running:
            observations = np.stack([recording.observations[-1] for recording in running])
            actions, _ = policy.predict(observations, deterministic=deterministic)
            ended = [
                recording.step(action) for recording, action in zip(running, actions, strict=True)
            ]
            if any(ended):
                running = [
                    recording for recording, over in zip(running, ended, strict=True) if not over
                ]
            if on_step is not None:
                on_step(len(running), episodes - len(running))
    for recording in recordings:
        recording.env.close()
    return [recording.episode() for recording in recordings]
