"""Gymnasium environments with motors; the classes are imported on first use."""

import importlib

_PUBLIC = {
    "ActuatedEnv": "codrl_mj.envs.single",
    "ActuatedVectorEnv": "codrl_mj.envs.vector",
    "SerialVectorEnv": "codrl_mj.envs.serial",
    "register": "codrl_mj.envs.registration",
}

__all__ = ["ActuatedEnv", "ActuatedVectorEnv", "SerialVectorEnv", "register"]


def __getattr__(name: str) -> object:
    """Import a public name on first use, so that `codrl_mj.envs.config` loads nothing heavy."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'codrl_mj.envs' has no attribute {name!r}")
