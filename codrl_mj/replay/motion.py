"""How the bodies of a model moved: poses over time, of what moved, at the instants that are needed."""

import dataclasses
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from codrl_mj.evaluation.episodes import Episode
from codrl_mj.replay.shapes import Shape, shapes

_MOST_PER_SECOND = 30
"""Instants; between them a viewer goes straight, and turns evenly."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """What a replay shows."""

    model: mujoco.MjModel
    """The model."""
    shapes: list[Shape]
    """What is seen of it."""
    time: np.ndarray
    """Instants [s], shape (T,)."""
    bodies: np.ndarray
    """Those that move and are seen, shape (n,)."""
    poses: np.ndarray
    """Of these: position [m] and orientation (quaternion w, x, y, z), shape (T, n, 7), float32."""
    still: np.ndarray
    """Of all bodies: the same at the first instant, shape (bodies, 7)."""
    camera: str | None = None
    """Of the model, from which it is first seen; None: MuJoCo's free camera."""


def motion(
    model: mujoco.MjModel,
    states: np.ndarray,
    time: np.ndarray,
    camera: str | None = None,
    show: Callable[[np.ndarray], mujoco.MjData] | None = None,
) -> Motion:
    """The motion of any model.

    Args:
        model: the model.
        states: one for each instant; what `show` takes, or else rows that begin with `qpos`.
        time: instants [s], ascending, shape (T,).
        camera: of the model, from which it is first seen.
        show: brings a simulation of the model into a state.

    Raises:
        ValueError: `states` and `time` do not fit each other or the model, or the model has no such camera.
    """
    if len(states) != len(time) or not len(time):
        raise ValueError(f"states: there are {len(states)} for {len(time)} instants: must be one for each, and some")
    cameras = [model.camera(index).name for index in range(model.ncam)]
    if camera is not None and camera not in cameras:
        raise ValueError(f"camera = {camera!r}: the model's cameras are {', '.join(cameras) or 'none'}")
    seen, show = shapes(model), show or _by_positions(model)
    chosen = _instants(np.asarray(time))
    poses = np.empty((len(chosen), model.nbody, 7))
    for row, index in zip(poses, chosen, strict=True):
        read_poses(show(states[index]), seen, row)
    spread = np.ptp(poses, axis=0).max(axis=1)
    bodies = np.array([body for body in sorted({one.body for one in seen}) if spread[body] > 1e-9], dtype=int)
    return Motion(model, seen, np.asarray(time)[chosen], bodies, _steady(poses[:, bodies]), poses[0], camera)


def motion_of_episode(episode: Episode, env: Any) -> Motion:
    """The motion of an episode that `codrl_mj.evaluation.run_episodes` recorded.

    Args:
        episode: the episode.
        env: the `EnvConfig` that it was recorded in.
    """
    model, show, camera = env.world.scene(env)
    return motion(model, episode.state, np.concatenate([[0.0], episode.time]), camera, show)


def _by_positions(model: mujoco.MjModel) -> Callable[[np.ndarray], mujoco.MjData]:
    data = mujoco.MjData(model)

    def show(state: np.ndarray) -> mujoco.MjData:
        if len(state) < model.nq:
            raise ValueError(f"states: a row has {len(state)} entries: must begin with the model's {model.nq} of qpos")
        data.qpos[:] = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        return data

    return show


def _instants(time: np.ndarray) -> np.ndarray:
    """Indices of the instants to keep: the first, the last, and of the others as many as are needed."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    stride = max(1, int(1.0 / (_MOST_PER_SECOND * step) + 1e-9))
    return np.unique([*range(0, len(time), stride), len(time) - 1])


def read_poses(data: mujoco.MjData, seen: list[Shape], poses: np.ndarray) -> None:
    """Fill `poses` (positions and quaternions, shape (bodies, 7)) with where the bodies that are seen are.

    The kinematics are up to date; where geoms were moved along a hill, the pose is that of one of the body's geoms.
    """
    poses[:, :3], poses[:, 3:] = data.xpos, data.xquat
    done = set()
    for shape in seen:
        if shape.geom is None or shape.body in done or shape.body == 0:
            continue
        done.add(shape.body)
        turned = np.empty(9)
        mujoco.mju_quat2Mat(turned, _product(data.xquat[shape.body], shape.orientation))
        place = data.xpos[shape.body] + data.xmat[shape.body].reshape(3, 3) @ shape.position
        if np.allclose(place, data.geom_xpos[shape.geom], atol=1e-9) and np.allclose(
            turned, data.geom_xmat[shape.geom], atol=1e-9
        ):
            continue
        at, back = np.empty(4), np.empty(4)
        mujoco.mju_mat2Quat(at, data.geom_xmat[shape.geom])
        mujoco.mju_negQuat(back, shape.orientation)
        body, offset = _product(at, back), np.empty(3)
        mujoco.mju_rotVecQuat(offset, shape.position, body)
        poses[shape.body] = *(data.geom_xpos[shape.geom] - offset), *body


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    result = np.empty(4)
    mujoco.mju_mulQuat(result, first, second)
    return result


def _steady(poses: np.ndarray) -> np.ndarray:
    """The same orientations without jumps between a quaternion and its negative, which are one turn."""
    for before, after in zip(poses[:-1, :, 3:], poses[1:, :, 3:], strict=True):
        after[(before * after).sum(axis=1) < 0] *= -1
    return poses.astype(np.float32)
