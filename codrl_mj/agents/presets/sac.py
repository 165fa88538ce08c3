"""Settings for SAC."""

from codrl_mj.agents.presets.preset import ELSEWHERE, Preset
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
    "mountain_car_continuous": {
        "default": Preset(
            SACConfig(
                learning_rate=1e-3,
                batch_size=128,
                tau=0.01,
                learning_starts=0,
                train_every=32,
                entropy_coefficient=0.1,
                state_dependent_noise=True,
                input_scale=(1.0, 10.0),
            ),
            total_steps=8000,
            about="The exploration of Stable-Baselines3 Zoo, by the state and for 32 steps each, drives up the hill.",
        )
    },
    ELSEWHERE: {
        "default": Preset(
            SACConfig(
                learning_rate=3e-4, hidden=(256, 256), batch_size=256, buffer_size=1_000_000, learning_starts=5000
            ),
            total_steps=100_000,
            about="As Haarnoja et al. (2018) have it for MuJoCo's robots.",
        )
    },
}
"""Task -> name of the settings -> the settings."""
