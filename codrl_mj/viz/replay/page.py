"""Motion of a model's bodies, and its replay on a page of its own or as a part of a page."""

import base64
import dataclasses
import html
import json
from collections.abc import Callable, Iterable
from pathlib import Path

import mujoco
import numpy as np

from codrl_mj.boundary import Json
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.runs.files import atomic_write, check_page
from codrl_mj.viz.replay.scene import (
    TRIANGLES,
    Shape,
    initial_view,
    read_mesh,
    read_poses,
    simplify_mesh,
    visible_shapes,
)
from codrl_mj.viz.scene import scene_of

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
    " blob:; connect-src blob:"
)
"""Content security policy, by which the browser itself forbids the page to fetch anything."""
SCRIPT = "const setTime = codrlReplay(element);"
"""JavaScript that defines `setTime(seconds)`, which shows that instant. The page must contain
`library_script` before it, and define `element`, the parent of the replay. The script follows a
clock but never moves it.
"""
_MAX_RATE = 30
"""Maximum number of stored instants per second, between which the viewer interpolates."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """Content of a replay."""

    model: mujoco.MjModel
    """The model."""
    shapes: list[Shape]
    """Visible shapes of the model."""
    time: np.ndarray
    """Instants [s], shape (T,)."""
    bodies: np.ndarray
    """Indices of the visible bodies that move, shape (n,)."""
    poses: np.ndarray
    """Poses of these bodies: position [m] and orientation (quaternion w, x, y, z), shape (T, n, 7),
    float32.
    """
    initial_poses: np.ndarray
    """Poses of all bodies at the first instant, shape (bodies, 7)."""
    camera: str | None = None
    """Camera of the initial view; None: MuJoCo's free camera."""


def motion(
    model: mujoco.MjModel,
    states: np.ndarray,
    time: np.ndarray,
    camera: str | None = None,
    show: Callable[[np.ndarray], mujoco.MjData] | None = None,
) -> Motion:
    """Return the motion of a model through a series of states.

    Args:
        model: the model.
        states: one state for each instant, as `show` takes it; by default rows that start with
            `qpos`.
        time: instants [s], increasing, shape (T,). The motion starts at the first one.
        camera: camera of the initial view.
        show: function that sets a simulation of the model to a state.

    Raises:
        ValueError: `states` and `time` do not match each other or the model, `time` does not
            increase, or the model has no such camera.
    """
    time = np.asarray(time, dtype=float)
    if len(states) != len(time) or not len(time):
        raise ValueError(
            f"states: there are {len(states)} for {len(time)} instants: must be one for each, and"
            " at least one"
        )
    if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise ValueError("time: must be finite, and ascend from each instant to the next")
    cameras = [model.camera(index).name for index in range(model.ncam)]
    if camera is not None and camera not in cameras:
        raise ValueError(
            f"camera = {camera!r}: the model's cameras are {', '.join(cameras) or 'none'}"
        )
    if show is None and np.shape(states)[-1] < model.nq:
        have = f"a row has {np.shape(states)[-1]} entries"
        raise ValueError(f"states: {have}: must begin with the model's {model.nq} of qpos")
    data = mujoco.MjData(model)

    def show_positions(state: np.ndarray) -> mujoco.MjData:
        data.qpos[:] = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        return data

    # Times start at zero, as the page's clock does.
    shapes, show, time = visible_shapes(model), show or show_positions, time - time[0]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    stride = max(1, int(1.0 / (_MAX_RATE * step) + 1e-9))
    # The last instant, and as many others as the maximum rate requires.
    indices = np.unique([*range(0, len(time), stride), len(time) - 1])
    poses = np.empty((len(indices), model.nbody, 7))
    for row, index in zip(poses, indices, strict=True):
        read_poses(show(states[index]), shapes, row)
    spread = np.ptp(poses, axis=0).max(axis=1)
    bodies = np.array(
        [body for body in sorted({shape.body for shape in shapes}) if spread[body] > 1e-9],
        dtype=int,
    )
    body_poses = poses[:, bodies]
    for previous, following in zip(body_poses[:-1, :, 3:], body_poses[1:, :, 3:], strict=True):
        # A quaternion and its negative are the same rotation. Equal signs avoid jumps in the
        # viewer's interpolation.
        following[(previous * following).sum(axis=1) < 0] *= -1
    return Motion(
        model, shapes, time[indices], bodies, body_poses.astype(np.float32), poses[0], camera
    )


def motion_of_episode(episode: Episode, env: EnvConfig) -> Motion:
    """Return the motion of an episode that `codrl_mj.evaluation.run_episodes` recorded.

    Args:
        episode: the episode.
        env: the `EnvConfig` that it was recorded in.
    """
    model, show, camera = scene_of(env)
    return motion(model, episode.state, np.concatenate([[0.0], episode.time]), camera, show)


