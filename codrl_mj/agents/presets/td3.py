"""Settings for TD3."""

from codrl_mj.agents.presets.preset import Preset
from codrl_mj.agents.td3 import TD3Config

PRESETS: dict[str, dict[str, Preset]] = {
    "pendulum": {"default": Preset(TD3Config(), total_steps=20_000)},
    "mountain_car_continuous": {"default": Preset(TD3Config(), total_steps=50_000)},
}
"""Task -> name of the settings -> the settings."""
