"""The test suite; it mirrors the package."""

import codrl_mj  # noqa: F401 - before anything imports mujoco, so that it renders without a display
