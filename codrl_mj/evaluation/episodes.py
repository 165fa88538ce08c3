"""Whole episodes: running them, and keeping them in files."""

import contextlib
import copy
import dataclasses
import json
import operator
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from codrl_mj.envs.registration import ENVIRONMENTS
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.motor import Actuator
from codrl_mj.physics import Signals
from codrl_mj.runs.files import writing
from codrl_mj.runs.policies import Policy
from codrl_mj.tasks import find_task

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
    trace: np.ndarray
    """What the actuator did in each integration step, shape (T*n, 6); columns `codrl_mj.physics.TRACE_NAMES`."""
    signals: dict[str, np.ndarray]
    """The actuator's signals at the end of each step, by their names in `info`, each of shape (T,)."""
    terminated: bool
    """The task ended it; otherwise the time limit did."""
    actuator: Actuator | None
    """What it ran on: the one that was drawn for it, if actuators were; None is the ideal one."""
    command: str = "force"
    """What the agent commanded: `force`, `current` or `voltage`."""

    @property
    def total(self) -> float:
        """The return: the sum of the rewards."""
        return float(self.reward.sum())

    @property
    def inner_steps(self) -> int:
        """Integration steps in an environment step."""
        return len(self.trace) // len(self.time)

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
        self._space = copy.deepcopy(find_task(actions).action_space if isinstance(actions, str) else actions)
        self._space.seed(seed)

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = False,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """One random action for each observation; `deterministic` makes no difference."""
        return np.array([self._space.sample() for _ in observation]), None


_ARRAYS = ("time", "state", "observation", "action", "reward", "trace")


def save_episode(episode: Episode, path: Path) -> None:
    """Write an episode as a compressed NumPy archive, whole or not at all.

    Args:
        episode: the episode.
        path: `.npz` file; its arrays are named as the fields of `Episode`, the signals by their own names. `actuator`
            is text: its fields as JSON.

    Raises:
        ValueError: another suffix.
    """
    if path.suffix != ".npz":
        raise ValueError(f"trajectory {path}: the suffix must be .npz")
    arrays: dict[str, Any] = {field: getattr(episode, field) for field in (*_ARRAYS, "terminated", "command")}
    arrays["actuator"] = json.dumps(None if episode.actuator is None else episode.actuator.as_mapping())
    with writing(path) as temporary:
        np.savez_compressed(temporary, **arrays, **episode.signals)  # type: ignore[arg-type]


def load_episode(path: Path) -> Episode:
    """Read an episode that `save_episode` wrote; nothing is unpickled.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not such an archive.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            actuator = json.loads(str(archive["actuator"]))
            return Episode(
                **{field: archive[field] for field in _ARRAYS},
                signals={name: archive[name] for name in Signals._fields},
                terminated=bool(archive["terminated"]),
                actuator=None if actuator is None else Actuator.from_mapping(actuator),
                command=str(archive["command"]),
            )
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not the trajectory of an episode: {error}") from None


def make_env(task: str, actuator: str | Actuator | Mapping[str, Any] | None, **options: Any) -> gymnasium.Env[Any, Any]:
    """One environment of a task by the task's name, through Gymnasium's registry.

    Args:
        task: name on the command line.
        actuator: as `ActuatedEnv` takes it.
        **options: anything else that `ActuatedEnv` or `gymnasium.make` takes.
    """
    return gymnasium.make(ENVIRONMENTS[task].env_id, actuator=actuator, disable_env_checker=True, **options)


class _Recording:
    """One environment, and what has happened in it since the reset."""

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int) -> None:
        """Reset the environment."""
        self.env = env
        self._core: ActuatedEnv = env.unwrapped  # type: ignore[assignment]
        self.observations = [env.reset(seed=seed)[0]]
        self._states = [self._core.physics.state]
        self._actions: list[Any] = []
        self._rewards: list[float] = []
        self._traces: list[np.ndarray] = []
        self._signals: list[tuple[Any, ...]] = []
        self._terminated = False

    def step(self, action: Any) -> bool:
        """Take a step, and say whether the episode has ended."""
        observation, reward, self._terminated, truncated, info = self.env.step(action)
        self.observations.append(observation)
        self._states.append(self._core.physics.state)
        self._actions.append(action)
        self._rewards.append(float(reward))
        self._traces.append(self._core.physics.trace.copy())
        self._signals.append(_signals(info))
        return self._terminated or truncated

    def episode(self) -> Episode:
        """What has happened."""
        return Episode(
            time=self._core.task.step_duration * np.arange(1, len(self._rewards) + 1),
            state=np.array(self._states),
            observation=np.array(self.observations),
            action=np.array(self._actions),
            reward=np.array(self._rewards),
            trace=np.concatenate(self._traces),
            signals={
                name: np.array(values)
                for name, values in zip(Signals._fields, zip(*self._signals, strict=True), strict=True)
            },
            terminated=self._terminated,
            actuator=self._core.actuator,
            command=self._core.setup.command,
        )


_signals = operator.itemgetter(*Signals._fields)


@contextlib.contextmanager
def _sampling_from(seed: int) -> Iterator[None]:
    """Seed the generator that torch's policies sample actions from, and leave it as it was found."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield


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
    if episodes < 1:
        raise ValueError(f"episodes = {episodes}: must be >= 1")
    if seed < 0:
        raise ValueError(f"seed = {seed}: must be >= 0")
    recordings = [_Recording(make(), seed + index) for index in range(episodes)]
    running = recordings
    with contextlib.nullcontext() if deterministic else _sampling_from(seed):
        while running:
            observations = np.stack([recording.observations[-1] for recording in running])
            actions, _ = policy.predict(observations, deterministic=deterministic)
            ended = [recording.step(action) for recording, action in zip(running, actions, strict=True)]
            if any(ended):
                running = [recording for recording, over in zip(running, ended, strict=True) if not over]
            if on_step is not None:
                on_step(len(running), episodes - len(running))
    for recording in recordings:
        recording.env.close()
    return [recording.episode() for recording in recordings]
