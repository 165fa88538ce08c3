"""Settings for SARSA."""

from codrl_mj.agents.presets.preset import Preset
from codrl_mj.agents.sarsa import SARSAConfig

PRESETS: dict[str, dict[str, Preset]] = {
    "mountain_car": {
        "default": Preset(SARSAConfig(), total_steps=None, total_episodes=600),
        "paper": Preset(SARSAConfig(), total_steps=None, total_episodes=600, about="As printed."),
    },
    "acrobot": {
        "default": Preset(
            SARSAConfig(step_size=0.3 / 16, tilings=16, intervals=(6, 6, 6, 6), angles=2),
            total_steps=None,
            total_episodes=500,
        )
    },
    "cartpole": {
        "default": Preset(
            SARSAConfig(
                step_size=0.1 / 16,
                gamma=0.99,
                trace_decay=0.9,
                tilings=16,
                intervals=(6, 6, 6, 6),
                low=(-2.4, -3.0, -0.21, -3.5),
                high=(2.4, 3.0, 0.21, 3.5),
                initial_value=100.0,
            ),
            total_steps=None,
            total_episodes=300,
        )
    },
}
"""Task -> name of the settings -> the settings."""
