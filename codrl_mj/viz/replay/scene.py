"""The scene of a model: geoms and sites as shapes, meshes, where its bodies are, and whence it is first seen."""

import dataclasses
from collections.abc import Collection
from typing import Any, NamedTuple

import mujoco
import numpy as np

_MUJOCO_ELEVATION, _ELEVATION = -45.0, -20.0
"""Of a free camera [degrees]: MuJoCo's, of models that say nothing, which looks down on a robot; ours for these."""
_GEOM = mujoco.mjtGeom
_NAMES = {
    int(_GEOM.mjGEOM_PLANE): "plane",
    int(_GEOM.mjGEOM_SPHERE): "ellipsoid",
    int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_HFIELD): "mesh",
    int(_GEOM.mjGEOM_MESH): "mesh",
    int(_GEOM.mjGEOM_SDF): "mesh",
}
_SHOWN_GROUPS = 3  # as in MuJoCo's viewers, the first of six
_UNPAINTED = (0.5, 0.5, 0.5, 1.0)
TRIANGLES = 60_000
"""That all meshes of a replay have at most, together."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A geom or a site."""

    kind: str
    """`plane`, `ellipsoid`, `capsule`, `cylinder`, `box` or `mesh`."""
    size: tuple[float, ...]
    """As MuJoCo has it: half sizes [m]."""
    colour: tuple[float, ...]
    """Red, green, blue, opacity, each from 0 to 1."""
    body: int
    """Whose it is."""
    position: np.ndarray
    """In its body's frame [m], shape (3,)."""
    orientation: np.ndarray
    """In its body's frame: quaternion w, x, y, z."""
    geom: int | None = None
    """Its index, of a geom."""
    mesh: tuple[str, int] | None = None
    """Of a mesh: `mesh` or `hfield`, and its index."""
    chequered: bool = False
    """Whether the model has a picture on it."""


def shapes(model: mujoco.MjModel) -> list[Shape]:
    """What MuJoCo's viewers show of a model by default: geoms and sites of groups 0 to 2 that are not transparent."""
    found = []
    for kind in ("geom", "site"):
        column = {
            name: getattr(model, f"{kind}_{name}")
            for name in ("type", "size", "rgba", "matid", "bodyid", "pos", "quat", "group")
        }
        for index in range(len(column["type"])):
            one = {name: values[index] for name, values in column.items()}
            colour, pictured = _colour(model, one["rgba"], int(one["matid"]))
            name = _NAMES.get(int(one["type"]))
            if name is None or colour[3] == 0.0 or one["group"] >= _SHOWN_GROUPS:
                continue
            size = (
                np.repeat(one["size"][:1], 3) if one["type"] == _GEOM.mjGEOM_SPHERE else one["size"]
            )
            mesh = None
            if name == "mesh":
                mesh = (
                    "hfield" if one["type"] == _GEOM.mjGEOM_HFIELD else "mesh",
                    int(model.geom_dataid[index]),
                )
            geom = index if kind == "geom" else None
            place = one["pos"].copy(), one["quat"].copy()
            found.append(
                Shape(
                    name,
                    tuple(size.tolist()),
                    colour,
                    int(one["bodyid"]),
                    *place,
                    geom,
                    mesh,
                    pictured,
                )
            )
    return found


def _colour(model: mujoco.MjModel, rgba: Any, material: int) -> tuple[tuple[float, ...], bool]:
    """A shape's colour, as MuJoCo chooses it, times the mean of its picture; and whether it has one."""
    own = np.array(rgba, dtype=float)
    if material < 0:
        return tuple(own.tolist()), False
    if tuple(own) == _UNPAINTED:
        own = np.array(model.mat_rgba[material], dtype=float)
    textures = [int(one) for one in model.mat_texid[material] if one >= 0]
    if textures:
        begin, channels = int(model.tex_adr[textures[0]]), int(model.tex_nchannel[textures[0]])
        count = int(model.tex_width[textures[0]] * model.tex_height[textures[0]])
        pixels = model.tex_data[begin : begin + count * channels].reshape(count, channels)
        own[:3] *= pixels[:, : min(channels, 3)].mean(axis=0) / 255
    return tuple(own.tolist()), bool(textures)


