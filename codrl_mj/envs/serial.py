"""Single environments stepped one by one as one: a `VectorEnv` for whatever cannot be batched."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from codrl_mj.envs.setup import one_for_each
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.envs.snapshots import check_snapshot, elapsed_steps, set_elapsed_steps
from codrl_mj.envs.vector import check_counts
from codrl_mj.physics import Signals

Array = np.ndarray
_BOOKKEEPING = ("elapsed", "observations", "ended")
"""Entries of a snapshot that are not the environments' own."""


class SerialVectorEnv(SyncVectorEnv[Array, Array]):
    """Gymnasium's `SyncVectorEnv`, by default in `SAME_STEP` mode, with what Stable-Baselines3's face needs.

    Of each it asks for `motors`, `signal_names`, `randomization`, `snapshot` and `restore`, as an
    `ActuatedEnv` and what `codrl_mj.make` makes have them.
    """

    def __init__(
        self,
        num_envs: int,
        task: str | Callable[..., Any],
        actuator: Any = "default",
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        num_threads: int = 0,
        **arguments: Any,
    ) -> None:
        """Build the environments.

        Args:
            num_envs: how many, >= 1.
            task: the task's name; or a function that makes an environment which has its actuators,
                a picklable one for processes.
            actuator: as for `ActuatedEnv`; or a sequence of N actuators, one for each environment.
            max_episode_steps: time limit of each environment [steps]; None for none.
            autoreset_mode: when an environment whose episode ended is reset, as for
                `ActuatedVectorEnv`.
            num_threads: 0 or 1: there is one thread.
            **arguments: the other arguments of `ActuatedEnv`, `physics` among them; or the
                function's.

        Raises:
            ValueError: an argument is unknown or out of bounds, or a current loop is unstable; the
                message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        check_counts(num_envs, max_episode_steps, 20_000 if isinstance(task, str) else 200_000)
        if num_threads not in (0, 1):
            raise ValueError(
                f"num_threads = {num_threads!r}: must be 0 or 1 here: these environments are"
                " stepped one by one, only tasks on physics='mujoco' as a batch: leave it out"
            )
        make: Any = task
        each = [{} if actuator == "default" else {"actuator": actuator}] * num_envs
        if isinstance(task, str):
            make = functools.partial(ActuatedEnv, task)
            if one_for_each(actuator, task):
                each = [{"actuator": one} for one in actuator]
        if len(each) != num_envs:
            raise ValueError(
                f"actuator: {len(each)} actuators for {num_envs} environments: there must be one"
                " for each"
            )
        makers = [
            functools.partial(_limited, max_episode_steps, make, {**arguments, **one})
            for one in each
        ]
        super().__init__(makers, autoreset_mode=AutoresetMode(autoreset_mode))
        self.signals: Signals | None = (
            None  # of the last step, each an array of shape (N,) or (N, motors)
        )
        self._signal_names = self.get_attr("signal_names")[0]
        self.arm_radii = np.array([one.arm_radius for one in self.get_attr("motors")[0].values()])

    @property
    def task(self) -> Any:
        """The task of the first environment."""
        return self.get_attr("task")[0]

    @property
    def randomization(self) -> dict[str, Array]:
        """What the present episodes were drawn with, fields of several motors as PATTERN:FIELD: each of shape (N,).

        Also how many sets were `rejected`; empty if nothing is drawn.
        """
        drawn = []
        for one in self.get_attr("randomization"):
            nested = {
                name: each if isinstance(each, Mapping) else {"": each}
                for name, each in one.items()
            }
            drawn.append(
                {
                    f"{of}:{name}".rstrip(":"): value
                    for of, each in nested.items()
                    for name, value in each.items()
                }
            )
        kinds = {name: np.int64 if name == "rejected" else np.float64 for name in drawn[0]}
        return {name: np.array([one[name] for one in drawn], kind) for name, kind in kinds.items()}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance every environment by one step; those whose episode ends start another at once."""
        observations, rewards, terminated, truncated, infos = super().step(actions)
        ended = terminated | truncated
        last = infos.get("final_info", infos)  # of those that ended
        others = last if ended.all() else infos
        # In NEXT_STEP mode a step may have reset all of them, and tells nothing of motors.
        self.signals = {
            name: np.where(
                ended.reshape(-1, *[1] * (last[name].ndim - 1)), last[name], others[name]
            )
            for name in self._signal_names
            if name in others
        }
        return observations, rewards, terminated, truncated, infos

    def image(self, row: int = 0) -> Array | None:
        """One environment as an image, shape (height, width, 3), uint8; None if there is no render mode."""
        image: Any = self.envs[row].render()
        return image

    def snapshot(self) -> dict[str, Array]:
        """Everything that the future depends on, as plain arrays: the environments' own, and their bookkeeping."""
        each = self.call("snapshot")
        same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        return {
            **({} if same_step else {"ended": self._autoreset_envs.copy()}),
            **{name: np.stack([one[name] for one in each]) for name in each[0]},
            "elapsed": np.stack([elapsed_steps(env) for env in self.envs]),
            "observations": self._observations.copy(),
        }

    def restore(self, snapshot: Mapping[str, Array]) -> Array | None:
        """Continue from what `snapshot` returned, bit for bit, in environments made with the same arguments.

        Returns:
            None; or the first observations (N, k), where the environments could only start an
            episode anew.

        Raises:
            ValueError: the snapshot is of another number of environments, another task or other
                arguments.
        """
        if self._env_obs[0] is None:  # Gymnasium's wrappers insist on a reset
            self.reset()
        check_snapshot(snapshot, self.snapshot())
        own = {name: values for name, values in snapshot.items() if name not in _BOOKKEEPING}
        begun = [
            env.get_wrapper_attr("restore")({name: values[row] for name, values in own.items()})
            for row, env in enumerate(self.envs)
        ]
        self.signals = None  # of a step that was not this one's past
        self._autoreset_envs[:] = snapshot.get("ended", False)
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


def _limited(limit: int | None, make: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    """One environment, with a time limit [steps] if one is given."""
    env = make(**arguments)
    return env if limit is None else TimeLimit(env, int(limit))
