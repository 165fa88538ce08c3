"""Settings for DQN."""

from codrl_mj.agents.dqn import DQNConfig
from codrl_mj.agents.presets.preset import Preset

PRESETS: dict[str, dict[str, Preset]] = {
    "acrobot": {
        "default": Preset(DQNConfig(), total_steps=None, total_episodes=500),
        "paper": Preset(DQNConfig(), total_steps=None, total_episodes=500),
    },
    "cartpole": {"default": Preset(DQNConfig(), total_steps=50_000)},
    "mountain_car": {"default": Preset(DQNConfig(), total_steps=120_000)},
}
"""Task -> name of the settings -> the settings."""
