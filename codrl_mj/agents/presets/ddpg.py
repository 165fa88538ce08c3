"""Settings for DDPG."""

import dataclasses

from codrl_mj.agents.ddpg import DDPGConfig
from codrl_mj.agents.presets.preset import Preset

_NOT_PRINTED = (
    "Not printed, and taken from the Keras example of DDPG: Ornstein-Uhlenbeck noise (theta 0.15, dt 0.01, reset in "
    "every episode) of sigma 0.2 in the action's unit, a buffer of 50 000, batches of 64, a gradient step for every "
    "environment step from the first on."
)

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
    noise_sigma=0.1,  # of a range of +-2 N*m: 0.2 N*m
    noise_theta=0.15,
    noise_dt=0.01,
)

_CAR = DDPGConfig(
    learning_rate=1e-3,
    critic_learning_rate=4e-5,
    gamma=0.85,
    tau=0.45,
    actor_units=(64, 64),
    state_units=(64,),
    action_units=(),
    joint_units=(64,),
    buffer_size=50_000,
    batch_size=64,
    learning_starts=0,
    noise_sigma=0.2,
    noise_theta=0.15,
    noise_dt=0.01,
)

PRESETS: dict[str, dict[str, Preset]] = {
    "pendulum": {
        "default": Preset(
            DDPGConfig(
                learning_rate=2e-3,
                gamma=0.95,
                tau=0.02,
                actor_units=(64, 64),
                state_units=(),
                action_units=(),
                joint_units=(64, 64),
                batch_size=128,
                learning_starts=400,
                train_every=None,
                noise_sigma=0.3,
                noise_theta=1.0,
                noise_dt=1.0,
            ),
            total_steps=8000,
            about=(
                "Ours, for a short run: an ordinary critic, a low discount, targets that follow fast, independent "
                "noise. It learns in a twelfth of the paper's steps."
            ),
        ),
        "paper": Preset(
            _PENDULUM,
            total_steps=None,
            total_episodes=500,
            about=(
                f"As printed; it does not learn: one ReLU is all of the state that the critic sees. {_NOT_PRINTED} "
                "The critic sees the action in shares of its range, and three observations instead of the two printed."
            ),
        ),
        "repaired": Preset(
            dataclasses.replace(_PENDULUM, state_units=(16, 32)),
            total_steps=None,
            total_episodes=500,
            about=(
                "As `paper`, but for the critic's layers for the state: 16 and 32 units, as in the Keras example, "
                "instead of 1."
            ),
        ),
    },
    "mountain_car_continuous": {
        "default": Preset(
            DDPGConfig(
                learning_rate=1e-3,
                tau=0.01,
                actor_units=(64, 64),
                state_units=(),
                action_units=(),
                joint_units=(64, 64),
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
        ),
        "paper": Preset(
            _CAR,
            total_steps=None,
            total_episodes=200,
            about=(
                "As printed; it does not learn: the goal is some 70 steps away, 0.85**70 of its reward is less than "
                f"the force costs, and standing still is optimal. {_NOT_PRINTED}"
            ),
        ),
        "repaired": Preset(
            dataclasses.replace(
                _CAR,
                learning_rate=4e-5,
                critic_learning_rate=1e-3,
                gamma=0.99,
                tau=5e-3,
                noise_sigma=0.5,
                noise_dt=1.0,
                input_scale=(1.0, 10.0),
            ),
            total_steps=None,
            total_episodes=200,
            about=(
                "As `paper`, but for: discount 0.99, not 0.85, so that the goal is worth the way; learning rates 4e-5 "
                "and 1e-3, which the paper prints the other way round; targets followed by 0.005, not 0.45; velocity "
                "times 10 into the networks; noise of sigma 0.5 and dt 1, which lasts for 7 steps."
            ),
        ),
    },
}
"""Task -> name of the settings -> the settings."""
