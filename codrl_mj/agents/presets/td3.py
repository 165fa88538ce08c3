"""Settings for TD3."""

from codrl_mj.agents.presets.preset import Preset
from codrl_mj.agents.td3 import TD3Config

PRESETS: dict[str, dict[str, Preset]] = {
    "pendulum": {
        "default": Preset(
            TD3Config(
                learning_rate=2e-3,
                gamma=0.95,
                tau=0.02,
                batch_size=64,
                learning_starts=400,
                train_every=None,
                noise_sigma=0.3,
                noise_theta=1.0,
                noise_dt=1.0,
            ),
            total_steps=8000,
            about="Ours, for a short run: a low discount, targets that follow fast, a high learning rate.",
        )
    },
    "mountain_car_continuous": {
        "default": Preset(
            TD3Config(
                learning_rate=1e-3,
                tau=0.01,
                batch_size=64,
                learning_starts=1000,
                train_every=None,
                noise_sigma=0.5,
                noise_theta=0.15,
                noise_dt=1.0,
                input_scale=(1.0, 10.0),
            ),
            total_steps=20_000,
            about="Ours: noise that lasts for 7 steps drives up the hill; the velocity is times 10 for the networks.",
        )
    },
}
"""Task -> name of the settings -> the settings."""
