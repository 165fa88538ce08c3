"""Thin shells that turn a task and its physics into the environments that agents know."""

from codrl_mj.envs.serial import SerialVectorEnv
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.envs.vector import ActuatedVectorEnv

__all__ = ["ActuatedEnv", "ActuatedVectorEnv", "SerialVectorEnv"]
