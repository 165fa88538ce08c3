"""Actuators in C and on arrays: other back ends than numba for the `advance` of every family.

The reader executes the source of `advance` with symbols (`reader.py`), and a back end receives the
operations: `c_code.py` writes C, `array_code.py` computes with arrays of numpy, torch or JAX.
`writers.py` writes motors in the notations of other simulators, which know less of a motor.
docs/arrays.md has examples.
"""

import importlib
from typing import Any

_PUBLIC = {
    "advance": "codrl_mj.arrays.array_code",
    "Advanced": "codrl_mj.arrays.array_code",
    "c_function": "codrl_mj.arrays.c_code",
    "c_program": "codrl_mj.arrays.c_code",
    "CProgram": "codrl_mj.arrays.c_code",
    "check_family": "codrl_mj.arrays.family",
    "prepare_model": "codrl_mj.arrays.models",
    "SimulatorModel": "codrl_mj.arrays.models",
    "UnsupportedError": "codrl_mj.arrays.scalars",
    "write_motor": "codrl_mj.arrays.writers",
    "WrittenMotor": "codrl_mj.arrays.writers",
}
"""Public names -> their modules, which are imported on first use."""

__all__ = [*_PUBLIC]


def __getattr__(name: str) -> Any:  # a public name may be of any type
    """Import a public name on first use."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'codrl_mj.arrays' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted({*globals(), *__all__})
