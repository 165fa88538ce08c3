"""Settings for PPO."""

from codrl_mj.agents.ppo import PPOConfig
from codrl_mj.agents.presets.preset import ELSEWHERE, Preset

PRESETS: dict[str, dict[str, Preset]] = {
    "cartpole": {
        "default": Preset(
            PPOConfig(), total_steps=100_000, num_envs=32, about="Ours: 500 of 500 after 20 000 to 30 000 steps."
        ),
        "paper": Preset(
            PPOConfig(
                learning_rate=3e-4,
                critic_learning_rate=1e-3,
                rollout_steps=4000,
                batch_size=None,
                epochs=80,
                gamma=0.99,
                gae_lambda=0.97,
                clip_range=0.2,
                target_kl=0.01,
                hidden=(64, 64),
                activation="tanh",
            ),
            total_steps=60 * 4000,
            env={"max_episode_steps": 4000, "center_radius": 0.1},
            about=(
                "As printed. Not printed, and taken from the Keras example of PPO, whose numbers the paper's are: 80 "
                "passes over the whole rollout for actor and critic each, the actor's stopping at 1.5 times the KL."
            ),
        ),
    },
    "acrobot": {
        "default": Preset(
            PPOConfig(), total_steps=150_000, num_envs=16, about="The same settings as for the cart-pole."
        )
    },
    "mountain_car": {
        "default": Preset(
            PPOConfig(rollout_steps=4096, gae_lambda=0.98, target_kl=None, input_scale=(1.0, 10.0)),
            total_steps=300_000,
            num_envs=16,
            env={"max_episode_steps": 2000},
            about=(
                "Ours. It is trained in episodes of 2000 steps: in Gymnasium's 200 it never saw the goal, and had "
                "learnt nothing after 400 000 steps."
            ),
        )
    },
    "pendulum": {
        "default": Preset(
            PPOConfig(
                batch_size=128,
                gamma=0.9,
                gae_lambda=0.95,
                target_kl=None,
                state_dependent_noise=True,
                noise_steps=4,
                input_scale=(1.0, 1.0, 0.2),
            ),
            total_steps=80_000,
            num_envs=16,
            about=(
                "Stable-Baselines3 Zoo's, with four times the environments and the speed times 0.2 into the networks. "
                "Without that and the state-dependent noise, one start in ten was not swung up."
            ),
        )
    },
    "mountain_car_continuous": {
        "default": Preset(
            PPOConfig(
                batch_size=128,
                gamma=0.9999,
                gae_lambda=0.95,
                target_kl=None,
                state_dependent_noise=True,
                input_scale=(1.0, 10.0),
            ),
            total_steps=100_000,
            num_envs=8,
            about="Ours: the exploration depends on the state and lasts for 256 steps, which drives up the hill.",
        )
    },
    "furuta": {
        "default": Preset(
            PPOConfig(
                rollout_steps=4096,
                batch_size=512,
                epochs=8,
                gamma=0.98,
                gae_lambda=0.95,
                target_kl=None,
                log_std_init=-0.5,
                unit_actions=True,
                input_scale=(1.0, 1.0, 1.0, 1.0, 0.1, 0.1),
            ),
            total_steps=200_000,
            num_envs=32,
            about=(
                "Ours, for commands of torque, current and voltage alike: actions in units of the largest. With 16 "
                "environments, a discount of 0.99 and speeds times 0.05 some learnt to whirl the rod, not to hold it."
            ),
        )
    },
    ELSEWHERE: {
        "default": Preset(
            PPOConfig(learning_rate=3e-4, batch_size=64, gae_lambda=0.95, target_kl=None),
            total_steps=300_000,
            about="As Schulman et al. (2017) have it for MuJoCo's robots.",
        )
    },
}
"""Task -> name of the settings -> the settings."""
