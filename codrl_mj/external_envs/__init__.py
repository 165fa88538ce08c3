"""Motors in environments of others: Gymnasium's, dm_control's, and whatever builds its model from XML."""

import importlib.metadata
import re

import mujoco

NEWEST_DM_CONTROL_WITHOUT_MUJOCO_4 = (1, 0, 50)
"""Newest version of dm_control, which reads fields that MuJoCo 4 removed (`MjModel.flex_vertedge`)."""


def check_dm_control() -> None:
    """Refuse a dm_control that cannot load a model with the installed MuJoCo.

    Without this check the first model ends in an AttributeError about a field of the engine.

    Raises:
        RuntimeError: MuJoCo is 4 or newer, and this dm_control needs 3; the message has the remedy.
        importlib.metadata.PackageNotFoundError: dm_control is not installed.
    """
    version = importlib.metadata.version("dm-control")
    numbers = tuple(int(number) for number in re.findall(r"\d+", version)[:3])
    if (
        int(mujoco.__version__.partition(".")[0]) >= 4
        and numbers <= NEWEST_DM_CONTROL_WITHOUT_MUJOCO_4
    ):
        raise RuntimeError(
            f"dm_control {version} does not work with MuJoCo {mujoco.__version__}: it needs MuJoCo"
            " 3. pip install 'codrl-mj[dm-control]' installs one that fits"
        )