def mesh(model: mujoco.MjModel, kind: str, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m], shape (n, 3), and triangles, shape (m, 3), of a mesh or of a height field."""
    if kind == "hfield":
        rows, columns = int(model.hfield_nrow[index]), int(model.hfield_ncol[index])
        begin, (x, y, top, _) = int(model.hfield_adr[index]), model.hfield_size[index]
        heights = model.hfield_data[begin : begin + rows * columns] * top
        across, along = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        faces = np.concatenate(
            [
                np.stack([corner, corner + 1, corner + columns], 1),
                np.stack([corner + 1, corner + columns + 1, corner + columns], 1),
            ]
        )
        return np.stack([across.ravel(), along.ravel(), heights], 1), faces
    vertex, face = int(model.mesh_vertadr[index]), int(model.mesh_faceadr[index])
    return (
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[index]].copy(),
        model.mesh_face[face : face + model.mesh_facenum[index]].copy(),
    )


def thinned(
    vertices: np.ndarray, triangles: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of at most some number of triangles: vertices that share a cell of a grid become one, in their midst.

    (Rossignac and Borrel, Multi-resolution 3D approximations for rendering complex scenes, 1993.)
    """
    cells = 512
    while len(triangles) > most and cells > 2:
        low, span = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-12)
        grid = np.minimum((vertices - low) * (cells / span), cells - 1).astype(np.int64)
        _, places, counts = np.unique(
            grid @ [1, cells, cells**2], return_inverse=True, return_counts=True
        )
        middles = np.stack([np.bincount(places, column) / counts for column in vertices.T], axis=1)
        merged = places[triangles]
        whole = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
        if whole.sum() <= most:
            return middles, np.unique(merged[whole], axis=0)
        cells = int(cells / 1.25)
    return vertices, triangles


def read_poses(data: mujoco.MjData, seen: list[Shape], poses: np.ndarray) -> None:
    """Fill `poses` (positions and quaternions, shape (bodies, 7)) with where the bodies that are seen are.

    The kinematics are up to date. A body is where its first geom is, which may have been moved
    along a hill.
    """
    poses[:, :3], poses[:, 3:] = data.xpos, data.xquat
    first = {one.body: one for one in reversed(seen) if one.geom is not None and one.body != 0}
    for body, one in first.items():
        turned, back, back_turned = np.empty(4), np.empty(3), np.empty(4)
        mujoco.mju_mat2Quat(turned, data.geom_xmat[one.geom])
        mujoco.mju_negPose(back, back_turned, one.position, one.orientation)
        mujoco.mju_mulPose(
            poses[body, :3], poses[body, 3:], data.geom_xpos[one.geom], turned, back, back_turned
        )


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
    model: mujoco.MjModel,
    shapes: list[Shape],
    poses: np.ndarray,
    moving: Collection[int],
    camera: str | None,
) -> Viewpoint:
    """A named camera of the model; else MuJoCo's free one, near enough to the bodies that move.

    Poses are of all bodies, position and quaternion, shape (bodies, 7).
    """
    reaches = []
    for one in shapes:
        if one.geom is not None and one.body in moving:
            offset = np.empty(3)
            mujoco.mju_rotVecQuat(offset, one.position, poses[one.body, 3:])
            middle, radius = poses[one.body, :3] + offset, model.geom_rbound[one.geom]
            reaches += [middle - radius, middle + radius]
    centre, extent = np.array(model.stat.center), float(model.stat.extent)
    if reaches:  # the middle of what moves, and how far it reaches from there
        low, high = np.min(reaches, axis=0), np.max(reaches, axis=0)
        centre, extent = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
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
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    return Viewpoint(centre - 2.6 * extent * forward, centre, 45.0, extent)
