"""Single environments stepped one by one as one: a `VectorEnv` for the physics that cannot be batched."""

import functools
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from codrl_mj.envs.setup import Setup
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.envs.snapshots import check_snapshot
from codrl_mj.envs.vector import check_counts, one_for_each
from codrl_mj.physics import Signals, signal_names
from codrl_mj.tasks import Task

Array = np.ndarray


class SerialVectorEnv(SyncVectorEnv[Array, Array]):
    """Gymnasium's `SyncVectorEnv` of `ActuatedEnv`s with time limits, in `SAME_STEP` mode.

    It has what Stable-Baselines3's face needs of an `ActuatedVectorEnv`: `signals`, `randomization`, `snapshot` and
    `restore`.
    """

    def __init__(
        self,
        num_envs: int,
        task: str,
        actuator: Any = "default",
        max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:
        """Build the environments.

        Args:
            num_envs: how many, >= 1.
            task: the task's name.
            actuator: as for `ActuatedEnv`; or a sequence of N actuators, one for each environment.
            max_episode_steps: time limit of each environment [steps]; None for none.
            **arguments: the other arguments of `ActuatedEnv`, `physics` among them.

        Raises:
            ValueError: an argument is unknown or out of bounds, or a current loop is unstable; the message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        check_counts(num_envs, max_episode_steps)
        each: Sequence[Any] = actuator if one_for_each(actuator, task) else [actuator] * num_envs
        if len(each) != num_envs:
            raise ValueError(f"actuator: {len(each)} actuators for {num_envs} environments: there must be one for each")
        self.max_episode_steps = max_episode_steps
        limit = sys.maxsize if max_episode_steps is None else int(max_episode_steps)
        makers = [functools.partial(_limited, limit, task, one, arguments) for one in each]  # unlike lambdas, picklable
        super().__init__(makers, autoreset_mode=AutoresetMode.SAME_STEP)
        self.signals: Signals | None = None  # of the last step, each an array of shape (N,)

    @property
    def setup(self) -> Setup:
        """The set-up of the first environment."""
        return self._singles[0].setup

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def randomization(self) -> dict[str, Array]:
        """What the present episodes were drawn with: shape (N,) for every field, and how many sets were `rejected`."""
        if self.setup.randomization is None:
            return {}
        snapshot = self.snapshot()
        columns = zip(self.setup.randomization.names, snapshot["drawn"].T.copy(), strict=True)
        return dict(columns) | {"rejected": snapshot["rejected"]}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance every environment by one step; those whose episode ends start another at once."""
        observations, rewards, terminated, truncated, infos = super().step(actions)
        ended = terminated | truncated
        last = infos.get("final_info", infos)  # of those that ended
        others = last if ended.all() else infos
        self.signals = {
            name: np.where(ended.reshape(-1, *[1] * (last[name].ndim - 1)), last[name], others[name])
            for name in signal_names(self.setup.family)
        }
        return observations, rewards, terminated, truncated, infos

    def image(self, row: int = 0) -> Array | None:
        """One environment as an image, shape (height, width, 3), uint8; None if there is no render mode."""
        return self._singles[row].render()

    def snapshot(self) -> dict[str, Array]:
        """Everything that the future depends on, as plain arrays: the environments' own, and their bookkeeping."""
        each = [single.snapshot() for single in self._singles]
        started = [-1 if env._elapsed_steps is None else env._elapsed_steps for env in self._limits]
        return {
            **{name: np.stack([one[name] for one in each]) for name in each[0]},
            "elapsed": np.array(started, dtype=np.int64),
            "observations": self._observations.copy(),
        }

    def restore(self, snapshot: Mapping[str, Array]) -> None:
        """Continue from what `snapshot` returned, bit for bit, in environments made with the same arguments.

        Raises:
            ValueError: the snapshot is of another number of environments, another task or other arguments.
        """
        check_snapshot(snapshot, self.snapshot())
        own = {name: values for name, values in snapshot.items() if name not in ("elapsed", "observations")}
        for row, single in enumerate(self._singles):
            single.restore({name: values[row] for name, values in own.items()})
        for env, elapsed in zip(self._limits, snapshot["elapsed"].tolist(), strict=True):
            env._elapsed_steps = None if elapsed < 0 else elapsed
        self._observations[:] = snapshot["observations"]
        self._env_obs = list(snapshot["observations"].copy())
        self.signals = None  # of a step that was not this one's past

    @property
    def _limits(self) -> list[Any]:
        return list(self.envs)

    @property
    def _singles(self) -> list[ActuatedEnv]:
        return [env.env for env in self._limits]


def _limited(limit: int, task: str, actuator: Any, arguments: Mapping[str, Any]) -> "TimeLimit[Any, Any]":
    # quoted: rl-zoo3 puts a class of its own in the place of Gymnasium's, and that one is not generic
    return TimeLimit(ActuatedEnv(task, actuator, **arguments), limit)
