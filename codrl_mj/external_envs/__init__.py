"""Motors in third-party environments: Gymnasium's, dm_control's, and others with XML models."""

import importlib.metadata
import re

import mujoco

NEWEST_DM_CONTROL_WITHOUT_MUJOCO_4 = (1, 0, 50)
"""Newest known dm_control that needs MuJoCo 3: it reads `MjModel.flex_vertedge`."""


def check_dm_control() -> None:
    """Raise if dm_control cannot load a model with the installed MuJoCo.

    Without this check, loading the first model raises an AttributeError about a field of MuJoCo.

    Raises:
        RuntimeError: MuJoCo is 4 or newer, but this dm_control needs 3; the message has the remedy.
        importlib.metadata.PackageNotFoundError: dm_control is not installed.
    """
    version = importlib.metadata.version("dm-control")
    release = tuple(int(number) for number in re.findall(r"\d+", version)[:3])
    if (
        int(mujoco.__version__.partition(".")[0]) >= 4
        and release <= NEWEST_DM_CONTROL_WITHOUT_MUJOCO_4
    ):
        raise RuntimeError(
            f"dm_control {version} does not work with MuJoCo {mujoco.__version__}: it needs MuJoCo"
            " 3; pip install 'codrl-mj[dm-control]' installs versions that fit together"
        )
