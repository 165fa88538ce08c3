"""A motion of a model's bodies, and its replay: a part of a page or a page of its own, which asks no server."""

import base64
import dataclasses
import html
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from codrl_mj.evaluation.episodes import Episode
from codrl_mj.runs.files import check_page, atomic_write
from codrl_mj.viz.replay.scene import (
    TRIANGLES,
    Shape,
    first_view,
    mesh,
    read_poses,
    shapes,
    thinned,
)

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
    " blob:; connect-src blob:"
)
"""What the browser itself holds the page to: nothing is fetched."""
SCRIPT = "const setTime = codrlReplay(element);"
"""JavaScript that defines `setTime(seconds)`, which shows that instant; it needs `library` before
it in the page, and sees `element`, which a replay stands in. It follows a clock, and moves none.
"""
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
        time: instants [s], ascending, shape (T,); the motion begins at the first.
        camera: of the model, from which it is first seen.
        show: brings a simulation of the model into a state.

    Raises:
        ValueError: `states` and `time` do not fit each other or the model, `time` does not ascend,
            or the model has no such camera.
    """
    time = np.asarray(time, dtype=float)
    if len(states) != len(time) or not len(time):
        raise ValueError(
            f"states: there are {len(states)} for {len(time)} instants: must be one for each, and"
            " some"
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

    def by_positions(state: np.ndarray) -> mujoco.MjData:
        data.qpos[:] = state[: model.nq]
        mujoco.mj_kinematics(model, data)
        return data

    seen, show, time = shapes(model), show or by_positions, time - time[0]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    stride = max(1, int(1.0 / (_MOST_PER_SECOND * step) + 1e-9))
    chosen = np.unique(
        [*range(0, len(time), stride), len(time) - 1]
    )  # the last, and as many others as are needed
    poses = np.empty((len(chosen), model.nbody, 7))
    for row, index in zip(poses, chosen, strict=True):
        read_poses(show(states[index]), seen, row)
    spread = np.ptp(poses, axis=0).max(axis=1)
    bodies = np.array(
        [body for body in sorted({one.body for one in seen}) if spread[body] > 1e-9], dtype=int
    )
    moved = poses[:, bodies]
    for before, after in zip(moved[:-1, :, 3:], moved[1:, :, 3:], strict=True):
        after[
            (before * after).sum(axis=1) < 0
        ] *= -1  # a quaternion and its negative are one turn: no jumps
    return Motion(model, seen, time[chosen], bodies, moved.astype(np.float32), poses[0], camera)


def motion_of_episode(episode: Episode, env: Any) -> Motion:
    """The motion of an episode that `codrl_mj.evaluation.run_episodes` recorded.

    Args:
        episode: the episode.
        env: the `EnvConfig` that it was recorded in.
    """
    model, show, camera = env.world.scene(env)
    return motion(model, episode.state, np.concatenate([[0.0], episode.time]), camera, show)


def replay(what: Motion, label: str) -> str:
    """HTML of a replay, where it is seen and its data, with a label for those who do not see it; `SCRIPT` runs it."""
    data = json.dumps(_content(what)).replace("<", "\\u003c")
    return (
        f"<style>{_text('replay.css')}</style>\n"
        f'<div class="replay"><canvas tabindex="0" role="img" aria-label="{html.escape(label)}:'
        " three-dimensional, "
        "drag to turn, wheel to zoom, right button to move; keys R: view from the beginning, F:"
        ' follow"></canvas>\n'
        f'<p class="replay-none" hidden>This browser shows no WebGL, which a replay needs.</p>\n'
        '<div class="replay-view"><button type="button" data-do="reset" title="R">view</button>'
        '<button type="button" data-do="follow" title="F"'
        ' aria-pressed="false">follow</button></div>\n'
        f'<script type="application/json">{data}</script></div>'
    )


def library() -> str:
    """JavaScript that all replays of a page share."""
    return f"/* three.js\n{_text('three/LICENSE').strip()}\n*/\n{_text('three/three.min.js')}\n{_text('replay.js')}"


def write_replay(what: Motion, path: Path, title: str) -> Path:
    """Write a page that holds a replay, with play, time and speed.

    Args:
        what: the motion.
        path: the file.
        title: its heading; text, not markup.

    Raises:
        ValueError: the suffix is none of a page.
    """
    check_page(path)
    entries = {
        "TITLE": html.escape(title),
        "POLICY": _POLICY,
        "FRAGMENT": replay(what, title),
        "LIBRARY": library(),
        "SCRIPT": SCRIPT,
        "END": f"{what.time[-1]:.6g}",
    }
    text = _text("page.html")
    before, *rest = text.split("{{")
    filled = before + "".join(
        entries[name] + after for name, after in (one.split("}}", 1) for one in rest)
    )
    with atomic_write(path) as temporary:
        temporary.write_text(filled, encoding="utf-8")
    return path


def _text(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")


def _content(what: Motion) -> dict[str, Any]:
    """What the viewer reads; numbers of which there are many as base64."""
    places = {int(body): place for place, body in enumerate(what.bodies)}
    used = list(dict.fromkeys(one.mesh for one in what.shapes if one.mesh is not None))
    view = first_view(what.model, what.shapes, what.still, set(what.bodies.tolist()), what.camera)
    return {
        "extent": view.extent,
        "camera": {"eye": _rounded(view.eye), "at": _rounded(view.at), "fovy": view.fovy},
        "time": _packed(what.time.astype(np.float32)),
        "bodies": [what.model.body(int(body)).name for body in what.bodies],
        "poses": _packed(what.poses),
        "meshes": _meshes(what.model, used),
        "shapes": [
            {
                "kind": one.kind,
                "size": _rounded(one.size),
                "colour": _rounded(one.colour),
                "at": _rounded([*one.position, *one.orientation]),
                "chequered": one.chequered,
                **({"mesh": used.index(one.mesh)} if one.mesh is not None else {}),
                **(
                    {"body": places[one.body]}
                    if one.body in places
                    else {"frame": _rounded(what.still[one.body])}
                ),
            }
            for one in what.shapes
        ],
    }


def _meshes(model: mujoco.MjModel, used: list[tuple[str, int]]) -> list[dict[str, Any]]:
    """Each on a grid of 16 bits over its own extent."""
    whole = [mesh(model, *one) for one in used]
    total = sum(len(triangles) for _, triangles in whole)
    made = []
    for vertices, triangles in whole:
        few, corners = thinned(
            vertices, triangles, max(32, int(TRIANGLES * len(triangles) / max(total, 1)))
        )
        low, span = few.min(axis=0), max(float(np.ptp(few, axis=0).max()), 1e-12)
        grid = np.round((few - low) / span * 65535).astype(np.uint16)
        index = corners.astype(np.uint16 if len(few) < 65536 else np.uint32)
        made.append(
            {
                "low": _rounded(low),
                "span": span,
                "vertices": _packed(grid),
                "triangles": _packed(index),
                "wide": index.dtype == np.uint32,
            }
        )
    return made


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(
        np.ascontiguousarray(values).tobytes()
    ).decode()  # little-endian, as browsers are


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.7g}") for value in values]
