"""Whole episodes: running, saving and loading them."""

import contextlib
import copy
import dataclasses
import itertools
import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from codrl_mj.actuators import (
    IDEAL,
    ActuatorModel,
    actuator_from_mapping,
    allow_imports,
    mapping_of,
)
from codrl_mj.boundary import Action, Info
from codrl_mj.envs.config import Env, EnvConfig, Space
from codrl_mj.fields import check_memory
from codrl_mj.runs.files import atomic_write, select_prefix
from codrl_mj.runs.policies import Policy as Policy
from codrl_mj.runs.policies import check_spaces

MakeEnv = Callable[[], Env]


class Recorder(Protocol):
    """Recorder of an environment's last step: the environment itself, or a `SubstepRecorder`."""

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the actuators' signals in `info`."""

    @property
    def trace_names(self) -> tuple[str, ...]:
        """Names of the columns of `trace`."""

    @property
    def step_duration(self) -> float:
        """Duration of an environment step [s]."""

    @property
    def command(self) -> str:
        """Quantity that the agent commands: `force`, `current` or `voltage`."""

    @property
    def motor_names(self) -> tuple[str, ...]:
        """Names of the motors."""

    @property
    def actuator(self) -> ActuatorModel | tuple[ActuatorModel, ...]:
        """Actuator of the present episode; for several motors a tuple."""

    @property
    def state(self) -> np.ndarray:
        """Mechanical state, shape (k,)."""

    @property
    def speeds(self) -> np.ndarray:
        """Speeds of the shafts [m/s or rad/s], shape (motors,)."""

    @property
    def trace(self) -> np.ndarray:
        """Signals after each integration step of the last step, shape (n, motors, columns)."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """Recording of one episode of T environment steps with n integration steps each."""

    time: np.ndarray
    """Time at the end of each step [s], shape (T,)."""
    state: np.ndarray
    """Mechanical state before the first step and after each, shape (T+1, k)."""
    observation: np.ndarray
    """Observation before the first step and after each, shape (T+1, ...)."""
    action: np.ndarray
    """Action of each step, shape (T, ...)."""
    reward: np.ndarray
    """Reward of each step, shape (T,)."""
    first_speeds: np.ndarray
    """Velocities on the motor side of the model's gears before the first step, shape (motors,).

    The unit is m/s or rad/s.
    """
    trace: dict[str, np.ndarray]
    """Signals of the actuators in each integration step, by the names of
    `codrl_mj.physics.trace_names`, each of shape (T*n,); with several motors (T*n, motors).
    """
    signals: dict[str, np.ndarray]
    """Signals of the actuators at the end of each step, by their names in `info`, shape (T,) or
    (T, motors).
    """
    terminated: bool
    """True if the task ended the episode. If False, the time limit did."""
    actuator: ActuatorModel | tuple[ActuatorModel, ...]
    """Actuator of the episode, after randomization; with several motors a tuple."""
    command: str = "force"
    """Quantity that the agent commands: `force`, `current` or `voltage`."""
    motors: tuple[str, ...] = ()
    """Names of the motors; empty for a single one."""
    succeeded: bool | None = None
    """Final `is_success` or `success` in `info`; None if the environment has neither."""

    @property
    def actuators(self) -> tuple[ActuatorModel, ...]:
        """Actuators of the episode, always as a tuple."""
        return self.actuator if isinstance(self.actuator, tuple) else (self.actuator,)

    @property
    def is_torque_controlled(self) -> tuple[bool, ...]:
        """For each motor, True if its command is a torque, not a voltage, position or speed."""
        command_actuators = (
            actuator if self.command == "force" else actuator.commands()[self.command].actuator
            for actuator in self.actuators
        )
        return tuple(actuator.is_torque_controlled for actuator in command_actuators)

    @property
    def total(self) -> float:
        """Return of the episode: the sum of its rewards."""
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
    """Policy that samples uniformly from an action space."""

    def __init__(self, actions: str | Space, seed: int = 0) -> None:
        """Seed a private copy of the action space.

        Args:
            actions: the space, or the name of a task.
            seed: seed of the samples.

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
        deterministic: bool = False,  # noqa: ARG002 - required by the Policy protocol
    ) -> tuple[np.ndarray, None]:
        """Return one random action for each observation; `deterministic` is ignored."""
        return np.array([self._space.sample() for _ in observation]), None


_ARRAYS = ("time", "state", "observation", "action", "reward", "first_speeds")


def save_episode(episode: Episode, path: Path) -> None:
    """Write an episode atomically as a compressed NumPy archive.

    Args:
        episode: the episode.
        path: `.npz` file. Its arrays have the names of the fields of `Episode`, and `trace/NAME`
            and `signals/NAME` for the entries of `trace` and `signals`. `actuator` is a text: its
            fields as JSON, or a list for several motors.

    Raises:
        ValueError: the suffix is not .npz.
    """
    if path.suffix != ".npz":
        raise ValueError(f"trajectory {path}: the suffix must be .npz")
    # NumPy converts arrays, flags and names alike.
    arrays: dict[str, Any] = {
        field: getattr(episode, field) for field in (*_ARRAYS, "terminated", "command")
    }
    for field in ("trace", "signals"):
        arrays |= {f"{field}/{name}": values for name, values in getattr(episode, field).items()}
    if episode.motors:
        arrays["motors"] = episode.motors
    if episode.succeeded is not None:
        arrays["succeeded"] = episode.succeeded
    descriptions = (
        [mapping_of(actuator) for actuator in episode.actuator]
        if isinstance(episode.actuator, tuple)
        else mapping_of(episode.actuator)
    )
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, actuator=json.dumps(descriptions), **arrays)


