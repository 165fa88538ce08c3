"""Motorised environments side by side, as Stable-Baselines3 trains in them."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from codrl_mj.envs.sb3 import ActuatedVecEnv
from codrl_mj.envs.stepped import SteppedVectorEnv
from codrl_mj.envs.vector import check_counts


class MotorisedVectorEnv(SteppedVectorEnv):
    """A `SteppedVectorEnv` of what `codrl_mj.make` makes."""

    @property
    def arm_radii(self) -> np.ndarray:
        """See `SteppedVectorEnv`."""
        return np.array([one.arm_radius for one in self.of_each("motors")[0].values()])

    @property
    def randomization(self) -> dict[str, np.ndarray]:
        """See `SteppedVectorEnv`; fields are PATTERN:FIELD."""
        drawn = []
        for each in self.of_each("randomization"):
            patterns = {pattern: own for pattern, own in each.items() if pattern != "rejected"}
            motors = {pattern: own for pattern, own in patterns.items() if isinstance(own, Mapping)}
            of_model = {name: one for name, one in patterns.items() if name not in motors}
            drawn.append(
                of_model | {f"{pattern}:{name}": one for pattern, own in motors.items() for name, one in own.items()}
            )
        return {name: np.array([one[name] for one in drawn]) for name in drawn[0]}


def make_sb3_vec_env(make: Callable[[], "gymnasium.Env[Any, Any]"], num_envs: int) -> ActuatedVecEnv:
    """Some motorised environments, stepped one by one, as one Stable-Baselines3 `VecEnv`.

    Args:
        make: makes one, as `EnvConfig.make` does.
        num_envs: how many, >= 1.

    Raises:
        ValueError: more than memory holds; observations are no vector, or actions neither a vector nor a choice.
    """
    check_counts(num_envs, None, 200_000)
    envs = MotorisedVectorEnv([make] * num_envs)
    observed, acted = envs.single_observation_space, envs.single_action_space
    if not isinstance(observed, spaces.Box) or len(observed.shape) != 1:
        envs.close()
        raise ValueError(
            f"observations are {observed}: must be a vector, which our agents' networks take: flatten them with a "
            "wrapper of Gymnasium's (FlattenObservation), and register that environment"
        )
    if not isinstance(acted, spaces.Box | spaces.Discrete):
        envs.close()
        raise ValueError(f"actions are {acted}: must be a vector (Box) or a choice (Discrete)")
    return ActuatedVecEnv(envs)
