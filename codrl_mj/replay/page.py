"""A replay as a part of a page, or as a page of its own; nothing in it asks anything of a server."""

import base64
import dataclasses
import html
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from codrl_mj.replay.camera import first_view
from codrl_mj.replay.motion import Motion
from codrl_mj.replay.shapes import TRIANGLES, mesh, thinned
from codrl_mj.runs.files import check_page, writing

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; connect-src blob:"
)
"""What the browser itself holds the page to: nothing is fetched."""


@dataclasses.dataclass(frozen=True)
class ReplayPart:
    """A replay to be put into a page."""

    fragment: str
    """HTML: where it is seen, and its data."""
    script: str
    """JavaScript that defines `setTime(seconds)`, which shows that instant; it needs `library` before it in the page.
    It sees `element`, which the fragment stands in, and `seek(seconds)`, which it never calls: it follows a clock."""
    library: str
    """JavaScript that all replays of a page share."""
    end: float
    """The last instant [s]."""


def replay(what: Motion, label: str) -> ReplayPart:
    """A replay.

    Args:
        what: the motion.
        label: what is seen, for those who do not see it.
    """
    data = json.dumps(_content(what)).replace("<", "\\u003c")
    fragment = (
        f"<style>{_text('replay.css')}</style>\n"
        f'<div class="replay"><canvas tabindex="0" role="img" aria-label="{html.escape(label)}: three-dimensional, '
        'drag to turn, wheel to zoom, right button to move; keys R: view from the beginning, F: follow"></canvas>\n'
        f'<p class="replay-none" hidden>This browser shows no WebGL, which a replay needs.</p>\n'
        '<div class="replay-view"><button type="button" data-do="reset" title="R">view</button>'
        '<button type="button" data-do="follow" title="F" aria-pressed="false">follow</button></div>\n'
        f'<script type="application/json">{data}</script></div>'
    )
    library = f"/* three.js\n{_text('three/LICENSE').strip()}\n*/\n{_text('three/three.min.js')}\n{_text('replay.js')}"
    return ReplayPart(fragment, "const setTime = codrlReplay(element);", library, float(what.time[-1]))


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
    part = replay(what, title)
    entries = {
        "TITLE": html.escape(title),
        "POLICY": _POLICY,
        "FRAGMENT": part.fragment,
        "LIBRARY": part.library,
        "SCRIPT": part.script,
        "END": f"{part.end:.6g}",
    }
    text = _text("page.html")
    before, *rest = text.split("{{")
    filled = before + "".join(entries[name] + after for name, after in (one.split("}}", 1) for one in rest))
    with writing(path) as temporary:
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
                **({"body": places[one.body]} if one.body in places else {"frame": _rounded(what.still[one.body])}),
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
        few, corners = thinned(vertices, triangles, max(32, int(TRIANGLES * len(triangles) / max(total, 1))))
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
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()  # little-endian, as browsers are


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.7g}") for value in values]
