"""Settings for SAC."""

from codrl_mj.agents.presets.preset import Preset
from codrl_mj.agents.sac import SACConfig

PRESETS: dict[str, dict[str, Preset]] = {
    "pendulum": {"default": Preset(SACConfig(), total_steps=20_000)},
    "mountain_car_continuous": {"default": Preset(SACConfig(), total_steps=50_000)},
}
"""Task -> name of the settings -> the settings."""
