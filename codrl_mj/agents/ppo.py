"""PPO (Stable-Baselines3) with settings that suit CartPole through a motor."""

import dataclasses
import math
import numbers
from collections.abc import Callable
from typing import Any


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation with clipping, on Stable-Baselines3.

    Discount, clip range and network are the paper's; the remaining defaults were chosen so that a run takes a minute on
    two cores. The paper instead makes 80 full-batch passes over 4000 steps, with separate learning rates.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    learning_rate: float = 1e-3
    """Adam's step size, > 0, for actor and critic. The paper: 3e-4 and 1e-3."""
    rollout_steps: int = 2048
    """Environment steps, over all environments, between two updates, >= 2; a multiple of the environments."""
    batch_size: int = 256
    """Minibatch size, >= 2. The paper: the whole rollout of 4000 steps."""
    epochs: int = 10
    """Passes over each rollout, >= 1, unless `target_kl` stops them."""
    gamma: float = 0.99
    """Discount factor, in (0, 1]. The paper: 0.99."""
    gae_lambda: float = 0.97
    """Generalised advantage estimation's lambda, in [0, 1]. The paper: 0.97."""
    clip_range: float = 0.2
    """Clip range of the probability ratio, > 0. The paper: 0.2."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus, >= 0."""
    target_kl: float = 0.03
    """Passes over a rollout stop when the policy has moved this far [nat], > 0. The paper: 0.01."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of actor and critic (tanh). The paper: 64-64."""

    def __post_init__(self) -> None:
        """Validate."""
        finite = math.isfinite
        bounds: dict[str, tuple[Callable[[Any], bool], str]] = {
            "learning_rate": (lambda value: _is_number(value) and finite(value) and value > 0, "a finite number > 0"),
            "rollout_steps": (lambda value: _is_integer(value) and value >= 2, "an integer >= 2"),
            "batch_size": (lambda value: _is_integer(value) and value >= 2, "an integer >= 2"),
            "epochs": (lambda value: _is_integer(value) and value >= 1, "an integer >= 1"),
            "gamma": (lambda value: _is_number(value) and 0 < value <= 1, "a number in (0, 1]"),
            "gae_lambda": (lambda value: _is_number(value) and 0 <= value <= 1, "a number in [0, 1]"),
            "clip_range": (lambda value: _is_number(value) and value > 0, "a number > 0"),
            "entropy_coefficient": (
                lambda value: _is_number(value) and finite(value) and value >= 0,
                "a finite number >= 0",
            ),
            "target_kl": (lambda value: _is_number(value) and value > 0, "a number > 0"),
            "hidden": (
                lambda value: isinstance(value, tuple) and all(_is_integer(units) and units >= 1 for units in value),
                "a tuple of integers >= 1",
            ),
        }
        for name, (holds, bound) in bounds.items():
            if not holds(value := getattr(self, name)):
                raise ValueError(f"PPOConfig.{name} = {value!r}: must be {bound}")


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def make_ppo(config: PPOConfig, env: Any, seed: int) -> Any:
    """A Stable-Baselines3 PPO on a vector environment, on the CPU.

    Args:
        config: the settings.
        env: a Stable-Baselines3 `VecEnv`.
        seed: of the weights, the minibatches and the actions.

    Raises:
        ValueError: the rollout is not a multiple of the environments, or of the minibatch.
    """
    from stable_baselines3 import PPO
    from torch import nn

    for name, size in (("num_envs", env.num_envs), ("batch_size", config.batch_size)):
        if config.rollout_steps % size:
            raise ValueError(f"PPOConfig.rollout_steps = {config.rollout_steps}: must be a multiple of {name} = {size}")
    return PPO(
        "MlpPolicy",
        env,
        learning_rate=config.learning_rate,
        n_steps=config.rollout_steps // env.num_envs,
        batch_size=config.batch_size,
        n_epochs=config.epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        ent_coef=config.entropy_coefficient,
        target_kl=config.target_kl,
        policy_kwargs={"net_arch": list(config.hidden), "activation_fn": nn.Tanh},
        seed=seed,
        device="cpu",
    )
