"""The agents: configurations of Stable-Baselines3's."""

from codrl_mj.agents.ppo import PPOConfig, make_ppo

__all__ = ["PPOConfig", "make_ppo"]