def replay_html(content: Motion, label: str) -> str:
    """Return a replay as HTML with its data; `SCRIPT` runs it.

    Args:
        content: motion to show.
        label: description for readers who do not see it.
    """
    data = json.dumps(_content(content)).replace("<", "\\u003c")
    return (
        f"<style>{_read_text('replay.css')}</style>\n"
        f'<div class="replay"><canvas tabindex="0" role="img" aria-label="{html.escape(label)}:'
        " three-dimensional, "
        "drag to turn, wheel to zoom, right button to move; keys R: initial view, F:"
        ' follow"></canvas>\n'
        f'<p class="replay-none" hidden>This browser has no WebGL, which a replay needs.</p>\n'
        '<div class="replay-view"><button type="button" data-do="reset" title="R">view</button>'
        '<button type="button" data-do="follow" title="F"'
        ' aria-pressed="false">follow</button></div>\n'
        f'<script type="application/json">{data}</script></div>'
    )


def library_script() -> str:
    """Return the JavaScript that all replays of a page share."""
    return (
        f"/* three.js\n{_read_text('three/LICENSE').strip()}\n*/\n"
        f"{_read_text('three/three.min.js')}\n{_read_text('replay.js')}"
    )


def write_replay(content: Motion, path: Path, title: str) -> Path:
    """Write a page with a replay and controls for play, time and speed.

    Args:
        content: motion to show.
        path: the file.
        title: heading; text, not markup.

    Raises:
        ValueError: the suffix is not that of a page.
    """
    check_page(path)
    entries = {
        "TITLE": html.escape(title),
        "POLICY": _POLICY,
        "FRAGMENT": replay_html(content, title),
        "LIBRARY": library_script(),
        "SCRIPT": SCRIPT,
        "END": f"{content.time[-1]:.6g}",
    }
    text = _read_text("page.html")
    # Only fields of the template itself are filled: a title that contains {{SCRIPT}} stays as it
    # is.
    filled_start, *pieces = text.split("{{")
    filled = filled_start + "".join(
        entries[name] + after for name, after in (piece.split("}}", 1) for piece in pieces)
    )
    with atomic_write(path) as temporary:
        temporary.write_text(filled, encoding="utf-8")
    return path


def _read_text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _content(motion: Motion) -> dict[str, Json]:
    """Return the data that the viewer reads; large arrays are base64."""
    body_index = {int(body): index for index, body in enumerate(motion.bodies)}
    meshes = list(dict.fromkeys(shape.mesh for shape in motion.shapes if shape.mesh is not None))
    view = initial_view(
        motion.model,
        motion.shapes,
        motion.initial_poses,
        set(motion.bodies.tolist()),
        motion.camera,
    )
    return {
        "extent": view.extent,
        "camera": {"eye": _rounded(view.eye), "at": _rounded(view.target), "fovy": view.fovy},
        "time": _to_base64(motion.time.astype(np.float32)),
        "bodies": [motion.model.body(int(body)).name for body in motion.bodies],
        "poses": _to_base64(motion.poses),
        "meshes": _meshes(motion.model, meshes),
        "shapes": [
            {
                "kind": shape.kind,
                "size": _rounded(shape.size),
                "colour": _rounded(shape.colour),
                "at": _rounded([*shape.position, *shape.orientation]),
                "chequered": shape.chequered,
                **({"mesh": meshes.index(shape.mesh)} if shape.mesh is not None else {}),
                **(
                    {"body": body_index[shape.body]}
                    if shape.body in body_index
                    else {"frame": _rounded(motion.initial_poses[shape.body])}
                ),
            }
            for shape in motion.shapes
        ],
    }


def _meshes(model: mujoco.MjModel, mesh_ids: list[tuple[str, int]]) -> list[dict[str, Json]]:
    """Return the meshes, with vertices on a 16-bit grid over the extent of each."""
    meshes = [read_mesh(model, *mesh_id) for mesh_id in mesh_ids]
    total = sum(len(triangles) for _, triangles in meshes)
    entries = []
    for vertices, triangles in meshes:
        simple_vertices, corners = simplify_mesh(
            vertices, triangles, max(32, int(TRIANGLES * len(triangles) / max(total, 1)))
        )
        low = simple_vertices.min(axis=0)
        span = max(float(np.ptp(simple_vertices, axis=0).max()), 1e-12)
        grid = np.round((simple_vertices - low) / span * 65535).astype(np.uint16)
        index = corners.astype(np.uint16 if len(simple_vertices) < 65536 else np.uint32)
        entries.append(
            {
                "low": _rounded(low),
                "span": span,
                "vertices": _to_base64(grid),
                "triangles": _to_base64(index),
                "wide": index.dtype == np.uint32,
            }
        )
    return entries


def _to_base64(values: np.ndarray) -> str:
    # The arrays are little-endian, as typed arrays in browsers are.
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def _rounded(values: Iterable[float]) -> list[float]:
    return [float(f"{value:.7g}") for value in values]
