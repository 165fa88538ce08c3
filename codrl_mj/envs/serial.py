"""A `VectorEnv` that steps environments one by one, for those that cannot be batched."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import cast

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from codrl_mj.boundary import Argument, Info
from codrl_mj.envs.config import Env
from codrl_mj.envs.snapshots import check_snapshot, elapsed_steps, set_elapsed_steps
from codrl_mj.envs.vector import check_counts
from codrl_mj.physics import Signals
from codrl_mj.tasks import Task

Array = np.ndarray
VECTOR_ARGUMENTS = ("num_threads", "autoreset_mode")
"""Keyword arguments of vector environments that a single environment does not have."""
BYTES_PER_ENV = 20_000
"""Memory that an environment of a task takes [bytes]."""
_BOOKKEEPING = ("elapsed", "observations", "ended")
"""Entries of a snapshot that belong to the vector, and not to its environments."""


class SerialVectorEnv(SyncVectorEnv[Array, Array]):
    """Gymnasium's `SyncVectorEnv`, with the attributes that `ActuatedVecEnv` needs.

    The default mode is `SAME_STEP`. Each environment must have `motors`, `signal_names`,
    `randomization`, `snapshot` and `restore`, as an `ActuatedEnv` and the environments of
    `codrl_mj.make` have.
    """

    def __init__(
        self,
        num_envs: int,
        make: Callable[..., Env] | Sequence[Callable[..., Env]],
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        num_threads: int = 0,
        bytes_per_env: int = BYTES_PER_ENV,
        **arguments: Argument,
    ) -> None:
        """Build the environments.

        Args:
            num_envs: number of environments, >= 1.
            make: function that makes an environment with its actuators; or one for each
                environment.
            max_episode_steps: time limit of each environment [steps]; None for that of `make`.
            autoreset_mode: reset of an environment after its episode, as for `ActuatedVectorEnv`.
            num_threads: 0 or 1; there is only one thread.
            bytes_per_env: memory that an environment takes [bytes], which is checked first.
            **arguments: arguments of the function.

        Raises:
            ValueError: an argument is unknown or out of bounds, or a current loop is unstable; the
                message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        check_counts(num_envs, max_episode_steps, bytes_per_env)
        if num_threads not in (0, 1):
            raise ValueError(
                f"num_threads = {num_threads!r}: must be 0 or 1: these environments are stepped one"
                " by one; only tasks on physics='mujoco' are stepped as a batch: leave it out"
            )
        makers = [make] * num_envs if callable(make) else list(make)
        env_functions = [
            functools.partial(_make_env, max_episode_steps, maker, arguments) for maker in makers
        ]
        super().__init__(env_functions, autoreset_mode=AutoresetMode(autoreset_mode))
        # Signals of the last step, each an array of shape (N,) or (N, motors).
        self.signals: Signals | None = None
        self._signal_names = self.get_attr("signal_names")[0]
        self.arm_radii = np.array(
            [motor.arm_radius for motor in self.get_attr("motors")[0].values()]
        )

    @property
    def task(self) -> Task:
        """The task of the first environment."""
        task: Task = self.get_attr("task")[0]
        return task

    @property
    def randomization(self) -> dict[str, Array]:
        """Drawn values of the present episodes: path -> array (N,), and the number `rejected`.

        A field drawn for some motors has the path PATTERN:FIELD. Empty if nothing is randomized.
        """
        values_of_envs = []
        for env_values in self.get_attr("randomization"):
            nested = {
                name: field_values if isinstance(field_values, Mapping) else {"": field_values}
                for name, field_values in env_values.items()
            }
            values_of_envs.append(
                {
                    f"{pattern}:{name}".rstrip(":"): value
                    for pattern, field_values in nested.items()
                    for name, value in field_values.items()
                }
            )
        dtypes = {
            name: np.int64 if name == "rejected" else np.float64 for name in values_of_envs[0]
        }
        return {
            name: np.array([env_values[name] for env_values in values_of_envs], dtype)
            for name, dtype in dtypes.items()
        }

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Advance every environment by one step, or reset it, as `autoreset_mode` says."""
        observations, rewards, terminated, truncated, infos = super().step(actions)
        ended = terminated | truncated
        # The last infos of episodes that ended are in `final_info`, those of other episodes in the
        # infos themselves. In NEXT_STEP mode a step may only reset, and return no signals.
        final_infos = infos.get("final_info", infos)
        other_infos = final_infos if ended.all() else infos
        self.signals = {
            name: np.where(
                ended.reshape(-1, *[1] * (final_infos[name].ndim - 1)),
                final_infos[name],
                other_infos[name],
            )
            for name in self._signal_names
            if name in other_infos
        }
        return observations, rewards, terminated, truncated, infos

    def image(self, row: int = 0) -> Array | None:
        """Return an image of one environment, (height, width, 3), uint8; None if not rendered."""
        # A single environment renders one image.
        return cast(Array | None, self.envs[row].render())

    def snapshot(self) -> dict[str, Array]:
        """Return the complete state as arrays: of the environments, and of the vector itself."""
        snapshots = self.call("snapshot")
        same_step = self.autoreset_mode == AutoresetMode.SAME_STEP
        return {
            **({} if same_step else {"ended": self._autoreset_envs.copy()}),
            **{
                name: np.stack([env_snapshot[name] for env_snapshot in snapshots])
                for name in snapshots[0]
            },
            "elapsed": np.stack([elapsed_steps(env) for env in self.envs]),
            "observations": self._observations.copy(),
        }

    def restore(self, snapshot: Mapping[str, Array]) -> Array | None:
        """Continue from a snapshot, bit for bit, in environments made with the same arguments.

        Returns:
            None; or the first observations (N, k), if the environments could only start a new
            episode.

        Raises:
            ValueError: the snapshot is of another number of environments, another task or other
                arguments.
        """
        # Gymnasium's wrappers refuse to be used before a first reset.
        if self._env_obs[0] is None:
            self.reset()
        check_snapshot(snapshot, self.snapshot())
        env_entries = {
            name: values for name, values in snapshot.items() if name not in _BOOKKEEPING
        }
        first_observations = [
            env.get_wrapper_attr("restore")(
                {name: values[row] for name, values in env_entries.items()}
            )
            for row, env in enumerate(self.envs)
        ]
        # The last step's signals are not part of a snapshot.
        self.signals = None
        self._autoreset_envs[:] = snapshot.get("ended", False)
        if first_observations[0] is not None:
            self._set_observations(np.stack(first_observations))
            return self._observations.copy()
        for env, elapsed in zip(self.envs, snapshot["elapsed"], strict=True):
            set_elapsed_steps(env, elapsed)
        self._set_observations(snapshot["observations"])
        return None

    def _set_observations(self, observations: Array) -> None:
        """Write the observations into both attributes in which `SyncVectorEnv` stores them."""
        self._observations[:] = observations
        self._env_obs = list(observations.copy())


def _make_env(
    max_episode_steps: int | None, make: Callable[..., Env], arguments: Mapping[str, Argument]
) -> Env:
    """Make one environment, with a time limit [steps] if there is one."""
    env = make(**arguments)
    return env if max_episode_steps is None else TimeLimit(env, int(max_episode_steps))