def load_episode(path: Path, trust: bool = False) -> Episode:
    """Read an episode written by `save_episode`, without unpickling.

    Args:
        path: the file.
        trust: import, and thereby execute, the module of a custom actuator.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not an archive of an episode.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        descriptions = json.loads(str(arrays["actuator"]))
        has_several = isinstance(descriptions, list)
        with allow_imports(trust):
            actuators = [
                IDEAL if description is None else actuator_from_mapping(description)
                for description in (descriptions if has_several else [descriptions])
            ]
        return Episode(
            **{field: arrays[field] for field in _ARRAYS},
            trace=select_prefix("trace/", arrays),
            signals=select_prefix("signals/", arrays),
            terminated=bool(arrays["terminated"]),
            actuator=tuple(actuators) if has_several else actuators[0],
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


# Memory [bytes] of the smallest environment. The environments of the built-in tasks need three to
# seven times as much.
_EPISODE_SIZE = 100_000
_STEPS_BETWEEN_CHECKS = 10_000


def check_episodes(episodes: int, name: str = "episodes") -> None:
    """Raise if the number of episodes is below 1 or their environments do not fit into memory."""
    if episodes < 1:
        raise ValueError(f"{name} = {episodes}: must be >= 1")
    check_memory(
        _EPISODE_SIZE * episodes, f"{name} = {episodes:,}, which run side by side", "run fewer"
    )


class _Recording:
    """Environment and the recording of its episode."""

    def __init__(self, env: Env, seed: int) -> None:
        """Reset the environment."""
        self.env = env
        self._recorder: Recorder = env.get_wrapper_attr("recorder")
        self.observations = [env.reset(seed=seed)[0]]
        self._states = [self._recorder.state]
        self._first_speeds = self._recorder.speeds
        self._actions: list[Action] = []
        self._rewards: list[float] = []
        self._traces: list[np.ndarray] = []
        self._signals: list[Info] = []
        self._terminated = False

    def step(self, action: Action) -> bool:
        """Take a step; return True if the episode has ended."""
        observation, reward, self._terminated, truncated, info = self.env.step(action)
        self.observations.append(observation)
        self._states.append(self._recorder.state)
        self._actions.append(action)
        self._rewards.append(float(reward))
        self._traces.append(self._recorder.trace)
        self._signals.append(info)
        # The recording is concatenated at the end, which needs the same amount of memory again.
        if (steps := len(self._traces)) % _STEPS_BETWEEN_CHECKS == 0:
            label = f"an episode of {steps:,} steps, which does not end"
            check_memory(steps * self._traces[-1].nbytes, label, "lower max_episode_steps")
        return self._terminated or truncated

    def episode(self) -> Episode:
        """Return the recording as an `Episode`."""
        recorder = self._recorder
        success = self._signals[-1].get("is_success", self._signals[-1].get("success"))
        trace = np.concatenate(self._traces)
        columns = trace[:, 0].T if trace.shape[1] == 1 else np.moveaxis(trace, 2, 0)
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
            succeeded=None if success is None else bool(success),
        )


def check_policy(policy: Policy, env: Env, same_bounds: bool = False) -> None:
    """Raise ValueError if a policy was trained with other observations or actions.

    A space that the policy does not have is not compared. Other bounds of currents or voltages
    cause a warning, or with `same_bounds` an error too.
    """
    # The task defines the bounds of forces. The bounds of other commands depend on the motor, and
    # a policy may be tested on another motor on purpose.
    is_force = env.get_wrapper_attr("recorder").command == "force"
    check_spaces(policy, env, exact=same_bounds or is_force)


def run_episodes(
    policy: Policy,
    make: MakeEnv,
    episodes: int,
    seed: int = 0,
    deterministic: bool = True,
    on_step: Callable[[int, int], None] | None = None,
    same_bounds: bool = False,
) -> list[Episode]:
    """Run whole episodes side by side, with one call of the policy per step for all of them.

    Args:
        policy: policy that chooses actions for a batch of observations.
        make: function that makes one environment with a time limit.
        episodes: number of episodes, >= 1; episode i starts from seed `seed + i`.
        seed: first seed, and seed of torch's generator for sampled actions.
        deterministic: True for the most likely action, False for a sampled one.
        on_step: called with (episodes running, episodes finished) after every step.
        same_bounds: True to raise, instead of warning, if currents or voltages only have other
            bounds than in the policy's training.

    Returns:
        The episodes, in the order of their seeds.

    Raises:
        ValueError: `episodes` is below 1, or `seed` below 0; or the policy was trained with other
            observations or actions.
        SimulationDivergedError: a simulation has a value that is not finite.
    """
    check_episodes(episodes)
    if seed < 0:
        raise ValueError(f"seed = {seed}: must be >= 0")
    env = make()
    try:
        check_policy(policy, env, same_bounds)
    except ValueError:
        env.close()
        raise
    envs = itertools.chain([env], (make() for _ in range(episodes - 1)))
    recordings = [_Recording(env, seed + index) for index, env in enumerate(envs)]
    running = recordings
    with contextlib.ExitStack() as stack:
        # Stochastic policies sample from torch's global generator, whose state is restored
        # afterwards.
        if not deterministic:
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
                    recording
                    for recording, has_ended in zip(running, ended, strict=True)
                    if not has_ended
                ]
            if on_step is not None:
                on_step(len(running), episodes - len(running))
    for recording in recordings:
        recording.env.close()
    return [recording.episode() for recording in recordings]
