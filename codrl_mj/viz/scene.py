"""The view of an environment: its camera and image size, the model of its scene, state names."""

import contextlib
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv

from codrl_mj.boundary import Argument
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.physics.offscreen import check_view
from codrl_mj.user_code import asset_path

_UNITS = (
    (("m",) * 3 + ("1",) * 4, ("m/s",) * 3 + ("rad/s",) * 3),  # free
    (("1",) * 4, ("rad/s",) * 3),  # ball
    (("m",), ("m/s",)),  # slide
    (("rad",), ("rad/s",)),  # hinge
)
"""Units of the entries of `qpos` (with quaternions) and of `qvel`, by MuJoCo's type of joint."""


class Scene(NamedTuple):
    """Objects that show recorded states."""

    model: mujoco.MjModel
    """Model of the environment, with bounds and hills."""
    pose: Callable[[np.ndarray], mujoco.MjData] | None
    """Function that moves the bodies to a state; None if a state is `qpos` and `qvel`."""
    camera: str | None
    """Name of the default camera; None for the viewer's."""


def render_arguments(
    env: EnvConfig, width: int, height: int, camera: str | None
) -> dict[str, Argument] | None:
    """Return arguments of `EnvConfig.build` for images; None if recorded states are rendered.

    Args:
        env: the environment.
        width: width of the images [px].
        height: height of the images [px].
        camera: name of a camera; None for the default.

    Raises:
        ValueError: it has no such camera, or no choice of cameras.
    """
    task = env.source.task
    if task is not None:
        model = mujoco.MjModel.from_xml_path(str(asset_path(task.asset)))
        check_view(model, width, height, camera or "fixed")
        return None
    with contextlib.closing(env.build()) as opened_env:
        has_cameras = isinstance(opened_env.unwrapped, MujocoEnv)
    if has_cameras:
        camera_argument = {} if camera is None else {"camera_name": camera}
        return {"render_mode": "rgb_array", "width": width, "height": height, **camera_argument}
    if camera is not None:
        raise ValueError(
            f"camera = {camera!r}: {env.source.name} always renders with its own camera: leave it"
            " out"
        )
    return {"render_mode": "rgb_array"}


def scene_of(env: EnvConfig) -> Scene:
    """Return the scene of an environment."""
    if env.source.task is None:
        with contextlib.closing(env.build()) as opened_env:
            return Scene(opened_env.unwrapped.model, None, None)  # type: ignore[attr-defined]
    # Options may change the model, such as the lengths of a rig.
    options = env.source.non_default_options(env.options)
    task_env = ActuatedEnv(env.source.reference, "ideal", **options)

    def pose(state: np.ndarray) -> mujoco.MjData:
        task_env.physics.show(state)
        return task_env.data

    return Scene(task_env.model, pose, "fixed")


def state_names(env: EnvConfig) -> tuple[str, ...]:
    """Return names and units of the recorded states: a task's own, or those of all joints."""
    if env.source.task is not None:
        return env.source.task.state_names
    model = scene_of(env).model
    positions: list[str] = []
    speeds: list[str] = []
    for index, kind in enumerate(model.jnt_type.tolist()):
        joint = model.joint(index).name or f"joint {index}"
        for names, units in zip((positions, speeds), _UNITS[kind], strict=True):
            names += [
                f"{joint}{f' {k}' if len(units) > 1 else ''} [{unit}]"
                for k, unit in enumerate(units)
            ]
    return (*positions, *speeds)
