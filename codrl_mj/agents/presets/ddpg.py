"""Settings for DDPG."""

from codrl_mj.agents.ddpg import DDPGConfig
from codrl_mj.agents.presets.preset import Preset

_PENDULUM = DDPGConfig(
    learning_rate=1e-3,
    critic_learning_rate=2e-3,
    gamma=0.99,
    tau=5e-3,
    actor_units=(64, 64),
    state_units=(1,),
    action_units=(32,),
    joint_units=(256, 256),
    buffer_size=50_000,
    batch_size=64,
    learning_starts=0,
    noise_sigma=0.1,
)

PRESETS: dict[str, dict[str, Preset]] = {
    "pendulum": {
        "default": Preset(DDPGConfig(), total_steps=20_000),
        "paper": Preset(_PENDULUM, total_steps=None, total_episodes=500),
    },
    "mountain_car_continuous": {"default": Preset(DDPGConfig(), total_steps=50_000)},
}
"""Task -> name of the settings -> the settings."""
