"""Stable-Baselines3's agents with a replay buffer, with what the paper's have besides. Imports torch."""

from typing import Any

from stable_baselines3 import DDPG, DQN, SAC, TD3
from stable_baselines3.common.utils import update_learning_rate


class _CriticRate:
    """Gives the critic a learning rate of its own."""

    def __init__(self, *args: Any, critic_learning_rate: float, **kwargs: Any) -> None:
        """Take what the Stable-Baselines3 model takes; its `learning_rate` is all others'."""
        self.critic_learning_rate = critic_learning_rate
        super().__init__(*args, **kwargs)

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)  # type: ignore[misc]
        update_learning_rate(self.critic.optimizer, self.critic_learning_rate)  # type: ignore[attr-defined]


class TwoRateDDPG(_CriticRate, DDPG):
    """DDPG whose critic has a learning rate of its own."""


class TwoRateTD3(_CriticRate, TD3):
    """TD3 whose critics have a learning rate of their own."""


class TwoRateSAC(_CriticRate, SAC):
    """SAC whose critics have a learning rate of their own."""


class EpisodicDQN(DQN):
    """DQN whose exploration shrinks by a factor with every episode."""

    def __init__(self, *args: Any, exploration_decay: float, **kwargs: Any) -> None:
        """Take what `DQN` takes.

        Args:
            *args: as for `DQN`.
            exploration_decay: epsilon in episode n is `exploration_initial_eps * exploration_decay**n`, but at least
                `exploration_final_eps`.
            **kwargs: as for `DQN`; `exploration_fraction` has no effect.
        """
        self.exploration_decay = exploration_decay
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.exploration_schedule = self._decayed

    def _decayed(self, _progress: float) -> float:
        """Epsilon in the present episode."""
        return max(self.exploration_final_eps, self.exploration_initial_eps * self.exploration_decay**self._episode_num)

    def _sample_action(self, *args: Any, **kwargs: Any) -> Any:
        # DQN refreshes epsilon before it counts an episode as ended: the next would start with the last one's
        self.exploration_rate = self._decayed(self._current_progress_remaining)
        return super()._sample_action(*args, **kwargs)
