"""The test suite; it mirrors the package."""

import os

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # threads of torch, waiting for CPUs that other tests have, take as much

import codrl_mj  # noqa: F401 - before anything imports mujoco, so that it renders without a display
