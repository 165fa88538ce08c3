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
            _ACROBOT,
            total_steps=None,
            total_episodes=500,
            about="The paper's. With rarer gradient steps, the policies never finished from some starts.",
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
                learning_rate=2.3e-3,
                hidden=(256, 256),
                tau=1.0,
                target_every=10,
                train_every=256,
                gradient_steps=128,
                exploration_decay=None,
                exploration_fraction=0.16,
                exploration_end=0.04,
            ),
            total_steps=50_000,
            about="Stable-Baselines3 Zoo's. PPO balances longer, and learns it in the same time.",
        )
    },
    "mountain_car": {
        "default": Preset(
            DQNConfig(
                learning_rate=1e-3,
                hidden=(64, 64),
                batch_size=64,
                buffer_size=50_000,
                tau=0.01,
                train_every=4,
                gradient_steps=2,
                exploration_decay=None,
                exploration_fraction=0.3,
                exploration_end=0.05,
                input_scale=(1.0, 10.0),
            ),
            total_steps=80_000,
            env={"max_episode_steps": 1000},
            about=(
                "Ours. It is trained in episodes of 1000 steps: in Gymnasium's 200 it sees the goal rarely, and "
                "Stable-Baselines3 Zoo's settings reached -189."
            ),
        )
    },
}
"""Task -> name of the settings -> the settings."""
