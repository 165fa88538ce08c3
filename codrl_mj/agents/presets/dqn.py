"""Settings for DQN."""

from codrl_mj.agents.dqn import DQNConfig
from codrl_mj.agents.presets.preset import Preset

_ACROBOT = DQNConfig(
    learning_rate=1e-3,
    gamma=0.99,
    hidden=(64, 128),
    buffer_size=100_000,
    batch_size=64,
    learning_starts=64,
    tau=5e-3,
    target_every=1,
    exploration_start=1.0,
    exploration_decay=0.99,
    exploration_end=0.01,
)

PRESETS: dict[str, dict[str, Preset]] = {
    "acrobot": {
        "default": Preset(
            DQNConfig(
                learning_rate=1e-3,
                hidden=(64, 128),
                batch_size=64,
                buffer_size=50_000,
                learning_starts=1000,
                train_every=4,
                gradient_steps=2,
                tau=1.0,
                target_every=250,
                exploration_decay=None,
                exploration_fraction=0.2,
                exploration_end=0.05,
            ),
            total_steps=60_000,
        ),
        "paper": Preset(
            _ACROBOT,
            total_steps=None,
            total_episodes=500,
            about=(
                "As printed. Not printed: a buffer of 100 000, batches of 64, a gradient step and a soft update of the "
                "target (5e-3) for every environment step, an epsilon of 1 that shrinks by 0.99 an episode to 0.01."
            ),
        ),
    },
    "cartpole": {
        "default": Preset(
            DQNConfig(
                learning_rate=1e-3,
                hidden=(64, 64),
                learning_starts=1000,
                train_every=8,
                gradient_steps=4,
                tau=1.0,
                target_every=50,
                exploration_decay=None,
                exploration_fraction=0.3,
                exploration_end=0.04,
            ),
            total_steps=50_000,
        )
    },
    "mountain_car": {
        "default": Preset(
            DQNConfig(
                learning_rate=4e-3,
                hidden=(64, 64),
                gamma=0.98,
                batch_size=128,
                buffer_size=10_000,
                learning_starts=1000,
                train_every=16,
                gradient_steps=8,
                tau=1.0,
                target_every=600,
                exploration_decay=None,
                exploration_fraction=0.2,
                exploration_end=0.07,
                input_scale=(1.0, 10.0),
            ),
            total_steps=120_000,
            about="Stable-Baselines3 Zoo's settings, with a smaller network and the velocity times 10.",
        )
    },
}
"""Task -> name of the settings -> the settings."""
