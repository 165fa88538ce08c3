"""Settings for SAC."""

from codrl_mj.agents.presets.preset import Preset
from codrl_mj.agents.sac import SACConfig

PRESETS: dict[str, dict[str, Preset]] = {
    "pendulum": {
        "default": Preset(
            SACConfig(
                learning_rate=2e-3,
                gamma=0.95,
                tau=0.02,
                batch_size=64,
                learning_starts=400,
                train_every=None,
            ),
            total_steps=6000,
            about="Ours, for a short run: a low discount, targets that follow fast, a high learning rate.",
        )
    },
    "mountain_car_continuous": {"default": Preset(SACConfig(), total_steps=50_000)},
}
"""Task -> name of the settings -> the settings."""
