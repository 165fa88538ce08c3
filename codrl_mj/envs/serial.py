"""Single environments stepped one by one as one: a `VectorEnv` for the physics that cannot be batched."""

import functools
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.wrappers import TimeLimit

from codrl_mj.envs.setup import Setup
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.envs.stepped import SteppedVectorEnv
from codrl_mj.envs.vector import check_counts, one_for_each
from codrl_mj.tasks import Task

Array = np.ndarray


class SerialVectorEnv(SteppedVectorEnv):
    """A `SteppedVectorEnv` of `ActuatedEnv`s with time limits."""

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
        check_counts(num_envs, max_episode_steps, 20_000)
        each: Sequence[Any] = actuator if one_for_each(actuator, task) else [actuator] * num_envs
        if len(each) != num_envs:
            raise ValueError(f"actuator: {len(each)} actuators for {num_envs} environments: there must be one for each")
        self.max_episode_steps = max_episode_steps
        limit = sys.maxsize if max_episode_steps is None else int(max_episode_steps)
        makers = [functools.partial(_limited, limit, task, one, arguments) for one in each]  # unlike lambdas, picklable
        super().__init__(makers)

    @property
    def setup(self) -> Setup:
        """The set-up of the first environment."""
        return self._singles[0].setup

    @property
    def arm_radii(self) -> Array:
        """See `SteppedVectorEnv`."""
        return self.setup.arm_radii

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def randomization(self) -> dict[str, Array]:
        """See `SteppedVectorEnv`; and how many sets were `rejected`."""
        if self.setup.randomization is None:
            return {}
        snapshot = self.snapshot()
        columns = zip(self.setup.randomization.names, snapshot["drawn"].T.copy(), strict=True)
        return dict(columns) | {"rejected": snapshot["rejected"]}

    @property
    def _singles(self) -> list[ActuatedEnv]:
        return [env.unwrapped for env in self.envs]  # type: ignore[misc]


def _limited(limit: int, task: str, actuator: Any, arguments: Mapping[str, Any]) -> "TimeLimit[Any, Any]":
    # quoted: rl-zoo3 puts a class of its own in the place of Gymnasium's, and that one is not generic
    return TimeLimit(ActuatedEnv(task, actuator, **arguments), limit)
