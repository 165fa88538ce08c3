"""How well a policy does on an actuator: returns with intervals, torque tracking, voltage saturation."""

import copy
import dataclasses
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from codrl_mj.envs import ActuatedEnv
from codrl_mj.files import writing
from codrl_mj.motor import Actuator
from codrl_mj.physics import Signals
from codrl_mj.policies import Policy
from codrl_mj.registration import ENVIRONMENTS
from codrl_mj.tasks import find_task

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]


class Interval(NamedTuple):
    """A mean and its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float


def bootstrap_mean(values: np.ndarray) -> Interval:
    """Mean and 95 % percentile-bootstrap interval (scipy, 9999 resamples, fixed seed).

    Args:
        values: shape (n,), n >= 1.
    """
    mean = float(np.mean(values))
    if np.ptp(values) == 0:  # scipy's bootstrap warns about a sample without spread
        return Interval(mean, mean, mean)
    from scipy.stats import bootstrap

    interval = bootstrap((values,), np.mean, method="percentile", rng=0).confidence_interval
    return Interval(mean, float(interval.low), float(interval.high))


@dataclasses.dataclass(frozen=True)
class Episode:
    """Everything that happened in one episode of T steps."""

    time: np.ndarray
    """Time at the end of each step [s], shape (T,)."""
    state: np.ndarray
    """Mechanical state before the first step and after each, shape (T+1, n)."""
    observation: np.ndarray
    """What the agent saw, before the first step and after each, shape (T+1, k)."""
    action: np.ndarray
    """What the agent did, shape (T, ...)."""
    reward: np.ndarray
    """Reward of each step, shape (T,)."""
    signals: dict[str, np.ndarray]
    """The actuator's signals at the end of each step, by their names in `info`, each of shape (T,)."""
    terminated: bool
    """The task ended it; otherwise the time limit did."""

    @property
    def total(self) -> float:
        """The return: the sum of the rewards."""
        return float(self.reward.sum())


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


def save_episode(episode: Episode, path: Path) -> None:
    """Write an episode as a compressed NumPy archive, whole or not at all.

    Args:
        episode: the episode.
        path: `.npz` file; its arrays are named as the fields of `Episode`, the signals by their own names.

    Raises:
        ValueError: another suffix.
    """
    if path.suffix != ".npz":
        raise ValueError(f"trajectory {path}: the suffix must be .npz")
    arrays: dict[str, Any] = {field: getattr(episode, field) for field in (*_ARRAYS, "terminated")}
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
            return Episode(
                **{field: archive[field] for field in _ARRAYS},
                signals={name: archive[name] for name in Signals._fields},
                terminated=bool(archive["terminated"]),
            )
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not the trajectory of an episode: {error}") from None


_ARRAYS = ("time", "state", "observation", "action", "reward")


def make_env(task: str, actuator: str | Actuator | Mapping[str, Any] | None, **options: Any) -> gymnasium.Env[Any, Any]:
    """One environment of a task by the task's name, through Gymnasium's registry.

    Args:
        task: name on the command line.
        actuator: as `ActuatedEnv` takes it.
        **options: anything else that `ActuatedEnv` or `gymnasium.make` takes.
    """
    return gymnasium.make(ENVIRONMENTS[task].env_id, actuator=actuator, disable_env_checker=True, **options)


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
        seed: first seed.
        deterministic: whether the policy takes its most likely action or samples.
        on_step: called with (episodes running, episodes finished) after every step.

    Returns:
        The episodes, in the order of their seeds.

    Raises:
        ValueError: `episodes` is below 1, or `seed` below 0.
    """
    if episodes < 1:
        raise ValueError(f"episodes = {episodes}: must be >= 1")
    if seed < 0:
        raise ValueError(f"seed = {seed}: must be >= 0")
    envs = [make() for _ in range(episodes)]
    cores: list[ActuatedEnv] = [env.unwrapped for env in envs]  # type: ignore[misc]
    observations = [[env.reset(seed=seed + index)[0]] for index, env in enumerate(envs)]
    states = [[core.state] for core in cores]
    actions: list[list[Any]] = [[] for _ in envs]
    rewards: list[list[float]] = [[] for _ in envs]
    infos: list[list[dict[str, Any]]] = [[] for _ in envs]
    ended: dict[int, bool] = {}
    running = list(range(episodes))
    while running:
        chosen, _ = policy.predict(
            np.stack([observations[index][-1] for index in running]), deterministic=deterministic
        )
        for index, action in zip(list(running), chosen, strict=True):
            observation, reward, terminated, truncated, info = envs[index].step(action)
            observations[index].append(observation)
            states[index].append(cores[index].state)
            actions[index].append(action)
            rewards[index].append(float(reward))
            infos[index].append(info)
            if terminated or truncated:
                ended[index] = terminated
                running.remove(index)
        if on_step is not None:
            on_step(len(running), len(ended))
    for env in envs:
        env.close()
    return [
        Episode(
            time=cores[index].task.step_duration * np.arange(1, len(rewards[index]) + 1),
            state=np.array(states[index]),
            observation=np.array(observations[index]),
            action=np.array(actions[index]),
            reward=np.array(rewards[index]),
            signals={name: np.array([info[name] for info in infos[index]]) for name in Signals._fields},
            terminated=ended[index],
        )
        for index in range(episodes)
    ]


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What a policy achieved on an actuator, over all steps of all episodes."""

    task: str
    episodes: int
    returns: Interval
    """Return."""
    length: Interval
    """Steps per episode."""
    tracking_rms: float
    """Root mean square of desired minus delivered torque at the motor shaft [N*m]."""
    tracking_percent: float
    """The same, as a share of the root mean square of the desired torque [%]."""
    tracking_max: float
    """Largest absolute difference [N*m]."""
    saturated_percent: float
    """Share of steps that ended with the voltage at its limit [%]."""
    peak_voltage: float | None
    """Largest absolute voltage [V]; None for the ideal actuator."""

    def as_mapping(self) -> dict[str, Any]:
        """The evaluation as JSON-serialisable values; intervals as mappings of `mean`, `low` and `high`."""
        return {name: value._asdict() if isinstance(value, Interval) else value for name, value in vars(self).items()}


def summarize(task: str, actuator: Actuator | None, episodes: list[Episode]) -> Evaluation:
    """Reduce episodes on one actuator to an `Evaluation`.

    Args:
        task: the task's name.
        actuator: what they ran on; its arm turns forces into torques (1 for the ideal actuator).
        episodes: at least one.
    """
    arm = 1.0 if actuator is None else actuator.motor.arm_radius
    joined = {name: np.concatenate([episode.signals[name] for episode in episodes]) for name in episodes[0].signals}
    desired = joined["desired_force"] * arm
    error = desired - joined["actual_force"] * arm
    rms, scale = np.sqrt(np.mean(error**2)), np.sqrt(np.mean(desired**2))
    return Evaluation(
        task=task,
        episodes=len(episodes),
        returns=bootstrap_mean(np.array([episode.total for episode in episodes])),
        length=bootstrap_mean(np.array([len(episode.reward) for episode in episodes], dtype=float)),
        tracking_rms=float(rms),
        tracking_percent=float(100 * rms / scale) if scale > 0 else 0.0,
        tracking_max=float(np.abs(error).max()),
        saturated_percent=float(100 * joined["saturated"].mean()),
        peak_voltage=None if actuator is None else float(np.abs(joined["voltage"]).max()),
    )
