"""Single environments stepped one by one as one, which Stable-Baselines3's face and continued trainings can use."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from codrl_mj.envs.snapshots import check_snapshot, elapsed_steps, set_elapsed_steps
from codrl_mj.physics import Signals

Array = np.ndarray


class SteppedVectorEnv(SyncVectorEnv[Array, Array]):
    """Gymnasium's `SyncVectorEnv` in `SAME_STEP` mode, of environments with `signal_names`, `snapshot` and `restore`.

    It has what Stable-Baselines3's face needs of an `ActuatedVectorEnv`: `signals`, `snapshot` and `restore`.
    """

    def __init__(self, makers: Any) -> None:
        """Make the environments.

        Args:
            makers: functions that do, picklable ones for processes.
        """
        super().__init__(makers, autoreset_mode=AutoresetMode.SAME_STEP)
        self.signals: Signals | None = None  # of the last step, each an array of shape (N,) or (N, motors)
        self._signal_names = self.of_each("signal_names")[0]

    @property
    def arm_radii(self) -> Array:
        """Of the motors of an environment [m], or 1 where a joint is driven directly; shape (motors,)."""
        raise NotImplementedError

    @property
    def randomization(self) -> dict[str, Array]:
        """What the present episodes were drawn with: shape (N,) for every field; empty if nothing is randomised."""
        raise NotImplementedError

    def of_each(self, name: str) -> list[Any]:
        """An attribute of every environment, wherever among its wrappers that is."""
        return [env.get_wrapper_attr(name) for env in self.envs]

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance every environment by one step; those whose episode ends start another at once."""
        observations, rewards, terminated, truncated, infos = super().step(actions)
        ended = terminated | truncated
        last = infos.get("final_info", infos)  # of those that ended
        others = last if ended.all() else infos
        self.signals = {
            name: np.where(ended.reshape(-1, *[1] * (last[name].ndim - 1)), last[name], others[name])
            for name in self._signal_names
        }
        return observations, rewards, terminated, truncated, infos

    def image(self, row: int = 0) -> Array | None:
        """One environment as an image, shape (height, width, 3), uint8; None if there is no render mode."""
        image: Any = self.envs[row].render()
        return image

    def snapshot(self) -> dict[str, Array]:
        """Everything that the future depends on, as plain arrays: the environments' own, and their bookkeeping."""
        each = [snapshot() for snapshot in self.of_each("snapshot")]
        return {
            **{name: np.stack([one[name] for one in each]) for name in each[0]},
            "elapsed": np.stack([elapsed_steps(env) for env in self.envs]),
            "observations": self._observations.copy(),
        }

    def restore(self, snapshot: Mapping[str, Array]) -> Array | None:
        """Continue from what `snapshot` returned, bit for bit, in environments made with the same arguments.

        Returns:
            None; or the first observations (N, k), where the environments could only start an episode anew.

        Raises:
            ValueError: the snapshot is of another number of environments, another task or other arguments.
        """
        check_snapshot(snapshot, self.snapshot())
        own = {name: values for name, values in snapshot.items() if name not in ("elapsed", "observations")}
        begun = [
            restore({name: values[row] for name, values in own.items()})
            for row, restore in enumerate(self.of_each("restore"))
        ]
        self.signals = None  # of a step that was not this one's past
        if begun[0] is not None:
            self._keep(np.stack(begun))
            return self._observations.copy()
        for env, elapsed in zip(self.envs, snapshot["elapsed"], strict=True):
            set_elapsed_steps(env, elapsed)
        self._keep(snapshot["observations"])
        return None

    def _keep(self, observations: Array) -> None:
        self._observations[:] = observations
        self._env_obs = list(observations.copy())
