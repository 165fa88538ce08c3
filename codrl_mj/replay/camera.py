"""Where a scene is first seen from."""

from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.replay.shapes import Shape

_MUJOCO_ELEVATION, _ELEVATION = -45.0, -20.0
"""Of a free camera [degrees]: MuJoCo's, of models that say nothing, which looks down on a robot; ours for these."""


class Viewpoint(NamedTuple):
    """A camera that looks at something."""

    eye: np.ndarray
    """Where it is [m]."""
    at: np.ndarray
    """What it looks at [m]."""
    fovy: float
    """Vertical field of view [degrees]."""
    extent: float
    """How far what moves reaches from its middle [m]."""


def first_view(
    model: mujoco.MjModel, shapes: list[Shape], poses: np.ndarray, moving: Collection[int], camera: str | None
) -> Viewpoint:
    """A named camera of the model; else MuJoCo's free one, near enough to the bodies that move.

    Poses are of all bodies, position and quaternion, shape (bodies, 7).
    """
    centre, extent = _reach(model, shapes, poses, moving)
    if camera is not None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        index = model.camera(camera).id
        eye, forward = data.cam_xpos[index].copy(), -data.cam_xmat[index].reshape(3, 3)[:, 2]
        ahead = max(float((centre - eye) @ forward), 0.5 * extent)
        return Viewpoint(eye, eye + ahead * forward, float(model.cam_fovy[index]), extent)
    free = model.vis.global_
    down = _ELEVATION if free.elevation == _MUJOCO_ELEVATION else free.elevation
    azimuth, elevation = np.radians([free.azimuth, down])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return Viewpoint(centre - 2.6 * extent * forward, centre, 45.0, extent)


def _reach(
    model: mujoco.MjModel, shapes: list[Shape], poses: np.ndarray, moving: Collection[int]
) -> tuple[np.ndarray, float]:
    """Middle of what moves [m], and how far it reaches from there; of all, if nothing moves."""
    reaches = []
    for one in shapes:
        if one.geom is not None and one.body in moving:
            offset = np.empty(3)
            mujoco.mju_rotVecQuat(offset, one.position, poses[one.body, 3:])
            middle, radius = poses[one.body, :3] + offset, model.geom_rbound[one.geom]
            reaches += [middle - radius, middle + radius]
    if not reaches:
        return np.array(model.stat.center), float(model.stat.extent)
    low, high = np.min(reaches, axis=0), np.max(reaches, axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2
