"""Thin shells that turn a task and its physics into the environments that agents know; imported on first use."""

import importlib
from typing import Any

_PUBLIC = {
    "ActuatedEnv": "codrl_mj.envs.single",
    "ActuatedVectorEnv": "codrl_mj.envs.vector",
    "SerialVectorEnv": "codrl_mj.envs.serial",
}

__all__ = ["ActuatedEnv", "ActuatedVectorEnv", "SerialVectorEnv"]


def __getattr__(name: str) -> Any:
    """Import a public name on first use: `codrl_mj.envs.config` needs nothing heavy."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'codrl_mj.envs' has no attribute {name!r}")
